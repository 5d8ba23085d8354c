"""The supervision of a training pair, for both stages, and the losses that compare with it."""

import dataclasses
import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from hm_sfm.geometry.frames import Grid
from hm_sfm.network.backbone import LightBackbone
from hm_sfm.network.fine import FineEstimate
from hm_sfm.network.homography import apply_homography, homography_from_corners, make_corners
from hm_sfm.network.resnet import LoftrBackbone
from hm_sfm.training import losses
from hm_sfm.training.losses import (
    TEACHER_ERROR,
    measure_coarse_loss,
    measure_errors,
    measure_loss,
    measure_point_loss,
)
from hm_sfm.training.supervision import (
    CoarseSupervision,
    PatchSupervision,
    PointSupervision,
    draw_patches,
    draw_point_patches,
    find_coarse_matches,
    find_lookalikes,
)

COARSE, FINE = LightBackbone.coarse_grid, LightBackbone.fine_grid
HALF = 4.0


def map_points(homography: np.ndarray, xy: np.ndarray) -> np.ndarray:
    mapped = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1) @ homography.T
    return mapped[..., :2] / mapped[..., 2:]


# Patches and the loss of the fine stage


def make_features(rows: int, columns: int, pairs: int = 1) -> torch.Tensor:
    """(B, 2, 32, rows, columns) of unit length: the same for both views, no two cells alike."""
    features = torch.randn(pairs, 1, 32, rows, columns, generator=torch.Generator().manual_seed(5))
    return F.normalize(features, dim=2).expand(-1, 2, -1, -1, -1)


def draw(b_from_a: np.ndarray, seed: int = 0, per_pair: int = 400, **changed) -> PatchSupervision:
    matrix = torch.tensor(b_from_a, dtype=torch.float32).reshape(-1, 1, 3, 3)
    surface = torch.zeros(len(matrix), 256, 256, dtype=torch.int64)
    settings = {"features": make_features(32, 32, len(matrix)), "surface": surface} | changed
    generator = torch.Generator().manual_seed(seed)
    return draw_patches(
        matrix, per_pair=per_pair, coarse_grid=COARSE, fine_grid=FINE, half=HALF, generator=generator, **settings
    )


@pytest.mark.parametrize("started_share", [0.0, 1.0])
def test_patches_hold_the_ground_truth(started_share):
    b_from_a = np.array([[[1.1, -0.1, 9.0], [0.12, 0.95, -14.0], [1e-4, 2e-4, 1.0]], np.eye(3)])
    supervision = draw(b_from_a, started_share=started_share)
    assert 400 < len(supervision.cell0) <= 800
    points = torch.tensor([[0.0, 0.0], [-4.0, 4.0], [2.5, 1.0]])
    in_patch = apply_homography(supervision.homography, points).double().numpy()
    for matrix in range(2):
        mine = (supervision.image_index == matrix).numpy()
        px0 = FINE.to_px(supervision.cell0.numpy()[mine][:, None] + points.numpy())
        px1 = FINE.to_px(supervision.cell1.numpy()[mine][:, None] + in_patch[mine])
        np.testing.assert_allclose(px1, map_points(b_from_a[matrix], px0), atol=0.01)
    corners = make_corners(HALF)
    moved = apply_homography(homography_from_corners(supervision.displacement, HALF), corners)
    correct = supervision.correct
    torch.testing.assert_close(
        moved[correct], apply_homography(supervision.homography, corners)[correct], atol=1e-3, rtol=1e-3
    )


def test_most_patches_are_within_reach_and_some_are_wrong():
    supervision = draw(np.eye(3))
    apart = apply_homography(supervision.homography, torch.zeros(1, 2))[:, 0].norm(dim=1)
    assert 0.8 < supervision.correct.float().mean() < 0.9
    assert (apart[supervision.correct] <= 4 * 2**0.5 + 1e-3).all()
    exact = (apart < 1e-3).float().mean()
    assert 0.55 < exact < 0.75
    assert apart[~supervision.correct].median() > 20 and apart[~supervision.correct].min() >= 2 * HALF
    assert not supervision.start.any()


