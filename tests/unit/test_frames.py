"""The identities of the one frame of coordinates."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hm_sfm.geometry.frames import (
    Grid,
    homography_from_pixel_index,
    homography_to_pixel_index,
    px_from_pixel_index,
    rotation_matrix,
)

sides = st.integers(1, 5000)
rotations = st.sampled_from((0, 90, 180, 270))
coordinates = st.floats(-1e4, 1e4, allow_nan=False)


def turned_size(size_wh, rotation_deg):
    return size_wh if rotation_deg in (0, 180) else size_wh[::-1]


def turn_points(xy, size_wh, rotation_deg):
    matrix = rotation_matrix(size_wh, rotation_deg)
    return xy @ matrix[:2, :2].T + matrix[:2, 2]


@given(width=sides, height=sides, rotation=rotations, x=coordinates, y=coordinates)
def test_turning_there_and_back_is_the_identity(width, height, rotation, x, y):
    xy = np.array([[x, y]])
    there = turn_points(xy, (width, height), rotation)
    back = turn_points(there, turned_size((width, height), rotation), -rotation % 360)
    np.testing.assert_allclose(back, xy, atol=1e-9)


@given(width=sides, height=sides, rotation=rotations)
def test_rotation_matrix_of_the_turn_back_is_the_inverse(width, height, rotation):
    there = rotation_matrix((width, height), rotation)
    back = rotation_matrix(turned_size((width, height), rotation), -rotation % 360)
    assert np.array_equal(back @ there, np.eye(3))


@given(width=sides, height=sides, x=coordinates, y=coordinates)
def test_two_quarter_turns_are_a_half_turn(width, height, x, y):
    xy = np.array([x, y])
    twice = turn_points(turn_points(xy, (width, height), 90), (height, width), 90)
    np.testing.assert_allclose(twice, turn_points(xy, (width, height), 180), atol=1e-9)


@given(width=st.integers(1, 9), height=st.integers(1, 9), rotation=rotations, column=st.integers(0), row=st.integers(0))
def test_points_turn_as_pixels_do(width, height, rotation, column, row):
    column, row = column % width, row % height
    impulse = np.zeros((height, width))
    impulse[row, column] = 1
    turned_row, turned_column = np.argwhere(np.rot90(impulse, -rotation // 90))[0]  # rot90 counts anticlockwise
    centre = px_from_pixel_index(np.array([column, row], dtype=np.float64))
    turned_centre = px_from_pixel_index(np.array([turned_column, turned_row], dtype=np.float64))
    assert np.array_equal(turn_points(centre, (width, height), rotation), turned_centre)
    assert np.array_equal(rotation_matrix((width, height), rotation) @ [*centre, 1], [*turned_centre, 1])


def test_the_top_left_pixel_has_its_centre_at_one_half():
    assert np.array_equal(px_from_pixel_index(np.zeros(2)), [0.5, 0.5])


@given(
    stride=st.sampled_from((1, 2, 4, 8, 16)),
    offset=st.sampled_from((0.0, 0.5, 1.0, 4.0)),
    cells=st.lists(st.integers(0, 2000), max_size=5),
)
def test_grid_round_trip(stride, offset, cells):
    grid = Grid(stride, offset)
    cells = np.array(cells, dtype=np.float64)
    assert np.array_equal(grid.from_px(grid.to_px(cells)), cells)


def test_a_pooled_grid_has_its_cells_at_the_mean_of_their_pixel_centres():
    pixel_centres = px_from_pixel_index(np.arange(32.0))
    assert np.array_equal(Grid(8, 4.0).to_px(np.arange(4.0)), pixel_centres.reshape(4, 8).mean(1))


def test_pixel_index_homographies_convert_there_and_back():
    homography = np.array([[1.1, 0.02, 5], [-0.03, 0.9, 7], [1e-4, -2e-4, 1]])
    assert np.allclose(homography_to_pixel_index(homography_from_pixel_index(homography)), homography)
    shift = homography_from_pixel_index(np.diag([2.0, 2.0, 1.0]))
    assert np.allclose(shift @ [0.5, 0.5, 1], [0.5, 0.5, 1])
