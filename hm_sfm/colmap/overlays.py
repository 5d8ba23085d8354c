"""What stays in its place in the frame while the scene moves: a time stamp, a logo, the bonnet of a car.

Matches of an overlay agree with each other in any two photos, of the same place or not, so that they join places that
have nothing in common. In one pair they cannot be told from those of two equal photos, whose matches rightly all
stay where they are. So the collection is asked: an overlay is where matches stay in several pairs whose scene moves.
"""

import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hm_sfm.colmap.verification import measure_cover
from hm_sfm.types import ImagePair, ImageRef, PairMatches

logger = logging.getLogger(__name__)

STILL_PX = 1.0
"""Px of the matching resolution by which a match that stays in its place moves at most."""
NEARLY_STILL_PX = 3.0
"""Where the scene itself moves little, around a point that stays, more matches move up to this than stay."""
CELLS = 32
"""Of the longer side of a frame: overlays consist of cells."""
LEAST_PAIRS = 2
"""An overlay's cell has matches that stay in so many pairs whose scene moves,"""
LEAST_SHARE = 0.25
"""and in this share of all such pairs that have a match in the cell."""


@dataclass(frozen=True)
class Overlays:
    """Where the photos of a collection have overlays."""

    frame_of: Mapping[str, tuple[int, int]]
    """Image name -> size of the photo at the matching resolution: photos of one size have one frame."""
    cells: Mapping[tuple[int, int], np.ndarray]
    """Frame -> (rows, columns) bool, of the frames that have an overlay."""
    px_scale: Mapping[str, float]
    """Image name -> px of the stored image per px of the matching resolution."""

    def drop_still(self, matches: PairMatches) -> PairMatches:
        """The matches without those that stay in their place on an overlay."""
        frame = self.frame_of[matches.pair.name0]
        if frame not in self.cells or self.frame_of[matches.pair.name1] != frame:
            return matches
        xy0, moved_px = measure_moves(matches, self.px_scale)
        row, column = find_cells(xy0, frame)
        return matches.select(~(self.cells[frame][row, column] & (moved_px <= NEARLY_STILL_PX)))


def find_overlays(
    images: Sequence[ImageRef],
    pairs: Sequence[ImagePair],
    read: Callable[[ImagePair], PairMatches],
    px_scale: Mapping[str, float],
    min_score: float,
) -> Overlays:
    """The overlays of a collection, from its matches with at least min_score; each is logged as a warning.

    read: gives the matches of a pair. px_scale: image name -> px of the stored image per px at the matching resolution.
    """
    frame_of = {
        image.name: (round(image.size_wh[0] / px_scale[image.name]), round(image.size_wh[1] / px_scale[image.name]))
        for image in images
    }
    still_pairs: dict[tuple[int, int], np.ndarray] = {}
    moving_pairs: dict[tuple[int, int], np.ndarray] = {}
    for pair in pairs:
        frame = frame_of[pair.name0]
        if frame_of[pair.name1] != frame:
            continue
        matches = read(pair)
        xy0, moved_px = measure_moves(matches.select(matches.score >= min_score), px_scale)
        still = moved_px <= STILL_PX
        moving = moved_px > NEARLY_STILL_PX
        if measure_cover(xy0[moving], frame) < measure_cover(xy0[still], frame) or not moving.any():
            continue  # equal photos, or too little of the scene in both
        if frame not in still_pairs:
            still_pairs[frame], moving_pairs[frame] = (np.zeros(count_cells(frame), np.int64) for _ in range(2))
        moving_pairs[frame][find_cells(xy0, frame)] += 1
        if np.count_nonzero(still) > np.count_nonzero(~still & ~moving):
            still_pairs[frame][find_cells(xy0[still], frame)] += 1
    cells = {}
    photos_of = Counter(frame_of.values())
    for frame, still_in in still_pairs.items():
        on_overlay = (still_in >= LEAST_PAIRS) & (still_in >= LEAST_SHARE * moving_pairs[frame])
        if on_overlay.any():
            cells[frame] = spread_cells(on_overlay)
            logger.warning(
                "%.0f %% of the frame of %d photos stays in its place while the scene moves, such as a time stamp, a "
                "logo or a part of the car: matches that stay there are left out (--camera-mask hides it for certain)",
                max(1, 100 * cells[frame].mean()),
                photos_of[frame],
            )
    return Overlays(frame_of, cells, px_scale)


def measure_moves(matches: PairMatches, px_scale: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """(M, 2) float64 px of the matching resolution in image 0, and (M,): how far from there they are in image 1."""
    xy0, xy1 = matches.xy0 / px_scale[matches.pair.name0], matches.xy1 / px_scale[matches.pair.name1]
    return xy0, np.linalg.norm(xy1 - xy0, axis=1)


def count_cells(frame: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of a frame's cells."""
    side_px = max(frame) / CELLS
    return int(np.ceil(frame[1] / side_px)), int(np.ceil(frame[0] / side_px))


def find_cells(xy: np.ndarray, frame: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns, (N,) int64 each, of the cells of points (N, 2), px of the matching resolution."""
    column, row = (xy * (CELLS / max(frame))).astype(np.int64).T
    rows, columns = count_cells(frame)
    return row.clip(0, rows - 1), column.clip(0, columns - 1)


def spread_cells(cells: np.ndarray) -> np.ndarray:
    """(rows, columns) bool with all cells beside those that are set: an overlay does not end where cells do."""
    padded = np.pad(cells, 1)
    rows, columns = cells.shape
    return np.any([padded[y : y + rows, x : x + columns] for y in range(3) for x in range(3)], axis=0)
