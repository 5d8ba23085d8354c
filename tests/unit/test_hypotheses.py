"""Pairs of photos that are turned against each other, or of very different scale."""

import dataclasses
import math
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import torch

from hm_sfm.config import ImageConfig, MatchingConfig
from hm_sfm.geometry.frames import flip_matrix, homography_to_pixel_index, pixel_index_from_px, rotation_matrix
from hm_sfm.geometry.homographies import apply_homographies
from hm_sfm.matching.feature_cache import cache_features, match_pair
from hm_sfm.matching.hypotheses import (
    FEW_MATCHES,
    ROTATIONS,
    SCALES,
    TILTS,
    UNCHANGED,
    Sketch,
    choose_hypotheses,
    count_agreeing,
    count_good,
    find_cells_inside,
    place_cells,
    relate_scales,
)
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.photos.exif import write_jpeg
from hm_sfm.photos.hypotheses import IDENTITY, Hypothesis, apply_hypothesis
from hm_sfm.photos.images import list_images, prepare_array, prepare_image, read_ref, read_rgb
from hm_sfm.photos.orientation import CV_ROTATIONS
from hm_sfm.synthetic.textures import MATERIALS, make_texture
from hm_sfm.types import ImagePair, PatchMatches

SHIFT = np.array([[1, 0, -13], [0, 1, -9], [0, 0, 1.0]])
"""Px of `photo` -> px of `other`."""
CLOSER = np.array([[3, 0, -160], [0, 3, -160], [0, 0, 1.0]])
"""Px of the whole scene at a third of its size -> px of `middle`."""


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    """(480, 642) uint8: a collage, which is made faster than a scene is rendered."""
    rng = np.random.default_rng(4)
    tiles = [
        [make_texture(rng, material, (1.07, 1.2), 100) for material in order]
        for order in np.array(list(MATERIALS))[
            [[5, 0, 6, 1, 4, 6], [6, 4, 1, 6, 5, 0], [1, 6, 5, 0, 6, 4], [4, 5, 6, 6, 1, 0]]
        ]
    ]
    return cv2.cvtColor(np.vstack([np.hstack(row) for row in tiles]), cv2.COLOR_RGB2GRAY)


@pytest.fixture(scope="module")
def whole(scene) -> np.ndarray:
    return cv2.resize(scene, (214, 160), interpolation=cv2.INTER_AREA)


@pytest.fixture(scope="module")
def middle(scene) -> np.ndarray:
    return scene[160:400, 160:480]


@pytest.fixture(scope="module")
def photo(scene) -> np.ndarray:
    return cv2.resize(scene, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)[40:232, 20:276]


@pytest.fixture(scope="module")
def other(scene) -> np.ndarray:
    return cv2.resize(scene, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)[49:240, 33:289]


@pytest.fixture(scope="module")
def matcher() -> HomoMatcher:
    return HomoMatcher.from_pretrained("light")


@pytest.fixture(scope="module")
def upright(matcher) -> HomoMatcher:
    """The same one, that tries nothing else."""
    return HomoMatcher.from_network(matcher.net, MatchingConfig(try_hypotheses=False), ImageConfig())


def turn(image: np.ndarray, rotation_deg: int) -> np.ndarray:
    return cv2.rotate(image, CV_ROTATIONS[rotation_deg])


def measure_errors(matches: PatchMatches, truth: np.ndarray) -> np.ndarray:
    """(M,) px of image 1."""
    true = apply_homographies(np.broadcast_to(truth, (len(matches), 3, 3)), matches.xy0)
    return np.linalg.norm(true - matches.xy1, axis=1)


def assert_right(matches: PatchMatches, truth: np.ndarray, least: int) -> None:
    """At least so many good matches, nearly all within 1 px, and their homographies the truth's."""
    good = matches.select(matches.score >= 0.5)
    assert len(good) >= least
    assert (measure_errors(good, truth) < 1).mean() > 0.95
    corner = good.xy0 + 0.7 * good.patch_radius_px
    propagated = apply_homographies(good.homography, corner)
    expected = apply_homographies(np.broadcast_to(truth, (len(good), 3, 3)), corner)
    assert np.median(np.linalg.norm(propagated - expected, axis=1)) < 0.5


@pytest.mark.parametrize("rotation_deg", CV_ROTATIONS)
def test_turned_photos_match_as_upright_ones_do(matcher, upright, photo, other, rotation_deg):
    truth = rotation_matrix((256, 191), rotation_deg) @ SHIFT
    turned = turn(other, rotation_deg)
    alone = upright.match(photo, turned)
    assert np.count_nonzero(measure_errors(alone, truth) < 1) < 10
    assert_right(matcher.match(photo, turned), truth, 350)


