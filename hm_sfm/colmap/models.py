"""COLMAP models that exist already: read from disk, and as the source of known cameras and poses."""

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

from hm_sfm.errors import InputError
from hm_sfm.io.colmap_log import quiet_colmap
from hm_sfm.keypoints.tracks import build_tracks
from hm_sfm.types import ImageRef, Tracks

ENDINGS = (".bin", ".txt")
REQUIRED = ("cameras", "images")
OPTIONAL = ("rigs", "frames", "points3D")
NO_POINTS = {".bin": bytes(8), ".txt": b""}
"""A points3D file without points: people who know their cameras often have none."""


def read_model(path: Path) -> pycolmap.Reconstruction:
    """Read a COLMAP model, binary or text. path: its folder, or its file cameras.bin or cameras.txt.

    The file of points may be missing. Raises InputError where there is no such model or it is damaged.
    """
    path = Path(path)
    if path.is_file() and path.name in {f"cameras{ending}" for ending in ENDINGS}:
        folder, endings = path.parent, (path.suffix,)
    else:
        folder, endings = path, ENDINGS
    if not folder.is_dir():
        reason = "is neither a folder nor named cameras.txt or cameras.bin" if folder.exists() else "does not exist"
        raise InputError(f"the COLMAP model {path} {reason}")
    for ending in endings:
        if all((folder / f"{part}{ending}").is_file() for part in REQUIRED):
            return _read_files(folder, ending)
    names = " and ".join(f"{part}{endings[-1]}" for part in REQUIRED)
    raise InputError(f"{folder} holds no COLMAP model: it lacks {names}")


def _read_files(folder: Path, ending: str) -> pycolmap.Reconstruction:
    # Only the files of one ending: of two kinds in one folder, pycolmap would choose for itself.
    with tempfile.TemporaryDirectory(prefix="hm_sfm.") as temporary:
        for part in (*REQUIRED, *OPTIONAL):
            file = folder / f"{part}{ending}"
            if file.is_file():
                shutil.copy(file, temporary)
        points = Path(temporary) / f"points3D{ending}"
        if not points.exists():
            points.write_bytes(NO_POINTS[ending])
        model = pycolmap.Reconstruction()
        try:
            with quiet_colmap(pycolmap.logging.FATAL):
                (model.read_binary if ending == ".bin" else model.read_text)(temporary)
        except (ValueError, RuntimeError, IndexError, MemoryError) as error:
            reason = " ".join(str(error).replace(temporary, str(folder)).split())
            raise InputError(f"the COLMAP model {folder} is damaged ({reason})") from error
    return model


def find_known(path: Path, images: Sequence[ImageRef]) -> tuple[list[pycolmap.Camera], list[pycolmap.Rigid3d]]:
    """The camera (with its id in the model) and the pose, cam_from_world, of each photo, by name in a model.

    Raises InputError where the model lacks photos, or has one with a camera of another size.
    """
    model = read_model(path)
    by_name = {image.name: image for image in model.images.values()}
    missing = [image.name for image in images if image.name not in by_name]
    if missing:
        # A text file with a name with spaces looks as if it held the first word only.
        spaced = any(" " in name for name in missing)
        hint = " (COLMAP cannot read names with spaces from text files)" if spaced else ""
        raise InputError(
            f"the COLMAP model {path} lacks {len(missing)} of {len(images)} photos, for example "
            f"{', '.join(map(repr, missing[:3]))}{hint}; it has {len(by_name)}, such as {min(by_name, default='')!r}"
        )
    cameras, poses = [], []
    for image in images:
        known = by_name[image.name]
        camera = model.cameras[known.camera_id]
        if (camera.width, camera.height) != tuple(image.size_wh):
            raise InputError(
                f"the camera of {image.name!r} in the COLMAP model {path} is of {camera.width} x {camera.height} px, "
                f"the photo is {image.size_wh[0]} x {image.size_wh[1]} px"
            )
        cameras.append(pycolmap.Camera(camera.todict()))
        poses.append(known.cam_from_world())
    return cameras, poses


def list_observations(model: pycolmap.Reconstruction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the images of a model see: (O,) int64 each, the id of the point, the image and the index of the keypoint.

    Images are numbered in the order of their ids, which is also the order of the observations; within an image they go
    by the ids of the points. Where an image observes a point twice, the first observation counts.
    """
    rows = [np.zeros((3, 0), np.int64)]
    for number, image_id in enumerate(sorted(model.reg_image_ids())):
        image = model.image(image_id)
        point = np.array([seen.point3D_id for seen in image.get_observation_points2D()], np.int64)
        keypoint = np.array(image.get_observation_point2D_idxs(), np.int64)
        point, first = np.unique(point, return_index=True)
        rows.append(np.stack([point, np.full(len(point), number), keypoint[first]]))
    point, number, keypoint = np.concatenate(rows, axis=1)
    return point, number, keypoint


def read_tracks(model: pycolmap.Reconstruction) -> Tracks:
    """The tracks of a model's points, in the order of their ids; images are numbered in the order of their ids."""
    return build_tracks(*list_observations(model))
