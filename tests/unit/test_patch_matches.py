"""PatchMatches: points that they transfer, and dense matches."""

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


def test_densify_covers_the_squares_once():
    xy0, xy1 = two_patches().densify(2)
    assert len(xy0) == len(xy1) == 50
    expected = {(x + 0.5, y + 0.5) for y in range(8, 13) for x in [*range(8, 13), *range(18, 23)]}
    assert set(map(tuple, xy0.tolist())) == expected
    warped, valid = two_patches().warp(xy0)
    assert valid.all()
    np.testing.assert_allclose(xy1, warped)
    assert np.array_equal(xy0, xy0[np.lexsort(xy0.T)])


def test_densify_gives_overlaps_to_the_nearest_patch():
    xy0, xy1 = two_patches().densify(6)
    assert len(xy0) == len(np.unique(xy0, axis=0)) == 23 * 13
    by_shift = xy1[:, 0] - xy0[:, 0] == 100
    assert by_shift[xy0[:, 0] < 15].all() and not by_shift[xy0[:, 0] > 16].any()


@pytest.mark.parametrize("radius", [0, 1, 2, 4, 8])
def test_densify_uses_a_patch_for_its_own_pixels_wherever_its_centre_lies(radius):
    """Patch centres of the network lie on corners of pixels; the second patch is far away and maps elsewhere."""
    shift, elsewhere = np.array([[1, 0, 5], [0, 1, 7], [0, 0, 1]]), np.array([[1, 0, 9000], [0, 1, 9000], [0, 0, 1]])
    matches = PatchMatches(
        xy0=[[50.0, 50.0], [500.0, 500.0]], xy1=[[55.0, 57.0], [9500.0, 9500.0]], score=[0.9, 0.8],
        homography=[shift, elsewhere], patch_radius_px=8.0,
    )  # fmt: skip
    xy0, xy1 = matches.densify(radius)
    near = xy0[:, 0] < 100
    assert near.sum() == (2 * radius + 1) ** 2
    np.testing.assert_allclose(xy1[near] - xy0[near], np.tile([5.0, 7.0], (near.sum(), 1)))


@pytest.mark.parametrize("radius", [-1, 7])
def test_densify_refuses_what_the_homographies_do_not_cover(radius):
    with pytest.raises(ValueError, match="radius"):
        two_patches().densify(radius)
