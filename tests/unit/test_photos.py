"""Photos and the pairs of warped views made of them."""

import cv2
import numpy as np
import pytest

from hm_sfm.errors import InputError
from hm_sfm.training.photos import (
    POINTS,
    SURFACES,
    WarpedPhotos,
    WarpRange,
    disturb_view,
    draw_photo,
    draw_views,
    find_shown,
    load_photos,
    measure_scale,
    render_view,
    split_photos,
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


def wave(xy: np.ndarray) -> np.ndarray:
    """A smooth image that is known everywhere: (..., 2) px -> (...)."""
    x, y = xy[..., 0], xy[..., 1]
    return 128 + 50 * np.sin(x / 13 + y / 31) + 40 * np.cos(y / 11 - x / 23) + 20 * np.sin((x + y) / 9)


def make_pixel_centres(width: int, height: int) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)


@pytest.mark.parametrize("seed", range(6))
def test_views_show_the_photo_where_their_homography_says(seed):
    """To a tenth of a pixel: the wave changes by up to 9 grey values a pixel of the photo."""
    width, height, size = 400, 300, 128
    photo = np.round(wave(make_pixel_centres(width, height))).astype(np.uint8)
    rng = np.random.default_rng(seed)
    for view_from_photo in draw_views(photo.shape, (size, size), WarpRange(), rng):
        view = render_view(photo, view_from_photo, (size, size))
        source = map_points(np.linalg.inv(view_from_photo), make_pixel_centres(size, size))
        inside = np.all((source > 4) & (source < (width - 4, height - 4)), axis=-1)
        error = (view - wave(source))[inside]
        slope = np.abs(np.gradient(view)[0])[inside].mean()
        assert inside.mean() > 0.2
        # A shift of half a pixel would show as a mean error of about half the slope.
        assert np.abs(error).mean() < 0.15 * slope + 1.0
        shift = fit_shift(view, error, inside)
        assert np.abs(shift).max() < 0.1


def fit_shift(view: np.ndarray, error: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """(2,) px: the shift of the view that explains its error best."""
    gradient_y, gradient_x = np.gradient(view)
    slopes = np.stack([gradient_x[inside], gradient_y[inside]], axis=1)
    return np.linalg.lstsq(slopes, error, rcond=None)[0]


def test_the_homography_between_views_is_that_of_the_item():
    """What view A shows at a point, view B shows where b_from_a puts it."""
    photo = np.round(wave(make_pixel_centres(400, 300))).astype(np.uint8)
    size, warp = 128, WarpRange()
    pairs = WarpedPhotos([photo], (size, size), seed=3, count=4, warp=warp)
    for index in range(4):
        item = pairs[index]
        rng = np.random.default_rng([3, index])
        rng.integers(1)
        a_from_photo, b_from_photo = draw_views(photo.shape, (size, size), warp, rng)
        points = make_pixel_centres(size, size)[8:-8:16, 8:-8:16]
        in_photo = map_points(np.linalg.inv(a_from_photo), points)
        np.testing.assert_allclose(
            map_points(item["b_from_a"][0].astype(float), points), map_points(b_from_photo, in_photo), atol=0.05
        )
        assert item["images"].shape == (2, size, size) and item["images"].dtype == np.uint8
        assert item["b_from_a"].dtype == np.float32 and item["b_from_a"][0, 2, 2] == 1


def test_items_depend_on_seed_and_index_alone():
    photos = [make_photo(200, 160, seed) for seed in range(3)]
    first, again, other = (WarpedPhotos(photos, (64, 64), seed, 10, WarpRange()) for seed in (1, 1, 2))
    assert len(first) == 10
    # Whatever was asked for before does not matter.
    assert len(again[0]["images"]) == len(again[5]["images"]) == 2
    for key in ("images", "b_from_a"):
        assert np.array_equal(first[7][key], again[7][key])
        assert not np.array_equal(first[7][key], first[6][key])
        assert not np.array_equal(first[7][key], other[7][key])


def test_views_are_no_farther_apart_than_asked():
    warp = WarpRange(scale=1.5, rotation_deg=20.0, perspective=0.0)
    scales, turns = [], []
    for seed in range(200):
        a_from_photo, b_from_photo = draw_views((300, 400), (128, 128), warp, np.random.default_rng(seed))
        linear = (b_from_photo @ np.linalg.inv(a_from_photo))[:2, :2]
        scales.append(np.sqrt(np.linalg.det(linear)))
        turns.append(np.degrees(np.arctan2(linear[1, 0], linear[0, 0])))
    assert 1 / 1.5 - 1e-6 <= min(scales) < 0.75 and 1.35 < max(scales) <= 1.5 + 1e-6
    assert -20 - 1e-6 <= min(turns) < -15 and 15 < max(turns) <= 20 + 1e-6


def test_disturbing_a_view_keeps_its_geometry():
    view = make_photo(96, 96).astype(np.float32)
    for seed in range(20):
        disturbed = disturb_view(view, np.random.default_rng(seed))
        assert disturbed.shape == view.shape and disturbed.dtype == np.uint8
        spectrum = np.fft.fft2(view - view.mean()) * np.conj(np.fft.fft2(disturbed - disturbed.mean()))
        peak = np.unravel_index(np.fft.ifft2(spectrum).real.argmax(), view.shape)
        assert peak == (0, 0)


def test_photos_are_read_grey_reduced_and_in_order(tmp_path, caplog):
    (tmp_path / "b").mkdir()
    cv2.imwrite(str(tmp_path / "b" / "1.JPG"), make_photo(1280, 900))
    cv2.imwrite(str(tmp_path / "a.png"), np.stack([make_photo(200, 300)] * 3, axis=-1))
    cv2.imwrite(str(tmp_path / "small.png"), make_photo(127, 300))
    (tmp_path / "bad.png").write_bytes(b"no photo")
    (tmp_path / "notes.txt").write_text("no photo either")
    photos = load_photos(tmp_path)
    assert [photo.shape for photo in photos] == [(300, 200), (450, 640)]
    assert all(photo.dtype == np.uint8 for photo in photos)
    assert "small.png" in caplog.text and "bad.png" in caplog.text and "notes" not in caplog.text


def test_folders_without_photos_are_refused(tmp_path):
    with pytest.raises(InputError, match="absent"):
        load_photos(tmp_path / "absent")
    with pytest.raises(InputError, match=tmp_path.name):
        load_photos(tmp_path)
    (tmp_path / "bad.png").write_bytes(b"no photo")
    with pytest.raises(InputError, match="no usable training image"):
        load_photos(tmp_path)
    with pytest.raises(InputError, match="bad.png"):
        load_photos(tmp_path / "bad.png")


def test_validation_photos_are_not_trained_on():
    photos = [np.full((1, 1), i) for i in range(40)]
    training, validation = split_photos(photos)
    assert sorted(int(photo[0, 0]) for photo in training + validation) == list(range(40))
    assert [int(photo[0, 0]) for photo in validation] == [0, 15, 30]
    training, validation = split_photos(photos[:1])
    assert len(training) == len(validation) == 1
