"""Persistent keypoints on hand-drawn pairs and on an exact scene of several views of a plane."""

import dataclasses

import numpy as np
import pytest

from hm_sfm.config import KeypointConfig
from hm_sfm.geometry.homographies import apply_homographies
from hm_sfm.keypoints.graph import FlatGraph, KeypointGraph, Photo
from hm_sfm.keypoints.persistence import collect_keypoints, group_matches, persist_keypoints
from hm_sfm.keypoints.propagation import MIN_PROPAGATING, choose_good, propagate_keypoints
from hm_sfm.keypoints.settled_tracks import prune_edges
from hm_sfm.types import ImagePair, PairMatches

CONFIG = KeypointConfig()
SIZE_WH = (128, 96)


def make_photo(name: str, *seeds: tuple[float, float], px_scale: float = 1.0) -> Photo:
    size_wh = tuple(round(side * px_scale) for side in SIZE_WH)
    return Photo(name, size_wh, px_scale, np.array(seeds, float).reshape(-1, 2))


def make_pair(name_a: str, name_b: str, b_from_a: np.ndarray, score: float = 0.9, px_scale=1.0) -> PairMatches:
    """Patches every 8 px of image a that fall into image b, all with the same homography; in the order of the names."""
    x, y = np.meshgrid(np.arange(4, SIZE_WH[0], 8) + 1.0, np.arange(4, SIZE_WH[1], 8) + 1.0)
    xy_a = np.stack([x.ravel(), y.ravel()], axis=1) * px_scale
    b_from_a = np.array(b_from_a, float)
    xy_b = apply_homographies(np.tile(b_from_a, (len(xy_a), 1, 1)), xy_a)
    inside = np.all((xy_b >= 0) & (xy_b < np.array(SIZE_WH) * px_scale), axis=1)
    xy_a, xy_b = xy_a[inside], xy_b[inside]
    if name_a > name_b:
        name_a, name_b, xy_a, xy_b, b_from_a = name_b, name_a, xy_b, xy_a, np.linalg.inv(b_from_a)
    homography = np.tile(b_from_a, (len(xy_a), 1, 1))
    at_centre = np.einsum("nj,nj->n", homography[:, 2, :2], xy_a) + homography[:, 2, 2]
    return PairMatches(
        pair=ImagePair(name_a, name_b), xy0=xy_a, xy1=xy_b, score=np.full(len(xy_a), score),
        homography=homography / at_centre[:, None, None], patch_radius_px=8.0 * px_scale,
    )  # fmt: skip


def make_no_matches(name_a: str, name_b: str) -> PairMatches:
    return dataclasses.replace(
        make_pair(name_a, name_b, np.eye(3)), xy0=np.zeros((0, 2)), xy1=np.zeros((0, 2)), score=[],
        homography=np.zeros((0, 3, 3)),
    )  # fmt: skip


def shift(x: float, y: float) -> np.ndarray:
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])


def persist(photos, pairs, config=CONFIG):
    """persist_keypoints, checked for what always holds: {name: Keypoints}, {pair: IndexMatches}, tracks."""
    by_pair = {matches.pair: matches for matches in pairs}
    keypoints, matches = persist_keypoints(photos, list(by_pair), by_pair.__getitem__, config, quiet=True)
    assert [points.name for points in keypoints] == [photo.name for photo in photos]
    for points, photo in zip(keypoints, photos):
        assert ((points.xy >= 0) & (points.xy <= photo.size_wh)).all()
        assert np.isfinite(points.sigma_px).all() and (points.sigma_px >= 0).all()
        assert ((points.score > 0) & (points.score <= 1)).all()
    keypoints = {points.name: points for points in keypoints}
    assert len({pair_matches.pair for pair_matches in matches}) == len(matches)
    for pair_matches in matches:
        assert len(pair_matches) and pair_matches.pair in by_pair
        assert pair_matches.indices[:, 0].max() < len(keypoints[pair_matches.pair.name0])
        assert pair_matches.indices[:, 1].max() < len(keypoints[pair_matches.pair.name1])
    tracks = find_tracks(matches)
    for track in tracks:
        assert len({name for name, _ in track}) == len(track), "two keypoints of one image in a track"
    return keypoints, {pair_matches.pair: pair_matches for pair_matches in matches}, tracks


