"""What belongs together in a training pair: coarse cells, patches and the true homography of each."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from hm_sfm.geometry.frames import Grid
from hm_sfm.matching.patches import fine_cell_of
from hm_sfm.network.homography import apply_homography, is_regular, make_corners

JITTERED_SHARE = 0.25
"""Of the patches whose coarse match is one cell off: what mutual nearest neighbours suppress or get wrong."""
WRONG_SHARE = 0.15
"""Of the patches whose coarse match is plainly wrong; they teach the error scale only."""
LOOKALIKE_SHARE = 0.75
"""Of the wrong ones that look right, as the coarse stage's own errors do; the others are anywhere."""
STARTED_SHARE = 0.3
"""Of the patches that start near the true homography, as growth and keypoint refinement do, and not at the identity."""
START_CELLS = 2.0
"""By which their centres start off the true places at most, and at half of the patches by a quarter of that at most.

In matches of fountain-P11 and castle-P19, good patches grew from starts that were 0.3 cells off in the median, 0.7 in
nine of ten cases and 1.2 in 98 %. Keypoint refinement starts nearer."""
START_TURN_DEG = 5.0
START_LOG_SCALE = 0.1
"""Standard deviations of the rotation and the logarithm of the scale by which their shapes start off the true ones."""


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
    start: Tensor
    """(P, 4, 2) float32 cells: displacements of the corners that the head starts from; 0 for the identity."""


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
    cells = list_cells(rows, columns)
    centre_px = grid.to_px(cells.float()).expand(batch, -1, -1)
    mapped, _ = map_points(b_from_a, surface, centre_px)
    claims = torch.cat([torch.cat([centre_px, mapped], dim=2), points], dim=1)

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


def list_cells(rows: int, columns: int) -> Tensor:
    """(rows * columns, 2) int64: all cells (x, y), row by row."""
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    return torch.stack([x, y], dim=-1).reshape(-1, 2)


def map_points(b_from_a: Tensor, surface: Tensor, points_px: Tensor) -> tuple[Tensor, Tensor]:
    """Where points (B, N, 2) px of view A lie in B, (B, N, 2) px, NaN where B does not show them.

    b_from_a, surface: as in draw_patches. Also returns the homographies of their surfaces, (B, N, 3, 3).
    """
    item = torch.arange(len(surface))[:, None]
    column, row = points_px.long().unbind(dim=-1)
    shown = surface[item, row, column]
    homography = b_from_a[item, shown.clamp_min(0)]
    mapped = apply_homography(homography.flatten(0, 1), points_px.flatten(0, 1)[:, None]).view(points_px.shape)
    return torch.where(shown[..., None] >= 0, mapped, torch.nan), homography


def _pick_first(key: Tensor) -> Tensor:
    """Indices, ascending, of the first entry of each distinct value of `key` (Q,) int64."""
    values, group = key.unique(return_inverse=True)
    first = torch.full((len(values),), len(key))
    return first.scatter_reduce_(0, group, torch.arange(len(key)), reduce="amin").sort().values


