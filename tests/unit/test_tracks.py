"""Tracks from matches: merges, conflicts, and one keypoint per image."""

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hm_sfm.keypoints.tracks import build_tracks, label_components, label_tracks, measure_lengths


def label(count, edges, scores, images):
    source, target = np.array(edges, np.int64).reshape(-1, 2).T
    return label_tracks(count, source, target, np.array(scores, float), np.array(images, np.int64))


def sets_of(labels) -> set[frozenset[int]]:
    """The groups of keypoints that labels say."""
    return {frozenset(np.flatnonzero(labels == value).tolist()) for value in np.unique(labels)}


def unite(count, edges) -> list[set[int]]:
    groups = [{k} for k in range(count)]
    for a, b in edges:
        if groups[a] is not groups[b]:
            groups[a] |= groups[b]
            for k in groups[b]:
                groups[k] = groups[a]
    return groups


@st.composite
def match_graphs(draw):
    count = draw(st.integers(1, 14))
    ends = st.integers(0, count - 1)
    edges = draw(st.lists(st.tuples(ends, ends).filter(lambda edge: edge[0] != edge[1]), max_size=25))
    scores = draw(st.lists(st.floats(0, 1), min_size=len(edges), max_size=len(edges)))
    images = draw(st.lists(st.integers(0, 5), min_size=count, max_size=count))
    return count, edges, scores, images


def test_two_matches_that_share_a_keypoint_merge():
    assert sets_of(label(5, [(0, 1), (2, 1)], [1, 1], [0, 1, 2, 0, 1])) == {
        frozenset({0, 1, 2}), frozenset({3}), frozenset({4}),
    }  # fmt: skip


def test_a_long_chain_is_one_track_whatever_its_direction():
    chain = np.random.default_rng(0).permutation(200)
    labels = label(200, list(pairwise(chain)), np.ones(199), np.arange(200))
    assert len(np.unique(labels)) == 1


def test_a_conflict_is_split_at_its_weakest_match():
    # Keypoints 0 and 3 are both of image 0; the match (1, 2) joins them and is the weakest.
    assert sets_of(label(4, [(0, 1), (1, 2), (2, 3)], [0.9, 0.2, 0.8], [0, 1, 2, 0])) == {
        frozenset({0, 1}), frozenset({2, 3}),
    }  # fmt: skip


def test_the_strongest_match_wins_among_rivals():
    # Keypoint 0 matches two keypoints of image 1: the stronger one stays, wherever it is in the list.
    for scores, winner in (([0.3, 0.9], 2), ([0.9, 0.3], 1)):
        labels = label(3, [(0, 1), (0, 2)], scores, [0, 1, 1])
        assert sets_of(labels) == {frozenset({0, winner}), frozenset({3 - winner})}


def test_a_conflict_leaves_other_tracks_whole():
    labels = label(6, [(0, 1), (1, 2), (3, 4), (4, 5)], [0.9, 0.1, 0.05, 0.05], [0, 1, 0, 0, 1, 2])
    assert frozenset({3, 4, 5}) in sets_of(labels)


def test_a_match_within_one_image_joins_nothing():
    assert len(sets_of(label(2, [(0, 1)], [1.0], [3, 3]))) == 2


def test_nothing_to_label():
    assert len(label(0, [], [], [])) == 0
    assert label(3, [], [], [0, 0, 1]).tolist() == [0, 1, 2]


@given(graph=match_graphs())
def test_components_equal_a_naive_union_find(graph):
    count, edges, _, _ = graph
    source, target = np.array(edges, np.int64).reshape(-1, 2).T
    assert label_components(count, source, target).tolist() == [min(group) for group in unite(count, edges)]


@given(graph=match_graphs())
def test_tracks_equal_a_naive_union_find_that_refuses_conflicts(graph):
    count, edges, scores, images = graph
    groups = [{k} for k in range(count)]
    whole = unite(count, edges)
    for e in sorted(range(len(edges)), key=lambda e: -scores[e]):
        a, b = edges[e]
        joined = groups[a] | groups[b]
        conflict_free = len({images[k] for k in whole[a]}) == len(whole[a])
        if conflict_free or len({images[k] for k in joined}) == len(joined):
            for k in joined:
                groups[k] = joined
    assert sets_of(label(count, edges, scores, images)) == {frozenset(group) for group in groups}


@given(graph=match_graphs())
def test_no_track_holds_two_keypoints_of_an_image(graph):
    count, edges, scores, images = graph
    labels = label(count, edges, scores, images)
    observations = list(zip(labels.tolist(), images))
    assert len(observations) == len(set(observations))


def test_tracks_as_rows():
    image, keypoint = np.array([0, 0, 1, 1, 2]), np.array([0, 1, 0, 1, 0])
    tracks = build_tracks(np.array([7, 3, 7, 5, 7]), image, keypoint)
    assert len(tracks) == 1
    assert tracks.offsets.tolist() == [0, 3]
    assert tracks.image_index.tolist() == [0, 1, 2] and tracks.keypoint_index.tolist() == [0, 0, 0]
    assert len(build_tracks(np.array([7, 3, 7, 5, 7]), image, keypoint, min_length=1)) == 3


def test_no_tracks():
    none = np.zeros(0, np.int64)
    assert len(build_tracks(none, none, none)) == 0
    assert len(build_tracks(np.array([0, 1]), np.array([0, 1]), np.array([0, 0]))) == 0


@given(labels=st.lists(st.integers(0, 6), max_size=20))
def test_lengths_count_keypoints_of_the_same_track(labels):
    assert measure_lengths(np.array(labels, np.int64)).tolist() == [labels.count(value) for value in labels]
