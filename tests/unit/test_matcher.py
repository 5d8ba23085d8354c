"""Matching two images from the outside."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from hm_sfm import HomoMatcher
from hm_sfm.config import ImageConfig, MatchingConfig, NetworkConfig, load_config
from hm_sfm.errors import InputError
from hm_sfm.network.checkpoints import load_weights
from hm_sfm.network.homonet import HomoNet
from hm_sfm.types import PatchMatches

CELLS = NetworkConfig(coarse="cosine")
"""Cells compared one by one, without context."""


def make_texture(width: int, height: int, seed: int = 0) -> np.ndarray:
    """(H, W) uint8: smoothed noise of two scales."""
    noise = np.random.default_rng(seed).normal(size=(2, height, width))
    layers = [cv2.GaussianBlur(layer, (0, 0), sigma) for layer, sigma in zip(noise, (1.5, 6.0))]
    mixed = sum(layer / layer.std() for layer in layers)
    return np.clip(128 + 40 * mixed, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def matcher() -> HomoMatcher:
    return HomoMatcher.from_pretrained("light")


def test_a_shifted_image_matches_by_its_shift(matcher):
    texture = make_texture(320, 240)
    found = matcher.match(texture[:, :288], texture[8:, 16:])
    assert len(found) > 300
    offset = found.xy1 - found.xy0
    assert (np.linalg.norm(offset - [-16, -8], axis=1) < 1).mean() > 0.9
    assert found.xy0.dtype == found.xy1.dtype == found.score.dtype == found.homography.dtype == np.float32


def test_the_fast_configuration_matches_a_shifted_image():
    config = load_config(Path(__file__).parents[2] / "configs" / "light_fast.yaml")
    fast = HomoMatcher.from_pretrained(config.matching.model, config=config.matching, network=config.network)
    texture = make_texture(260, 200)
    found = fast.match(texture[:, :240], texture[:, 20:])
    good = found.score >= config.verification.min_score
    assert good.sum() > 300
    assert np.mean(np.linalg.norm(found.xy1 - (found.xy0 - [20, 0]), axis=1)[good] < 1) > 0.9


def test_features_lie_channels_last_which_is_twice_as_fast(matcher):
    with torch.inference_mode():
        maps = matcher.net.backbone(torch.rand(1, 1, 64, 96))
    for features in (maps.coarse, maps.fine):
        assert features.is_contiguous(memory_format=torch.channels_last)


def test_matches_come_best_first(matcher):
    found = matcher.match(make_texture(160, 128), make_texture(192, 128)[:, 10:])
    assert len(found) > 20
    assert (np.diff(found.score) <= 0).all()
    assert found.score.max() <= 1 and found.score.min() >= 0 and found.score[0] > found.score[-1]


def test_homographies_put_the_centres_where_the_matches_are(matcher):
    texture = make_texture(320, 240)
    found = matcher.match(texture, cv2.resize(texture, (290, 250)))
    centre = np.concatenate([found.xy0, np.ones((len(found), 1))], axis=1)
    mapped = np.einsum("nij,nj->ni", found.homography.astype(float), centre)
    np.testing.assert_allclose(mapped[:, 2], 1, atol=1e-4)
    np.testing.assert_allclose(mapped[:, :2], found.xy1, atol=0.02)


def test_homographies_know_the_scale(matcher):
    texture = make_texture(320, 240)
    found = matcher.match(texture, cv2.resize(texture, None, fx=0.8, fy=0.8, interpolation=cv2.INTER_AREA))
    # The derivative at the centre, where the denominator is 1.
    jacobian = found.homography[:, :2, :2] - found.xy1[:, :, None] * found.homography[:, 2:, :2]
    assert np.median(np.linalg.det(jacobian.astype(float))) == pytest.approx(0.64, abs=0.06)


@pytest.mark.parametrize("size_wh", [(37, 45), (64, 33), (101, 77), (32, 32)])
def test_matches_lie_in_images_of_any_size(matcher, size_wh):
    image = make_texture(*size_wh)
    found = matcher.match(image, image)
    for xy in (found.xy0, found.xy1):
        assert (xy >= 0).all() and (xy < size_wh).all()


def test_reduced_photos_give_matches_in_stored_pixels():
    images = ImageConfig(long_edge_px=160)
    matcher = HomoMatcher.from_pretrained("light", images=images)
    large = cv2.resize(make_texture(160, 120), (640, 480), interpolation=cv2.INTER_CUBIC)
    found = matcher.match(large, large)
    assert found.xy0.max() > 500
    assert found.patch_radius_px == pytest.approx(4 * 2 * 4)
    assert (np.linalg.norm(found.xy1 - found.xy0, axis=1) < 4).mean() > 0.9


def write_pair(folder: Path, texture: np.ndarray) -> tuple[list[np.ndarray], list[Path]]:
    """Two views of a texture, (H, W) grey or (H, W, 3) RGB, as arrays and as files."""
    arrays = [texture[:, :160], texture[:, 30:]]
    paths = [folder / "a.png", folder / "b.png"]
    for path, array in zip(paths, arrays):
        # OpenCV writes BGR.
        cv2.imwrite(str(path), array[..., ::-1] if array.ndim == 3 else array)
    return arrays, paths


def test_colour_arrays_are_rgb(matcher, tmp_path):
    """OpenCV's PNG reader rounds grey otherwise than its colour conversion: equal up to that."""
    layers = [make_texture(190, 120, seed) for seed in range(3)]
    arrays, paths = write_pair(tmp_path, np.stack(layers, axis=-1))
    by_array, by_path = matcher.match(*arrays), matcher.match(*paths)
    common, at_array, at_path = np.intersect1d(by_array.xy0 @ [1, 1000], by_path.xy0 @ [1, 1000], return_indices=True)
    assert len(common) > 0.9 * max(len(by_array), len(by_path)) > 50
    apart = np.linalg.norm(by_array.xy1[at_array] - by_path.xy1[at_path], axis=1)
    assert np.median(apart) < 0.05


