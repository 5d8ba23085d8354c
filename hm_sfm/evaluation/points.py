"""How far off matches are, point by point: end-point errors against the exact geometry of the validation pairs."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from hm_sfm.geometry.homographies import apply_homographies
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.types import PatchMatches, TrainingPairs

ERROR_LIMITS_PX = (1, 3, 5)
CORRECT_LIMITS_PX = (3, 1)
"""A match whose centre is nearer than this to the ground truth is correct."""
PATCH_POINTS = np.stack(np.meshgrid(np.arange(-4, 5), np.arange(-4, 5)), axis=-1).reshape(-1, 2)
"""(81, 2) px around a patch's centre: what the paper's r_e = 2 cells of the 1/2 grid hold."""
CELL_PX = 8


@dataclass(frozen=True)
class MatchErrors:
    """The M matches of a pair against the ground truth; an error is NaN where image 1 does not show the true point."""

    score: np.ndarray
    """(M,) float32, as in PatchMatches."""
    centre_px: np.ndarray
    """(M,) float64: of the patch centres."""
    points_px: np.ndarray
    """(M, 81) float64: of the points of the patches, each mapped by the homography of its match."""
    cell: np.ndarray
    """(M,) int64: which of the 8 x 8 px cells of image 0 holds the patch centre, counted row by row."""
    visible: np.ndarray
    """(cells,) bool: whether image 1 shows what is at the middle of a cell."""


def measure_matches(matches: PatchMatches, b_from_a: np.ndarray, surface: np.ndarray) -> MatchErrors:
    """Compare the matches of a training pair with its ground truth.

    b_from_a: (N, 3, 3) px of image 0 -> px of image 1 over each surface; surface: (H, W) int64, the surface at each
    pixel of image 0, -1 where image 1 does not show it.
    """
    height, width = surface.shape
    xy0 = matches.xy0.astype(np.float64)
    points = (xy0[:, None] + PATCH_POINTS).reshape(-1, 2)
    mapped = apply_homographies(np.repeat(matches.homography, len(PATCH_POINTS), axis=0), points)
    middle = slice(CELL_PX // 2, None, CELL_PX)
    columns = len(range(width)[middle])
    # The last cells of a row or column may be narrower than half a cell: their matches belong to the one before.
    column = np.minimum(xy0[:, 0] // CELL_PX, columns - 1)
    row = np.minimum(xy0[:, 1] // CELL_PX, len(range(height)[middle]) - 1)
    return MatchErrors(
        score=matches.score,
        centre_px=measure_points(xy0, matches.xy1, b_from_a, surface),
        points_px=measure_points(points, mapped, b_from_a, surface).reshape(-1, len(PATCH_POINTS)),
        cell=(row * columns + column).astype(np.int64),
        visible=(surface[middle, middle] >= 0).ravel(),
    )


def measure_points(xy0: np.ndarray, xy1: np.ndarray, b_from_a: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """Distances (N,) float64 px of xy1 (N, 2) from where xy0 (N, 2) truly is in image 1; NaN where that is not shown.

    The surface at a point is that of its pixel's centre.
    """
    height, width = surface.shape
    column, row = np.floor(xy0).astype(np.int64).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    index = np.where(inside, surface[row.clip(0, height - 1), column.clip(0, width - 1)], -1)
    shown = index >= 0
    error = np.full(len(xy0), np.nan)
    homography = b_from_a[index[shown]].astype(np.float64)
    true = np.einsum("nij,nj->ni", homography[:, :, :2], xy0[shown]) + homography[:, :, 2]
    error[shown] = np.linalg.norm(true[:, :2] / true[:, 2:] - xy1[shown], axis=1)
    return error


def score_points(
    matcher: HomoMatcher,
    pairs: TrainingPairs,
    min_score: float,
    quiet: bool = False,
    observe: Callable[[np.ndarray, PatchMatches, np.ndarray], None] | None = None,
) -> dict[str, float]:
    """Match pairs with exact geometry, as training.validation makes them, and measure the errors.

    Returns by name, for all matches (all_...) and for those with a score of at least min_score (trusted_...), over all
    pairs together: mean and median end-point error in px and the percentage below 1, 3 and 5 px (PCK), for the
    visible points of the matched patches (points) and for the patch centres only (centres); the mean number of
    matches; the percentage of correct ones, wrong where image 1 does not show the point; and coverage, the percentage
    of the 8 x 8 px cells of image 0 visible in image 1 that hold a match within 3 px. Besides, the median
    milliseconds per pair. Errors of no points are NaN.
    observe: called for each pair with its two images, the matches and the errors of their centres (M,) px.
    """
    errors, seconds = [], []
    for index in tqdm(range(len(pairs)), desc="points", unit="pair", disable=quiet):
        item = pairs[index]
        started = time.perf_counter()
        matches = matcher.match(item["images"][0], item["images"][1])
        seconds.append(time.perf_counter() - started)
        errors.append(measure_matches(matches, item["b_from_a"], item["surface"]))
        if observe is not None:
            observe(item["images"], matches, errors[-1].centre_px)
    scores = {
        f"{group}_{name}": value
        for group, limit in (("all", 0.0), ("trusted", min_score))
        for name, value in summarise_errors(errors, limit).items()
    }
    return scores | {"milliseconds": float(np.median(seconds)) * 1000}


def summarise_errors(errors: Sequence[MatchErrors], min_score: float) -> dict[str, float]:
    """The metrics of score_points over the matches of all pairs with a score of at least min_score."""
    used = [pair.score >= min_score for pair in errors]
    centre_px = np.concatenate([pair.centre_px[chosen] for pair, chosen in zip(errors, used)])
    points_px = np.concatenate([pair.points_px[chosen].ravel() for pair, chosen in zip(errors, used)])
    covered = 0
    for pair, chosen in zip(errors, used):
        correct = chosen & (pair.centre_px < CORRECT_LIMITS_PX[0])
        hit = np.zeros(len(pair.visible), bool)
        hit[pair.cell[correct]] = True
        covered += int((hit & pair.visible).sum())
    metrics: dict[str, float] = {}
    for name, distances in (("points", points_px[~np.isnan(points_px)]), ("centres", centre_px[~np.isnan(centre_px)])):
        metrics[f"{name}_mean_px"] = float(distances.mean()) if len(distances) else np.nan
        metrics[f"{name}_median_px"] = float(np.median(distances)) if len(distances) else np.nan
        for limit in ERROR_LIMITS_PX:
            metrics[f"{name}_pck_{limit}px"] = measure_share((distances < limit).sum(), len(distances))
    metrics["mean_matches"] = len(centre_px) / len(errors)
    for limit in CORRECT_LIMITS_PX:
        metrics[f"correct_{limit}px"] = measure_share((centre_px < limit).sum(), len(centre_px))
    return metrics | {"coverage": measure_share(covered, sum(int(pair.visible.sum()) for pair in errors))}


def measure_share(part: int, whole: int) -> float:
    """Percent; NaN of nothing."""
    return 100 * float(part) / whole if whole else np.nan
