"""The geometry of patches: from points of the network's input to cells and back to px of the stored images.

Patch coordinates are cells of the fine grid relative to the centre of the patch, see hm_sfm.network.homography.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hm_sfm.geometry.frames import Grid
from hm_sfm.network.estimates import PatchEstimates
from hm_sfm.network.homography import apply_homography, is_regular, make_corners


@dataclass(frozen=True)
class StoredPatches:
    """Patches in px of the stored images, float64."""

    xy0: np.ndarray
    """(P, 2): points in the patches of image 0."""
    xy1: np.ndarray
    """(P, 2): where they are in image 1."""
    homography: np.ndarray
    """(P, 3, 3): image 0 -> image 1, the denominator 1 at xy0; the identity, and xy1 of no use, where not regular."""
    score: np.ndarray
    """(P,) in [0, 1], see PatchEstimates."""
    regular: np.ndarray
    """(P,) bool, see is_regular."""
    patch_radius_px: float
    """Half a patch of image 0."""


def locate_patches(
    patches: PatchEstimates,
    offset0: np.ndarray,
    stored_from_scaled0: np.ndarray,
    stored_from_scaled1: np.ndarray,
    grid: Grid,
    half: float,
) -> StoredPatches:
    """From patch coordinates to px of the stored images.

    offset0: (P, 2) float64 cells, the matched points of image 0 relative to the centres of their patches. grid: of the
    fine cells. half: distance of a patch's corner cells from its centre along each axis, cells.
    """
    stored0 = stored_from_scaled0 @ patch_to_px(patches.cell0.cpu().numpy(), grid)
    stored1 = stored_from_scaled1 @ patch_to_px(patches.cell1.cpu().numpy(), grid)
    regular = is_regular(patches.homography, half).cpu().numpy()
    homography = stored1 @ patches.homography.cpu().numpy().astype(np.float64) @ np.linalg.inv(stored0)
    homography[~regular] = np.eye(3)
    xy0 = stored0[:, :2, 2] + np.einsum("nij,nj->ni", stored0[:, :2, :2], offset0)
    mapped = np.einsum("nij,nj->ni", homography[:, :, :2], xy0) + homography[:, :, 2]
    px_per_cell = np.sqrt(abs(np.linalg.det(stored_from_scaled0[:2, :2]))) * grid.stride
    return StoredPatches(
        xy0=xy0,
        xy1=mapped[:, :2] / mapped[:, 2:],
        homography=homography / mapped[:, 2, None, None],
        score=patches.score.cpu().numpy().astype(np.float64),
        regular=regular,
        patch_radius_px=float(half * px_per_cell),
    )


def locate_matches(patches: PatchEstimates, offset0: np.ndarray | float, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """(P, 2) float64 px of the network's inputs: points of image 0, and where the patches put them in image 1.

    offset0: (P, 2) cells, the points relative to the centres of their patches. grid: of the fine cells.
    """
    at = torch.as_tensor(offset0, dtype=torch.float64).expand(len(patches.cell0), 2)
    moved = apply_homography(patches.homography.double().cpu(), at[:, None])[:, 0]
    xy0, xy1 = (cell.cpu() + offset for cell, offset in ((patches.cell0, at), (patches.cell1, moved)))
    return grid.to_px(xy0).numpy(), grid.to_px(xy1).numpy()


def fine_cell_of(coarse_cell: Tensor, coarse_grid: Grid, fine_grid: Grid) -> Tensor:
    """(P, 2) int64 coarse cells -> (P, 2) int64: the fine cell nearest to each one's centre (halves go up)."""
    return torch.floor(fine_grid.from_px(coarse_grid.to_px(coarse_cell.double())) + 0.5).long()


def round_to_cells(xy_px: np.ndarray, grid: Grid) -> tuple[Tensor, np.ndarray]:
    """(P, 2) px of the network's input -> (P, 2) int64 cells nearest to them, and (P, 2) cells from these to them."""
    position = grid.from_px(xy_px)
    cell = np.floor(position + 0.5)
    return torch.tensor(cell, dtype=torch.int64), position - cell


def make_start(offset0: np.ndarray, offset1: np.ndarray, linear: np.ndarray | None, half: float) -> Tensor:
    """(P, 4, 2) float32 cells: the displacements of the patches' corners that bring matched points together.

    offset0, offset1: (P, 2) cells, the points relative to the centres of their patches; linear: (P, 2, 2), see
    PointPairs.
    """
    corners = make_corners(half).double().numpy()
    around = np.eye(2) if linear is None else linear
    displaced = (corners - offset0[:, None]) @ np.swapaxes(around, -1, -2) + offset1[:, None]
    return torch.tensor(displaced - corners).float()


def patch_to_px(cell: np.ndarray, grid: Grid) -> np.ndarray:
    """(P, 2) int64 cells -> (P, 3, 3) float64: patch coordinates around each -> px of the network's input."""
    matrix = np.zeros((len(cell), 3, 3))
    matrix[:, 0, 0] = matrix[:, 1, 1] = grid.stride
    matrix[:, :2, 2] = grid.to_px(cell.astype(np.float64))
    matrix[:, 2, 2] = 1
    return matrix


def is_inside(xy: np.ndarray, size_wh: tuple[int, int]) -> np.ndarray:
    """(M,) bool: which points (M, 2), px of the stored image, lie in it."""
    return np.all((xy >= 0) & (xy < size_wh), axis=1)