def draw_patches(
    b_from_a: Tensor, surface: Tensor, features: Tensor, per_pair: int, coarse_grid: Grid, fine_grid: Grid, half: float,
    generator: torch.Generator, jittered_share: float = JITTERED_SHARE, started_share: float = 0.0,
) -> PatchSupervision:  # fmt: skip
    """Draw coarse matches of two views: mostly the true cell, some (`jittered_share`) one cell off, some wrong.

    b_from_a: (B, SURFACES, 3, 3) float32, px of view A -> px of view B over each surface; surface: (B, H, W) int64, the
    surface at each pixel of A, -1 where B does not show it; features: (B, 2, C, rows, columns) float32 of unit length,
    of the coarse cells of both views. Of each pair at most `per_pair` cells are taken, whose centres B shows.
    `started_share` of all start near the true homography, at the wrong place where the match is wrong.
    """
    height, width = surface.shape[1:]
    cells = list_cells(*features.shape[3:])
    centre0_px = coarse_grid.to_px(cells.float()).expand(len(surface), -1, -1)
    centre1_px, homography_px = map_points(b_from_a, surface, centre0_px)
    shown = ((centre1_px > 4) & (centre1_px < torch.tensor([width, height]) - 4)).all(dim=2)
    drawn, real = draw_some(shown, per_pair, generator)
    item = torch.arange(len(surface))[:, None]
    coarse0, true1 = cells[drawn], coarse_grid.from_px(centre1_px[item, drawn])
    reach = 2 * half * fine_grid.stride / coarse_grid.stride
    coarse1, wrong = draw_partners(features, coarse0, true1, reach, jittered_share, generator)
    started = torch.rand(wrong.shape, generator=generator) < started_share

    image_index, number = (real & is_in_map(coarse1, features)).nonzero(as_tuple=True)
    wrong, started = wrong[image_index, number], started[image_index, number, None]
    homography_px = homography_px[image_index, drawn[image_index, number]]
    cell0, cell1 = (fine_cell_of(c[image_index, number], coarse_grid, fine_grid) for c in (coarse0, coarse1))
    homography = patch_homography(homography_px, cell0, cell1, fine_grid)
    step, start = draw_starts(homography, wrong, half, generator)
    cell1 = cell1 + step * started
    homography = patch_homography(homography_px, cell0, cell1, fine_grid)
    corners = make_corners(half)
    displacement = apply_homography(homography, corners) - corners
    correct = (displacement.abs().amax(dim=(1, 2)) < 2 * half) & is_regular(homography, half)
    return PatchSupervision(image_index, cell0, cell1, homography, displacement, correct, start * started[..., None])


