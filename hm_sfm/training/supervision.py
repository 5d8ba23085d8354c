"""What belongs together in a training pair: coarse cells, patches and the true homography of each."""

from dataclasses import dataclass

import torch
from torch import Tensor

from hm_sfm.geometry.frames import Grid
from hm_sfm.matching.patches import fine_cell_of
from hm_sfm.network.homography import apply_homography, is_regular, make_corners

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
    """(P,) bool: the true point lies within reach; the others are wrong coarse matches."""


@dataclass(frozen=True)
class CoarseSupervision:
    """Q true coarse matches, one to one within a pair."""

    image_index: Tensor
    """(Q,) int64: pair of the batch."""
    index0: Tensor
    index1: Tensor
    """(Q,) int64: cells of view A and view B, counted row by row."""


def find_coarse_matches(b_from_a: Tensor, surface: Tensor, points: Tensor, grid: Grid) -> CoarseSupervision:
    """The true coarse matches of a batch: where the centre of each cell of A lies in B, and the given points.

    b_from_a, surface: as in draw_patches, (B, H, W) pixels; points: (B, N, 4) float32 px (x, y in A, x, y in B), NaN
    where there is none. Of several claims to a cell the one nearest to the cells' centres is kept.
    """
    batch, height, width = surface.shape
    rows, columns = height // grid.stride, width // grid.stride
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    centre_px = grid.to_px(torch.stack([x, y], dim=-1).reshape(-1, 2).float())
    column_px, row_px = centre_px.long().unbind(dim=-1)
    shown = surface[:, row_px, column_px]
    homography = b_from_a[torch.arange(batch)[:, None], shown.clamp_min(0)]
    mapped = apply_homography(homography.flatten(0, 1), centre_px.repeat(batch, 1)[:, None]).view(batch, -1, 2)
    mapped = torch.where(shown[..., None] >= 0, mapped, torch.nan)
    claims = torch.cat([torch.cat([centre_px.expand(batch, -1, -1), mapped], dim=2), points], dim=1)

    position = grid.from_px(claims.view(batch, -1, 2, 2))
    cell = torch.floor(position + 0.5)
    size = torch.tensor([columns, rows])
    valid = ((cell >= 0) & (cell < size)).flatten(2).all(dim=2)
    image_index, claim = valid.nonzero(as_tuple=True)
    off_centre = (position - cell)[image_index, claim].square().sum(dim=(1, 2))
    index0, index1 = (cell[image_index, claim].long() * torch.tensor([1, columns])).sum(dim=2).unbind(dim=1)
    order = off_centre.argsort(stable=True)
    image_index, index0, index1 = image_index[order], index0[order], index1[order]
    first = _pick_first(image_index * rows * columns + index1)
    image_index, index0, index1 = image_index[first], index0[first], index1[first]
    first = _pick_first(image_index * rows * columns + index0)
    image_index, index0, index1 = image_index[first], index0[first], index1[first]
    return CoarseSupervision(image_index, index0, index1)


def _pick_first(key: Tensor) -> Tensor:
    """Indices, ascending, of the first entry of each distinct value of `key` (Q,) int64."""
    values, group = key.unique(return_inverse=True)
    first = torch.full((len(values),), len(key))
    return first.scatter_reduce_(0, group, torch.arange(len(key)), reduce="amin").sort().values


def draw_patches(
    b_from_a: Tensor,
    surface: Tensor,
    per_pair: int,
    coarse_grid: Grid,
    fine_grid: Grid,
    half: float,
    generator: torch.Generator,
    jittered_share: float = JITTERED_SHARE,
) -> PatchSupervision:
    """Draw coarse matches of two views: mostly the true cell, some (`jittered_share`) one cell off, some wrong.

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
    jittered = ~wrong & (kind < WRONG_SHARE + jittered_share)
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


@dataclass(frozen=True)
class PointSupervision:
    """P patches of real photos, of each of which one pair of points is known; cells are of the fine grid."""

    image_index: Tensor
    """(P,) int64: pair of the batch."""
    cell0: Tensor
    cell1: Tensor
    """(P, 2) int64: patch centres in view A and view B."""
    point0: Tensor
    point1: Tensor
    """(P, 2) float32: the points, relative to the patch centres, cells."""
    correct: Tensor
    """(P,) bool: as in PatchSupervision."""


def draw_point_patches(
    points: Tensor, size_wh: tuple[int, int], per_pair: int, coarse_grid: Grid, fine_grid: Grid, half: float,
    generator: torch.Generator, jittered_share: float = JITTERED_SHARE,
) -> PointSupervision:  # fmt: skip
    """Draw coarse matches around known points, shifted and wrong ones in the same shares as draw_patches.

    points: (B, N, 4) float32 px (x, y in A, x, y in B), NaN where there is none; size_wh: of the views, px. Of each
    pair at most `per_pair` points are taken.
    """
    batch, count = points.shape[:2]
    order = torch.rand(batch, count, generator=generator).masked_fill(points[..., 0].isnan(), 2.0)
    drawn = order.argsort(dim=1)[:, :per_pair]
    points = points.gather(1, drawn[..., None].expand(-1, -1, 4)).view(batch, -1, 2, 2)
    coarse0, coarse1 = torch.floor(coarse_grid.from_px(points) + 0.5).unbind(dim=2)
    shape = coarse1.shape
    cells = torch.tensor(size_wh) // coarse_grid.stride
    jitter = torch.randint(-1, 2, shape, generator=generator)
    kind = torch.rand(*shape[:2], 1, generator=generator)
    wrong = kind < WRONG_SHARE
    jittered = ~wrong & (kind < WRONG_SHARE + jittered_share)
    coarse1 = torch.where(
        wrong, torch.floor(torch.rand(shape, generator=generator) * cells), coarse1 + jittered * jitter
    )

    inside = ((coarse0 >= 0) & (coarse0 < cells) & (coarse1 >= 0) & (coarse1 < cells)).all(dim=-1)
    image_index, item = inside.nonzero(as_tuple=True)
    cell0, cell1 = (fine_cell_of(c[image_index, item].long(), coarse_grid, fine_grid) for c in (coarse0, coarse1))
    point0, point1 = fine_grid.from_px(points[image_index, item]).unbind(dim=1)
    point0, point1 = point0 - cell0, point1 - cell1
    within_reach = (point1 - point0).abs().amax(dim=1) < 2 * half
    correct = within_reach & ~wrong[image_index, item, 0]
    return PointSupervision(image_index, cell0, cell1, point0, point1, correct)


def patch_homography(b_from_a: Tensor, cell0: Tensor, cell1: Tensor, grid: Grid) -> Tensor:
    """Homographies between images (P, 3, 3) px -> between patches (P, 3, 3) cells around cell0 and cell1 (P, 2)."""
    to_px = torch.eye(3, dtype=torch.float64).repeat(2, len(cell0), 1, 1)
    to_px[..., 0, 0] = to_px[..., 1, 1] = grid.stride
    to_px[0, :, :2, 2] = grid.to_px(cell0.double())
    to_px[1, :, :2, 2] = grid.to_px(cell1.double())
    homography = torch.linalg.solve(to_px[1], b_from_a.double() @ to_px[0])
    return (homography / homography[:, 2:, 2:]).float()
