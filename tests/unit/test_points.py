"""Point errors of matches that are planted, and the command around them."""

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from hm_sfm.cli import main
from hm_sfm.errors import InputError
from hm_sfm.evaluation.points import PATCH_POINTS, measure_matches, measure_points, score_points
from hm_sfm.geometry.homographies import apply_homographies
from hm_sfm.training.photos import split_photos
from hm_sfm.training.validation import make_validation_pairs
from hm_sfm.types import PatchMatches

WIDTH, HEIGHT = 96, 64
SHIFTED = np.array([[1, 0, 7.5], [0, 1, -3.25], [0, 0, 1]])
TURNED = np.array([[0.9, -0.2, 20], [0.15, 1.1, -4], [1e-4, -2e-4, 1]])


def make_photo(width, height, seed=0):
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(height, width)), (0, 0), 2.0)
    return np.clip(128 + 45 * noise / noise.std(), 0, 255).astype(np.uint8)


def make_item():
    """Two surfaces side by side; the last 16 columns of image 0 and a hole are not shown in image 1."""
    surface = np.zeros((HEIGHT, WIDTH), np.int64)
    surface[:, 48:] = 1
    surface[:, 80:] = -1
    surface[24:32, 16:24] = -1
    return {
        "images": np.zeros((2, HEIGHT, WIDTH), np.uint8),
        "b_from_a": np.stack([SHIFTED, TURNED]).astype(np.float32),
        "surface": surface,
    }


class PlantedMatcher:
    """Matches every 8 x 8 cell by the true homography of its surface, moved by `shift` px."""

    def __init__(self, item, shift=(0.0, 0.0), score=0.9, cells=slice(None)):
        x, y = np.meshgrid(np.arange(4, WIDTH, 8), np.arange(4, HEIGHT, 8))
        xy0 = np.stack([x, y], axis=-1).reshape(-1, 2)[cells].astype(np.float64)
        index = np.maximum(item["surface"][xy0[:, 1].astype(int), xy0[:, 0].astype(int)], 0)
        move = np.array([[1, 0, shift[0]], [0, 1, shift[1]], [0, 0, 1]])
        homography = move @ item["b_from_a"][index].astype(np.float64)
        self.matches = PatchMatches(
            xy0=xy0,
            xy1=apply_homographies(homography, xy0),
            score=np.broadcast_to(score, len(xy0)),
            homography=homography,
            patch_radius_px=8.0,
        )

    def match(self, image0, image1):
        assert image0.shape == image1.shape == (HEIGHT, WIDTH)
        return self.matches


def score(matcher, items, **more):
    return score_points(matcher, items, 0.5, quiet=True, **more)


def test_exact_homographies_have_no_error():
    item = make_item()
    scores = score(PlantedMatcher(item), [item])
    # Points of a patch that lie beyond the edge between the surfaces follow the other surface: centres only are exact.
    assert scores["all_centres_mean_px"] < 1e-4 and scores["all_centres_median_px"] < 1e-4
    assert scores["all_points_median_px"] < 1e-4
    assert scores["all_centres_pck_1px"] == 100
    assert scores["all_mean_matches"] == 96
    # 16 cells in the last columns and one in the hole cannot be right.
    assert scores["all_correct_3px"] == scores["all_correct_1px"] == pytest.approx(100 * 79 / 96)
    assert scores["all_coverage"] == 100


def test_the_milliseconds_are_the_median_time_of_matching(monkeypatch):
    clock = iter([0.0, 0.25, 1.0, 1.5, 7.0, 8.0])
    monkeypatch.setattr("hm_sfm.evaluation.points.time", SimpleNamespace(perf_counter=lambda: next(clock)))
    item = make_item()
    assert score(PlantedMatcher(item), [item, item, item])["milliseconds"] == 500


def test_points_beyond_an_edge_follow_their_own_surface():
    item = make_item()
    errors = measure_matches(PlantedMatcher(item).matches, item["b_from_a"], item["surface"])
    # The centre at x = 44 is 4 px from the edge at x = 48: only the last column of its points is across.
    match = 5
    assert errors.points_px.shape == (96, 81)
    points = errors.points_px[match].reshape(9, 9)
    assert (points[4:, :8] < 1e-4).all() and (points[4:, 8] > 1).all()


def test_a_shift_of_two_px_is_measured_everywhere():
    item = make_item()
    item["surface"][:, 48:80] = 0
    scores = score(PlantedMatcher(item, shift=(2.0, 0.0)), [item, item])
    for part in ("points", "centres"):
        assert scores[f"all_{part}_mean_px"] == pytest.approx(2, abs=1e-4)
        assert scores[f"all_{part}_median_px"] == pytest.approx(2, abs=1e-4)
        assert scores[f"all_{part}_pck_1px"] == 0
        assert scores[f"all_{part}_pck_3px"] == scores[f"all_{part}_pck_5px"] == 100
    assert scores["all_correct_1px"] == 0 and scores["all_correct_3px"] == pytest.approx(100 * 79 / 96)
    assert scores["all_coverage"] == 100


