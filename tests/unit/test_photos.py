"""Warped photos of any shape; what they share with other pairs is tested in test_training.py."""

import cv2
import numpy as np
import pytest

from hm_sfm.training.photos import (
    POINTS,
    SURFACES,
    WarpedPhotos,
    WarpRange,
    disturb_view,
    draw_photo,
    find_shown,
    measure_scale,
    render_view,
)

SIZE_WH = (96, 64)


def make_photo(width, height, seed=0):
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(height, width)), (0, 0), 2.5)
    return np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)


def map_points(homography, xy):
    mapped = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1) @ homography.T
    return mapped[..., :2] / mapped[..., 2:]


def test_items_are_as_wide_and_high_as_asked():
    pairs = WarpedPhotos([make_photo(220, 180)], SIZE_WH, 3, 4, WarpRange())
    item = pairs[1]
    assert item["images"].shape == (2, 64, 96) and item["images"].dtype == np.uint8
    assert item["b_from_a"].shape == (SURFACES, 3, 3)
    assert item["points"].shape == (POINTS, 4) and item["points"].dtype == np.float32
    assert np.isnan(item["points"]).all()
    shares = []
    for index in range(4):
        item = pairs[index]
        centres = np.stack(np.meshgrid(np.arange(96) + 0.5, np.arange(64) + 0.5), axis=-1)
        mapped = map_points(item["b_from_a"][0].astype(float), centres)
        inside = np.all((mapped >= 0) & (mapped < SIZE_WH), axis=-1)
        assert item["surface"].dtype == np.int64 and set(np.unique(item["surface"])) <= {-1, 0}
        assert (inside == (item["surface"] == 0)).mean() > 0.999
        shares.append(inside.mean())
    assert min(shares) < 0.99


def test_points_beyond_the_horizon_are_not_shown():
    # The denominator is zero along x = 40, and negative to its right, where quotients fall into the view again.
    b_from_a = np.array([[1, 0, -20], [0, 1, -20], [-1 / 40, 0, 1]])
    shown = find_shown(b_from_a, SIZE_WH) == 0
    assert shown[:, 20:28].any() and not shown[:, 40:].any()


@pytest.mark.parametrize("seed", range(3))
def test_the_local_scale_is_that_at_the_centre(seed):
    rng = np.random.default_rng(seed)
    matrix = np.array([[0.8, 0.2, 5], [-0.1, 0.6, 9], [1e-3, -2e-3, 1]]) * rng.uniform(-3, 3)
    centre = np.array(SIZE_WH) / 2
    around = map_points(np.linalg.inv(matrix), centre + 0.01 * np.array([[-1, 0], [1, 0], [0, -1], [0, 1]]))
    photo_px_per_view_px = np.linalg.det([(around[1] - around[0]) / 0.02, (around[3] - around[2]) / 0.02])
    assert measure_scale(matrix, SIZE_WH) == pytest.approx(abs(photo_px_per_view_px) ** -0.5, rel=1e-4)


def test_views_that_shrink_do_not_alias():
    """Where the photo's corner is seen enlarged but the view's centre reduced, the centre decides."""
    checker = ((np.indices((800, 800)).sum(axis=0) % 2) * 200 + 20).astype(np.uint8)
    corners = np.array([[0, 0], [800, 0], [800, 800], [0, 800]], np.float32)
    quad = np.array([[-2000, -1500], [150, 10], [110, 80], [10, 110]], np.float32)
    matrix = cv2.getPerspectiveTransform(corners, quad)
    assert abs(np.linalg.det(matrix)) ** 0.5 > 0.9 > measure_scale(matrix, SIZE_WH)
    view = render_view(checker, matrix, SIZE_WH)
    assert view[24:40, 40:56].std() < 40


def test_small_photos_are_put_together():
    photos = [np.full((60, 90), value, np.uint8) for value in (10, 20, 30, 40, 50)]
    mosaic = draw_photo(photos, SIZE_WH, np.random.default_rng(0))
    assert mosaic.shape == (120, 180)
    assert len(np.unique(mosaic)) > 1
    large = [np.full((160, 240), value, np.uint8) for value in (10, 20)]
    assert draw_photo(large, SIZE_WH, np.random.default_rng(0)).shape == (160, 240)
    uneven = [np.full((160, 90), 10, np.uint8), np.full((80, 200), 20, np.uint8)]
    for seed in range(4):
        assert draw_photo(uneven, SIZE_WH, np.random.default_rng(seed)).shape in ((320, 180), (160, 400))


def test_disturbed_views_keep_their_shape():
    view = make_photo(*SIZE_WH).astype(np.float32)
    for seed in range(12):
        disturbed = disturb_view(view, np.random.default_rng(seed))
        assert disturbed.shape == (64, 96) and disturbed.dtype == np.uint8
        assert np.array_equal(disturbed, disturb_view(view, np.random.default_rng(seed)))
