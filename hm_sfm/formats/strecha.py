"""Known cameras in the files of Strecha's multi-view data sets: one `<image name>.camera` file per photo.

Such a file holds K, a line of zeros, R (world from camera), C and the image size, so that x = K R^T (X - C). Its K
counts the centre of the top-left pixel as (0, 0); half a pixel is added on reading and taken off on writing.
"""

from pathlib import Path

import numpy as np

from hm_sfm.errors import InputError
from hm_sfm.io.atomic import replace_file
from hm_sfm.types import PinholeView


def read_strecha_cameras(folder: Path) -> dict[str, PinholeView]:
    """Read the `<image name>.camera` files of a folder, the layout of Strecha's multi-view data sets.

    Returns image name -> camera, sorted by name. The files hold K, a line of zeros, R (camera to world), C and the
    image size, so that x = K R^T (X - C). Their K counts the centre of the top-left pixel as (0, 0) and refers to
    the size they state, which photos that were resized since no longer have; K is returned in COLMAP's frame at the
    stated size. Raises InputError where the folder holds no such file, or one that is malformed.
    """
    paths = sorted(Path(folder).glob("*.camera"))
    if not paths:
        raise InputError(f"{folder} holds no ground truth: expected <image name>.camera files")
    return {path.name.removesuffix(".camera"): _read_strecha_camera(path) for path in paths}


def _read_strecha_camera(path: Path) -> PinholeView:
    try:
        values = np.array(path.read_text().split(), dtype=np.float64)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the ground truth {path}: {error}") from error
    if len(values) != 26 or not np.isfinite(values).all():
        raise InputError(f"{path} must hold 26 finite numbers (K, three zeros, R, C, width height)")
    k, rotation, center, size_wh = values[:9].reshape(3, 3), values[12:21].reshape(3, 3), values[21:24], values[24:]
    if not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise InputError(f"{path} must hold a rotation matrix in its lines 5 to 7")
    if (size_wh < 1).any():
        raise InputError(f"{path} must end with the width and height of the image")
    k[:2, 2] += 0.5
    cam_from_world = np.column_stack([rotation.T, -rotation.T @ center])
    return PinholeView(k, (int(size_wh[0]), int(size_wh[1])), cam_from_world)


def write_strecha_cameras(folder: Path, views: dict[str, PinholeView]) -> None:
    """Write what read_strecha_cameras reads: one `<image name>.camera` file per view. Creates the folder."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    for name, view in views.items():
        k = view.K.copy()
        k[:2, 2] -= 0.5
        rows = [*k, np.zeros(3), *view.cam_from_world[:, :3].T, view.center]
        lines = [" ".join(repr(float(value)) for value in row) for row in rows]
        with replace_file(Path(folder) / f"{name}.camera") as temporary:
            temporary.write_text("\n".join([*lines, f"{view.size_wh[0]} {view.size_wh[1]}"]) + "\n")