def test_patches_without_partner_are_left_out():
    far = np.array([[1, 0, 128.0], [0, 1, 0], [0, 0, 1]])
    supervision = draw(far)
    assert len(supervision.cell0) > 50
    assert (FINE.to_px(supervision.cell0[:, 0]) < 132).all()
    away = draw(np.array([[1, 0, 1000.0], [0, 1, 0], [0, 0, 1]]))
    assert len(away.cell0) == 0


def test_all_patches_are_drawn_where_the_partner_is_shown():
    """Even if that is a small part of the view; each cell at most once."""
    surface = torch.full((2, 256, 256), -1)
    surface[0, 64:128, 64:128] = 0
    surface[1, 100:200] = 0
    shift = np.tile(np.array([[1, 0, 8.0], [0, 1, 0], [0, 0, 1]]), (2, 1, 1))
    supervision = draw(shift, surface=surface, per_pair=60)
    drawn = supervision.image_index.bincount()
    assert drawn.tolist() == [60, 60]
    px0 = FINE.to_px(supervision.cell0).long() - 1  # as in test_patches_of_scenes_follow_their_own_surface
    assert (surface[supervision.image_index, px0[:, 1], px0[:, 0]] == 0).all()
    both = torch.cat([supervision.image_index[:, None], supervision.cell0], dim=1)
    assert len(both.unique(dim=0)) == 120


def test_most_wrong_patches_look_right():
    """Cells of A have a twin in B, 96 px farther to the right than their partner."""
    features = make_features(32, 32)
    here, there = features[:, 0, :, :, :20], features[:, 1].clone()
    there[..., 12:] = here
    there[..., :12] = here[..., :12] + 0.3 * make_features(32, 12)[:, 0].flip(3)
    both = torch.stack([features[:, 0], F.normalize(there, dim=1)], dim=1)
    surface = torch.full((1, 256, 256), -1)
    surface[..., :80] = 0
    supervision = draw(np.eye(3), features=both, surface=surface)
    off = (supervision.cell1 - supervision.cell0)[~supervision.correct]
    twins = (off == torch.tensor([48, 0])).all(dim=1)
    assert len(off) > 30 and 0.6 < twins.float().mean() < 0.9


def test_lookalikes_are_searched_beyond_the_reach():
    features = make_features(12, 16)
    cell0 = torch.tensor([[[3, 2], [10, 7]]])
    for apart in (0.5, 3.0):
        best = find_lookalikes(features, cell0, cell0.float(), torch.full((1, 2), apart))
        for cell, actual in zip(cell0[0].tolist(), best[0].tolist()):
            own = features[0, 0, :, cell[1], cell[0]]
            similarity = {
                (x, y): float(own @ features[0, 1, :, y, x])
                for x in range(16) for y in range(12) if max(abs(x - cell[0]), abs(y - cell[1])) >= apart
            }  # fmt: skip
            assert tuple(actual) == max(similarity, key=similarity.get)
    assert find_lookalikes(features, cell0, cell0.float(), torch.zeros(1, 2)).tolist() == cell0.tolist()


def test_started_patches_start_near_the_truth():
    """They are a share of all, right and wrong ones, and not a cell off."""
    b_from_a = np.array([[1.2, -0.3, 20.0], [0.3, 1.1, -14.0], [1e-4, 2e-4, 1.0]])
    supervision = draw(b_from_a, started_share=0.3)
    started = supervision.start.any(dim=2).any(dim=1)
    assert 0.2 < started.float().mean() < 0.4 and started[~supervision.correct].any()
    near = started & supervision.correct
    corners = make_corners(HALF)
    begun, true = (homography_from_corners(x[near], HALF) for x in (supervision.start, supervision.displacement))
    centre = torch.zeros(1, 2)
    shift = (apply_homography(begun, centre) - apply_homography(true, centre))[:, 0].norm(dim=1)
    assert 1 < shift.max() < 2.1 and 0.3 < shift.median() < 0.8
    # The patch of B is cut where the prediction lies: it begins within half a cell of its centre.
    assert apply_homography(begun, centre).abs().max() < 0.6
    # Shape: the diagonals of the quads.
    diagonals = [
        (x[near] + corners)[:, 3] - (x[near] + corners)[:, 0] for x in (supervision.start, supervision.displacement)
    ]
    length, direction = zip(*((d.norm(dim=1), torch.atan2(d[:, 1], d[:, 0])) for d in diagonals))
    turned = torch.rad2deg(direction[0] - direction[1])
    assert 3 < turned.std() < 8 and 0.06 < (length[0] / length[1]).log().std() < 0.2
    assert not draw(b_from_a).start.any()