def find_tracks(matches) -> list[frozenset[tuple[str, int]]]:
    """The tracks that matches say, by a naive union-find."""
    track_of: dict[tuple[str, int], set] = {}
    for pair_matches in matches:
        for a, b in pair_matches.indices.tolist():
            one, other = (pair_matches.pair.name0, a), (pair_matches.pair.name1, b)
            joined = track_of.get(one, {one}) | track_of.get(other, {other})
            for keypoint in joined:
                track_of[keypoint] = joined
    return list({frozenset(track) for track in track_of.values()})


# Hand-drawn


def test_a_seed_starts_a_keypoint_in_both_images():
    keypoints, matches, tracks = persist(
        [make_photo("a", (40.0, 30.0)), make_photo("b")], [make_pair("a", "b", shift(7.5, -3.25))]
    )
    np.testing.assert_allclose(keypoints["a"].xy, [[40, 30]], atol=1e-3)
    np.testing.assert_allclose(keypoints["b"].xy, [[47.5, 26.75]], atol=1e-3)
    assert matches[ImagePair("a", "b")].indices.tolist() == [[0, 0]]
    assert matches[ImagePair("a", "b")].score[0] == pytest.approx(0.9)
    assert [len(track) for track in tracks] == [2]


def test_a_keypoint_is_propagated_and_joined_in_the_third_image():
    photos = [make_photo("a", (40.0, 30.0)), make_photo("b"), make_photo("c")]
    pairs = [make_pair("a", "b", shift(5, 0)), make_pair("a", "c", shift(0, 9)), make_pair("b", "c", shift(-5, 9))]
    keypoints, matches, tracks = persist(photos, pairs)
    assert [len(keypoints[name]) for name in "abc"] == [1, 1, 1]
    assert len(matches) == 3 and [len(track) for track in tracks] == [3]
    np.testing.assert_allclose(keypoints["c"].xy, [[40, 39]], atol=1e-3)
    np.testing.assert_allclose(keypoints["a"].score, 1.0)


def test_predictions_that_disagree_a_little_are_averaged():
    photos = [make_photo("a", (40.0, 30.0)), make_photo("b"), make_photo("c")]
    pairs = [make_pair("a", "b", shift(5, 0)), make_pair("a", "c", shift(0, 9)), make_pair("b", "c", shift(-4.4, 9))]
    keypoints, matches, tracks = persist(photos, pairs)
    assert len(matches) == 3 and [len(track) for track in tracks] == [3]
    apart = keypoints["c"].xy[0] - keypoints["a"].xy[0]
    assert 0.1 < apart[0] < 0.5 and apart[1] == pytest.approx(9, abs=1e-3)


def test_a_keypoint_is_propagated_back_through_the_inverse():
    """B has the keypoint first, from its pair with c; a, which is in more pairs, gets it from b."""
    linear = np.array([[1.2, -0.2, 4], [0.1, 0.9, -2], [1e-4, -2e-4, 1]])
    names = "abcdefg"
    photos = [make_photo(name, *([(60.0, 50.0)] if name == "b" else [])) for name in names]
    pairs = [make_pair("b", "c", shift(3, 3)), make_pair("a", "b", linear)]
    pairs += [make_no_matches("a", other) for other in "defg"]
    keypoints, _, tracks = persist(photos, pairs)
    expected = apply_homographies(np.linalg.inv(linear)[None], np.array([[60.0, 50.0]]))
    np.testing.assert_allclose(keypoints["a"].xy, expected, atol=2e-3)
    assert [len(track) for track in tracks] == [3]


def test_pixels_of_large_photos():
    """The same scene on photos of three times the matching resolution."""
    photos = [make_photo("a", (120.0, 90.0), px_scale=3.0), make_photo("b", px_scale=3.0)]
    keypoints, _, _ = persist(photos, [make_pair("a", "b", shift(15, 6), px_scale=3.0)])
    np.testing.assert_allclose(keypoints["a"].xy, [[120, 90]], atol=1e-2)
    np.testing.assert_allclose(keypoints["b"].xy, [[135, 96]], atol=1e-2)


