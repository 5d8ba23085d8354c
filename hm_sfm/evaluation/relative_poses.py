"""How good matches of single pairs are: the relative poses estimated from them, against the ground truth.

The protocol is LoFTR's (Sun et al., CVPR 2021, section 4), which HomoMatcher's tables follow.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import pycolmap
from tqdm import tqdm

from hm_sfm.errors import InputError
from hm_sfm.evaluation.poses import measure_angle_deg, measure_rotation_deg, pose_auc, relative_pose
from hm_sfm.formats.strecha import read_strecha_cameras
from hm_sfm.matching.feature_cache import FeatureCache
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.photos.images import PreparedImage, prepare_image, read_ref
from hm_sfm.types import PatchMatches, freeze_array

POSE_THRESHOLDS_DEG = (5, 10, 20)
ESSENTIAL_ERROR_PX = 0.5


@dataclass(frozen=True)
class PosePair:
    """Two photos with known cameras."""

    path0: Path
    path1: Path
    k0: np.ndarray
    k1: np.ndarray
    """(3, 3), px of the stored images, COLMAP's frame."""
    cam1_from_cam0: np.ndarray
    """(3, 4)."""


@dataclass(frozen=True)
class PointMatches:
    """Matches of two images as points only: what any matcher gives."""

    xy0: np.ndarray
    """(M, 2) float32 px of stored image 0, COLMAP's frame."""
    xy1: np.ndarray
    """(M, 2) float32 px of stored image 1."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "xy0", freeze_array(self.xy0, np.float32, (None, 2), "xy0"))
        object.__setattr__(self, "xy1", freeze_array(self.xy1, np.float32, (len(self.xy0), 2), "xy1"))

    def __len__(self) -> int:
        return len(self.xy0)


Matches = TypeVar("Matches", bound=PatchMatches | PointMatches)


def read_strecha_pairs(scene: Path) -> list[PosePair]:
    """All pairs of a scene in Strecha's layout: images/, gt_dense_cameras/ and K.txt (for the images there).

    Raises InputError where a part is missing or malformed.
    """
    scene = Path(scene)
    ground_truth = read_strecha_cameras(scene / "gt_dense_cameras")
    try:
        k = np.loadtxt(scene / "K.txt").reshape(3, 3)
    except (OSError, ValueError) as error:
        raise InputError(f"{scene / 'K.txt'} must hold the 3 x 3 intrinsics of the images ({error})") from error
    return [
        PosePair(
            scene / "images" / name0,
            scene / "images" / name1,
            k,
            k,
            relative_pose(ground_truth[name0].cam_from_world, ground_truth[name1].cam_from_world),
        )
        for name0, name1 in combinations(sorted(ground_truth), 2)
    ]


def read_superglue_pairs(path: Path, image_folder: Path) -> list[PosePair]:
    """Pairs in SuperGlue's pairs_with_gt format.

    A line holds two names, two EXIF rotations, K0, K1 and cam1_from_cam0. Their K counts the centre of the top-left
    pixel as (0, 0). Raises InputError on a malformed line.
    """
    try:
        lines = Path(path).read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the pairs file {path}: {error}") from error
    pairs = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words:
            continue
        try:
            values = np.array(words[4:], dtype=np.float64)
        except ValueError:
            values = np.zeros(0)
        if len(values) != 34:
            raise InputError(f"{path}, line {number}: expected 2 names and 36 numbers, found {len(words)} words")
        k0, k1, pose = values[:9].reshape(3, 3), values[9:18].reshape(3, 3), values[18:].reshape(4, 4)
        k0[:2, 2] += 0.5
        k1[:2, 2] += 0.5
        folder = Path(image_folder)
        pairs.append(PosePair(folder / words[0], folder / words[1], k0, k1, pose[:3]))
    if not pairs:
        raise InputError(f"{path} holds no pair")
    return pairs


def score_poses(
    matcher: HomoMatcher,
    pairs: Sequence[PosePair],
    quiet: bool = False,
    observe: Callable[[PosePair, PatchMatches], None] | None = None,
) -> dict[str, float]:
    """score_pose_matches of the matches that a reconstruction would use."""

    def prepare(path: Path) -> PreparedImage:
        return prepare_image(read_ref(path), matcher.images.long_edge_px)

    return score_pose_matches(FeatureCache(matcher, prepare).match, pairs, quiet, observe)


def score_pose_matches(
    match: Callable[[Path, Path], Matches],
    pairs: Sequence[PosePair],
    quiet: bool = False,
    observe: Callable[[PosePair, Matches], None] | None = None,
) -> dict[str, float]:
    """Match the pairs and estimate their relative poses, by OpenCV's RANSAC as LoFTR does and by COLMAP's LO-RANSAC.

    match: two photos -> their matches, px of the stored images; observe: called with each pair and its matches.
    Returns, by name: the AUC of pose errors (the larger of rotation and translation direction; the latter up to its
    sign, as in LoFTR) at 5, 10 and 20 degrees in percent for both, and the mean number of matches.
    """
    errors: dict[str, list[float]] = {"opencv": [], "colmap": []}
    counts = []
    for pair in tqdm(pairs, desc="poses", unit="pair", disable=quiet):
        matches = match(pair.path0, pair.path1)
        if observe is not None:
            observe(pair, matches)
        counts.append(len(matches))
        for name, estimate in (("opencv", estimate_pose_opencv), ("colmap", estimate_pose_colmap)):
            errors[name].append(measure_pose_error(estimate(matches, pair.k0, pair.k1), pair.cam1_from_cam0))
    scores = {
        f"{name}_auc_{threshold}deg": area
        for name, values in errors.items()
        for threshold, area in pose_auc(np.array(values), POSE_THRESHOLDS_DEG).items()
    }
    return scores | {"mean_matches": float(np.mean(counts))}


def estimate_pose_opencv(matches: PatchMatches | PointMatches, k0: np.ndarray, k1: np.ndarray) -> np.ndarray | None:
    """cam1_from_cam0 (3, 4), translation of unit length, as LoFTR estimates it; None where it fails."""
    if len(matches) < 5:
        return None
    ray0, ray1 = (((xy - k[:2, 2]) / k[[0, 1], [0, 1]]) for xy, k in ((matches.xy0, k0), (matches.xy1, k1)))
    limit = ESSENTIAL_ERROR_PX / np.mean([k0[0, 0], k0[1, 1], k1[0, 0], k1[1, 1]])
    essential, inliers = cv2.findEssentialMat(
        ray0, ray1, np.eye(3), method=cv2.RANSAC, prob=0.99999, threshold=float(limit)
    )
    if essential is None:
        return None
    # Several solutions come stacked: the one with the most points in front of both cameras is taken.
    solutions = [
        cv2.recoverPose(e, ray0, ray1, np.eye(3), 1e9, mask=inliers.copy())
        for e in np.split(essential, len(essential) // 3)
    ]
    best = max(solutions, key=lambda solution: solution[0])
    return np.column_stack([best[1], best[2]])


def estimate_pose_colmap(
    matches: PatchMatches | PointMatches, k0: np.ndarray, k1: np.ndarray, max_error_px: float = ESSENTIAL_ERROR_PX
) -> np.ndarray | None:
    """cam1_from_cam0 (3, 4), translation of unit length, by COLMAP's LO-RANSAC; None where it fails."""
    if len(matches) < 5:
        return None
    # The size of the image plays no part in the estimate.
    camera0, camera1 = (
        pycolmap.Camera(model="PINHOLE", width=1, height=1, params=[k[0, 0], k[1, 1], k[0, 2], k[1, 2]])
        for k in (k0, k1)
    )
    options = pycolmap.RANSACOptions(max_error=max_error_px, random_seed=0)
    xy0, xy1 = matches.xy0.astype(np.float64), matches.xy1.astype(np.float64)
    estimate = pycolmap.estimate_essential_matrix(xy0, xy1, camera0, camera1, options)
    return None if estimate is None else estimate["cam2_from_cam1"].matrix()


def measure_pose_error(estimate: np.ndarray | None, true: np.ndarray) -> float:
    """Degrees: the larger of rotation error and translation-direction error up to its sign; inf for no pose."""
    if estimate is None:
        return np.inf
    direction_deg = measure_angle_deg(estimate[:, 3], true[:, 3])
    return max(measure_rotation_deg(estimate[:, :3], true[:, :3]), min(direction_deg, 180 - direction_deg))