def test_the_same_generator_draws_the_same_patches():
    one, other, third = draw(np.eye(3), 1), draw(np.eye(3), 1), draw(np.eye(3), 2)
    assert torch.equal(one.cell1, other.cell1) and not torch.equal(one.cell1[:100], third.cell1[:100])


def make_supervision(count: int = 6) -> PatchSupervision:
    displacement = torch.randn(count, 4, 2, generator=torch.Generator().manual_seed(0)) * 0.5
    cells = torch.zeros(count, 2, dtype=torch.int64)
    return PatchSupervision(
        cells[:, 0], cells, cells, homography_from_corners(displacement, HALF), displacement,
        torch.ones(count, dtype=torch.bool), torch.zeros(count, 4, 2),
    )  # fmt: skip


def make_estimate(displacement: torch.Tensor, log_scale: float = 0.0) -> FineEstimate:
    return FineEstimate(
        displacement, homography_from_corners(displacement, HALF), torch.full((len(displacement),), log_scale)
    )


def test_the_ground_truth_has_no_error():
    supervision = make_supervision()
    estimate = make_estimate(supervision.displacement)
    assert measure_errors(estimate, supervision).shape == (6, 81)
    assert measure_errors(estimate, supervision).max() < 1e-4
    parts = measure_loss([estimate], supervision, HALF)
    assert parts["dense"] < 1e-4 and parts["corner"] < 1e-4


def test_errors_are_distances_in_cells():
    supervision = make_supervision()
    shifted = dataclasses.replace(make_estimate(supervision.displacement), homography=supervision.homography.clone())
    shifted.homography[:, 0] += 3 * supervision.homography[:, 2]
    shifted.homography[:, 1] += 4 * supervision.homography[:, 2]
    torch.testing.assert_close(measure_errors(shifted, supervision), torch.full((6, 81), 5.0))


def test_the_loss_prefers_the_better_estimate_and_the_later_iteration():
    supervision = make_supervision()
    good, bad = make_estimate(supervision.displacement + 0.1), make_estimate(supervision.displacement + 1.0)
    losses = [
        measure_loss(estimates, supervision, HALF)["loss"] for estimates in ([good], [bad], [bad, good], [good, bad])
    ]
    assert losses[0] < losses[1] and losses[2] < losses[3]


def test_the_error_scale_is_best_at_the_error_itself():
    supervision = make_supervision()
    # A plain shift of the corners is not quite one of the dense points: the scale is taught their mean distance.
    error = measure_errors(make_estimate(supervision.displacement + 0.5), supervision).mean()
    scales = [
        measure_loss([make_estimate(supervision.displacement + 0.5, float(error.log()) + off)], supervision, HALF)[
            "scale"
        ]
        for off in (-1.0, 0.0, 1.0)
    ]
    assert scales[1] < min(scales[0], scales[2])


def test_wrong_and_folded_patches_teach_no_dense_points():
    supervision = make_supervision()
    folded = supervision.displacement.clone()
    folded[0] += torch.tensor([[8.0, 0], [-8.0, 0], [8.0, 0], [-8.0, 0]])
    estimate = make_estimate(folded)
    assert measure_loss([estimate], supervision, HALF)["dense"] < 1e-4
    assert measure_loss([estimate], supervision, HALF)["corner"] > 0.1
    wrong = dataclasses.replace(supervision, correct=torch.zeros(6, dtype=torch.bool))
    parts = measure_loss([make_estimate(supervision.displacement + 1)], wrong, HALF)
    assert parts["dense"] == 0 and parts["corner"] == 0 and parts["scale"] > 1


def test_without_patches_there_is_nothing_to_learn():
    supervision = make_supervision(0)
    estimate = make_estimate(torch.zeros(0, 4, 2))
    assert all(value == 0 for value in measure_loss([estimate, estimate], supervision, HALF).values())


