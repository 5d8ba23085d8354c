"""Loops of matches: a point that goes from photo a to b and on to c should arrive where it goes from a directly."""

from dataclasses import dataclass

import numpy as np

from hm_sfm.geometry.homographies import apply_homographies
from hm_sfm.keypoints.transfer import make_transfers
from hm_sfm.types import PairMatches

CELL_PX = 8.0
"""A patch is looked up in cells of this size, px of the matching resolution."""


@dataclass(frozen=True)
class PatchMap:
    """The patches of a verified pair in one direction, found by where they are; px of the matching resolution."""

    centre: np.ndarray
    target: np.ndarray
    """(M, 2): patch centres in the one image and in the other."""
    homography: np.ndarray
    """(M, 3, 3) float64."""
    cells: np.ndarray
    """(rows, columns) int32: the best patch of each cell, -1 where there is none."""

    def transfer(self, xy: np.ndarray) -> np.ndarray:
        """Points (N, 2) -> (N, 2) float64 in the other image, NaN where no patch is."""
        row, column = np.floor(np.nan_to_num(xy[:, ::-1], nan=-1.0) / CELL_PX).astype(np.int64).T
        inside = (row >= 0) & (column >= 0) & (row < self.cells.shape[0]) & (column < self.cells.shape[1])
        patch = np.full(len(xy), -1)
        patch[inside] = self.cells[row[inside], column[inside]]
        moved = np.full((len(xy), 2), np.nan)
        covered = patch >= 0
        moved[covered] = apply_homographies(self.homography[patch[covered]], xy[covered])
        return moved


def map_patches(matches: PairMatches, px_scale0: float, px_scale1: float) -> tuple[PatchMap, PatchMap]:
    """The patches of verified matches from image 0 to image 1 and back.

    px_scale0, px_scale1: px of the stored images per px at the matching resolution.
    """
    forward, back = make_transfers(matches, px_scale0, px_scale1)
    return (
        PatchMap(forward.centre, back.centre, forward.homography, _index_cells(forward.centre)),
        PatchMap(back.centre, forward.centre, back.homography, _index_cells(back.centre)),
    )


def _index_cells(xy: np.ndarray) -> np.ndarray:
    cell = np.floor(xy[:, ::-1].clip(0) / CELL_PX).astype(np.int64)
    cells = np.full(cell.max(axis=0, initial=-1) + 1, -1, np.int32)
    # Matches come best first, and of several values numpy keeps the last.
    cells[tuple(cell[::-1].T)] = np.arange(len(xy), dtype=np.int32)[::-1]
    return cells


def vote_on_matches(ab: PatchMap, bc: PatchMap, ac: PatchMap, max_error_px: float) -> np.ndarray:
    """What photo c says of the matches of a and b, (M,) int8: 1 the loop closes, -1 it doesn't, 0 c shows nothing.

    max_error_px: px of the matching resolution.
    """
    apart = np.linalg.norm(bc.transfer(ab.target) - ac.transfer(ab.centre), axis=1)
    return np.where(np.isnan(apart), 0, np.where(apart <= max_error_px, 1, -1)).astype(np.int8)
