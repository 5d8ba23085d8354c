"""How good a model is: its poses against the truth, as the field reports them (AUC of pose errors)."""

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap

from hm_sfm.errors import InputError
from hm_sfm.io.atomic import replace_file
from hm_sfm.types import PinholeView

AUC_THRESHOLDS_DEG = (0.25, 0.5, 1, 3, 5, 10, 20)


@dataclass(frozen=True)
class ModelScore:
    registered: int
    """Images of the truth that the model holds."""
    num_images: int
    """Images of the truth."""
    auc_percent: dict[float, float]
    """Threshold in degrees -> pose AUC over all pairs of the truth, see pose_auc."""
    median_rotation_deg: float
    """Over the pairs with both images registered; inf where there are none."""
    median_translation_deg: float
    """Angle between the true and the found direction of translation, over the same pairs."""


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


def compare_poses(reconstruction: pycolmap.Reconstruction, truth: dict[str, PinholeView]) -> np.ndarray:
    """Relative-pose errors of a model (of several, pass the largest), one per unordered pair of the truth's images.

    Returns (N * (N - 1) / 2,) float64 degrees, in the order of itertools.combinations(sorted(truth), 2): the larger
    of the error of the relative rotation and that of the direction of the relative translation, inf where an image
    of the pair is not registered. Two cameras at one place have no direction: there the rotation alone counts.
    Raises InputError where the truth has fewer than two cameras, or where the model has images but none of them has
    a ground truth.
    """
    return np.maximum(*_measure_relative_errors(reconstruction, truth))


def pose_auc(errors_deg: np.ndarray, thresholds: tuple[float, ...] = AUC_THRESHOLDS_DEG) -> dict[float, float]:
    """Area under the curve of recall against error, up to each threshold and divided by it, in percent.

    `errors_deg`: (N,) degrees, N >= 1, in any order; an infinite error is a pair that was missed. The curve goes
    straight from one error to the next and starts at (0, 0), as in SuperGlue's and LoFTR's evaluations. Raises
    ValueError on no errors, and on errors that are negative or not a number.
    """
    errors = np.sort(np.asarray(errors_deg, dtype=np.float64))
    if len(errors) == 0 or not (errors >= 0).all():
        raise ValueError(f"errors_deg must hold at least one number and none below zero, got {errors_deg}")
    errors = np.concatenate([[0.0], errors])
    recall = np.linspace(0.0, 1.0, len(errors))
    areas = {}
    for threshold in thresholds:
        below = np.searchsorted(errors, threshold)
        x = np.append(errors[:below], threshold)
        y = np.append(recall[:below], recall[below - 1])
        areas[threshold] = float(np.trapezoid(y, x) / threshold * 100)
    return areas


def score_model(reconstruction: pycolmap.Reconstruction, truth: dict[str, PinholeView]) -> ModelScore:
    """The figures of a model (of several, pass the largest) against the truth. Raises what compare_poses raises."""
    rotation_deg, translation_deg = _measure_relative_errors(reconstruction, truth)
    found = np.isfinite(rotation_deg)
    return ModelScore(
        registered=len(_registered_poses(reconstruction).keys() & truth.keys()),
        num_images=len(truth),
        auc_percent=pose_auc(np.maximum(rotation_deg, translation_deg)),
        median_rotation_deg=float(np.median(rotation_deg[found])) if found.any() else np.inf,
        median_translation_deg=float(np.median(translation_deg[found])) if found.any() else np.inf,
    )


def measure_position_error(reconstruction: pycolmap.Reconstruction, truth: dict[str, PinholeView]) -> float:
    """RMS distance of the registered cameras from their true places, after the best similarity transform.

    The result is relative to the scene's extent, the largest distance between two true cameras: 0.01 is 1 % of it.
    Returns inf where fewer than three cameras are registered: any two would fit.
    """
    poses = _registered_poses(reconstruction)
    names = sorted(poses.keys() & truth.keys())
    if len(names) < 3:
        return np.inf
    found = np.array([-poses[name][:, :3].T @ poses[name][:, 3] for name in names])
    true = np.array([truth[name].center for name in names])
    residuals = _fit_similarity(found, true) - true
    everywhere = np.array([view.center for view in truth.values()])
    extent = np.linalg.norm(everywhere[:, None] - everywhere[None], axis=2).max()
    return float(np.sqrt((residuals**2).sum(axis=1).mean()) / extent)


def _fit_similarity(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """`source` (N, 3) carried onto `target` (N, 3) by the least-squares similarity transform (Umeyama 1991).

    pycolmap.estimate_sim3d gives up where the points lie in a plane, as cameras at one height do.
    """
    source = source - source.mean(axis=0)
    centered = target - target.mean(axis=0)
    left, singular, right = np.linalg.svd(centered.T @ source)
    sign = np.array([1, 1, np.linalg.det(left) * np.linalg.det(right)])
    spread = (source**2).sum()
    scale = (singular * sign).sum() / spread if spread > 0 else 0.0
    return scale * source @ ((left * sign) @ right).T + target.mean(axis=0)


def _registered_poses(reconstruction: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    images = (reconstruction.image(image_id) for image_id in reconstruction.reg_image_ids())
    return {image.name: image.cam_from_world().matrix() for image in images}


def _measure_relative_errors(
    reconstruction: pycolmap.Reconstruction, truth: dict[str, PinholeView]
) -> tuple[np.ndarray, np.ndarray]:
    if len(truth) < 2:
        raise InputError(f"comparing poses needs the ground truth of at least two images, found {len(truth)}")
    poses = _registered_poses(reconstruction)
    if poses and not poses.keys() & truth.keys():
        raise InputError(
            f"no image of the model has a ground truth: the model has {min(poses)!r}, the truth {min(truth)!r}"
        )
    errors = []
    for name0, name1 in combinations(sorted(truth), 2):
        if name0 not in poses or name1 not in poses:
            errors.append((np.inf, np.inf))
            continue
        found = relative_pose(poses[name0], poses[name1])
        true = relative_pose(truth[name0].cam_from_world, truth[name1].cam_from_world)
        errors.append((measure_rotation_deg(found[:, :3], true[:, :3]), measure_angle_deg(found[:, 3], true[:, 3])))
    rotation_deg, translation_deg = np.array(errors).T
    return rotation_deg, translation_deg


def relative_pose(cam0_from_world: np.ndarray, cam1_from_world: np.ndarray) -> np.ndarray:
    """(3, 4): cam1_from_cam0."""
    rotation = cam1_from_world[:, :3] @ cam0_from_world[:, :3].T
    return np.column_stack([rotation, cam1_from_world[:, 3] - rotation @ cam0_from_world[:, 3]])


def measure_rotation_deg(found: np.ndarray, true: np.ndarray) -> float:
    """Angle in degrees of the rotation between two rotation matrices (3, 3)."""
    # The chord, unlike the trace, keeps its precision at small angles.
    chord = np.linalg.norm(found - true) / np.sqrt(8)
    return float(np.degrees(2 * np.arcsin(min(chord, 1.0))))


def measure_angle_deg(found: np.ndarray, true: np.ndarray) -> float:
    """Angle in degrees between two directions (3,); 0 where there is no true one, 180 where none was found."""
    if not true.any():
        return 0.0
    if not found.any():
        return 180.0
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(found, true)), found @ true)))
