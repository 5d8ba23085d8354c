"""How good the poses of a model are: their errors against the ground truth, reported as AUC as the field does."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pycolmap

from hm_sfm.errors import InputError
from hm_sfm.types import PinholeView

AUC_THRESHOLDS_DEG = (0.25, 0.5, 1, 3, 5, 10, 20)


@dataclass(frozen=True)
class ModelScore:
    registered: int
    """Images with a ground truth that the model has registered."""
    num_images: int
    """Images with a ground truth."""
    auc_percent: dict[float, float]
    """Threshold in degrees -> pose AUC over all pairs of images with a ground truth, see pose_auc."""
    median_rotation_deg: float
    """Over the pairs with both images registered; inf where there are none."""
    median_translation_deg: float
    """Angle between the true and the estimated direction of translation, over the same pairs."""


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


def score_model(reconstruction: pycolmap.Reconstruction, ground_truth: dict[str, PinholeView]) -> ModelScore:
    """Score a model (of several, the largest) against the ground truth. Raises what measure_relative_errors raises."""
    rotation_deg, translation_deg = measure_relative_errors(reconstruction, ground_truth)
    registered = np.isfinite(rotation_deg)
    return ModelScore(
        registered=len(_registered_poses(reconstruction).keys() & ground_truth.keys()),
        num_images=len(ground_truth),
        auc_percent=pose_auc(np.maximum(rotation_deg, translation_deg)),
        median_rotation_deg=float(np.median(rotation_deg[registered])) if registered.any() else np.inf,
        median_translation_deg=float(np.median(translation_deg[registered])) if registered.any() else np.inf,
    )


def measure_position_error(reconstruction: pycolmap.Reconstruction, ground_truth: dict[str, PinholeView]) -> float:
    """RMS distance of the registered cameras from their true positions, after the best similarity transform.

    The result is relative to the scene's extent, the largest distance between two true cameras: 0.01 is 1 % of it.
    Returns inf where fewer than three cameras are registered: any two would fit.
    """
    poses = _registered_poses(reconstruction)
    names = sorted(poses.keys() & ground_truth.keys())
    if len(names) < 3:
        return np.inf
    estimated = np.array([-poses[name][:, :3].T @ poses[name][:, 3] for name in names])
    true = np.array([ground_truth[name].center for name in names])
    residuals = _fit_similarity(estimated, true) - true
    everywhere = np.array([view.center for view in ground_truth.values()])
    extent = np.linalg.norm(everywhere[:, None] - everywhere[None], axis=2).max()
    return float(np.sqrt((residuals**2).sum(axis=1).mean()) / extent)


def _fit_similarity(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """`source` (N, 3) moved onto `target` (N, 3) by the least-squares similarity transform (Umeyama 1991).

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


def measure_relative_errors(
    reconstruction: pycolmap.Reconstruction, ground_truth: dict[str, PinholeView]
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the relative rotations and of the directions of the relative translations of a model.

    Returns two arrays (N * (N - 1) / 2,) float64 degrees, one entry per unordered pair of images with a ground truth,
    in the order of itertools.combinations(sorted(ground_truth), 2); inf where an image of the pair is not registered.
    Two cameras at one place have no direction: their translation error is 0. Raises InputError where fewer than two
    images have a ground truth, or where the model has images but none of them has a ground truth.
    """
    if len(ground_truth) < 2:
        raise InputError(f"comparing poses needs the ground truth of at least two images, found {len(ground_truth)}")
    poses = _registered_poses(reconstruction)
    if poses and not poses.keys() & ground_truth.keys():
        raise InputError(
            f"no image of the model has a ground truth: the model has {min(poses)!r}, the ground truth "
            f"{min(ground_truth)!r}"
        )
    errors = []
    for name0, name1 in combinations(sorted(ground_truth), 2):
        if name0 not in poses or name1 not in poses:
            errors.append((np.inf, np.inf))
            continue
        estimate = relative_pose(poses[name0], poses[name1])
        true = relative_pose(ground_truth[name0].cam_from_world, ground_truth[name1].cam_from_world)
        errors.append(
            (measure_rotation_deg(estimate[:, :3], true[:, :3]), measure_angle_deg(estimate[:, 3], true[:, 3]))
        )
    rotation_deg, translation_deg = np.array(errors).T
    return rotation_deg, translation_deg


def relative_pose(cam0_from_world: np.ndarray, cam1_from_world: np.ndarray) -> np.ndarray:
    """(3, 4): cam1_from_cam0."""
    rotation = cam1_from_world[:, :3] @ cam0_from_world[:, :3].T
    return np.column_stack([rotation, cam1_from_world[:, 3] - rotation @ cam0_from_world[:, 3]])


def measure_rotation_deg(estimate: np.ndarray, true: np.ndarray) -> float:
    """Angle in degrees of the rotation between two rotation matrices (3, 3)."""
    # The chord, unlike the trace, keeps its precision at small angles.
    chord = np.linalg.norm(estimate - true) / np.sqrt(8)
    return float(np.degrees(2 * np.arcsin(min(chord, 1.0))))


def measure_angle_deg(estimate: np.ndarray, true: np.ndarray) -> float:
    """Angle in degrees between two directions (3,); 0 where the true one is zero, 180 where only the estimate is."""
    if not true.any():
        return 0.0
    if not estimate.any():
        return 180.0
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(estimate, true)), estimate @ true)))
