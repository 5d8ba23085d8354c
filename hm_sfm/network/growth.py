"""Growing matches: the homography of a good match says where the patches beside it should be.

The coarse stage matches some points only. A homography predicts both place and shape of the patches beside its own, so
the fine stage can start there. Only what it then rates as good is kept, and grows further: a wrong match has no
neighbours that agree with it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from hm_sfm.network.estimates import PatchEstimates
from hm_sfm.network.homography import apply_homography, is_regular, make_corners

BESIDE = ((1, 0), (-1, 0), (0, 1), (0, -1))
DIAGONAL = ((1, 1), (1, -1), (-1, 1), (-1, -1))
"""Steps (x, y) to the neighbours of a cell, on the whole grid and on one colour of a chessboard."""

Refine = Callable[[Tensor, Tensor, Tensor, Tensor], PatchEstimates]
"""cell0, cell1 (P, 2) int64 fine cells, start (P, 4, 2) displacements and place (P,) -> estimates."""


@dataclass(frozen=True)
class PatchGrid:
    """The patches of image 0 that matches grow into, one per coarse cell."""

    columns: int
    rows: int
    first_cell: int
    """Fine cell of the first coarse cell's patch, along both axes."""
    spacing: int
    """Fine cells from one patch to the next."""
    half: float
    """Of a patch, cells."""
    is_chessboard: bool = False
    """Whether only every second cell has a patch. Patches are wider than the spacing: these cover the image, too."""

    def to_fine(self, index: Tensor) -> Tensor:
        """(P,) int64 coarse cells, counted row by row -> (P, 2) int64 fine cells (x, y)."""
        return torch.stack([index % self.columns, index // self.columns], dim=1) * self.spacing + self.first_cell

    def holds(self, cell0: Tensor) -> Tensor:
        """(P,) bool: whether fine cells (P, 2) are centres of the grid's patches."""
        place = (cell0 - self.first_cell) / self.spacing
        size = torch.tensor([self.columns, self.rows], device=cell0.device)
        held = ((place == place.round()) & (place >= 0) & (place < size)).all(dim=1)
        return held & (place.sum(dim=1) % 2 == 0) if self.is_chessboard else held

    def find_nearest(self, cell0: Tensor) -> Tensor:
        """(P, 2) int64 fine cells -> (P,) int64 coarse cells: the nearest ones that have a patch."""
        place = (cell0 - self.first_cell).double() / self.spacing
        column, row = (place + 0.5).floor().long().unbind(dim=1)
        if self.is_chessboard:  # the nearest of the other colour is beside it, on the side of the point
            aside = place - torch.stack([column, row], dim=1)
            sideways = aside[:, 0].abs() >= aside[:, 1].abs()
            step = torch.where(aside < 0, -1, 1)
            is_other = (column + row) % 2 == 1
            column = column + step[:, 0] * (is_other & sideways)
            row = row + step[:, 1] * (is_other & ~sideways)
        inside = (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        return torch.where(inside, row * self.columns + column, -1)


def grow_matches(
    seeds: PatchEstimates, grid: PatchGrid, refine: Refine, size1_wh: tuple[int, int], good: float, rounds: int
) -> PatchEstimates:
    """Spread good matches (score of at least `good`) over the grid, `rounds` steps far.

    seeds: on the grid or beside it. size1_wh: cells of image 1's fine map. Of several good neighbours the best one
    predicts. Returns at most one match per coarse cell, seeds on the grid and grown ones, by cell; a seed that is not
    good gives way to a better match. What grew is as likely to be at the right place as the seed that it came from.
    """
    count, device = grid.columns * grid.rows, seeds.cell0.device
    best = PatchEstimates(
        cell0=grid.to_fine(torch.arange(count, device=device)),
        cell1=torch.zeros(count, 2, dtype=torch.int64, device=device),
        homography=torch.zeros(count, 3, 3, device=device),
        accuracy=torch.zeros(count, device=device),
        place=torch.zeros(count, device=device),
    )
    corners = make_corners(grid.half, device)

    def put(index: Tensor, matches: PatchEstimates) -> None:
        best.cell1[index], best.homography[index] = matches.cell1, matches.homography
        best.accuracy[index], best.place[index] = matches.accuracy, matches.place

    def predict(index: Tensor, sources: PatchEstimates) -> Tensor:
        """Match the patches of cells `index` as their sources predict; returns the cells that are good now."""
        offset = (best.cell0[index] - sources.cell0).float()
        around = offset[:, None] + torch.cat([corners.new_zeros(1, 2), corners])
        moved = apply_homography(sources.homography, around)
        cell1 = torch.floor(moved[:, 0] + sources.cell1 + 0.5).long()
        inside = ((cell1 >= 0) & (cell1 < torch.tensor(size1_wh, device=device))).all(dim=1)
        index, cell1, start = index[inside], cell1[inside], moved[inside, 1:] - corners
        start = start + (sources.cell1[inside] - cell1)[:, None]
        grown = refine(best.cell0[index], cell1, start, sources.place[inside])
        better = is_regular(grown.homography, grid.half) & (grown.score >= good) & (grown.score > best.score[index])
        put(index[better], grown.select(better))
        return index[better]

    nearest = grid.find_nearest(seeds.cell0)
    on_grid = grid.holds(seeds.cell0)
    put(nearest[on_grid], seeds.select(on_grid))
    is_good = is_regular(seeds.homography, grid.half) & (seeds.score >= good)
    beside = (is_good & ~on_grid & (nearest >= 0)).nonzero().flatten()
    chosen = choose_first(nearest[beside], seeds.score[beside].argsort(descending=True, stable=True))
    fresh = torch.cat([nearest[is_good & on_grid], predict(nearest[beside[chosen]], seeds.select(beside[chosen]))])
    for _ in range(rounds):
        target, source = find_neighbours(fresh, best.score, grid, good)
        if not len(target):
            break
        fresh = predict(target, best.select(source))
    return best.select(best.score > 0)


def find_neighbours(fresh: Tensor, score: Tensor, grid: PatchGrid, good: float) -> tuple[Tensor, Tensor]:
    """The cells beside `fresh` ones (F,) that have no good match.

    score: (N,) of all cells, 0 where there is no match. Returns (K,) cells, each once, and (K,) the best fresh cell
    beside each.
    """
    steps = torch.tensor(DIAGONAL if grid.is_chessboard else BESIDE, device=fresh.device)
    x = (fresh % grid.columns)[:, None] + steps[:, 0]
    y = (fresh // grid.columns)[:, None] + steps[:, 1]
    inside = (x >= 0) & (x < grid.columns) & (y >= 0) & (y < grid.rows)
    source = fresh[inside.nonzero(as_tuple=True)[0]]
    target = (y * grid.columns + x)[inside]
    free = score[target] < good
    target, source = target[free], source[free]
    chosen = choose_first(target, score[source].argsort(descending=True, stable=True))
    return target[chosen], source[chosen]


def choose_first(group: Tensor, order: Tensor) -> Tensor:
    """(K,) int64: of each value of `group`, (N,) int64, the index that comes first in `order`, (N,) int64."""
    values, number = group[order].unique(return_inverse=True)
    first = torch.full((len(values),), len(group), device=group.device)
    first.scatter_reduce_(0, number, torch.arange(len(group), device=group.device), reduce="amin")
    return order[first]