def test_the_centre_alone_can_supervise():
    supervision = make_supervision()
    errors = measure_errors(make_estimate(supervision.displacement + 0.5), supervision, dense=False)
    assert errors.shape == (6, 1)
    centre = torch.zeros(1, 2)
    moved = apply_homography(make_estimate(supervision.displacement + 0.5).homography, centre)
    torch.testing.assert_close(errors, (moved - apply_homography(supervision.homography, centre)).norm(dim=-1))
    # Turned and stretched about the right centre: only the dense points know better.
    turned = torch.eye(3).repeat(6, 1, 1)
    turned[:, :2, :2] = torch.tensor([[0.8, -0.6], [0.6, 0.8]]) * 1.3
    estimate = dataclasses.replace(
        make_estimate(supervision.displacement + 0.5), homography=supervision.homography @ turned
    )
    parts = measure_loss([estimate], supervision, HALF, dense=False)
    assert parts["dense"] < 1e-4 and measure_loss([estimate], supervision, HALF)["dense"] > 0.1
    assert parts["corner"] > 0 and parts["loss"] < parts["corner"] * 1e-3 + parts["scale"]


def test_without_suppressed_patches_none_is_a_cell_off():
    supervision = draw(np.eye(3), jittered_share=0.0)
    apart = apply_homography(supervision.homography, torch.zeros(1, 2))[:, 0].norm(dim=1)
    assert (apart[supervision.correct] < 1e-3).float().mean() > 0.98 and (~supervision.correct).any()


# Patches of which one point is known

SIZE_WH = (256, 192)


