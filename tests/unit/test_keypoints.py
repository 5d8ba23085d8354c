"""Persistent keypoints on hand-drawn pairs and on an exact scene of several views of a plane."""

import dataclasses

import numpy as np
import pytest

from hm_sfm.config import KeypointConfig
from hm_sfm.keypoints.propagation import (
    MIN_PROPAGATING,
    Photo,
    choose_good,
    differentiate,
    find_anchors,
    find_seeds,
    finish_keypoints,
    group_matches,
    persist_keypoints,
    propagate_keypoints,
    prune_edges,
    thin_points,
)
from hm_sfm.keypoints.selection import rank_in_groups, select_keypoints
from hm_sfm.photos.images import prepare_array
from hm_sfm.types import ImagePair, PairMatches, apply_homographies

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
    assert [found.name for found in keypoints] == [photo.name for photo in photos]
    for found, photo in zip(keypoints, photos):
        assert ((found.xy >= 0) & (found.xy <= photo.size_wh)).all()
        assert np.isfinite(found.sigma_px).all() and (found.sigma_px >= 0).all()
        assert ((found.score > 0) & (found.score <= 1)).all()
    keypoints = {found.name: found for found in keypoints}
    assert len({found.pair for found in matches}) == len(matches)
    for found in matches:
        assert len(found) and found.pair in by_pair
        assert found.indices[:, 0].max() < len(keypoints[found.pair.name0])
        assert found.indices[:, 1].max() < len(keypoints[found.pair.name1])
    tracks = find_tracks(matches)
    for track in tracks:
        assert len({name for name, _ in track}) == len(track), "two keypoints of one image in a track"
    return keypoints, {found.pair: found for found in matches}, tracks


def find_tracks(matches) -> list[frozenset[tuple[str, int]]]:
    """The tracks that matches say, by a naive union-find."""
    track_of: dict[tuple[str, int], set] = {}
    for found in matches:
        for a, b in found.indices.tolist():
            one, other = (found.pair.name0, a), (found.pair.name1, b)
            joined = track_of.get(one, {one}) | track_of.get(other, {other})
            for keypoint in joined:
                track_of[keypoint] = joined
    return list({frozenset(track) for track in track_of.values()})


# Hand-drawn


def test_a_seed_founds_a_keypoint_in_both_images():
    keypoints, matches, tracks = persist(
        [make_photo("a", (40.0, 30.0)), make_photo("b")], [make_pair("a", "b", shift(7.5, -3.25))]
    )
    np.testing.assert_allclose(keypoints["a"].xy, [[40, 30]], atol=1e-3)
    np.testing.assert_allclose(keypoints["b"].xy, [[47.5, 26.75]], atol=1e-3)
    assert matches[ImagePair("a", "b")].indices.tolist() == [[0, 0]]
    assert matches[ImagePair("a", "b")].score[0] == pytest.approx(0.9)
    assert [len(track) for track in tracks] == [2]


def test_a_keypoint_is_carried_and_joined_in_the_third_image():
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


def test_a_keypoint_is_carried_back_through_the_inverse():
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


def test_a_conflict_is_split_and_the_weaker_link_lost():
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


def test_what_falls_outside_the_other_image_is_not_carried():
    photos = [make_photo("a", (10.0, 50.0), (60.0, 50.0)), make_photo("b")]
    keypoints, _, _ = persist(photos, [make_pair("a", "b", shift(-20, 0))])
    np.testing.assert_allclose(keypoints["a"].xy, [[60, 50]], atol=1e-3)


def test_seeds_beyond_all_patches_are_not_carried():
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
    assert not matches and all(len(found) == 0 for found in keypoints.values())


def test_photos_without_seeds():
    keypoints, matches, _ = persist([make_photo("a"), make_photo("b")], [make_pair("a", "b", np.eye(3))])
    assert not matches and all(len(found) == 0 for found in keypoints.values())


# A plane seen from several sides


def make_scene(names: str) -> tuple[list[Photo], list[PairMatches]]:
    """Views of a plane with exact patches, all pairs, no two images equally strong; `names` in order of the views."""
    rng = np.random.default_rng(7)
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
        found = matches[pair.pair]
        xy0, xy1 = keypoints[pair.pair.name0].xy, keypoints[pair.pair.name1].xy
        truth = pair.homography[:1] / pair.homography[0, 2, 2]
        expected = apply_homographies(np.tile(truth, (len(found), 1, 1)), xy0[found.indices[:, 0]])
        np.testing.assert_allclose(xy1[found.indices[:, 1]], expected, atol=0.02)


def test_keypoints_on_a_plane_keep_their_distance(persisted):
    for found in persisted[0].values():
        apart = np.linalg.norm(found.xy[:, None] - found.xy[None], axis=2)
        assert apart[~np.eye(len(found), dtype=bool)].min() > CONFIG.separation_px - 0.02


