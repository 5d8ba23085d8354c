"""The context stage as a provider: bad images, other weights, and what its matches are worth."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from hm_sfm import HomoMatcher
from hm_sfm.config import MatchingConfig, NetworkConfig
from hm_sfm.errors import WeightsError
from hm_sfm.matching.encoder import Encoder
from hm_sfm.matching.epipolar import agree_with, fit_fundamental
from hm_sfm.matching.interfaces import ImageKeypoints
from hm_sfm.matching.providers.weights import OtherContext, load_coarse
from hm_sfm.network.checkpoints import find_weights, load_weights, save_weights
from hm_sfm.photos.images import PreparedImage, prepare_array
from hm_sfm.types import ImageRef

CPU = torch.device("cpu")
SHIFT = np.array([24.0, 8.0])


@pytest.fixture(scope="module")
def matcher() -> HomoMatcher:
    return HomoMatcher.from_pretrained("light", config=MatchingConfig(device="cpu", try_hypotheses=False))


@pytest.fixture(scope="module")
def photos() -> list[np.ndarray]:
    """Two views of one texture, moved by SHIFT px."""
    noise = np.random.default_rng(0).normal(size=(2, 420, 560))
    layers = [cv2.GaussianBlur(layer, (0, 0), sigma) for layer, sigma in zip(noise, (1.5, 6.0))]
    texture = np.clip(128 + 40 * sum(layer / layer.std() for layer in layers), 0, 255).astype(np.uint8)
    x, y = 40 - SHIFT.astype(int)
    return [np.ascontiguousarray(view) for view in (texture[40:360, 40:480], texture[y : y + 320, x : x + 440])]


@pytest.mark.slow
def test_keypoints_match_and_grow_over_the_image(matcher, photos):
    features = [matcher.encode(prepare_array(photo, 1024)) for photo in photos]
    points = matcher.provider.match(*features)
    assert points.grow == "always" and len(points) > 30
    assert np.median(np.linalg.norm(points.xy1 - points.xy0 - SHIFT, axis=1)) < 2
    np.testing.assert_allclose(points.place, np.sqrt(points.score), rtol=1e-6)
    matches = matcher.match_features(*features)
    good = matches.select(matches.score >= 0.5)
    assert len(good) > 1.3 * len(points)
    assert np.percentile(np.linalg.norm(good.xy1 - good.xy0 - SHIFT, axis=1), 90) < 1


@pytest.mark.slow
def test_the_score_is_no_more_than_the_probability_of_the_place(matcher, photos):
    features = [matcher.encode(prepare_array(photo, 1024)) for photo in photos]
    matches = matcher.match_features(*features)
    points = matcher.provider.match(*features)
    at = {tuple(np.round(xy, 3)): place for xy, place in zip(points.xy0, points.place)}
    places = np.array([at.get(tuple(np.round(xy, 3)), np.nan) for xy in matches.xy0])
    known = np.isfinite(places)
    assert known.sum() > 20 and np.all(matches.score[known] <= places[known] + 1e-5)


def make_prepared(grey: np.ndarray) -> PreparedImage:
    """As prepare_array does, of any size."""
    size_wh = (grey.shape[1], grey.shape[0])
    return PreparedImage(ImageRef("strip", Path("strip"), size_wh), grey / 255, size_wh, np.eye(3))


def make_few_keypoints() -> np.ndarray:
    """A grey image with one dark square: hardly a keypoint."""
    image = np.full((200, 240), 140, np.uint8)
    image[90:110, 100:130] = 20
    return image


@pytest.mark.parametrize(
    "image",
    [
        np.full((200, 240), 255, np.uint8),
        np.zeros((200, 240), np.uint8),
        make_few_keypoints(),
        np.zeros((64, 64), np.uint8),
    ],
    ids=["white wall", "black frame", "one square", "small and black"],
)
def test_images_without_context_have_no_or_few_matches(matcher, photos, image):
    for pair in ((image, photos[0]), (photos[0], image), (image, image)):
        matches = matcher.match(*pair)
        assert np.isfinite(matches.homography).all()
        assert np.count_nonzero(matches.score >= 0.5) < 50 or pair[0] is pair[1]


def test_a_photo_of_64_px_and_a_long_panorama(matcher, photos):
    small = np.ascontiguousarray(photos[0][:64, :64])
    assert np.isfinite(matcher.match(small, photos[0]).xy1).all()
    panorama = np.tile(cv2.resize(photos[0], (500, 500)), (1, 40))
    matches = matcher.match(panorama, panorama)
    assert panorama.shape == (500, 20000) and np.isfinite(matches.xy1).all()


def test_a_photo_of_a_few_rows(matcher, photos):
    """What is left of a long panorama at the matching resolution."""
    panorama = np.tile(cv2.resize(photos[0], (512, 26)), (1, 2))
    for pair in ((panorama, panorama), (panorama, photos[0])):
        features = [matcher.encode(make_prepared(image)) for image in pair]
        assert np.isfinite(matcher.match_features(*features).xy1).all()


@pytest.mark.parametrize(("count", "matched"), [(0, False), (1, False), (7, False), (8, True)])
def test_images_with_hardly_a_keypoint_have_no_context(matcher, photos, count, matched):
    """Below eight keypoints nothing is matched, whatever they look like."""
    whole = matcher.encode(prepare_array(photos[0], 1024))
    states = whole.keypoints.states.select(torch.arange(count))
    few = dataclasses.replace(whole, keypoints=ImageKeypoints(whole.keypoints.xy[:count], states))
    for pair in ((few, whole), (few, few)):
        assert (len(matcher.provider.match(*pair)) > 0) == matched
    assert np.isfinite(matcher.match_features(few, few).xy1).all()


def test_memory_counts_the_keypoints(matcher, photos):
    features = matcher.encode(prepare_array(photos[0], 1024))
    without = dataclasses.replace(features, keypoints=None)
    assert features.size_bytes - without.size_bytes == features.keypoints.nbytes > 0


@pytest.mark.slow
def test_other_weights_with_context_match_their_keypoints(matcher, photos):
    provider = load_coarse(find_weights("light"), MatchingConfig(), CPU)
    assert isinstance(provider, OtherContext)
    images = [prepare_array(photo, 1024) for photo in photos]
    described = [
        dataclasses.replace(matcher.encode(image), description=provider.describe(image), keypoints=None)
        for image in images
    ]
    found, expected = provider.match(*described), matcher.provider.match(*map(matcher.encode, images))
    assert len(found) == len(expected) > 30
    np.testing.assert_allclose(found.xy1, expected.xy1, atol=1e-3)


def test_the_network_without_context_is_a_setting():
    cells = load_weights("light", NetworkConfig(coarse="cosine"))
    assert not hasattr(cells, "context") and cells.config.coarse == "cosine"
    whole = load_weights("light")
    for name, value in cells.state_dict().items():
        assert torch.equal(value, whole.state_dict()[name])


def test_weights_without_context_are_refused_with_what_to_do(tmp_path):
    save_weights(tmp_path / "cells.pt", load_weights("light", NetworkConfig(coarse="cosine")))
    with pytest.raises(WeightsError, match=r"cells.pt has no context stage: take network.coarse cosine, or add one"):
        load_weights(str(tmp_path / "cells.pt"), NetworkConfig())


def test_weights_that_do_not_name_their_coarse_stage_are_refused_with_what_to_do(tmp_path):
    """As the first ones did not, which had none."""
    save_weights(tmp_path / "first.pt", load_weights("light", NetworkConfig(coarse="cosine")))
    content = torch.load(tmp_path / "first.pt", weights_only=True)
    del content["network"]["coarse"]
    torch.save(content, tmp_path / "first.pt")
    for network in (None, NetworkConfig()):
        with pytest.raises(WeightsError, match=r"first.pt has no context stage: take network.coarse cosine, or add"):
            load_weights(str(tmp_path / "first.pt"), network)


def test_fewer_keypoints_are_the_best_ones(photos):
    net = load_weights("light")
    image = prepare_array(photos[0], 1024)
    many, few = (Encoder(net, CPU, count).encode(image).keypoints.xy for count in (500, 60))
    assert len(few) == 60 and torch.equal(few, many[:60])


def make_two_views(count: int, wrong: int):
    """Matches of two views of points in space, the last `wrong` of them at random, in px."""
    rng = np.random.default_rng(1)
    points = rng.uniform([-3, -2, 5], [3, 2, 9], (count, 3))
    turn = cv2.Rodrigues(np.array([0.02, 0.15, -0.03]))[0]
    views = [points, points @ turn.T + [0.8, 0.1, 0.05]]
    xy0, xy1 = (800 * view[:, :2] / view[:, 2:] + [512, 384] for view in views)
    xy1[count - wrong :] = rng.uniform(0, 700, (wrong, 2))
    return xy0, xy1


def test_matches_that_the_geometry_denies_are_known():
    xy0, xy1 = make_two_views(200, 30)
    fundamental = fit_fundamental(xy0, xy1, np.ones(200))
    agreeing = agree_with(fundamental, xy0, xy1)
    assert agreeing[:170].all() and agreeing[170:].sum() < 8


@pytest.mark.parametrize(("count", "wrong"), [(0, 0), (10, 0), (200, 140)])
def test_too_few_matches_have_no_geometry(count, wrong):
    xy0, xy1 = make_two_views(count, wrong) if count else (np.zeros((0, 2)), np.zeros((0, 2)))
    assert fit_fundamental(xy0, xy1, np.ones(count)) is None


def test_the_geometry_is_fitted_to_the_sure_ones():
    xy0, xy1 = make_two_views(200, 120)
    place = np.where(np.arange(200) < 80, 0.9, 0.4)
    fundamental = fit_fundamental(xy0, xy1, place)
    assert fundamental is not None and agree_with(fundamental, xy0, xy1)[:80].all()