def draw_points(points: torch.Tensor, seed: int = 0, per_pair: int = 300, **changed) -> PointSupervision:
    generator = torch.Generator().manual_seed(seed)
    features = make_features(SIZE_WH[1] // 8, SIZE_WH[0] // 8, len(points))
    return draw_point_patches(points, features, per_pair, COARSE, FINE, HALF, generator, **changed)


@pytest.fixture
def points() -> torch.Tensor:
    """(2, 500, 4) px: those of the first pair are 20 px apart, those of the second, of which 100 are known, 30 px."""
    generator = torch.Generator().manual_seed(3)
    xy = torch.rand(2, 500, 2, generator=generator) * torch.tensor([200.0, 190.0])
    both = torch.cat([xy, xy + torch.tensor([20.0, 0.0])], dim=2)
    both[1, :, 2] += 10
    both[1, 100:] = torch.nan
    return both


def test_points_stay_where_they_are_relative_to_their_patches(points):
    supervision = draw_points(points)
    assert supervision.cell0.dtype == supervision.cell1.dtype == torch.int64
    px0, px1 = (
        FINE.to_px(cell + point)
        for cell, point in ((supervision.cell0, supervision.point0), (supervision.cell1, supervision.point1))
    )
    shift = torch.where(supervision.image_index == 0, 20.0, 30.0)
    torch.testing.assert_close(px1 - px0, torch.stack([shift, torch.zeros(len(shift))], dim=1), atol=1e-3, rtol=0)
    given = points[supervision.image_index, :, :2]
    assert ((given - px0[:, None]).abs().amax(dim=2) < 1e-3).any(dim=1).all()
    # A cell holds its points: they are no farther from its centre than half a cell, and the fine cell next to it.
    assert supervision.point0.abs().max() <= 2 + 0.5 + 1e-4
    assert (supervision.image_index == 0).sum() > 250 and 80 < (supervision.image_index == 1).sum() <= 100


def test_most_points_are_within_reach_and_some_are_wrong(points):
    supervision = draw_points(points)
    apart = (supervision.point1 - supervision.point0).abs().amax(dim=1)
    assert 0.8 < supervision.correct.float().mean() < 0.92
    assert apart[supervision.correct].max() < 2 * HALF and apart[~supervision.correct].median() > 2 * HALF
    beyond = supervision.point1[supervision.correct].abs().amax(dim=1) > 2.5 + 1e-4
    assert 0.1 < beyond.float().mean() < 0.4
    unshifted = draw_points(points, jittered_share=0.0)
    assert unshifted.point1[unshifted.correct].abs().max() <= 2.5 + 1e-4


def test_points_that_are_not_there_give_no_patches(points):
    assert len(draw_points(torch.full((2, 10, 4), torch.nan)).cell0) == 0
    assert len(draw_points(points[:, :0]).cell0) == 0
    assert (draw_points(points, per_pair=40).image_index.bincount() <= 40).all()
    one, other, third = draw_points(points, 1), draw_points(points, 1), draw_points(points, 2)
    assert torch.equal(one.point1, other.point1) and not torch.equal(one.point0[:50], third.point0[:50])


def make_point_supervision(count: int = 6, off: float = 0.0) -> tuple[FineEstimate, PointSupervision]:
    """An estimate, and points that lie `off` cells beside what it says."""
    estimate = make_estimate(make_supervision(count).displacement)
    point0 = torch.linspace(-2, 2, 2 * count).view(count, 2)
    point1 = apply_homography(estimate.homography, point0[:, None])[:, 0] + torch.tensor([0.0, off])
    cells = torch.zeros(count, 2, dtype=torch.int64)
    return estimate, PointSupervision(cells[:, 0], cells, cells, point0, point1, torch.ones(count, dtype=torch.bool))


def test_points_as_far_off_as_their_teachers_are_no_error():
    pulls = []
    for off in (0.0, 0.9 * TEACHER_ERROR, 0.9, 1.9):
        estimate, supervision = make_point_supervision(off=off)
        estimate = dataclasses.replace(estimate, homography=estimate.homography.clone().requires_grad_())
        loss = measure_point_loss([estimate], supervision, HALF)
        loss.backward()
        pulls.append((loss.item(), estimate.homography.grad.any().item()))
    losses, pulled = zip(*pulls)
    assert pulled == (False, False, True, True) and losses[1] < losses[2] < losses[3]


def test_the_error_scale_is_told_the_whole_error():
    """What teachers are off by is part of how far off a match is."""
    for off in (0.5 * TEACHER_ERROR, 0.8):
        estimate, supervision = make_point_supervision(off=off)
        losses = [
            measure_point_loss(
                [dataclasses.replace(estimate, log_scale=torch.full((6,), math.log(scale)))], supervision, HALF
            )
            for scale in (0.8 * off, off, 1.25 * off)
        ]
        assert losses[1] < min(losses[0], losses[2])


def test_wrong_points_teach_the_error_scale_only():
    estimate, supervision = make_point_supervision(off=3.0)
    wrong = dataclasses.replace(supervision, correct=torch.zeros(6, dtype=torch.bool))
    log_scale = torch.zeros(6, requires_grad=True)
    homography = estimate.homography.clone().requires_grad_()
    estimate = dataclasses.replace(estimate, homography=homography, log_scale=log_scale)
    measure_point_loss([estimate], wrong, HALF).backward()
    assert not homography.grad.any() and (log_scale.grad < 0).all()
    measure_point_loss([estimate], supervision, HALF).backward()
    assert homography.grad.any()


def test_without_points_there_is_nothing_to_learn():
    estimate, supervision = make_point_supervision(0)
    assert measure_point_loss([estimate], supervision, HALF) == measure_point_loss([], supervision, HALF) == 0


# Matches and the loss of the coarse stage

GRIDS = {"light": COARSE, "loftr": LoftrBackbone.coarse_grid}
NO_POINTS = torch.full((1, 0, 4), torch.nan)
NOWHERE = torch.full((1, 48, 64), -1)
"""The surfaces of a pair that is known by its points only: 8 x 6 cells."""


def find_matches(points: list[tuple[float, ...]], grid: Grid = COARSE) -> list[tuple[int, int]]:
    """Cell pairs of one pair of 64 x 48 px that is known by its points only."""
    given = torch.tensor(points, dtype=torch.float32).reshape(1, -1, 4)
    actual = find_coarse_matches(torch.eye(3).repeat(1, 1, 1, 1), NOWHERE, given, grid)
    assert not actual.image_index.any()
    return sorted(zip(actual.index0.tolist(), actual.index1.tolist()))


def find_matches_naively(b_from_a, surface, points, grid) -> set[tuple[int, int, int]]:
    """(pair, cell of A, cell of B), by a loop over all claims."""
    batch, height, width = surface.shape
    rows, columns = height // grid.stride, width // grid.stride
    kept = set()
    for item in range(batch):
        claims = []
        for row in range(rows):
            for column in range(columns):
                x, y = grid.to_px(column), grid.to_px(row)
                index = surface[item, int(y), int(x)]
                if index >= 0:
                    mapped = b_from_a[item, index].double().numpy() @ [x, y, 1]
                    claims.append((x, y, mapped[0] / mapped[2], mapped[1] / mapped[2]))
        claims += [tuple(point) for point in points[item].tolist() if not math.isnan(point[0])]
        best_of_b = {}
        for claim in claims:
            position = [grid.from_px(value) for value in claim]
            cell = [math.floor(value + 0.5) for value in position]
            if not all(0 <= c < size for c, size in zip(cell, (columns, rows) * 2)):
                continue
            off_centre = sum((value - c) ** 2 for value, c in zip(position, cell))
            index0, index1 = cell[1] * columns + cell[0], cell[3] * columns + cell[2]
            if index1 not in best_of_b or off_centre < best_of_b[index1][0]:
                best_of_b[index1] = off_centre, index0
        best_of_a = {}
        for index1, (off_centre, index0) in best_of_b.items():
            if index0 not in best_of_a or off_centre < best_of_a[index0][0]:
                best_of_a[index0] = off_centre, index1
        kept |= {(item, index0, index1) for index0, (_, index1) in best_of_a.items()}
    return kept


@pytest.mark.parametrize("name", GRIDS)
def test_coarse_matches_equal_a_naive_loop(name):
    """Three pairs: surfaces that overlap and points; points only; surfaces only."""
    rng = np.random.default_rng(4)
    b_from_a = torch.eye(3).repeat(3, 4, 1, 1)
    b_from_a[..., :2, :] += torch.tensor(rng.normal(size=(3, 4, 2, 3)) * [0.15, 0.15, 9], dtype=torch.float32)
    b_from_a[..., 2, :2] += torch.tensor(rng.normal(size=(3, 4, 2)) * 1e-3, dtype=torch.float32)
    surface = torch.tensor(rng.integers(-1, 4, (3, 12, 16))).repeat_interleave(4, 1).repeat_interleave(4, 2)
    surface[1] = -1
    points = torch.tensor(rng.uniform(-10, 75, (3, 150, 4)), dtype=torch.float32)
    points[:, ::3] = torch.nan
    points[2] = torch.nan
    actual = find_coarse_matches(b_from_a, surface, points, GRIDS[name])
    triples = list(zip(actual.image_index.tolist(), actual.index0.tolist(), actual.index1.tolist()))
    assert set(triples) == find_matches_naively(b_from_a, surface, points, GRIDS[name])
    assert [sum(item == i for item, _, _ in triples) > 10 for i in range(3)] == [True] * 3
    for columns in ((0, 1), (0, 2)):
        assert len({tuple(triple[c] for c in columns) for triple in triples}) == len(triples)


def test_of_several_claims_the_nearest_to_the_centres_wins():
    # The first two want the same cell of B, the last two come from the same cell of A.
    assert find_matches([(4, 4, 13, 12), (20, 4, 12, 12)]) == [(2, 9)]
    assert find_matches([(4, 4, 12, 12), (20, 4, 13, 12)]) == [(0, 9)]
    assert find_matches([(4, 5, 12, 12), (4, 4, 60, 44)]) == [(0, 47)]


@pytest.mark.parametrize(("name", "first_px"), [("light", 8.0), ("loftr", 4.5)])
def test_points_on_the_border_of_two_cells_belong_to_the_second(name, first_px):
    """Cells of light span [0, 8), [8, 16) ...: those of LoFTR sit 3.5 px further left and up."""
    before = math.nextafter(first_px, 0) - 1e-5
    grid = GRIDS[name]
    assert find_matches([(before, 1, 1, 1)], grid) == [(0, 0)]
    assert find_matches([(first_px, 1, 1, 1)], grid) == [(1, 0)]
    assert find_matches([(1, before, 1, 1)], grid) == [(0, 0)]
    assert find_matches([(1, first_px, 1, 1)], grid) == [(8, 0)]
    assert find_matches([(1, 1, first_px, first_px)], grid) == [(0, 9)]


def test_points_outside_a_view_are_no_matches():
    assert find_matches([(0, 0, 63.99, 47.99)]) == [(0, 47)]
    for index, beyond in ((0, -0.01), (1, -0.01), (2, 64.0), (3, 48.0)):
        point = [1.0] * 4
        point[index] = beyond
        assert find_matches([tuple(point)]) == []


def test_points_that_are_not_there_count_for_nothing():
    assert find_matches([]) == find_matches([(math.nan,) * 4] * 5) == []
    assert find_matches([(math.nan,) * 4, (1, 1, 1, 1), (math.nan,) * 4]) == [(0, 0)]


def test_every_cell_of_equal_views_matches_itself():
    actual = find_coarse_matches(torch.eye(3).repeat(1, 1, 1, 1), torch.zeros(1, 48, 64).long(), NO_POINTS, COARSE)
    assert sorted(actual.index0.tolist()) == list(range(48))
    assert torch.equal(actual.index0, actual.index1)


def make_cells(generator_seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """(3, 12, 8) and (3, 10, 8) features of three pairs."""
    generator = torch.Generator().manual_seed(generator_seed)
    return torch.randn(3, 12, 8, generator=generator), torch.randn(3, 10, 8, generator=generator)


def bound_loss(confidence: float) -> float:
    q, share = losses.COARSE_TRUNCATION, losses.UNBOUNDED_SHARE
    return (1 - share) * (1 - confidence**q) / q - share * math.log(confidence)


def measure_densely(coarse0, coarse1, sharpness, matches: list[list[tuple[int, int]]]) -> float:
    """The loss by whole matrices of confidences."""
    means = []
    for cells0, cells1, pairs in zip(coarse0, coarse1, matches):
        similarity = sharpness * cells0.double() @ cells1.double().T
        confidence = similarity.softmax(dim=0) * similarity.softmax(dim=1)
        if pairs:
            means.append(np.mean([bound_loss(confidence[i, j].item()) for i, j in pairs]))
    return float(np.mean(means))


def make_coarse_supervision(matches: list[list[tuple[int, int]]]) -> CoarseSupervision:
    rows = [(item, i, j) for item, pairs in enumerate(matches) for i, j in pairs]
    return CoarseSupervision(*torch.tensor(rows, dtype=torch.int64).reshape(-1, 3).unbind(dim=1))


@pytest.mark.parametrize(
    "matches",
    [
        pytest.param([[(0, 0), (3, 9)], [(11, 4)], [(5, 5), (6, 1), (7, 2)]], id="all pairs"),
        pytest.param([[], [(11, 4), (2, 0)], []], id="one pair"),
    ],
)
def test_the_coarse_loss_equals_that_of_whole_matrices(matches):
    coarse0, coarse1 = make_cells()
    actual = measure_coarse_loss(coarse0, coarse1, torch.tensor(1.7), make_coarse_supervision(matches))
    assert actual.item() == pytest.approx(measure_densely(coarse0, coarse1, 1.7, matches), rel=1e-5)


def test_pairs_without_matches_teach_nothing_and_break_nothing():
    coarse0, coarse1 = make_cells()
    coarse0.requires_grad_()
    loss = measure_coarse_loss(coarse0, coarse1, torch.tensor(1.7), make_coarse_supervision([[], [], []]))
    loss.backward()
    assert loss == 0 and not coarse0.grad.any()


def test_many_matches_are_thinned_evenly(monkeypatch):
    monkeypatch.setattr(losses, "COARSE_MATCHES", 4)
    coarse0, coarse1 = make_cells()
    matches = [[(i, 9 - i) for i in range(10)], [(0, 0), (1, 1), (2, 2)], []]
    thinned = [matches[0][::3], matches[1], []]
    actual = measure_coarse_loss(coarse0, coarse1, torch.tensor(1.7), make_coarse_supervision(matches))
    assert actual.item() == pytest.approx(measure_densely(coarse0, coarse1, 1.7, thinned), rel=1e-5)