def test_photos_of_two_resolutions():
    three_to_one = np.diag([1 / 3, 1 / 3, 1.0])
    pair = make_pair("a", "b", np.eye(3))
    pair = dataclasses.replace(pair, xy0=3 * pair.xy0, homography=pair.homography @ three_to_one, patch_radius_px=24.0)
    keypoints, _, _ = persist([make_photo("a", (121.0, 90.5), px_scale=3.0), make_photo("b")], [pair])
    np.testing.assert_allclose(keypoints["a"].xy, [[121, 90.5]], atol=1e-2)
    np.testing.assert_allclose(keypoints["b"].xy, [[121 / 3, 90.5 / 3]], atol=1e-2)


def test_keypoints_keep_their_distance():
    """Two seeds 3 px apart are 1.2 px apart in a smaller image: one of them stays."""
    smaller = np.diag([0.4, 0.4, 1.0])
    photos = [make_photo("a", (60.0, 50.0), (63.0, 50.0), (80.0, 50.0)), make_photo("b")]
    keypoints, _, _ = persist(photos, [make_pair("a", "b", smaller)])
    assert len(keypoints["a"]) == len(keypoints["b"]) == 2
    assert np.ptp(keypoints["b"].xy[:, 0]) > CONFIG.separation_px


def test_a_conflict_is_split_and_the_weaker_edge_lost():
    """The pair (b, c) contradicts the two stronger ones by 6 px: c would get two keypoints of one track."""
    photos = [make_photo("a", (40.0, 30.0)), make_photo("b"), make_photo("c")]
    pairs = [
        make_pair("a", "b", shift(5, 0)), make_pair("a", "c", shift(0, 9)),
        make_pair("b", "c", shift(1, 9), score=0.3),
    ]  # fmt: skip
    keypoints, matches, tracks = persist(photos, pairs)
    assert [len(track) for track in tracks] == [3]
    assert ImagePair("b", "c") not in matches
    assert [len(keypoints[name]) for name in "abc"] == [1, 1, 1]
    np.testing.assert_allclose(keypoints["c"].xy, [[40, 39]], atol=0.1)


def test_what_falls_outside_the_other_image_is_not_propagated():
    photos = [make_photo("a", (10.0, 50.0), (60.0, 50.0)), make_photo("b")]
    keypoints, _, _ = persist(photos, [make_pair("a", "b", shift(-20, 0))])
    np.testing.assert_allclose(keypoints["a"].xy, [[60, 50]], atol=1e-3)


def test_seeds_beyond_all_patches_are_not_propagated():
    pair = make_pair("a", "b", np.eye(3))
    keep = [0]
    pair = dataclasses.replace(
        pair, xy0=pair.xy0[keep], xy1=pair.xy1[keep], score=pair.score[keep], homography=pair.homography[keep]
    )
    photos = [make_photo("a", (5.0, 6.0), (100.0, 80.0)), make_photo("b")]
    keypoints, _, _ = persist(photos, [pair])
    np.testing.assert_allclose(keypoints["a"].xy, [[5, 6]], atol=1e-3)


def test_pairs_without_matches_and_images_without_pairs():
    photos = [make_photo(name, (40.0, 30.0)) for name in "abcd"]
    keypoints, matches, _ = persist(photos, [make_no_matches("a", "b"), make_pair("b", "c", np.eye(3))])
    assert [len(keypoints[name]) for name in "abcd"] == [0, 1, 1, 0]
    assert list(matches) == [ImagePair("b", "c")]


def test_no_pairs_at_all():
    keypoints, matches, _ = persist([make_photo("a", (4.0, 4.0)), make_photo("b")], [])
    assert not matches and all(len(points) == 0 for points in keypoints.values())


def test_photos_without_seeds():
    keypoints, matches, _ = persist([make_photo("a"), make_photo("b")], [make_pair("a", "b", np.eye(3))])
    assert not matches and all(len(points) == 0 for points in keypoints.values())


# A plane seen from several sides


