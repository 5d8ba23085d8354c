"""The closed-form homographies of patches, against OpenCV and by their defining properties."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from hm_sfm.network.homography import (
    apply_homography,
    homography_from_corners,
    is_regular,
    make_corners,
    make_patch_grid,
)

HALF = 4.0
# Corners that move by less than a quarter of the patch's side keep it convex.
shifts = st.lists(st.floats(-1.875, 1.875, width=32), min_size=8, max_size=8)
halves = st.sampled_from((2.0, 4.0, 8.0))


def displaced(*rows: tuple[float, float]) -> torch.Tensor:
    """(1, 4, 2): top left, top right, bottom left, bottom right."""
    return torch.tensor([rows], dtype=torch.float32)


@given(shifts=shifts, half=halves)
def test_corners_move_as_displaced(shifts, half):
    displacement = torch.tensor(shifts).view(1, 4, 2) * half / HALF
    corners = make_corners(half)
    moved = apply_homography(homography_from_corners(displacement, half), corners)
    torch.testing.assert_close(moved - corners, displacement, atol=2e-4 * half, rtol=0)


@given(shifts=shifts, half=halves)
def test_agrees_with_opencv(shifts, half):
    displacement = torch.tensor(shifts).view(1, 4, 2) * half / HALF
    corners = make_corners(half)
    expected = cv2.getPerspectiveTransform(corners.numpy(), (corners + displacement[0]).numpy())
    actual = homography_from_corners(displacement, half)[0].numpy()
    np.testing.assert_allclose(actual, expected / expected[2, 2], atol=1e-3 * half)


def test_no_displacement_is_the_identity():
    homography = homography_from_corners(torch.zeros(3, 4, 2), HALF)
    torch.testing.assert_close(homography, torch.eye(3).expand(3, 3, 3), atol=1e-7, rtol=0)


def test_every_patch_has_its_own_homography():
    displacement = torch.stack([torch.full((4, 2), 1.0), torch.tensor([2.0, -3.0]).expand(4, 2)])
    centres = apply_homography(homography_from_corners(displacement, HALF), torch.zeros(1, 2))
    torch.testing.assert_close(centres, torch.tensor([[[1.0, 1.0]], [[2.0, -3.0]]]))


def test_no_patches():
    homography = homography_from_corners(torch.zeros(0, 4, 2), HALF)
    assert homography.shape == (0, 3, 3)
    assert apply_homography(homography, torch.zeros(5, 2)).shape == (0, 5, 2)
    assert is_regular(homography, HALF).shape == (0,)


def test_apply_maps_shared_and_own_points_as_matrix_products_do():
    homography = torch.tensor([[1.1, 0.2, 3.0], [-0.1, 0.9, -2.0], [0.01, -0.02, 1.0]]).repeat(2, 1, 1)
    homography[1, 0, 2] = 7.0
    points = torch.tensor([[0.0, 0.0], [4.0, -4.0], [1.5, 2.5]])
    product = torch.cat([points, torch.ones(3, 1)], dim=1) @ homography.transpose(1, 2)
    expected = product[..., :2] / product[..., 2:]
    torch.testing.assert_close(apply_homography(homography, points), expected)
    torch.testing.assert_close(apply_homography(homography, points.expand(2, 3, 2)), expected)


def test_grid_runs_row_by_row():
    grid = make_patch_grid(1.0)
    assert grid.tolist() == [[x, y] for y in (-1, 0, 1) for x in (-1, 0, 1)]
    assert len(make_patch_grid(2.0, 0.5)) == 81


@pytest.mark.parametrize("shift", [0.0, 1.5, -30.0])
def test_plain_shifts_are_regular(shift):
    assert is_regular(homography_from_corners(torch.full((1, 4, 2), shift), HALF), HALF).all()


@pytest.mark.parametrize(
    "displacement",
    [
        pytest.param(displaced((8, 0), (-8, 0), (8, 0), (-8, 0)), id="mirrored"),
        pytest.param(displaced((8, 0), (-8, 0), (0, 0), (0, 0)), id="folded like a bow tie"),
        pytest.param(displaced((7, 7), (0, 0), (0, 0), (0, 0)), id="a corner pushed through the diagonal"),
        pytest.param(displaced((4, 4), (-4, 4), (4, -4), (-4, -4)), id="all in one point"),
        pytest.param(displaced((0, 4), (0, 4), (0, -4), (0, -4)), id="flattened to a line"),
        pytest.param(displaced((3.4, 0), (-3.4, 0), (0, 0), (0, 0)), id="strong perspective"),
        pytest.param(torch.full((1, 4, 2), torch.nan), id="not a number"),
    ],
)
def test_folded_and_mirrored_patches_are_irregular(displacement):
    assert not is_regular(homography_from_corners(displacement, HALF), HALF).any()


@given(shifts=st.lists(st.floats(-12, 12, width=32), min_size=8, max_size=8))
def test_regular_means_a_convex_unmirrored_quad(shifts):
    displacement = torch.tensor(shifts).view(1, 4, 2)
    if is_regular(homography_from_corners(displacement, HALF), HALF).item():
        quad = (make_corners(HALF) + displacement[0])[[0, 1, 3, 2]].numpy().astype(np.float64)
        sides = np.roll(quad, -1, axis=0) - quad
        following = np.roll(sides, -1, axis=0)
        turns = sides[:, 0] * following[:, 1] - sides[:, 1] * following[:, 0]
        assert (turns > -1e-3).all()


@given(shifts=st.lists(st.sampled_from((-8.0, -4.0, 0.0, 4.0, 8.0)), min_size=8, max_size=8))
def test_values_and_gradients_stay_finite_even_where_the_patch_collapses(shifts):
    displacement = torch.tensor(shifts).view(1, 4, 2).requires_grad_()
    mapped = apply_homography(homography_from_corners(displacement, HALF), make_patch_grid(2.0, 0.5))
    assert mapped.isfinite().all()
    mapped.sum().backward()
    assert displacement.grad.isfinite().all()
