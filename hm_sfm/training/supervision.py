"""Which patches of a training pair belong together, and the true homography of each."""

from dataclasses import dataclass

import torch
from torch import Tensor

from hm_sfm.coordinates import Grid
from hm_sfm.network.homography import apply_homography, is_regular, make_corners
from hm_sfm.network.model import fine_cell_of

JITTERED_SHARE = 0.25
"""Of the patches whose coarse match is one cell off: what mutual nearest neighbours suppress or get wrong."""
WRONG_SHARE = 0.08
"""Of the patches whose coarse match is plainly wrong; they teach the error scale only."""


@dataclass(frozen=True)
class PatchSupervision:
    """P supervised patches; cells are of the fine grid, patch coordinates as in network/homography.py."""

    image_index: Tensor
    """(P,) int64: pair of the batch."""
    cell0: Tensor
    cell1: Tensor
    """(P, 2) int64: patch centres in view A and view B."""
    homography: Tensor
    """(P, 3, 3) float32: patch of A -> patch of B."""
    displacement: Tensor
    """(P, 4, 2) float32 cells: of the four corners."""
    correct: Tensor
    """(P,) bool: the truth lies within reach; the others are wrong coarse matches."""


def draw_patches(
    b_from_a: Tensor,
    surface: Tensor,
    per_pair: int,
    coarse_grid: Grid,
    fine_grid: Grid,
    half: float,
    generator: torch.Generator,
) -> PatchSupervision:
    """Draw coarse matches of two views: mostly the true cell, some one cell off, some wrong.

    b_from_a: (B, SURFACES, 3, 3) float32, px of view A -> px of view B over each surface; surface: (B, S, S) int64, the
    surface at each pixel of A, -1 where B does not show it. Cells whose centre B does not show are left out, so
    P <= B * per_pair.
    """
    batch, size_px = surface.shape[:2]
    cells = size_px // coarse_grid.stride
    coarse0 = torch.randint(cells, (batch, per_pair, 2), generator=generator)
    centre0_px = coarse_grid.to_px(coarse0.float())
    item_index = torch.arange(batch)[:, None]
    x, y = centre0_px.long().unbind(dim=-1)
    shown = surface[item_index, y, x]
    homography_px = b_from_a[item_index, shown.clamp_min(0)]
    centre1_px = apply_homography(homography_px.flatten(0, 1), centre0_px.reshape(-1, 1, 2)).view(batch, -1, 2)
    coarse1 = torch.floor(coarse_grid.from_px(centre1_px) + 0.5).long()
    jitter = torch.randint(-1, 2, (batch, per_pair, 2), generator=generator)
    kind = torch.rand(batch, per_pair, 1, generator=generator)
    anywhere = torch.randint(cells, (batch, per_pair, 2), generator=generator)
    wrong = kind < WRONG_SHARE
    jittered = ~wrong & (kind < WRONG_SHARE + JITTERED_SHARE)
    coarse1 = torch.where(wrong, anywhere, coarse1 + jittered * jitter)

    inside = (
        (shown >= 0)
        & ((centre1_px > 4) & (centre1_px < size_px - 4)).all(-1)
        & ((coarse1 >= 0) & (coarse1 < cells)).all(-1)
    )
    image_index, item = inside.nonzero(as_tuple=True)
    cell0 = fine_cell_of(coarse0[image_index, item], coarse_grid, fine_grid)
    cell1 = fine_cell_of(coarse1[image_index, item], coarse_grid, fine_grid)
    homography = patch_homography(homography_px[image_index, item], cell0, cell1, fine_grid)
    corners = make_corners(half)
    displacement = apply_homography(homography, corners) - corners
    within_reach = (displacement.abs().amax(dim=(1, 2)) < 2 * half) & is_regular(homography, half)
    correct = within_reach & ~wrong[image_index, item, 0]
    return PatchSupervision(image_index, cell0, cell1, homography, displacement, correct)


def patch_homography(b_from_a: Tensor, cell0: Tensor, cell1: Tensor, grid: Grid) -> Tensor:
    """Homographies between images (P, 3, 3) px -> between patches (P, 3, 3) cells around cell0 and cell1 (P, 2)."""
    to_px = torch.eye(3, dtype=torch.float64).repeat(2, len(cell0), 1, 1)
    to_px[..., 0, 0] = to_px[..., 1, 1] = grid.stride
    to_px[0, :, :2, 2] = grid.to_px(cell0.double())
    to_px[1, :, :2, 2] = grid.to_px(cell1.double())
    homography = torch.linalg.solve(to_px[1], b_from_a.double() @ to_px[0])
    return (homography / homography[:, 2:, 2:]).float()
