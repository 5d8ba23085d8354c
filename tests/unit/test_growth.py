"""Growing matches: from a seed over a plane, exactly as far as asked, and only where the fine stage agrees."""

import pytest
import torch

from hm_sfm.network.estimates import PatchEstimates
from hm_sfm.network.growth import PatchGrid, grow_matches
from hm_sfm.network.homography import apply_homography, homography_from_corners, make_corners

HALF, GOOD = 4.0, 0.5
GRID = PatchGrid(columns=9, rows=7, first_cell=2, spacing=4, half=HALF)
SIZE1_WH = (60, 50)
PLANE = torch.tensor([[1.1, 0.1, 3.0], [-0.05, 0.95, 5.0], [1e-3, -5e-4, 1.0]], dtype=torch.float64)
"""Fine cells of image 0 -> fine cells of image 1."""


def move(points: torch.Tensor) -> torch.Tensor:
    mapped = torch.cat([points.double(), torch.ones(*points.shape[:-1], 1)], dim=-1) @ PLANE.T
    return mapped[..., :2] / mapped[..., 2:]


def true_displacement(cell0: torch.Tensor, cell1: torch.Tensor) -> torch.Tensor:
    """(P, 4, 2) of the corners of the patches around cell0, relative to cell1."""
    corners = make_corners(HALF)
    return (move(cell0[:, None] + corners) - cell1[:, None] - corners).float()


class Oracle:
    """A fine stage that knows the plane, on the cells of image 0 where there is one."""

    def __init__(self, known: torch.Tensor) -> None:
        self.known, self.calls = known, 0

    def __call__(self, cell0, cell1, start, place):
        self.calls += len(cell0)
        truth = true_displacement(cell0, cell1)
        # A start from the plane's own homography is the truth itself.
        torch.testing.assert_close(start, truth, atol=2e-3, rtol=0)
        index = (cell0 - GRID.first_cell) // GRID.spacing
        known = self.known[index[:, 1], index[:, 0]]
        accuracy = torch.where(known, 0.9, 0.1)
        return PatchEstimates(cell0, cell1, homography_from_corners(truth, HALF), accuracy, place)


def match_cells(cell0: torch.Tensor, accuracy: float = 0.9, place: float = 1.0) -> PatchEstimates:
    """True matches of patches around fine cells (P, 2) of image 0."""
    cell1 = torch.floor(move(cell0) + 0.5).long()
    homography = homography_from_corners(true_displacement(cell0, cell1), HALF)
    count = (len(cell0),)
    return PatchEstimates(cell0, cell1, homography, torch.full(count, accuracy), torch.full(count, place))


def make_matches(index0: list[int], accuracy: float = 0.9, place: float = 1.0) -> PatchEstimates:
    return match_cells(GRID.to_fine(torch.tensor(index0, dtype=torch.int64)), accuracy, place)