def make_scene(names: str) -> tuple[list[Photo], list[PairMatches]]:
    """Views of a plane with exact patches, all pairs, no two images equally strong; `names` in order of the views."""
    rng = np.random.default_rng(3)  # without a distance that rounding moves across a threshold
    views = [np.eye(3)]
    for _ in names[1:]:
        angle = rng.uniform(-0.3, 0.3)
        linear = rng.uniform(0.9, 1.1) * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        view = np.eye(3)
        view[:2, :2], view[2, :2] = linear, rng.uniform(-5e-4, 5e-4, 2)
        view[:2, 2] = np.array(SIZE_WH) / 2 - linear @ np.array(SIZE_WH) / 2 + rng.uniform(-6, 6, 2)
        views.append(view)
    photos = []
    for name in names:
        x, y = np.meshgrid(np.arange(0, SIZE_WH[0], 8), np.arange(0, SIZE_WH[1], 8))
        corners = np.stack([x.ravel(), y.ravel()], axis=1)
        photos.append(make_photo(name, *(corners + rng.uniform(0.5, 7.5, corners.shape))))
    pairs = [
        make_pair(names[i], names[j], views[j] @ np.linalg.inv(views[i]), score=0.9 - 0.01 * (i + j))
        for i in range(len(names))
        for j in range(i + 1, len(names))
    ]
    return photos, pairs


@pytest.fixture(scope="module")
def scene():
    return make_scene("abcde")


@pytest.fixture(scope="module")
def persisted(scene):
    return persist(*scene)


def test_tracks_on_a_plane_are_long(persisted):
    _, _, tracks = persisted
    assert len(tracks) > 100
    assert np.mean([len(track) for track in tracks]) > 3.5


def test_keypoints_of_a_plane_are_where_the_homographies_say(scene, persisted):
    keypoints, matches, _ = persisted
    for pair in scene[1]:
        shared = matches[pair.pair]
        xy0, xy1 = keypoints[pair.pair.name0].xy, keypoints[pair.pair.name1].xy
        ground_truth = pair.homography[:1] / pair.homography[0, 2, 2]
        expected = apply_homographies(np.tile(ground_truth, (len(shared), 1, 1)), xy0[shared.indices[:, 0]])
        np.testing.assert_allclose(xy1[shared.indices[:, 1]], expected, atol=0.02)


def test_keypoints_on_a_plane_keep_their_distance(persisted):
    for points in persisted[0].values():
        apart = np.linalg.norm(points.xy[:, None] - points.xy[None], axis=2)
        assert apart[~np.eye(len(points), dtype=bool)].min() > CONFIG.separation_px - 0.02


@pytest.mark.parametrize("names", ["edcba", "bdaec"])
def test_names_do_not_matter(persisted, names):
    keypoints, _, tracks = persist(*make_scene(names))
    assert sorted(map(len, tracks)) == sorted(map(len, persisted[2]))
    for name, original in zip(names, "abcde"):
        actual, expected = keypoints[name].xy, persisted[0][original].xy
        assert len(actual) == len(expected)
        apart = np.linalg.norm(actual[:, None] - expected[None], axis=2)
        assert apart.min(axis=1).max() < 0.05 and apart.min(axis=0).max() < 0.05


def test_the_order_of_the_photos_does_not_matter(scene, persisted):
    photos, pairs = scene
    keypoints, matches, _ = persist(photos[::-1], pairs)
    for name, points in keypoints.items():
        assert len(points) == len(persisted[0][name])
        np.testing.assert_allclose(
            points.xy[np.lexsort(points.xy.T.round(1))],
            persisted[0][name].xy[np.lexsort(persisted[0][name].xy.T.round(1))],
            atol=0.05,
        )
    assert {pair: len(shared) for pair, shared in matches.items()} == {
        pair: len(shared) for pair, shared in persisted[1].items()
    }


def test_the_same_input_gives_the_same_result(scene, persisted):
    keypoints, matches, _ = persist(*scene)
    for name, points in keypoints.items():
        assert points.xy.tobytes() == persisted[0][name].xy.tobytes()
    for pair, shared in matches.items():
        assert shared.indices.tobytes() == persisted[1][pair].indices.tobytes()


