"""How good matches of image pairs of planar scenes are: the homographies estimated from them, against the ground truth.

The protocol is LoFTR's on HPatches (Sun et al., CVPR 2021, section 4), which HomoMatcher's tables follow.
"""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from hm_sfm.errors import InputError
from hm_sfm.evaluation.poses import pose_auc
from hm_sfm.geometry.frames import homography_from_pixel_index
from hm_sfm.matching.feature_cache import FeatureCache
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.photos.images import PreparedImage, prepare_image, read_ref
from hm_sfm.types import ImageRef, PatchMatches

CORNER_THRESHOLDS_PX = (3, 5, 10)
HOMOGRAPHY_ERROR_PX = 3.0
HPATCHES_SHORT_EDGE_PX = 480


def score_homographies(
    matcher: HomoMatcher,
    folder: Path,
    quiet: bool = False,
    observe: Callable[[Path, Path, np.ndarray, PatchMatches], None] | None = None,
) -> dict[str, float]:
    """Match the pairs of a folder in HPatches' layout and estimate the homographies between the images.

    folder: has a subfolder for each sequence, with images 1.* to 6.* and H_1_2 to H_1_6. Short edges become 480 px.
    observe: called with the two paths, the true homography (3, 3) between the stored images, and the matches of each
    pair. Returns the AUC of the mean corner error at 3, 5 and 10 px of the reduced image 1, in percent, and the mean
    number of matches. Raises InputError where the folder has another layout.
    """
    sequences = sorted(path.parent for path in Path(folder).glob("*/H_1_2"))
    if not sequences:
        raise InputError(f"{folder} is not a folder in HPatches' layout: it has no */H_1_2")
    errors, counts = [], []
    cache = FeatureCache(matcher, _prepare_short_edge)
    for sequence in tqdm(sequences, desc="homographies", unit="sequence", disable=quiet):
        ref0, *others = (read_ref(_find_image(sequence, number)) for number in range(1, 7))
        for number, ref1 in enumerate(others, start=2):
            matches = cache.match(ref0.path, ref1.path)
            true = homography_from_pixel_index(np.loadtxt(sequence / f"H_1_{number}"))
            if observe is not None:
                observe(ref0.path, ref1.path, true, matches)
            counts.append(len(matches))
            errors.append(_measure_corner_error(matches, true, ref0.size_wh, _measure_scale(ref1)))
    scores = {f"auc_{limit}px": area for limit, area in pose_auc(np.array(errors), CORNER_THRESHOLDS_PX).items()}
    return scores | {"mean_matches": float(np.mean(counts))}


def _find_image(sequence: Path, number: int) -> Path:
    path = next(iter(sorted(sequence.glob(f"{number}.*"))), None)
    if path is None:
        raise InputError(f"{sequence} lacks the image {number}.*")
    return path


def _prepare_short_edge(path: Path) -> PreparedImage:
    ref = read_ref(path)
    return prepare_image(ref, round(max(ref.size_wh) / _measure_scale(ref)))


def _measure_scale(ref: ImageRef) -> float:
    """Px of the stored image per px of the reduced one."""
    return max(1.0, min(ref.size_wh) / HPATCHES_SHORT_EDGE_PX)


def _measure_corner_error(matches: PatchMatches, true: np.ndarray, size_wh: tuple[int, int], px_scale1: float) -> float:
    """Mean distance of image 0's corners under the estimated and the true homography, px of the reduced image 1."""
    if len(matches) < 4:
        return np.inf
    xy0, xy1 = matches.xy0.astype(np.float64), matches.xy1.astype(np.float64)
    estimate, _ = cv2.findHomography(xy0, xy1, cv2.RANSAC, HOMOGRAPHY_ERROR_PX * px_scale1)
    if estimate is None:
        return np.inf
    width, height = size_wh
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], dtype=np.float64)
    mapped = [corners @ homography.T for homography in (estimate, true)]
    apart = mapped[0][:, :2] / mapped[0][:, 2:] - mapped[1][:, :2] / mapped[1][:, 2:]
    return float(np.linalg.norm(apart, axis=1).mean() / px_scale1)