@pytest.mark.parametrize("names", ["edcba", "bdaec"])
def test_names_do_not_matter(persisted, names):
    keypoints, _, tracks = persist(*make_scene(names))
    assert sorted(map(len, tracks)) == sorted(map(len, persisted[2]))
    for name, original in zip(names, "abcde"):
        found, expected = keypoints[name].xy, persisted[0][original].xy
        assert len(found) == len(expected)
        apart = np.linalg.norm(found[:, None] - expected[None], axis=2)
        assert apart.min(axis=1).max() < 0.05 and apart.min(axis=0).max() < 0.05


def test_the_order_of_the_photos_does_not_matter(scene, persisted):
    photos, pairs = scene
    keypoints, matches, _ = persist(photos[::-1], pairs)
    for name, found in keypoints.items():
        assert len(found) == len(persisted[0][name])
        np.testing.assert_allclose(
            found.xy[np.lexsort(found.xy.T.round(1))],
            persisted[0][name].xy[np.lexsort(persisted[0][name].xy.T.round(1))],
            atol=0.05,
        )
    assert {pair: len(found) for pair, found in matches.items()} == {
        pair: len(found) for pair, found in persisted[1].items()
    }


def test_the_same_input_gives_the_same_result(scene, persisted):
    keypoints, matches, _ = persist(*scene)
    for name, found in keypoints.items():
        assert found.xy.tobytes() == persisted[0][name].xy.tobytes()
    for pair, found in matches.items():
        assert found.indices.tobytes() == persisted[1][pair].indices.tobytes()