def tilt(image: np.ndarray, rotation_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """What is left of an image in its middle, (180, 180) uint8, as it is rotated clockwise; px of it -> px of that."""
    height, width = image.shape
    angle = np.deg2rad(rotation_deg)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    tilted_from_image = np.eye(3)
    tilted_from_image[:2, :2] = rotation
    tilted_from_image[:2, 2] = 90 - rotation @ (width / 2, height / 2)
    size_wh = (180, 180)
    return cv2.warpAffine(image, homography_to_pixel_index(tilted_from_image)[:2], size_wh), tilted_from_image


@pytest.mark.parametrize("rotation_deg", [135, 225])
def test_a_photo_between_the_quarter_turns_matches_as_an_upright_one_does(matcher, scene, photo, rotation_deg):
    half = cv2.resize(scene, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    tilted, tilted_from_half = tilt(half, rotation_deg)
    truth = tilted_from_half @ [[1, 0, 20], [0, 1, 40], [0, 0, 1.0]]  # `photo` begins there
    assert_right(matcher.match(photo, tilted), truth, 400)


def test_a_photo_three_times_closer(matcher, upright, whole, middle):
    as_they_are, good = (
        matches.select(matches.score >= 0.5) for matches in (upright.match(whole, middle), matcher.match(whole, middle))
    )
    assert len(good) > 50
    assert np.count_nonzero(measure_errors(as_they_are, CLOSER) < 3) < len(good) / 4
    assert np.median(measure_errors(good, CLOSER)) < 1.5  # a pixel of the whole is three of the middle


def test_a_turned_photo_and_its_thumbnail(matcher, upright, scene):
    large = scene[150:406, 150:490]
    small = turn(cv2.resize(large, (136, 102), interpolation=cv2.INTER_AREA), 90)
    truth = rotation_matrix((136, 102), 90) @ np.diag([136 / 340, 102 / 256, 1])
    assert np.count_nonzero(measure_errors(upright.match(large, small), truth) < 1) < 10
    assert_right(matcher.match(large, small), truth, 80)


def test_pairs_that_match_as_they_are_stay_the_same(matcher, upright, photo, scene, one_thread):
    beside = cv2.resize(scene, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)[70:200, 100:260]
    found, expected = (each.match(photo, beside) for each in (matcher, upright))
    assert 100 < count_good(expected) < FEW_MATCHES  # so that it is looked at
    for field in ("xy0", "xy1", "score", "homography"):
        assert getattr(found, field).tobytes() == getattr(expected, field).tobytes()


def test_nothing_to_see(matcher, photo):
    flat, tiny = np.full((100, 120), 90, np.uint8), np.ascontiguousarray(photo[:32, :32])
    for pair in ((flat, photo), (flat, flat), (tiny, flat)):
        matches = matcher.match(*pair)
        assert np.isfinite(matches.homography).all() and count_good(matches) < 100
        sketches = [Sketch(prepare_array(image, 1024)) for image in pair]
        assert choose_hypotheses(matcher.cell_matcher, *sketches) is None


@pytest.fixture
def folder(tmp_path, photo, other) -> Path:
    """Photos that are turned against each other, and one of something else."""
    noise = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 255, (96, 128), np.uint8), (0, 0), 3)
    for name, image in (("a", photo[:128, 80:240]), ("b", turn(other[:128, 60:220], 90)), ("c", noise)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
    return tmp_path


def test_neither_order_nor_memory_matter(matcher, folder, one_thread):
    images = [read_ref(path) for path in sorted(folder.glob("*.png"))]
    pairs = [ImagePair(f"{a}.png", f"{b}.png") for a, b in ("ab", "bc", "ac")]
    found = []
    just_enough_mb = math.ceil(2e-6 * max(matcher.encode(prepare_image(image, 1024)).size_bytes for image in images))
    for order, limit_mb in ((pairs, 1500), (pairs[::-1], just_enough_mb)):
        limited = HomoMatcher.from_network(matcher.net, MatchingConfig(feature_cache_mb=limit_mb), ImageConfig())
        cache = cache_features(images, limited)
        found.append({pair: match_pair(cache, pair) for pair in order})
        held = sum(made.size_bytes for made in cache.cached.values())
        assert held <= limit_mb * 1_000_000
    for pair in pairs:
        one, two = found[0][pair], found[1][pair]
        assert (
            one.pair == pair and one.xy1.tobytes() == two.xy1.tobytes() and one.score.tobytes() == two.score.tobytes()
        )
        assert (count_good(one) > 100) == (pair == pairs[0])
    # The same as of the photos without a cache.
    direct = matcher.match(folder / "a.png", folder / "b.png")
    assert direct.xy1.tobytes() == found[0][pairs[0]].xy1.tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("orientation", [2, 5])
def test_mirrored_photos_match_as_they_are_shown(upright, tmp_path, photo, other, orientation):
    """Points of `match` are those of the stored pixels, which are mirrored; those of a run make a scene that is not."""
    stored = other[:, ::-1] if orientation == 2 else other.T
    for name, pixels, tag in (("a.jpg", photo, 1), ("b.jpg", stored, orientation)):
        write_jpeg(tmp_path / name, np.dstack([pixels] * 3), None, tag)
    stored_from_other = np.array([[-1, 0, 256], [0, 1, 0], [0, 0, 1.0]] if orientation == 2 else np.eye(3)[[1, 0, 2]])
    assert_right(upright.match(tmp_path / "a.jpg", tmp_path / "b.jpg"), stored_from_other @ SHIFT, 350)
    cache = cache_features(list_images(tmp_path).images, upright)
    in_run = match_pair(cache, ImagePair("a.jpg", "b.jpg"))
    assert_right(in_run, flip_matrix(stored.shape[1]) @ stored_from_other @ SHIFT, 350)
    assert (np.linalg.det(in_run.homography) > 0).all()


def test_given_matches_of_turned_photos_become_homographies(matcher, folder, tmp_path):
    """Px of a.png -> px of b.png: crops of `photo` and `other`, the latter turned."""
    between = np.array([[1, 0, 7], [0, 1, -9], [0, 0, 1.0]])
    truth = rotation_matrix((160, 128), 90) @ between
    xy0 = np.stack(np.meshgrid(np.arange(20.0, 140, 7), np.arange(20.0, 120, 7)), axis=-1).reshape(-1, 2)
    xy1 = apply_homographies(np.broadcast_to(truth, (len(xy0), 3, 3)), xy0)
    with h5py.File(tmp_path / "points.h5", "w") as h5:
        h5["a.png/b.png/keypoints0"], h5["a.png/b.png/keypoints1"] = map(pixel_index_from_px, (xy0, xy1))
    config = MatchingConfig(coarse_matches=str(tmp_path / "points.h5"))
    given = HomoMatcher.from_network(matcher.net, config, ImageConfig())
    assert_right(given.match(folder / "a.png", folder / "b.png"), truth, len(xy0) // 2)
    config = dataclasses.replace(config, try_hypotheses=False)
    alone = HomoMatcher.from_network(matcher.net, config, ImageConfig()).match(folder / "a.png", folder / "b.png")
    assert count_good(alone) < len(xy0) // 4


@pytest.mark.parametrize("rotation_deg", [0, *CV_ROTATIONS])
@pytest.mark.parametrize("downscale", [1, 2])
def test_points_of_a_variant_are_those_of_the_stored_photo(rotation_deg, downscale):
    blocks = np.random.default_rng(0).integers(0, 255, (24, 40), np.uint8)
    image = prepare_array(np.kron(blocks, np.ones((2, 2), np.uint8)), 1024)
    shown = apply_hypothesis(image, Hypothesis(rotation_deg, downscale))
    row, column = np.indices(shown.grey.shape).reshape(2, -1)
    stored = np.column_stack([column + 0.5, row + 0.5, np.ones(len(row))]) @ shown.stored_from_scaled.T
    x, y = (stored[:, :2] / 2).astype(int).T
    np.testing.assert_allclose(shown.grey[row, column] * 255, blocks[y, x], atol=1e-3)
    assert shown.ref.rotation_deg == rotation_deg
    again = apply_hypothesis(shown, Hypothesis(-rotation_deg % 360))
    assert again.ref.rotation_deg == 0
    np.testing.assert_allclose(again.stored_from_scaled, np.diag([downscale, downscale, 1]))


@pytest.mark.parametrize(("rotation_deg", "mirrored"), [(45, False), (200, False), (70, True)])
def test_a_tilted_photo_is_whole_and_its_points_are_those_of_the_stored_one(tmp_path, rotation_deg, mirrored):
    """Bright spots on grey: where they are in the tilted photo, and in its colours as other packages read them."""
    spots = np.array([[6, 7], [60, 5], [71, 41], [9, 38], [33, 20]])
    stored = np.full((48, 80), 90, np.uint8)
    stored[spots[:, 1], spots[:, 0]] = 255
    cv2.imwrite(str(tmp_path / "a.png"), stored)
    ref = dataclasses.replace(read_ref(tmp_path / "a.png"), mirrored=mirrored, flipped=mirrored)
    shown = apply_hypothesis(prepare_image(ref, 1024), Hypothesis(rotation_deg))
    xy = spots + 0.5
    if mirrored:
        xy[:, 0] = 80 - xy[:, 0]
    scaled_from_stored = np.linalg.inv(shown.stored_from_scaled)
    x, y = np.floor(xy @ scaled_from_stored[:2, :2].T + scaled_from_stored[:2, 2]).astype(int).T
    for grey in (shown.grey, read_rgb(shown)[:, :, 0] / 255):
        assert grey.shape == shown.scaled_wh[::-1]
        around = [grey[row - 1 : row + 2, column - 1 : column + 2].max() for row, column in zip(y, x)]
        assert min(around) > 0.5 and np.median(grey) == pytest.approx(90 / 255, abs=0.02)
    inside = find_cells_inside(shown, *shown.grey.shape)
    assert inside.sum() == pytest.approx(48 * 80, rel=0.03) and inside[y, x].all() and not inside[0, 0]


def test_the_photo_as_it_is_is_not_touched(photo):
    image = prepare_array(photo, 1024)
    assert apply_hypothesis(image, IDENTITY) is image


def test_providers_that_read_the_photo_read_it_turned(tmp_path):
    colours = np.random.default_rng(0).integers(0, 255, (48, 80, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), colours)
    image = prepare_image(read_ref(tmp_path / "a.png"), 1024)
    np.testing.assert_array_equal(read_rgb(apply_hypothesis(image, Hypothesis(270))), turn(read_rgb(image), 270))


def test_each_way_is_compared_once():
    ways = ROTATIONS + TILTS + SCALES
    assert ways[0] == UNCHANGED and len(ways) == len(set(ways)) == 4 + 4 + 4 * 4
    assert all(
        hypothesis0.rotation_deg == 0 and 1 in (hypothesis0.downscale, hypothesis1.downscale)
        for hypothesis0, hypothesis1 in ways
    )


class ToldSketch:
    """A sketch whose cells say how many of them agree with those of another one that is rotated by so many degrees."""

    downscale = 1.0

    def __init__(self, agreeing: dict[int, int]) -> None:
        self.agreeing = agreeing

    def encode(self, hypothesis: Hypothesis, matcher: object) -> torch.Tensor:
        count = self.agreeing.get(hypothesis.rotation_deg, 0) if hypothesis.downscale == 1 else 0
        return torch.full((30, 30, 1), float(count))

    def match(self, cells0: torch.Tensor, cells1: torch.Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        index = np.arange(int(max(cells0.max(), cells1.max())))
        return index, index, np.ones(len(index))


@pytest.mark.parametrize(("quarter", "chosen_deg"), [(60, 135), (150, 90)])
def test_angles_between_the_quarter_turns_are_compared_unless_a_quarter_turn_is_sure(quarter, chosen_deg):
    sketch = ToldSketch({90: quarter, 135: 200})
    assert choose_hypotheses(sketch, ToldSketch({}), sketch) == (IDENTITY, Hypothesis(chosen_deg))


def test_scales_of_sketches_are_scales_of_photos():
    reduced = Hypothesis(90, 2)
    assert relate_scales((IDENTITY, reduced), 2.5, 2.5) == (IDENTITY, reduced)
    assert relate_scales((IDENTITY, IDENTITY), 2.5, 1.0) == (Hypothesis(0, 2.5), IDENTITY)
    assert relate_scales((IDENTITY, Hypothesis(180, 3)), 2.0, 1.0) == (IDENTITY, Hypothesis(180, 1.5))
    assert relate_scales((IDENTITY, reduced), 2.0, 1.2) == (IDENTITY, Hypothesis(90))


def test_matches_agree_with_those_around_them():
    count = np.arange(60)
    cells = place_cells(count, 10)
    assert cells[13].tolist() == [3, 1]
    assert count_agreeing(cells, cells + 5) == 60
    assert count_agreeing(cells, cells[::-1]) == 0  # turned by 180 degrees
    assert count_agreeing(cells, cells[:, ::-1] * (-1, 1)) == 0  # and by 90
    assert count_agreeing(cells, np.random.default_rng(0).permutation(cells)) == 0
    wrong = np.where((count % 7 == 3)[:, None], cells[::-1], cells)
    assert 40 < count_agreeing(cells, wrong) <= 52
    assert count_agreeing(cells[:0], cells[:0]) == count_agreeing(cells[:8], cells[:8]) == 0