def index_of(matches: PatchEstimates) -> torch.Tensor:
    """Coarse cells, counted row by row."""
    column, row = ((matches.cell0 - GRID.first_cell) // GRID.spacing).unbind(dim=1)
    return row * GRID.columns + column


def grow(seeds: PatchEstimates, known: torch.Tensor, rounds: int, grid: PatchGrid = GRID):
    oracle = Oracle(known)
    return grow_matches(seeds, grid, oracle, SIZE1_WH, GOOD, rounds), oracle


EVERYWHERE = torch.ones(GRID.rows, GRID.columns, dtype=torch.bool)


@pytest.mark.parametrize("rounds", [0, 1, 2, 3])
def test_a_seed_grows_one_cell_a_round(rounds):
    column, row = 4, 3
    grown, _ = grow(make_matches([row * GRID.columns + column]), EVERYWHERE, rounds)
    away = (index_of(grown) % GRID.columns - column).abs() + (index_of(grown) // GRID.columns - row).abs()
    assert len(index_of(grown)) == sum((away == step).sum() for step in range(rounds + 1))
    assert len(index_of(grown)) == len(index_of(grown).unique()) == [1, 5, 13, 25][rounds]


def test_grown_matches_follow_the_plane():
    grown, _ = grow(make_matches([31]), EVERYWHERE, 20)
    cell0 = GRID.to_fine(index_of(grown))
    centre = apply_homography(grown.homography, torch.zeros(1, 2))[:, 0] + grown.cell1
    torch.testing.assert_close(centre.double(), move(cell0), atol=1e-3, rtol=0)
    # The patch of image 1 is the one around the prediction.
    assert (centre - grown.cell1).abs().max() <= 0.5 + 1e-3
    assert len(index_of(grown)) == GRID.columns * GRID.rows


def test_nothing_grows_out_of_image_1():
    """The plane puts the lower rows beyond an image 1 of 25 cells' height."""
    oracle = Oracle(EVERYWHERE)
    grown = grow_matches(make_matches([4]), GRID, oracle, (60, 25), GOOD, 20)
    assert grown.cell1[:, 1].max() < 25
    expected = torch.floor(move(GRID.to_fine(torch.arange(63))) + 0.5)[:, 1] < 25
    assert len(index_of(grown)) == expected.sum() < 63


def test_growth_ends_where_the_fine_stage_does_not_agree():
    known = EVERYWHERE.clone()
    known[:, 5] = False
    grown, oracle = grow(make_matches([3 * GRID.columns + 1]), known, 20)
    assert sorted((index_of(grown) % GRID.columns).unique().tolist()) == [0, 1, 2, 3, 4]
    assert len(index_of(grown)) == 5 * GRID.rows
    # The cells beyond are asked from each side, but not over and over.
    assert oracle.calls <= 5 * GRID.rows + 2 * GRID.rows


def test_matches_that_are_not_good_do_not_grow_but_stay():
    grown, oracle = grow(make_matches([10, 40], accuracy=0.3), EVERYWHERE, 5)
    assert index_of(grown).tolist() == [10, 40] and oracle.calls == 0


def test_a_good_neighbour_replaces_a_match_that_is_not_good():
    good, bad = make_matches([31]), make_matches([32], accuracy=0.3)
    bad.cell1[:] = 0
    both = PatchEstimates.concatenate([good, bad])
    grown, _ = grow(both, EVERYWHERE, 1)
    place = index_of(grown).tolist().index(32)
    assert grown.accuracy[place] == pytest.approx(0.9)
    torch.testing.assert_close(
        grown.cell1[place].double(), torch.floor(move(GRID.to_fine(torch.tensor([32])))[0] + 0.5)
    )


def test_good_matches_are_left_as_they_are():
    found = make_matches([31, 32], accuracy=0.7)
    grown, oracle = grow(found, EVERYWHERE, 1)
    kept = torch.isin(index_of(grown), index_of(found))
    assert torch.equal(grown.accuracy[kept], found.accuracy) and oracle.calls == len(index_of(grown)) - 2


def test_the_best_neighbour_predicts():
    """Between two good matches of different planes, the surer one says where to look."""
    left, right = make_matches([30], accuracy=0.7), make_matches([32], accuracy=0.95)
    left.homography[:, 0, 2] += 3.0
    both = PatchEstimates.concatenate([left, right])
    asked = {}

    def remember(cell0, cell1, start, place):
        asked.update(zip(map(tuple, cell0.tolist()), start))
        return PatchEstimates(cell0, cell1, homography_from_corners(start, HALF), torch.zeros(len(cell0)), place)

    grow_matches(both, GRID, remember, SIZE1_WH, GOOD, 1)
    between = GRID.to_fine(torch.tensor([31]))
    place = torch.floor(move(between) + 0.5).long()
    torch.testing.assert_close(
        asked[tuple(between[0].tolist())], true_displacement(between, place)[0], atol=2e-3, rtol=0
    )


def test_folded_patches_do_not_grow():
    found = make_matches([31])
    found.homography[:, 0, 0] *= -1
    grown, oracle = grow(found, EVERYWHERE, 2)
    assert index_of(grown).tolist() == [31] and oracle.calls == 0


def test_nothing_grows_from_nothing():
    grown, oracle = grow(make_matches([]), EVERYWHERE, 3)
    assert len(index_of(grown)) == len(grown.homography) == oracle.calls == 0


CHESSBOARD = PatchGrid(columns=9, rows=7, first_cell=2, spacing=4, half=HALF, is_chessboard=True)


def test_a_point_beside_the_grid_grows_over_one_colour_of_the_chessboard():
    point = torch.tensor([[17, 15]])
    grown, _ = grow(match_cells(point), EVERYWHERE, 20, CHESSBOARD)
    index = index_of(grown)
    assert torch.all((index % 9 + index // 9) % 2 == 0)
    assert len(index) == 32  # of 63 cells
    centre = apply_homography(grown.homography, torch.zeros(1, 2))[:, 0] + grown.cell1
    torch.testing.assert_close(centre.double(), move(grown.cell0), atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    ("cell0", "column_row"),
    [([2, 2], (0, 0)), ([3, 2], (0, 0)), ([6, 7], (1, 1)), ([7, 2], (2, 0)), ([6, 3], (1, 1)), ([5, 2], (0, 0))],
)
def test_the_nearest_patch_of_a_chessboard(cell0, column_row):
    nearest = CHESSBOARD.find_nearest(torch.tensor([cell0]))
    assert divmod(int(nearest), 9)[::-1] == column_row


def test_a_point_beyond_the_grid_has_no_patch():
    assert CHESSBOARD.find_nearest(torch.tensor([[80, 10]])).tolist() == [-1]
    grown, oracle = grow(match_cells(torch.tensor([[80, 10]])), EVERYWHERE, 3, CHESSBOARD)
    assert len(grown.cell0) == oracle.calls == 0


def test_what_grows_is_as_likely_at_the_right_place_as_its_seed():
    grown, _ = grow(make_matches([10], place=0.8), EVERYWHERE, 20)
    assert torch.allclose(grown.place, torch.tensor(0.8)) and len(grown.place) == 63
    torch.testing.assert_close(grown.score[index_of(grown) != 10], torch.full((62,), 0.72))
    unlikely, oracle = grow(make_matches([10], place=0.4), EVERYWHERE, 20)
    assert len(unlikely.cell0) == 1 and oracle.calls == 0
