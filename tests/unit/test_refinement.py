"""Keypoint refinement, on a textured plane whose true homography is known."""

import dataclasses

import cv2
import numpy as np
import pytest

from hm_sfm.config import ImageConfig, KeypointConfig, MatchingConfig
from hm_sfm.errors import ConfigError
from hm_sfm.geometry.frames import homography_to_pixel_index
from hm_sfm.geometry.homographies import apply_homographies, differentiate
from hm_sfm.keypoints import refinement
from hm_sfm.keypoints.graph import KeypointGraph, Photo, PropagatedPoints, TrackEdges
from hm_sfm.keypoints.persistence import collect_keypoints
from hm_sfm.keypoints.refined_patches import fit_hypotheses
from hm_sfm.keypoints.refinement import KeypointRefiner
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.matching.store import MatchStore, digest_image
from hm_sfm.network.fine import ExpectationHead
from hm_sfm.photos.images import read_ref

SIZE_WH = (768, 576)
PX_SCALE = 3.0
"""Px of the photos per px of the matching resolution."""
B_FROM_A = np.array([[1.02, -0.06, 14.0], [0.05, 0.99, -9.0], [2e-5, 1e-5, 1.0]])
NOISE_PX = 0.7


def true_xy(homography: np.ndarray, xy: np.ndarray) -> np.ndarray:
    return apply_homographies(np.tile(homography, (len(xy), 1, 1)), xy).astype(np.float64)


