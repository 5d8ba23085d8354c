"""Growing matches: the homography of a good match says where the neighbours of its patch should be.

The coarse stage compares cells one by one and misses many where views differ: repeated or weak texture, other scales
and angles. A neighbour's homography predicts both place and shape of such a patch, so the fine stage can start there.
Only estimates that turn out good are kept, and grow further: a wrong match has no neighbours that agree with it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from hm_sfm.network.homography import apply_homography, is_regular, make_corners

STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1))

Estimate = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
"""cell0, cell1 (P, 2) int64 fine cells and start (P, 4, 2) displacements -> homography (P, 3, 3), log_scale (P,)."""


@dataclass(frozen=True)
class PatchGrid:
    """The patches of image 0, one per coarse cell."""

    columns: int
    rows: int
    first_cell: int
    """Fine cell of the first coarse cell's patch, along both axes."""
    spacing: int
    """Fine cells from one patch to the next."""
    half: float
    """Of a patch, cells."""

    def to_fine(self, index: Tensor) -> Tensor:
        """(P,) int64 coarse cells, counted row by row -> (P, 2) int64 fine cells (x, y)."""
        return torch.stack([index % self.columns, index // self.columns], dim=1) * self.spacing + self.first_cell


@dataclass(frozen=True)
class GridMatches:
    """At most one match per coarse cell of image 0."""

    index0: Tensor
    """(P,) int64: coarse cells of image 0, counted row by row."""
    cell1: Tensor
    """(P, 2) int64: fine cells of image 1, the centres of the patches there."""
    homography: Tensor
    """(P, 3, 3) float32, patch of image 0 -> patch of image 1, cells."""
    log_scale: Tensor
    """(P,) float32: log of the expected error, cells."""


def grow_matches(
    matches: GridMatches, grid: PatchGrid, estimate: Estimate, size1_wh: tuple[int, int], good: float, rounds: int
) -> GridMatches:
    """Spread good matches (log_scale below `good`) to the neighbouring cells that have none, `rounds` times.

    size1_wh: cells of image 1's fine map. Of several good neighbours the best one predicts. Returns the matches of all
    cells that have one, given or grown, by cell; a given one that is not good gives way to a better one.
    """
    count, device = grid.columns * grid.rows, matches.index0.device
    log_scale = torch.full((count,), torch.inf, device=device)
    homography = torch.zeros(count, 3, 3, device=device)
    cell1 = torch.zeros(count, 2, dtype=torch.int64, device=device)

    def put(index: Tensor, these: GridMatches, chosen: Tensor) -> None:
        log_scale[index], homography[index], cell1[index] = (
            these.log_scale[chosen], these.homography[chosen], these.cell1[chosen],
        )  # fmt: skip

    put(matches.index0, matches, torch.arange(len(matches.index0), device=device))
    usable = is_regular(matches.homography, grid.half) & (matches.log_scale < good)
    fresh = matches.index0[usable]
    corners = make_corners(grid.half, device)
    for _ in range(rounds):
        target, source, step = find_neighbours(fresh, log_scale, grid, good)
        offset = step * float(grid.spacing)
        moved = apply_homography(homography[source], offset[:, None] + torch.cat([corners.new_zeros(1, 2), corners]))
        place = torch.floor(moved[:, 0] + cell1[source] + 0.5).long()
        inside = ((place >= 0) & (place < torch.tensor(size1_wh, device=device))).all(dim=1)
        target, source, place, moved = target[inside], source[inside], place[inside], moved[inside, 1:]
        if not len(target):
            break
        start = moved + (cell1[source] - place)[:, None] - corners
        grown = GridMatches(target, place, *estimate(grid.to_fine(target), place, start))
        better = is_regular(grown.homography, grid.half) & (grown.log_scale < log_scale[target].clamp_max(good))
        put(target[better], grown, better)
        fresh = target[better]
    index0 = torch.isfinite(log_scale).nonzero().flatten()
    return GridMatches(index0, cell1[index0], homography[index0], log_scale[index0])


def find_neighbours(fresh: Tensor, log_scale: Tensor, grid: PatchGrid, good: float) -> tuple[Tensor, Tensor, Tensor]:
    """The cells beside `fresh` ones (F,) that have no good match.

    log_scale: (N,) of all cells, inf where there is no match. Returns (K,) cells, each once, (K,) the best fresh cell
    beside each, and (K, 2) int64 steps (x, y) from the latter to the former.
    """
    steps = torch.tensor(STEPS, device=fresh.device)
    x = (fresh % grid.columns)[:, None] + steps[:, 0]
    y = (fresh // grid.columns)[:, None] + steps[:, 1]
    inside = (x >= 0) & (x < grid.columns) & (y >= 0) & (y < grid.rows)
    source, direction = inside.nonzero(as_tuple=True)
    target = (y * grid.columns + x)[inside]
    source = fresh[source]
    free = log_scale[target] >= good
    target, source, direction = target[free], source[free], direction[free]
    order = log_scale[source].argsort(stable=True)
    target, source, direction = target[order], source[order], direction[order]
    cells, group = target.unique(return_inverse=True)
    first = torch.full((len(cells),), len(target), device=fresh.device)
    first.scatter_reduce_(0, group, torch.arange(len(target), device=fresh.device), reduce="amin")
    return target[first], source[first], steps[direction[first]]