def test_selection_takes_longer_tracks_and_spreads(scene, persisted):
    most = 200
    keypoints, _, tracks = persist(*scene, dataclasses.replace(CONFIG, max_keypoints=most))
    counts = [len(points) for points in keypoints.values()]
    assert max(counts) <= 2 * most and np.mean(counts) <= 1.3 * most and min(counts) >= most / 2
    assert np.mean([len(track) for track in tracks]) > np.mean([len(track) for track in persisted[2]])
    for points in keypoints.values():
        quarters = {tuple(quarter) for quarter in (points.xy // (np.array(SIZE_WH) / 2)).tolist()}
        assert len(quarters) == 4


def test_a_high_limit_changes_nothing(scene, persisted):
    keypoints, _, _ = persist(*scene, dataclasses.replace(CONFIG, max_keypoints=100_000))
    assert {name: len(points) for name, points in keypoints.items()} == {
        name: len(points) for name, points in persisted[0].items()
    }


def test_keypoints_end_at_exact_seeds():
    seeds = {"a": (40.0, 40.0), "b": (50.3, 40.2)}
    pair = make_pair("a", "b", shift(10, 0))
    for exact in (False, True):
        photos = [dataclasses.replace(make_photo(name, seed), seeds_are_exact=exact) for name, seed in seeds.items()]
        keypoints, _, tracks = persist(photos, [pair])
        assert len(tracks) == 1
        apart = keypoints["b"].xy[0] - keypoints["a"].xy[0] - (10, 0)
        assert np.linalg.norm(apart) < 0.03 if not exact else 0.05 < np.linalg.norm(apart) < 0.36


def test_pruned_edges_are_those_of_selected_keypoints(scene):
    by_pair = {matches.pair: matches for matches in scene[1]}
    config = dataclasses.replace(CONFIG, max_keypoints=40)
    graph = propagate_keypoints(scene[0], list(by_pair), by_pair.__getitem__, config, quiet=True)
    pruned = prune_edges(graph, config)
    of_all, of_pruned = (sum(len(edges.source) for edges in of.edges) for of in (graph, pruned))
    assert 0 < of_pruned < 0.6 * of_all
    (keypoints, matches), (again_keypoints, again_matches) = (
        collect_keypoints(graph, config),
        collect_keypoints(pruned, config),
    )
    for first, again in zip(keypoints, again_keypoints, strict=True):
        np.testing.assert_allclose(first.xy, again.xy, atol=0.02)
    for first, again in zip(matches, again_matches, strict=True):
        assert first.pair == again.pair and np.array_equal(first.indices, again.indices)


def test_nothing_is_pruned_to_nothing():
    graph = propagate_keypoints([make_photo("a")], [], {}.__getitem__, CONFIG, quiet=True)
    assert prune_edges(graph, CONFIG).edges == ()


# Parts


def test_good_matches_propagate_and_of_few_good_ones_the_best():
    rng = np.random.default_rng(0)
    many_good = rng.permutation(np.linspace(0.5, 1.0, 400))
    assert np.array_equal(choose_good(many_good, 0.7, 100), many_good >= 0.7)
    few_good = rng.permutation(np.linspace(0.5, 0.75, 400))
    assert sorted(few_good[choose_good(few_good, 0.7, 100)]) == sorted(few_good)[-100:]
    assert choose_good(few_good[:7], 0.7, 100).all()
    assert choose_good(np.zeros(0), 0.7, 100).shape == (0,)


def test_doubtful_patches_propagate_nothing_where_there_are_better_ones():
    """Doubtful patches shift by 5 px more, and lie where the seed is."""
    sure, doubtful = make_pair("a", "b", shift(7, 0)), make_pair("a", "b", shift(12, 0), score=0.6)
    around = np.linalg.norm(sure.xy0 - (40, 30), axis=1) < 25
    sure = sure.select(np.repeat(np.flatnonzero(~around), 3))
    assert len(sure) > MIN_PROPAGATING
    joined = {
        field: np.concatenate([getattr(sure, field), getattr(doubtful, field)])
        for field in ("xy0", "xy1", "score", "homography")
    }
    photos = [make_photo("a", (40.0, 30.0)), make_photo("b")]
    matches = dataclasses.replace(sure, **joined)
    assert not persist(photos, [matches])[2]
    assert len(persist(photos, [doubtful])[2]) == 1
    exact = [dataclasses.replace(photo, seeds_are_exact=True) for photo in photos]
    assert len(persist(exact, [matches])[2]) == 1


def test_matches_are_grouped_by_pair_in_the_order_of_names():
    # Image 0 is "z", image 1 is "a"; the edge 0 -> 2 is there twice.
    image, index = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
    graph = FlatGraph(
        image,
        xy=np.zeros((4, 2)),
        source=np.array([0, 2, 1]),
        target=np.array([2, 0, 3]),
        predicted=np.zeros((3, 2)),
        jacobian=np.zeros((3, 2, 2)),
        score=np.array([0.5, 0.7, 0.2]),
    )
    (shared,) = group_matches(["z", "a"], graph, index)
    assert shared.pair == ImagePair("a", "z")
    assert shared.indices.tolist() == [[0, 0], [1, 1]]
    np.testing.assert_allclose(shared.score, [0.7, 0.2])


# Settings


def test_the_score_from_which_matches_propagate_is_a_setting():
    """The best 100 matches propagate keypoints anyhow; four around the seed do so if their score is high enough."""
    pair = make_pair("a", "b", shift(7, 0))
    order = np.argsort(np.linalg.norm(pair.xy0 - (40, 30), axis=1))
    pair = pair.select(order)
    near, far = pair.select(np.arange(4)), pair.select(np.arange(30, len(pair)))
    assert len(far) > MIN_PROPAGATING
    joined = {
        field: np.concatenate([getattr(far, field), getattr(near, field)]) for field in ("xy0", "xy1", "homography")
    }
    matches = dataclasses.replace(pair, **joined, score=np.r_[np.full(len(far), 0.9), np.full(len(near), 0.6)])
    photos = [make_photo("a", (40.0, 30.0)), make_photo("b")]
    for min_score, tracks in ((0.55, 1), (0.65, 0)):
        config = dataclasses.replace(CONFIG, propagation_min_score=min_score)
        assert len(persist(photos, [matches], config)[2]) == tracks


def test_how_far_a_patch_propagates_points_is_a_setting():
    """A single patch whose centre is 5 px away from the seed."""
    pair = make_pair("a", "b", shift(7, 0)).select(np.array([20]))
    x, y = pair.xy0[0]
    photos = [make_photo("a", (x + 3.0, y + 4.0)), make_photo("b")]
    for radius_px, tracks in ((4.9, 0), (5.1, 1)):
        config = dataclasses.replace(CONFIG, propagation_radius_px=radius_px)
        assert len(persist(photos, [pair], config)[2]) == tracks


def test_how_far_seeds_keep_from_keypoints_is_a_setting():
    """The pair (a, b) is walked first and starts a keypoint in b, 4 px away from b's own seed."""
    names = "abcde"
    seeds = {"a": (40.0, 30.0), "b": (44.0, 30.0)}
    photos = [make_photo(name, *([seeds[name]] if name in seeds else [])) for name in names]
    # Keypoints of (a, b) start in a, which is in more pairs; those of (b, c) start in b.
    pairs = [make_pair("a", "b", np.eye(3)), make_pair("b", "c", np.eye(3))]
    pairs += [make_no_matches("a", other) for other in "cde"]
    for spacing_px, count in ((3.9, 2), (4.1, 1)):
        config = dataclasses.replace(CONFIG, seed_spacing_px=spacing_px)
        keypoints, _, _ = persist(photos, pairs, config)
        assert len(keypoints["b"]) == len(keypoints["c"]) == count


# Refinement


def test_what_is_refined_are_the_edges_that_tracks_use_and_its_result_is_what_counts(scene):
    """A refiner that gives up all edges of one pair: the rest of the chain takes what it returns."""
    config = dataclasses.replace(CONFIG, max_keypoints=40)
    by_pair = {matches.pair: matches for matches in scene[1]}
    pruned = prune_edges(propagate_keypoints(scene[0], list(by_pair), by_pair.__getitem__, config, quiet=True), config)
    given: list[KeypointGraph] = []

    class Refiner:
        def refine(self, graph: KeypointGraph, quiet: bool = False) -> KeypointGraph:
            given.append(graph)
            kept = [edges for edges in graph.edges if {edges.source_image, edges.target_image} != {0, 1}]
            return dataclasses.replace(graph, edges=tuple(kept))

    _, matches = persist_keypoints(scene[0], list(by_pair), by_pair.__getitem__, config, refiner=Refiner(), quiet=True)
    assert [len(edges.source) for edges in given[0].edges] == [len(edges.source) for edges in pruned.edges]
    assert ImagePair("a", "b") not in {shared.pair for shared in matches} and len(matches) == len(by_pair) - 1