def test_the_budget_takes_longer_tracks_and_spreads(scene, persisted):
    budget = 40
    keypoints, _, tracks = persist(*scene, dataclasses.replace(CONFIG, max_keypoints=budget))
    counts = [len(found) for found in keypoints.values()]
    assert max(counts) <= 2 * budget and np.mean(counts) <= 1.3 * budget and min(counts) >= budget / 2
    assert np.mean([len(track) for track in tracks]) > np.mean([len(track) for track in persisted[2]])
    for found in keypoints.values():
        quarters = {tuple(quarter) for quarter in (found.xy // (np.array(SIZE_WH) / 2)).tolist()}
        assert len(quarters) == 4


def test_a_generous_budget_changes_nothing(scene, persisted):
    keypoints, _, _ = persist(*scene, dataclasses.replace(CONFIG, max_keypoints=100_000))
    assert {name: len(found) for name, found in keypoints.items()} == {
        name: len(found) for name, found in persisted[0].items()
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


def test_anchors_are_the_nearest_exact_seeds_of_the_own_photo():
    photos = [
        dataclasses.replace(make_photo("a", (10, 10), (30, 30), (50, 50), px_scale=2.0), seeds_are_exact=True),
        make_photo("b", (10, 10)),
        dataclasses.replace(make_photo("c", (10, 10)), seeds_are_exact=True),
    ]
    # Of two near one seed the nearer is held; one is too far from any.
    xy = [np.array([[5.4, 5.0], [5.1, 5.0], [15.0, 16.5]]), np.array([[10.0, 10.0]]), np.array([[10.2, 10.0]])]
    anchors = find_anchors(photos, xy)
    assert anchors.keypoint.tolist() == [1, 4]
    assert anchors.xy.tolist() == [[5, 5], [10, 10]]


def test_thinned_links_are_those_that_the_budget_keeps(scene):
    by_pair = {matches.pair: matches for matches in scene[1]}
    config = dataclasses.replace(CONFIG, max_keypoints=40)
    graph = propagate_keypoints(scene[0], list(by_pair), by_pair.__getitem__, config, quiet=True)
    thinned = prune_edges(graph, config)
    of_all, of_thinned = (sum(len(links.source) for links in of.links) for of in (graph, thinned))
    assert 0 < of_thinned < 0.6 * of_all
    (keypoints, matches), (few_keypoints, few_matches) = (
        finish_keypoints(graph, config),
        finish_keypoints(thinned, config),
    )
    for found, again in zip(keypoints, few_keypoints, strict=True):
        np.testing.assert_allclose(found.xy, again.xy, atol=0.02)
    for found, again in zip(matches, few_matches, strict=True):
        assert found.pair == again.pair and np.array_equal(found.indices, again.indices)


def test_nothing_is_thinned_to_nothing():
    graph = propagate_keypoints([make_photo("a")], [], {}.__getitem__, CONFIG, quiet=True)
    assert prune_edges(graph, CONFIG).links == ()


# Parts


def test_the_budget_prefers_long_then_certain_tracks():
    # Two images, six tracks in one cell; the first track is of three images, so longer.
    label = np.array([0, 1, 2, 3, 0, 1, 2, 3, 0])
    image = np.array([0, 0, 0, 0, 1, 1, 1, 1, 2])
    sigma = np.array([0.9, 0.5, 0.1, 0.3] * 2 + [0.9])
    length = np.bincount(label)[label]
    xy = np.tile([[5.0, 5.0]], (9, 1))
    for budget, kept in ((1, {0}), (2, {0, 2}), (3, {0, 2, 3}), (9, {0, 1, 2, 3}), (0, set())):
        chosen = select_keypoints(label, length, sigma, xy, image, budget)
        assert set(label[chosen].tolist()) == kept
        assert set(label[~chosen].tolist()).isdisjoint(kept), "whole tracks are kept"


def test_the_budget_spreads_among_equals():
    # One image, 20 keypoints in one cell and one each in four others.
    xy = np.r_[np.full((20, 2), 5.0), [[40, 5], [70, 5], [5, 40], [5, 70]]]
    chosen = select_keypoints(np.arange(24), np.full(24, 2), np.ones(24), xy, np.zeros(24, int), 8)
    assert chosen.sum() == 8 and chosen[20:].all()


def test_the_budget_of_nothing():
    none = np.zeros(0, int)
    assert len(select_keypoints(none, none, np.zeros(0), np.zeros((0, 2)), none, 5)) == 0


def test_ranks_start_anew_in_every_group():
    assert rank_in_groups(np.array([3, 3, 3, 5, 7, 7])).tolist() == [0, 1, 2, 0, 0, 1]


def test_good_matches_carry_and_of_few_good_ones_the_best():
    rng = np.random.default_rng(0)
    many_good = rng.permutation(np.linspace(0.5, 1.0, 400))
    assert np.array_equal(choose_good(many_good, 0.7, 100), many_good >= 0.7)
    few_good = rng.permutation(np.linspace(0.5, 0.75, 400))
    assert sorted(few_good[choose_good(few_good, 0.7, 100)]) == sorted(few_good)[-100:]
    assert choose_good(few_good[:7], 0.7, 100).all()
    assert choose_good(np.zeros(0), 0.7, 100).shape == (0,)


def test_doubtful_patches_carry_nothing_where_there_are_better_ones():
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


def test_thinning_keeps_the_best_and_the_distance():
    xy = np.array([[0.0, 0.0], [1.0, 0.0], [5.0, 0.0], [5.5, 0.0], [20.0, 0.0]])
    assert thin_points(xy, 2.0).tolist() == [True, False, True, False, True]
    assert thin_points(np.zeros((0, 2)), 2.0).shape == (0,)
    rng = np.random.default_rng(0)
    kept = rng.uniform(0, 50, (500, 2))
    kept = kept[thin_points(kept, 2.0)]
    apart = np.linalg.norm(kept[:, None] - kept[None], axis=2)
    assert len(kept) > 50 and apart[~np.eye(len(kept), dtype=bool)].min() > 2.0


def test_the_derivative_of_a_homography():
    homography = np.array([[[1.2, -0.2, 4], [0.1, 0.9, -2], [1e-3, -2e-3, 1]]])
    xy, step = np.array([[30.0, 40.0]]), 1e-3
    numeric = np.stack(
        [
            (map_exactly(homography[0], xy[0] + offset) - map_exactly(homography[0], xy[0] - offset)) / (2 * step)
            for offset in step * np.eye(2)
        ],
        axis=1,
    )
    np.testing.assert_allclose(differentiate(homography, xy)[0], numeric, atol=1e-6)
    assert differentiate(np.zeros((0, 3, 3)), np.zeros((0, 2))).shape == (0, 2, 2)


def map_exactly(homography: np.ndarray, xy: np.ndarray) -> np.ndarray:
    mapped = homography @ [*xy, 1.0]
    return mapped[:2] / mapped[2]


def test_matches_are_grouped_by_pair_in_the_order_of_names():
    # Image 0 is "z", image 1 is "a"; the link 0 -> 2 is told twice.
    photos = [make_photo("z"), make_photo("a")]
    image, index = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
    (found,) = group_matches(photos, image, index, np.array([0, 2, 1]), np.array([2, 0, 3]), np.array([0.5, 0.7, 0.2]))
    assert found.pair == ImagePair("a", "z")
    assert found.indices.tolist() == [[0, 0], [1, 1]]
    np.testing.assert_allclose(found.score, [0.7, 0.2])


def test_seeds_are_at_corners():
    pixels = np.zeros((64, 96), np.uint8)
    pixels[20:44, 27:70] = 255
    seeds = find_seeds(prepare_array(pixels, 96))
    assert len(seeds) == 12 * 8
    for corner in ([27, 20], [70, 20], [27, 44], [70, 44]):
        assert np.linalg.norm(seeds[:4] - corner, axis=1).min() < 2
    cells = np.floor(seeds / 8)
    assert len(np.unique(cells, axis=0)) == len(cells)


def test_seeds_of_a_reduced_photo_are_in_stored_pixels():
    pixels = np.zeros((128, 192), np.uint8)
    pixels[40:88, 54:140] = 255
    seeds = find_seeds(prepare_array(pixels, 96))
    for corner in ([54, 40], [140, 40], [54, 88], [140, 88]):
        assert np.linalg.norm(seeds[:4] - corner, axis=1).min() < 4
