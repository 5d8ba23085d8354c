import cv2
import numpy as np
import pytest

from hm_sfm.evaluation.match_pictures import MatchPictures, measure_epipolar_error
from hm_sfm.evaluation.relative_poses import PosePair
from hm_sfm.report.drawn_matches import GAP_PX, draw_matches, pick_colour
from hm_sfm.types import PatchMatches

K0 = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])
K1 = np.array([[450.0, 0, 300], [0, 450, 250], [0, 0, 1]])


def make_matches(xy0, xy1):
    count = len(xy0)
    return PatchMatches(
        xy0=np.reshape(xy0, (-1, 2)),
        xy1=np.reshape(xy1, (-1, 2)),
        score=np.ones(count),
        homography=np.tile(np.eye(3), (count, 1, 1)),
        patch_radius_px=8.0,
    )


def make_pair(tmp_path, long_edge=640):
    """Two photos and the pose between their cameras: a step to the right."""
    size = long_edge // 4 * 3, long_edge
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), np.full(size, 90, np.uint8))
    pose = np.column_stack([np.eye(3), [-1.0, 0, 0]])
    return PosePair(tmp_path / "a.png", tmp_path / "b.png", K0, K1, pose)


def test_errors_go_from_green_over_yellow_to_red():
    assert pick_colour(0.0) == (0, 255, 0)
    assert pick_colour(2.5) == (0, 255, 255)
    assert pick_colour(5.0) == pick_colour(80.0) == (0, 0, 255)
    blue, green, red = pick_colour(np.nan)
    assert blue == green == red


def test_matches_are_drawn_at_their_places_in_their_colours():
    grey = np.full((60, 80), 40, np.uint8)
    xy0 = np.array([[20.5, 30.5], [60.5, 30.5], [40.5, 50.5]])
    picture = draw_matches(grey, grey[:50], xy0, xy0 - (0, 8), np.array([0.0, 9.0, np.nan]))
    assert picture.shape == (60, 160 + GAP_PX, 3) and picture.dtype == np.uint8
    for (x, y), colour in zip(xy0.astype(int), ((0, 255, 0), (0, 0, 255), (150, 150, 150))):
        assert np.abs(picture[y, x].astype(int) - colour).max() < 12
        assert np.abs(picture[y - 8, x + 80 + GAP_PX].astype(int) - colour).max() < 12
    # Images of different heights: nothing below the lower one.
    assert (picture[55, 120:] == 0).all()


def test_a_picture_of_many_matches_shows_a_sample_and_of_none_the_images():
    rng = np.random.default_rng(0)
    grey = np.full((200, 300), 40, np.uint8)
    xy0 = rng.uniform(30, 190, (5000, 2))
    few, many = (draw_matches(grey, grey, xy0[:n], xy0[:n], np.zeros(n)) for n in (100, 5000))
    assert (many == few).all(axis=-1).mean() > 0.3
    none = draw_matches(grey, grey, xy0[:0], xy0[:0], np.zeros(0))
    assert (none[30:, :300] == 40).all()


def test_epipolar_errors_are_distances_in_px(tmp_path):
    pair = make_pair(tmp_path)
    points = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 6], (20, 3))
    xy0, xy1 = points @ K0.T, (points + pair.cam1_from_cam0[:, 3]) @ K1.T
    xy0, xy1 = xy0[:, :2] / xy0[:, 2:], xy1[:, :2] / xy1[:, 2:]
    np.testing.assert_allclose(measure_epipolar_error(make_matches(xy0, xy1), pair), 0, atol=1e-3)
    # Epipolar lines are level here: a step along them is none, one across is shared by both images.
    np.testing.assert_allclose(measure_epipolar_error(make_matches(xy0, xy1 + (5, 0)), pair), 0, atol=1e-3)
    across = measure_epipolar_error(make_matches(xy0, xy1 + (0, 2)), pair)
    np.testing.assert_allclose(across, 2 / np.hypot(1, 450 / 510), rtol=1e-3)
    assert measure_epipolar_error(make_matches([], []), pair).shape == (0,)


def test_pictures_of_photos_are_numbered_reduced_and_whole(tmp_path):
    pair = make_pair(tmp_path, long_edge=2048)
    pictures = MatchPictures(tmp_path / "out" / "pictures")
    true = np.array([[1, 0, 10.0], [0, 1, 0], [0, 0, 1]])
    # 8 px off in the photo are 4 px in a picture of half its size: no longer red.
    matches = make_matches([[1000.0, 801.0]], [[1018.0, 801.0]])
    pictures.draw_homography(pair.path0, pair.path1, true, matches)
    pictures.draw_poses(pair, make_matches([], []))
    names = sorted(path.name for path in pictures.folder.iterdir())
    assert names == ["0000_a-b.png", "0001_a-b.png"]
    picture = cv2.imread(str(pictures.folder / names[0]))
    assert picture.shape == (768, 2048 + GAP_PX, 3)
    assert np.abs(picture[400, 500].astype(int) - pick_colour(4.0)).max() < 12


def test_pictures_of_photos_with_long_names(tmp_path):
    pair = make_pair(tmp_path)
    long = [path.rename(tmp_path / (path.stem * 200 + ".png")) for path in (pair.path0, pair.path1)]
    MatchPictures(tmp_path / "pictures").draw_poses(PosePair(*long, K0, K1, pair.cam1_from_cam0), make_matches([], []))
    assert [path.name for path in (tmp_path / "pictures").iterdir()] == [f"0000_{'a' * 100}-{'b' * 100}.png"]


def test_point_pictures_take_grey_images(tmp_path):
    pictures = MatchPictures(tmp_path)
    images = np.zeros((2, 48, 64), np.uint8)
    pictures.draw_points(images, make_matches([[10, 30]], [[12, 30]]), np.array([0.0]))
    picture = cv2.imread(str(tmp_path / "0000_pair.png"))
    assert picture.shape == (48, 128 + GAP_PX, 3)
    assert picture[29, 9, 1] == pytest.approx(255, abs=40)