@pytest.fixture(scope="module")
def matcher() -> HomoMatcher:
    images = ImageConfig(long_edge_px=round(SIZE_WH[0] / PX_SCALE))
    return HomoMatcher.from_pretrained("light", config=MatchingConfig(device="cpu"), images=images)


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """a.png and b.png, which sees it by B_FROM_A."""
    folder = tmp_path_factory.mktemp("photos")
    rng = np.random.default_rng(0)
    texture = sum(
        cv2.resize(rng.random((SIZE_WH[1] // cell, SIZE_WH[0] // cell)), SIZE_WH, interpolation=cv2.INTER_CUBIC) * cell
        for cell in (4, 8, 16, 48)
    )
    texture = (255 * (texture - texture.min()) / np.ptp(texture)).astype(np.uint8)
    warped = cv2.warpPerspective(texture, homography_to_pixel_index(B_FROM_A), SIZE_WH, flags=cv2.INTER_CUBIC)
    for name, image in (("a", texture), ("b", warped)):
        assert cv2.imwrite(str(folder / f"{name}.png"), image)
    return [read_ref(folder / f"{name}.png") for name in "ab"]


def connect_photos(photos, wrong: int = 0) -> KeypointGraph:
    """Keypoints of both photos, half propagated each way, off by NOISE_PX; `wrong` ones by 40 px."""
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(80, 690, 30.0), np.arange(80, 500, 30.0))
    xy_a = np.stack([x.ravel(), y.ravel()], axis=1) + rng.uniform(-4, 4, (x.size, 2))
    xy_b = true_xy(B_FROM_A, xy_a)
    half = len(xy_a) // 2
    noise = rng.normal(0, NOISE_PX, xy_a.shape)
    noise[:wrong] = 40.0
    index = np.arange(len(xy_a))
    onward, back = index[:half], index[half:]
    known = [np.concatenate([xy_a[:half], (xy_a + noise)[half:]]), np.concatenate([(xy_b + noise)[:half], xy_b[half:]])]

    def connect(source, target, chosen, homography) -> TrackEdges:
        jacobian = differentiate(np.tile(homography, (len(chosen), 1, 1)), known[source][chosen])
        score = np.full(len(chosen), 0.7)
        propagated = PropagatedPoints(
            chosen, np.full(len(chosen), -1), known[target][chosen] / PX_SCALE, jacobian, score
        )
        return TrackEdges(source, target, chosen, chosen, propagated)

    edges = (connect(0, 1, onward, B_FROM_A), connect(1, 0, back, np.linalg.inv(B_FROM_A)))
    seen = tuple(Photo(photo.name, photo.size_wh, PX_SCALE, np.zeros((0, 2))) for photo in photos)
    return KeypointGraph(seen, tuple(xy / PX_SCALE for xy in known), edges)


def refine(graph, photos, matcher, folder, made_by=None, refine_long_edge_px: int = SIZE_WH[0]) -> KeypointGraph:
    digests = {photo.name: digest_image(photo) for photo in photos}
    matches = MatchStore(folder / "matches.h5", made_by or {}, digests)
    return KeypointRefiner(matcher.encoder, photos, refine_long_edge_px, matches, 500).refine(graph, quiet=True)


def measure_errors(graph: KeypointGraph) -> np.ndarray:
    """How far the predictions of the keypoints are off, px of the photos; NaN where an edge was given up."""
    errors = np.full(len(graph.xy[0]), np.nan)
    for edges, homography in zip(graph.edges, (B_FROM_A, np.linalg.inv(B_FROM_A))):
        source, target = graph.photos[edges.source_image], graph.photos[edges.target_image]
        expected = true_xy(homography, graph.xy[edges.source_image][edges.source] * source.px_scale)
        errors[edges.source] = np.linalg.norm(edges.propagated.predicted * target.px_scale - expected, axis=1)
    return errors


@pytest.fixture
def many(monkeypatch):
    """A pair has enough edges."""
    monkeypatch.setattr(refinement, "MIN_CONFIRMED", 60)


@pytest.fixture
def refined(photos, matcher, tmp_path, many) -> KeypointGraph:
    return refine(connect_photos(photos, wrong=20), photos, matcher, tmp_path)


def test_predictions_get_more_exact_in_both_directions(photos, refined):
    before, after = measure_errors(connect_photos(photos, wrong=20))[20:], measure_errors(refined)[20:]
    half = len(before) // 2
    for part in (slice(0, half), slice(half, None)):
        assert np.nanmedian(after[part]) < 0.25 * np.median(before[part])
        assert np.mean(after[part] < 0.5) > 0.9


def test_jacobians_follow_the_plane(refined):
    edges = refined.edges[0]
    expected = differentiate(np.tile(B_FROM_A, (len(edges.source), 1, 1)), refined.xy[0][edges.source])
    assert np.median(abs(edges.propagated.jacobian - expected)) < 0.02


def test_the_scale_is_that_of_the_photos(photos, refined):
    assert [(photo.px_scale, photo.matching_scale) for photo in refined.photos] == [(1.0, PX_SCALE)] * 2
    np.testing.assert_allclose(refined.xy[0], connect_photos(photos, wrong=20).xy[0] * PX_SCALE)


def test_wrong_predictions_are_given_up(refined):
    given_up = np.isnan(measure_errors(refined))
    assert given_up[:20].all() and given_up[20:].mean() < 0.1
    assert np.median(refined.edges[0].propagated.score) > 0.5


def test_where_few_are_right_the_best_stay_and_wrong_ones_count_less(photos, matcher, tmp_path, many):
    graph = connect_photos(photos, wrong=20)
    first = graph.edges[0]
    graph = dataclasses.replace(graph, edges=(first.select(first.source < 60),))
    before, after = first.propagated, refine(graph, photos, matcher, tmp_path).edges[0].propagated
    np.testing.assert_array_equal(after.point, np.arange(60))
    np.testing.assert_allclose(after.predicted[:20], before.predicted[:20] * PX_SCALE)
    assert (after.score[:20] < 0.5 * before.score[:20]).all()
    assert np.median(after.score[20:]) > 0.5


def test_the_keypoints_of_tracks_end_where_they_should(photos, refined):
    keypoints, matches = collect_keypoints(refined, KeypointConfig())
    xy0, xy1 = (keypoints[side].xy[matches[0].indices[:, side]] for side in (0, 1))
    errors = np.linalg.norm(true_xy(B_FROM_A, xy0) - xy1, axis=1)
    assert len(errors) > 200 and np.median(errors) < 0.25
    assert [each.name for each in keypoints] == [photo.name for photo in photos]


def test_photos_of_the_matching_resolution_keep_their_scale(photos, matcher, tmp_path, many):
    graph = connect_photos(photos)
    small = tuple(dataclasses.replace(photo, px_scale=1.0) for photo in graph.photos)
    xy = tuple(xy * PX_SCALE for xy in graph.xy)
    edges = tuple(
        dataclasses.replace(
            part, propagated=dataclasses.replace(part.propagated, predicted=part.propagated.predicted * PX_SCALE)
        )
        for part in graph.edges
    )
    result = refine(KeypointGraph(small, xy, edges), photos, matcher, tmp_path)
    assert [photo.matching_scale for photo in result.photos] == [1.0, 1.0]
    before, after = measure_errors(graph), measure_errors(result)
    near = before < 0.6
    assert np.nanmedian(after[near]) < 0.5 * np.median(before[near])
    assert np.isnan(after[before > 1.2]).all()


@pytest.mark.slow
def test_what_was_done_is_not_done_again_and_other_edges_are(photos, matcher, tmp_path, monkeypatch):
    graph = connect_photos(photos)
    first = refine(graph, photos, matcher, tmp_path)
    encoded = []
    encode = matcher.encoder.encode_fine
    monkeypatch.setattr(matcher.encoder, "encode_fine", lambda image: encoded.append(image) or encode(image))
    again = refine(graph, photos, matcher, tmp_path)
    assert not encoded
    for a, b in zip(first.edges, again.edges):
        np.testing.assert_array_equal(a.propagated.predicted, b.propagated.predicted)
    refine(connect_photos(photos, wrong=5), photos, matcher, tmp_path)
    assert len(encoded) == 2
    refine(connect_photos(photos, wrong=5), photos, matcher, tmp_path, {"weights": "others"})
    assert len(encoded) == 4


@pytest.mark.parametrize("rotation_deg", [0, 90, 180, 270])
@pytest.mark.parametrize("scale", [0.3, 0.9, 1.2, 2.2])
def test_photos_are_shown_upright_and_in_one_scale(rotation_deg, scale):
    angle = np.deg2rad(rotation_deg + 12)
    linear = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    hypothesis0, hypothesis1 = fit_hypotheses(np.tile(linear, (5, 1, 1)))
    assert (rotation_deg + hypothesis1.rotation_deg) % 360 == 0 and hypothesis0.rotation_deg == 0
    assert (hypothesis0.downscale, hypothesis1.downscale) == {0.3: (4, 1), 0.9: (1, 1), 1.2: (1, 1), 2.2: (1, 2)}[scale]


@pytest.mark.slow
def test_a_photo_on_its_side_and_twice_as_large_gets_more_exact_too(photos, matcher, tmp_path):
    large = cv2.resize(cv2.imread(str(photos[1].path)), None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    cv2.imwrite(str(tmp_path / "b.png"), cv2.rotate(large, cv2.ROTATE_90_CLOCKWISE))
    turned = [photos[0], read_ref(tmp_path / "b.png")]
    width = 2 * SIZE_WH[1]
    turned_from_b = np.array([[0, -2, width], [2, 0, 0], [0, 0, 1.0]])
    graph = connect_photos(turned)
    edges = graph.edges[0]
    xy_a = graph.xy[0][edges.source] * PX_SCALE
    homography = turned_from_b @ B_FROM_A
    expected = true_xy(homography, xy_a)
    off = expected + np.random.default_rng(2).normal(0, 2 * NOISE_PX, expected.shape)
    jacobian = differentiate(np.tile(homography, (len(xy_a), 1, 1)), xy_a)
    propagated = dataclasses.replace(edges.propagated, predicted=off / PX_SCALE, jacobian=jacobian)
    graph = dataclasses.replace(graph, edges=(dataclasses.replace(edges, propagated=propagated),))
    after = refine(graph, turned, matcher, tmp_path, refine_long_edge_px=2 * SIZE_WH[0]).edges[0].propagated
    errors = np.linalg.norm(after.predicted - expected[after.point], axis=1)
    assert np.median(errors) < 0.3 * np.median(np.linalg.norm(off - expected, axis=1))
    assert np.median(after.score) > 0.3


def test_no_edges_at_all(photos, matcher, tmp_path):
    graph = dataclasses.replace(connect_photos(photos), edges=())
    assert refine(graph, photos, matcher, tmp_path).edges == ()


def test_an_expectation_head_is_refused(photos, matcher, tmp_path):
    net = HomoMatcher.from_pretrained("light_expectation").net
    assert isinstance(net.head, ExpectationHead)
    with pytest.raises(ConfigError, match="keypoints.refine_long_edge_px needs network.head homography"):
        refine(connect_photos(photos), photos, HomoMatcher.from_network(net, matcher.config, matcher.images), tmp_path)
