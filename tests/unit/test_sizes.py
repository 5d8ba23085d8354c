"""The sizes at which photos are matched: ordinary ones by their longer side, panoramas by their pixels."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hm_sfm.config import ImageConfig
from hm_sfm.errors import InputError
from hm_sfm.keypoints.seeds import find_seeds
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.photos.images import prepare_array
from hm_sfm.photos.sizes import check_size, find_scale, measure_px_scale
from hm_sfm.synthetic.textures import MATERIALS, make_texture


@given(longer=st.integers(32, 20_000), aspect=st.floats(1, 3), long_edge_px=st.integers(32, 4096))
def test_ordinary_photos_are_reduced_by_their_longer_side(longer, aspect, long_edge_px):
    shorter = max(32, int(np.ceil(longer / aspect)))
    longer = max(longer, shorter)
    for size_wh in ((longer, shorter), (shorter, longer)):
        assert find_scale(size_wh, long_edge_px) == min(1.0, long_edge_px / longer)
        assert measure_px_scale(size_wh, long_edge_px) == pytest.approx(max(1.0, longer / long_edge_px))


@pytest.mark.parametrize(
    ("size_wh", "matched_wh"),
    [
        ((4500, 1000), (1536, 341)),  # a third of 1024 px high
        ((8000, 1000), (2508, 314)),  # as many pixels as 1024 x 768
        ((20_000, 500), (5609, 140)),
        ((20_000, 64), (15_677, 50)),
        ((4500, 32), (4500, 32)),
        ((32_000, 40), (25_600, 32)),  # never lower than 32 px
        ((64, 20_000), (50, 15_677)),
    ],
)
def test_panoramas_and_strips_keep_their_height(size_wh, matched_wh):
    prepared = prepare_array(np.zeros(size_wh[::-1], np.uint8), 1024)
    assert prepared.scaled_wh == matched_wh
    corner = prepared.stored_from_scaled @ [*matched_wh, 1]
    np.testing.assert_allclose(corner, [*size_wh, 1], rtol=1e-12)
    assert measure_px_scale(size_wh, 1024) == pytest.approx(min(size_wh) / min(matched_wh), rel=0.01)


def test_strips_have_seeds_of_keypoints():
    noise = np.random.default_rng(0).integers(0, 255, (32, 4500), np.uint8)
    assert len(find_seeds(prepare_array(noise, 1024))) > 1000


@given(shorter=st.integers(32, 3000), aspect=st.floats(1, 1000), long_edge_px=st.integers(64, 4096))
def test_no_photo_has_more_pixels_than_a_square_or_less_height_than_cells_need(shorter, aspect, long_edge_px):
    size_wh = np.array([int(shorter * aspect), shorter])
    width, height = size_wh * find_scale((int(size_wh[0]), shorter), long_edge_px)
    assert width * height <= max(long_edge_px**2, 32.01 * 32.01 * aspect)
    assert height >= min(32, long_edge_px / 3) * (1 - 1e-9)


@pytest.mark.parametrize(
    ("size_wh", "reason"),
    [
        ((31, 500), "a.jpg is 31 x 500 px, at least 32 px a side are needed"),
        ((100_000, 40), "a.jpg is 100000 x 40 px, photos more than 1000 times as long as wide cannot be matched"),
    ],
)
def test_photos_that_are_too_small_or_too_long(size_wh, reason):
    with pytest.raises(InputError, match=f"^{reason}$"):
        check_size(size_wh, "a.jpg")
    check_size((64_000, 64), "a.jpg")


@pytest.mark.slow
def test_panoramas_match():
    rng = np.random.default_rng(4)
    tiles = [make_texture(rng, list(MATERIALS)[k % len(MATERIALS)], (2.5, 2.5), 100) for k in range(9)]
    scene = cv2.cvtColor(np.hstack(tiles), cv2.COLOR_RGB2GRAY)
    left, right = scene[:240, :2000], scene[10:250, 200:2200]
    matches = HomoMatcher.from_pretrained("light", images=ImageConfig(long_edge_px=320)).match(left, right)
    good = matches.select(matches.score >= 0.5)
    errors_px = np.linalg.norm(good.xy0 - (200, 10) - good.xy1, axis=1)
    assert len(good) > 300 and np.median(errors_px) < 1
