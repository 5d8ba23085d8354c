"""The geometry of patches: from points of the network's input to cells and back to px of the stored images.

Patch coordinates are cells of the fine grid relative to the centre of the patch, see hm_sfm.network.homography.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from hm_sfm.geometry.frames import Grid
from hm_sfm.network.device import autocast
from hm_sfm.network.fine import ExpectationHead, FineMap, HomographyHead
from hm_sfm.network.homography import is_regular, make_corners

FINE_CHUNK = 512
"""Patches per call of the fine head: bounds its memory to about 50 MB."""
FINE_STEP = 64
"""Smaller calls are filled up to a multiple of this: PyTorch keeps memory for every size it was ever called with."""

Head = HomographyHead | ExpectationHead


@dataclass(frozen=True)
class PatchEstimates:
    """What the fine head says of P patches around pairs of fine cells; tensors on its device."""

    cell0: Tensor
    """(P, 2) int64: the cells of image 0 that the patches are cut around."""
    cell1: Tensor
    """(P, 2) int64: those of image 1."""
    homography: Tensor
    """(P, 3, 3) float32: patch of image 0 -> patch of image 1."""
    log_scale: Tensor
    """(P,) float32: log of the expected error (Laplace scale), cells."""


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
    """(P,) in [0, 1], see score_from_scale."""
    regular: np.ndarray
    """(P,) bool, see is_regular."""
    patch_radius_px: float
    """Half a patch of image 0."""


def estimate_patches(
    head: Head,
    fine0: FineMap,
    fine1: FineMap,
    cell0: Tensor,
    cell1: Tensor,
    start: Tensor | None = None,
    iterations: int | None = None,
) -> PatchEstimates:
    """The head's last estimate of P patches, computed some at a time.

    cell0, cell1: (P, 2) int64 fine cells; start: (P, 4, 2) cells and iterations, as in HomographyHead.forward.
    """
    device = fine0.cells.device
    homography, log_scale = [torch.zeros(0, 3, 3, device=device)], [torch.zeros(0, device=device)]
    for first in range(0, len(cell0), FINE_CHUNK):
        chunk = slice(first, first + FINE_CHUNK)
        count = len(cell0[chunk])
        padding = (0, 0, 0, -count % FINE_STEP)
        image = torch.zeros(count + padding[-1], dtype=torch.int64, device=device)
        cells = (F.pad(cell[chunk], padding) for cell in (cell0, cell1))
        begin = {} if start is None else {"start": F.pad(start[chunk], (0, 0, *padding)), "iterations": iterations}
        with autocast(device):
            estimate = head(fine0, fine1, image, *cells, **begin)[-1]
        homography.append(estimate.homography[:count])
        log_scale.append(estimate.log_scale[:count])
    return PatchEstimates(cell0, cell1, torch.cat(homography), torch.cat(log_scale))


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
        score=score_from_scale(patches.log_scale.cpu().numpy().astype(np.float64), grid),
        regular=regular,
        patch_radius_px=float(half * px_per_cell),
    )


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


def is_inside(xy: np.ndarray, scaled_wh: tuple[int, int], stored_from_scaled: np.ndarray) -> np.ndarray:
    """(M,) bool: which points (M, 2), px of the stored image, lie in it."""
    width, height = scaled_wh
    corners = stored_from_scaled[:2] @ np.array([[0, width], [0, height], [1, 1]])
    return np.all((xy >= corners.min(axis=1)) & (xy < corners.max(axis=1)), axis=1)


def score_from_scale(log_scale: np.ndarray, grid: Grid) -> np.ndarray:
    """Error scale (P,), log cells -> (P,) in [0, 1]: the probability that a match is off by less than 1 px (Laplace).

    The px are those of the network's input.
    """
    return 1 - np.exp(-1 / (np.exp(log_scale) * grid.stride))


def scale_from_score(score: float, grid: Grid) -> float:
    """The inverse of score_from_scale."""
    return -math.log(-math.log(1 - score) * grid.stride)