def test_trusted_matches_are_those_with_a_score():
    item = make_item()
    good = np.arange(96) % 2 == 0
    matcher = PlantedMatcher(item, score=np.where(good, 0.5, 0.49))
    scores = score(matcher, [item])
    assert scores["all_mean_matches"] == 96 and scores["trusted_mean_matches"] == 48
    assert 40 < scores["trusted_coverage"] < 60
    assert scores["trusted_centres_pck_1px"] == 100


def test_coverage_counts_cells_once_and_visible_ones_only():
    item = make_item()
    twice = PlantedMatcher(item, cells=np.r_[0:12, 0:12])
    # A row of twelve cells, of which ten are visible, of 79 in all.
    assert score(twice, [item])["all_coverage"] == pytest.approx(100 * 10 / 79)
    assert score(PlantedMatcher(item, shift=(4, 0)), [item])["all_coverage"] == 0


def test_no_matches_give_metrics_without_errors():
    item = make_item()
    scores = score(PlantedMatcher(item, cells=slice(0)), [item])
    assert scores["all_mean_matches"] == 0 and scores["all_coverage"] == 0
    assert np.isnan(scores["all_points_mean_px"]) and np.isnan(scores["all_centres_pck_1px"])


def test_points_out_of_the_image_are_unknown():
    item = make_item()
    xy0 = np.array([[-0.5, 5.0], [5.0, 64.0], [95.5, 3.0], [10.2, 10.9]])
    error = measure_points(xy0, xy0 + (7.5, -3.25), item["b_from_a"], item["surface"])
    assert np.isnan(error[:3]).all() and error[3] == pytest.approx(0, abs=1e-5)
    assert len(PATCH_POINTS) == 81 and np.abs(PATCH_POINTS).max() == 4


def test_each_pair_can_be_observed():
    item, seen = make_item(), []
    score(PlantedMatcher(item), [item, item], observe=lambda *arguments: seen.append(arguments))
    images, matches, error_px = seen[1]
    assert len(seen) == 2 and images.shape == (2, HEIGHT, WIDTH) and len(matches) == len(error_px) == 96
    assert np.isnan(error_px).sum() == 17


# The validation set


def test_validation_pairs_show_held_out_photos_only():
    photos = [make_photo(140, 130, seed) for seed in range(31)]
    for kind in ("rendered", "warped"):
        pairs = make_validation_pairs(photos, kind, 3)
        assert len(pairs) == 3
        assert [id(photo) for photo in pairs.photos] == [id(photos[i]) for i in (0, 15, 30)]
        assert pairs.photos == split_photos(photos)[1]
        item, again = pairs[1], make_validation_pairs(photos, kind, 2)[1]
        assert item["images"].shape == (2, 480, 640)
        assert np.array_equal(item["images"], again["images"]) and np.array_equal(item["surface"], again["surface"])


@pytest.mark.parametrize(("kind", "count", "text"), [("real", 3, "'real'"), ("warped", 0, "0")])
def test_unknown_validation_pairs_are_refused(kind, count, text):
    with pytest.raises(InputError, match=text):
        make_validation_pairs([make_photo(140, 130)], kind, count)


# The command


@pytest.mark.slow
# A warp of the one held-out photo shows it four times, and nothing tells which of them is the right one.
@pytest.mark.parametrize(("kind", "least_percent"), [("rendered", 70), ("warped", 20)])
def test_evaluate_points_prints_writes_and_draws(tmp_path, capsys, kind, least_percent):
    photos = tmp_path / "photos"
    photos.mkdir()
    for seed in range(3):
        cv2.imwrite(str(photos / f"{seed}.png"), make_photo(320, 240, seed))
    pictures, scores = tmp_path / "new" / "pictures", tmp_path / "scores.json"
    command = ["evaluate", "points", photos, "--kind", kind, "--count", 1, "--quiet"]
    assert main([str(word) for word in (*command, "--pictures", pictures, "--json", scores)]) == 0
    metrics = json.loads(scores.read_text())
    printed = capsys.readouterr().out
    assert all(name in printed for name in metrics)
    assert metrics["all_mean_matches"] >= metrics["trusted_mean_matches"]
    assert metrics["all_mean_matches"] > 100
    assert metrics["trusted_correct_1px"] > least_percent
    (picture,) = pictures.iterdir()
    assert cv2.imread(str(picture)).shape == (480, 1288, 3)


def test_evaluate_points_refuses_a_folder_without_photos(tmp_path, capsys):
    assert main(["evaluate", "points", str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err
