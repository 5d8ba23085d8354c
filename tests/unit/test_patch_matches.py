"""PatchMatches: points that they transfer, and dense matches."""

import dataclasses

import numpy as np
import pytest

from hm_sfm.types import PatchMatches


def two_patches() -> PatchMatches:
    """Patches around (10.5, 10.5), which shifts by (100, 0), and (20.5, 10.5), which doubles about its centre."""
    shift = np.array([[1, 0, 100], [0, 1, 0], [0, 0, 1]])
    double = np.array([[2, 0, -20.5], [0, 2, -10.5], [0, 0, 1]])
    return PatchMatches(
        xy0=[[10.5, 10.5], [20.5, 10.5]], xy1=[[110.5, 10.5], [20.5, 10.5]], score=[0.9, 0.8],
        homography=[shift, double], patch_radius_px=6.0,
    )  # fmt: skip


def test_warp_takes_the_nearest_patch():
    xy1, valid = two_patches().warp(np.array([[10.5, 10.5], [15.0, 10.5], [16.0, 10.5], [21.5, 12.5]]))
    assert valid.all()
    np.testing.assert_allclose(xy1, [[110.5, 10.5], [115.0, 10.5], [11.5, 10.5], [22.5, 14.5]])
    assert xy1.dtype == np.float32


def test_warp_says_where_it_cannot():
    xy1, valid = two_patches().warp(np.array([[10.5, 16.5], [10.5, 16.6], [500.0, -3.0], [np.nan, 0.0]]))
    assert valid.tolist() == [True, False, False, False]
    assert np.isfinite(xy1[0]).all() and np.isnan(xy1[1:]).all()
    xy1, valid = two_patches().warp(np.zeros((0, 2)))
    assert xy1.shape == (0, 2) and valid.shape == (0,)


def test_warp_reaches_the_corners_of_a_patch():
    """Two centres on a diagonal: the nearest one need not be the one whose patch holds the point."""
    shift = np.array([[1, 0, 100], [0, 1, 0], [0, 0, 1]])
    matches = PatchMatches(
        xy0=[[10, 10], [10, 22]], xy1=[[110, 10], [10, 22]], score=[1, 1], homography=[shift, np.eye(3)],
        patch_radius_px=6.0,
    )  # fmt: skip
    xy1, valid = matches.warp(np.array([[15.9, 15.9], [10.0, 16.0], [4.1, 4.1], [16.1, 10.0]]))
    assert valid.tolist() == [True, True, True, False]
    np.testing.assert_allclose(xy1[:3], [[115.9, 15.9], [110, 16], [104.1, 4.1]], rtol=1e-6)


def test_points_that_leave_image_1_are_not_valid():
    matches = dataclasses.replace(two_patches(), size0_wh=(30, 12), size1_wh=(112, 14))
    xy1, valid = matches.warp(np.array([[10.5, 10.5], [12.5, 10.5], [20.5, 12.0], [20.5, 12.5]]))
    assert valid.tolist() == [True, False, True, False] and np.isnan(xy1[~valid]).all()
    xy0, xy1 = matches.densify()
    assert len(xy0) and (xy0 >= 0).all() and (xy0 < (30, 12)).all()
    assert (xy1 >= 0).all() and (xy1 < (112, 14)).all()
    everywhere = dataclasses.replace(matches, size0_wh=None, size1_wh=None).densify()
    inside = (everywhere[0][:, 1] < 12) & ((everywhere[1] >= 0) & (everywhere[1] < (112, 14))).all(axis=1)
    np.testing.assert_array_equal(xy0, everywhere[0][inside])
    np.testing.assert_array_equal(xy1, everywhere[1][inside])


def test_densify_covers_the_squares_once():
    xy0, xy1 = two_patches().densify(2 / 6)
    assert len(xy0) == len(xy1) == 50
    expected = {(x + 0.5, y + 0.5) for y in range(8, 13) for x in [*range(8, 13), *range(18, 23)]}
    assert set(map(tuple, xy0.tolist())) == expected
    warped, valid = two_patches().warp(xy0)
    assert valid.all()
    np.testing.assert_allclose(xy1, warped)
    assert np.array_equal(xy0, xy0[np.lexsort(xy0.T)])


def test_densify_is_warp_at_all_pixels():
    rng = np.random.default_rng(0)
    xy0 = rng.uniform(0, 60, (40, 2)).astype(np.float32)
    shift = np.tile(np.eye(3), (40, 1, 1))
    shift[:, :2, 2] = rng.uniform(-50, 50, (40, 2))
    matches = PatchMatches(
        xy0=xy0, xy1=xy0 + shift[:, :2, 2], score=np.ones(40), homography=shift, patch_radius_px=5.3,
        size0_wh=(60, 50), size1_wh=(70, 60),
    )  # fmt: skip
    row, column = np.indices((50, 60))
    pixels = np.stack([column.ravel(), row.ravel()], axis=1) + 0.5
    xy1, valid = matches.warp(pixels)
    dense0, dense1 = matches.densify()
    np.testing.assert_array_equal(dense0, pixels[valid])
    np.testing.assert_array_equal(dense1, xy1[valid])


@pytest.mark.parametrize("px_scale", [1, 3, 6])
def test_densify_leaves_nothing_out_between_patches_however_large_the_photo(px_scale):
    """Patches of 16 px of the matching resolution on one colour of a chessboard of 8 px, as matches grow."""
    column, row = np.indices((8, 6)).reshape(2, -1)
    centres = np.stack([column, row], axis=1)[(column + row) % 2 == 0] * 8.0 + 4
    matches = PatchMatches(
        xy0=px_scale * centres, xy1=px_scale * centres, score=np.ones(len(centres)),
        homography=np.tile(np.eye(3), (len(centres), 1, 1)), patch_radius_px=8.0 * px_scale,
        size0_wh=(64 * px_scale, 48 * px_scale),
    )  # fmt: skip
    xy0, _ = matches.densify()
    between = ((xy0 > 4 * px_scale) & (xy0 < (60 * px_scale, 44 * px_scale))).all(axis=1)
    assert between.sum() == 56 * 40 * px_scale**2


def test_densify_of_no_matches():
    none = two_patches().select(np.zeros(2, bool))
    assert [xy.shape for xy in none.densify()] == [(0, 2), (0, 2)]


def test_densify_gives_overlaps_to_the_nearest_patch():
    xy0, xy1 = two_patches().densify()
    assert len(xy0) == len(np.unique(xy0, axis=0)) == 23 * 13
    by_shift = xy1[:, 0] - xy0[:, 0] == 100
    assert by_shift[xy0[:, 0] < 15].all() and not by_shift[xy0[:, 0] > 16].any()


@pytest.mark.parametrize("radius", [-1, 0, 1.1, 4])
def test_densify_refuses_what_the_homographies_do_not_cover(radius):
    with pytest.raises(ValueError, match="radius"):
        two_patches().densify(radius)