def draw_some(usable: Tensor, most: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Draw `most` of the usable entries, (B, N) bool, of each row.

    Returns their indices, (B, min(N, most)) int64, and whether they are usable: where a row has too few, others follow.
    """
    order = torch.rand(usable.shape, generator=generator).masked_fill(~usable, 2.0)
    drawn = order.argsort(dim=1)[:, :most]
    return drawn, usable.gather(1, drawn)


def draw_partners(
    features: Tensor, cell0: Tensor, true1: Tensor, reach: float, jittered_share: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """The cells of B, (B, N, 2) int64, that coarse matches put beside cells of A, and which of them are wrong, (B, N).

    features: as in draw_patches; cell0: (B, N, 2) int64; true1: (B, N, 2) float32, where they lie in B, cells, NaN
    where that is not known; reach: how far off the fine stage still finds its target, cells.
    """
    shape = cell0.shape
    jitter = torch.randint(-1, 2, shape, generator=generator)
    kind, look = torch.rand(2, *shape[:2], 1, generator=generator)
    anywhere = torch.floor(torch.rand(shape, generator=generator) * torch.tensor(features.shape[:2:-1]))
    wrong = kind < WRONG_SHARE
    jittered = ~wrong & (kind < WRONG_SHARE + jittered_share)
    # Beside the reach lie the most similar cells of all; what is repeated lies farther away.
    apart = reach * (1 + 3 * torch.rand(shape[:2], generator=generator))
    mistaken = torch.where(look < LOOKALIKE_SHARE, find_lookalikes(features, cell0, true1, apart), anywhere)
    right = torch.floor(true1.nan_to_num() + 0.5) + jittered * jitter
    return torch.where(wrong, mistaken, right).long(), wrong[..., 0]


def find_lookalikes(features: Tensor, cell0: Tensor, true1: Tensor, apart: Tensor) -> Tensor:
    """The cells of B, (B, N, 2) int64, most similar to cells of A but at least `apart`, (B, N) cells, from the truth.

    features, cell0, true1: as in draw_partners.
    """
    rows, columns = features.shape[3:]
    described0, described1 = features.flatten(3).transpose(2, 3).unbind(dim=1)
    own = described0[torch.arange(len(cell0))[:, None], cell0[..., 1] * columns + cell0[..., 0]]
    off = (list_cells(rows, columns) - true1[:, :, None]).abs().amax(dim=3)
    best = (own @ described1.transpose(1, 2)).masked_fill(off < apart[..., None], -torch.inf).argmax(dim=2)
    return torch.stack([best % columns, best // columns], dim=2)


def is_in_map(cell: Tensor, features: Tensor) -> Tensor:
    """(B, N) bool: whether cells (B, N, 2) are some of the features'."""
    return ((cell >= 0) & (cell < torch.tensor(features.shape[:2:-1]))).all(dim=2)


def draw_starts(homography: Tensor, wrong: Tensor, half: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Where the head would start if something had predicted the patches, not quite right.

    homography: (P, 3, 3) cells; wrong: (P,) bool, patches whose prediction lies around their cell of B, and not where
    they truly are. Returns (P, 2) int64, the step from this cell to the one nearest to the prediction, and (P, 4, 2)
    float32, the displacements of the corners there.
    """
    corners = make_corners(half)
    moved = apply_homography(homography, torch.cat([torch.zeros(1, 2), corners]))
    centre, shape = moved[:, :1], moved[:, 1:] - moved[:, :1]
    length, angle = torch.rand(2, len(wrong), generator=generator)
    turn, growth = torch.randn(2, len(wrong), generator=generator)
    shift = START_CELLS * length[:, None].square() * make_directions(2 * math.pi * angle)
    x, y = ((START_LOG_SCALE * growth).exp()[:, None] * make_directions(math.radians(START_TURN_DEG) * turn)).T
    turned = torch.stack([torch.stack([x, -y], dim=1), torch.stack([y, x], dim=1)], dim=1)
    place = torch.where(wrong[:, None], 0.0, centre[:, 0]) + shift
    step = torch.floor(place + 0.5)
    return step.long(), shape @ turned.transpose(1, 2) + (place - step)[:, None] - corners


def make_directions(angle: Tensor) -> Tensor:
    """(P, 2): the unit vectors at angles (P,) in radians."""
    return torch.stack([angle.cos(), angle.sin()], dim=1)


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
    points: Tensor, features: Tensor, per_pair: int, coarse_grid: Grid, fine_grid: Grid, half: float,
    generator: torch.Generator, jittered_share: float = JITTERED_SHARE,
) -> PointSupervision:  # fmt: skip
    """Draw coarse matches around known points, shifted and wrong ones in the same shares as draw_patches.

    points: (B, N, 4) float32 px (x, y in A, x, y in B), NaN where there is none; features: as in draw_patches. Of each
    pair at most `per_pair` points are taken. All start at the identity: of these patches no true shape is known.
    """
    drawn, real = draw_some(~points[..., 0].isnan(), per_pair, generator)
    points = points[torch.arange(len(points))[:, None], drawn].unflatten(2, (2, 2))
    coarse = coarse_grid.from_px(points)
    coarse0 = torch.floor(coarse[:, :, 0] + 0.5).nan_to_num().long()
    known = real & is_in_map(coarse0, features)
    coarse0 = torch.where(known[..., None], coarse0, 0)
    reach = 2 * half * fine_grid.stride / coarse_grid.stride
    coarse1, _ = draw_partners(features, coarse0, coarse[:, :, 1], reach, jittered_share, generator)

    image_index, number = (known & is_in_map(coarse1, features)).nonzero(as_tuple=True)
    cell0, cell1 = (fine_cell_of(c[image_index, number], coarse_grid, fine_grid) for c in (coarse0, coarse1))
    point0, point1 = fine_grid.from_px(points[image_index, number]).unbind(dim=1)
    point0, point1 = point0 - cell0, point1 - cell1
    correct = (point1 - point0).abs().amax(dim=1) < 2 * half
    return PointSupervision(image_index, cell0, cell1, point0, point1, correct)


def patch_homography(b_from_a: Tensor, cell0: Tensor, cell1: Tensor, grid: Grid) -> Tensor:
    """Homographies between images (P, 3, 3) px -> between patches (P, 3, 3) cells around cell0 and cell1 (P, 2)."""
    to_px = torch.eye(3, dtype=torch.float64).repeat(2, len(cell0), 1, 1)
    to_px[..., 0, 0] = to_px[..., 1, 1] = grid.stride
    to_px[0, :, :2, 2] = grid.to_px(cell0.double())
    to_px[1, :, :2, 2] = grid.to_px(cell1.double())
    homography = torch.linalg.solve(to_px[1], b_from_a.double() @ to_px[0])
    return (homography / homography[:, 2:, 2:]).float()