def test_arrays_and_files_give_the_same_matches(matcher, tmp_path):
    arrays, paths = write_pair(tmp_path, make_texture(190, 120))
    by_array, by_path, by_name = matcher.match(*arrays), matcher.match(*paths), matcher.match(*map(str, paths))
    assert len(by_array) > 50
    for other in (by_path, by_name):
        for field in dataclasses.fields(PatchMatches):
            assert np.array_equal(getattr(by_array, field.name), getattr(other, field.name)), field.name


def test_unreadable_images_are_refused(matcher, tmp_path):
    (tmp_path / "bad.png").write_bytes(b"no image")
    good = make_texture(64, 64)
    for bad in (tmp_path / "bad.png", tmp_path / "absent.png", np.zeros((64, 64)), np.zeros((8, 8), np.uint8)):
        with pytest.raises(InputError):
            matcher.match(good, bad)


@pytest.mark.parametrize("value", [0, 128, 255])
def test_flat_images_are_no_trouble(matcher, value):
    flat = np.full((96, 128), value, np.uint8)
    for other in (flat, make_texture(128, 96)):
        found = matcher.match(flat, other)
        assert found.xy0.shape == found.xy1.shape == (len(found), 2)
        assert np.isfinite(found.xy1).all() and np.isfinite(found.homography).all()


def test_no_matches_at_all():
    strict = HomoMatcher.from_pretrained("light", config=MatchingConfig(min_cosine=1.1), network=CELLS)
    found = strict.match(make_texture(96, 64), make_texture(96, 64))
    assert len(found) == 0 and found.homography.shape == (0, 3, 3)
    xy1, valid = found.warp(np.array([[3.0, 4.0]]))
    assert not valid.any() and np.isnan(xy1).all()
    assert [dense.shape for dense in found.densify()] == [(0, 2), (0, 2)]


def test_max_matches_keeps_the_most_similar():
    image = make_texture(160, 128)
    few = HomoMatcher.from_pretrained("light", config=MatchingConfig(max_matches=9)).match(image, image)
    assert 0 < len(few) <= 9


def test_the_expectation_head_matches_too(tmp_path):
    torch.manual_seed(0)
    net = HomoNet(NetworkConfig(coarse="cosine", head="expectation"))
    net.backbone.load_state_dict(load_weights("light").backbone.state_dict())
    found = HomoMatcher.from_network(net, MatchingConfig(), ImageConfig()).match(*[make_texture(160, 128)] * 2)
    assert len(found) > 50
    assert (np.linalg.norm(found.xy1 - found.xy0, axis=1) < 12).all()


@pytest.mark.slow
def test_pairs_with_few_good_matches_grow_more():
    """A turn of 30 degrees, which the coarse features bear in places only."""
    image = make_texture(320, 256)
    turn = np.vstack([cv2.getRotationMatrix2D((160, 128), 30, 1), [0, 0, 1]])
    turned = cv2.warpAffine(image, turn[:2], (320, 256), flags=cv2.INTER_CUBIC)

    def match(grow_below: int) -> PatchMatches:
        matcher = HomoMatcher.from_pretrained("light", config=MatchingConfig(grow_below=grow_below), network=CELLS)
        found = matcher.match(image, turned)
        return found.select(np.flatnonzero(found.score >= 0.5))

    few, many = match(0), match(10_000)
    assert len(few) >= 5 and len(many) > 1.5 * len(few)
    # OpenCV's frame has the centre of the first pixel at (0, 0).
    true = cv2.transform(many.xy0[None] - 0.5, turn[:2])[0] + 0.5
    assert np.median(np.linalg.norm(many.xy1 - true, axis=1)) < 0.5
    # Where there are enough good matches, nothing changes.
    enough = match(len(few))
    assert np.array_equal(enough.xy0, few.xy0) and np.array_equal(enough.xy1, few.xy1)
