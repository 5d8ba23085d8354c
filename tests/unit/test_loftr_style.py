"""Keypoints from single matches: raw ones, and ones that are snapped to cells by votes."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from hm_sfm.evaluation.loftr_style import keep_most_voted, make_keypoints, merge_duplicates, snap_points
from hm_sfm.types import ImagePair, ImageRef, PairMatches


def snap(points, score, cell_px, vote_px=1.0):
    return snap_points(np.array(points, np.float32), np.array(score, np.float32), cell_px, vote_px)


def make_matches(name0: str, name1: str, rows: list[tuple[float, ...]]) -> PairMatches:
    """Rows of x0, y0, x1, y1, score."""
    x0, y0, x1, y1, score = np.array(rows, np.float32).reshape(-1, 5).T
    return PairMatches(
        pair=ImagePair(name0, name1),
        xy0=np.stack([x0, y0], axis=1),
        xy1=np.stack([x1, y1], axis=1),
        score=score,
        homography=np.tile(np.eye(3), (len(score), 1, 1)),
        patch_radius_px=4.0,
    )


def make_collection(names: str, *pairs: PairMatches, cell_px=None, max_keypoints=100, px_scale=1.0):
    """make_keypoints of images that are named by single letters; keypoints by name, index matches by both names."""
    images = [ImageRef(name, Path(name), (640, 480)) for name in names]
    stored = {matches.pair: matches for matches in pairs}
    keypoints, matches = make_keypoints(
        images, list(stored), stored.get, dict.fromkeys(names, px_scale), cell_px, max_keypoints
    )
    assert [points.name for points in keypoints] == list(names)
    assert [each.pair for each in matches] == list(stored)
    return (
        {points.name: points for points in keypoints},
        {each.pair.name0 + each.pair.name1: each for each in matches},
    )


# Snapping

# Cells of 8 px are squares around multiples of 8: this one is [4, 12] x [4, 12].


def test_votes_within_a_pixel_add_up():
    xy, votes, index = snap([(5.1, 6.2), (11.0, 11.0), (5.3, 6.4)], [0.4, 0.7, 0.4], 8)
    np.testing.assert_array_equal(xy, [(5, 6)])
    np.testing.assert_allclose(votes, [0.8])
    np.testing.assert_array_equal(index, [0, 0, 0])


def test_the_best_voted_position_wins_not_the_commonest():
    xy, _, _ = snap([(5, 6), (5, 6), (11, 11)], [0.2, 0.2, 0.9], 8)
    np.testing.assert_array_equal(xy, [(11, 11)])


@pytest.mark.parametrize("points", [[(5, 6), (11, 11)], [(11, 11), (5, 6)]])
def test_of_equally_voted_positions_the_first_seen_wins(points):
    xy, _, _ = snap(points, [0.5, 0.5], 8)
    np.testing.assert_array_equal(xy, points[:1])


def test_every_cell_has_a_keypoint_of_its_own():
    # 3.9 | 4.1: the border between the cells around 0 and around 8; rows come before columns.
    xy, _, index = snap([(4.1, 9), (3.9, 9), (3.9, 1)], [1, 1, 1], 8)
    np.testing.assert_array_equal(xy, [(4, 1), (4, 9), (4, 9)])
    assert len(set(index)) == 3 and index[2] == 0


def test_cells_of_a_pixel_round_to_whole_pixels():
    xy, votes, index = snap([(7.4, 3.6), (7.6, 3.6), (7.45, 3.9)], [0.5, 0.9, 0.25], 1)
    np.testing.assert_array_equal(xy, [(7, 4), (8, 4)])
    np.testing.assert_allclose(votes, [0.75, 0.9])
    np.testing.assert_array_equal(index, [0, 1, 0])


def test_finer_votes_keep_finer_positions():
    xy, _, _ = snap([(5.26, 6.24), (5.3, 6.3), (11.0, 11.0)], [0.4, 0.4, 0.7], 8, vote_px=0.25)
    np.testing.assert_array_equal(xy, [(5.25, 6.25)])


@pytest.mark.parametrize("cell_px", [1, 2, 4, 8])
def test_snapping_equals_a_count_by_hand(cell_px):
    rng = np.random.default_rng(cell_px)
    points = rng.uniform(0, 30, (400, 2)).astype(np.float32)
    # Few values, so that there are ties.
    score = rng.integers(1, 4, 400) / 4
    ballots: dict[tuple, Counter] = {}
    for point, weight in zip(points, score):
        ballot = ballots.setdefault(tuple(np.round(point / cell_px)), Counter())
        ballot[tuple(np.round(point))] += weight
    xy, votes, index = snap(points, score, cell_px)
    assert len(xy) == len(ballots)
    for point, keypoint in zip(points, index):
        winner, count = ballots[tuple(np.round(point / cell_px))].most_common(1)[0]
        assert tuple(xy[keypoint]) == winner and votes[keypoint] == pytest.approx(count)


def test_no_points_snap_to_nothing():
    xy, votes, index = snap(np.zeros((0, 2)), [], 4)
    assert xy.shape == (0, 2) and len(votes) == len(index) == 0


def test_the_most_voted_points_are_selected_in_their_order():
    position = np.array([(0, 0), (1, 1), (2, 2), (3, 3)])
    xy, votes = keep_most_voted(position, np.array([1.0, 3.0, 1.0, 2.0]), 3)
    np.testing.assert_array_equal(xy, position[[0, 1, 3]])
    np.testing.assert_array_equal(votes, [1, 3, 2])


# Raw


def test_only_exact_duplicates_merge():
    xy, votes, index = merge_duplicates(
        np.array([(3.5, 4.5), (1, 2), (3.5, np.nextafter(np.float32(4.5), 5)), (3.5, 4.5)], np.float32),
        np.array([0.5, 1.0, 1.0, 0.25]),
    )
    assert len(xy) == 3
    assert index[0] == index[3] and len(set(index)) == 3
    np.testing.assert_array_equal(xy[index[1]], (1, 2))
    assert votes[index[0]] == 0.75


# Whole collections


def test_raw_points_of_the_first_image_persist_and_others_do_not():
    keypoints, matches = make_collection(
        "abc",
        make_matches("a", "b", [(8, 8, 20.3, 9.1, 0.9), (16, 8, 28.2, 9.4, 0.8)]),
        make_matches("a", "c", [(8, 8, 31.7, 7.2, 0.7)]),
        make_matches("b", "c", [(20, 9, 31.6, 7.3, 0.9)]),
    )
    assert {name: len(points) for name, points in keypoints.items()} == {"a": 2, "b": 3, "c": 2}
    shared = matches["ab"].indices[0, 0]
    assert matches["ac"].indices[0, 0] == shared
    np.testing.assert_array_equal(keypoints["a"].xy[shared], (8, 8))
    np.testing.assert_array_equal(keypoints["b"].xy[matches["ab"].indices[0, 1]], np.float32((20.3, 9.1)))
    assert matches["bc"].indices[0, 0] not in matches["ab"].indices[:, 1]


def test_snapping_joins_what_lies_within_a_pixel():
    keypoints, matches = make_collection(
        "abc",
        make_matches("a", "b", [(8, 8, 20.3, 9.1, 0.9)]),
        make_matches("a", "c", [(8, 8, 31.7, 7.2, 0.7)]),
        make_matches("b", "c", [(20, 9, 31.6, 7.3, 0.9)]),
        cell_px=1,
    )
    assert all(len(points) == 1 for points in keypoints.values())
    np.testing.assert_array_equal(keypoints["b"].xy, [(20, 9)])
    np.testing.assert_allclose(keypoints["b"].score, [1.8], rtol=1e-6)
    assert [each.indices.tolist() for each in matches.values()] == [[[0, 0]]] * 3


def test_pixels_are_those_of_the_matching_resolution():
    # Photos reduced by four: 3 px apart is less than a pixel, and the keypoint is back in px of the photo.
    keypoints, matches = make_collection(
        "abc",
        make_matches("a", "b", [(33, 32, 50, 50, 0.9)]),
        make_matches("a", "c", [(30.5, 32, 50, 50, 0.7)]),
        cell_px=1,
        px_scale=4.0,
    )
    np.testing.assert_array_equal(keypoints["a"].xy, [(32, 32)])
    np.testing.assert_array_equal(keypoints["a"].sigma_px, [4])
    assert [each.indices.tolist() for each in matches.values()] == [[[0, 0]], [[0, 0]]]


def test_points_far_from_the_keypoint_of_their_cell_lose_their_matches():
    # All in the cell [4, 12] of image a: the first two win, the third is 6 px off, the fourth within a pixel.
    rows = [(5, 6, 50, 50, 0.9), (5, 6, 60, 60, 0.8), (11, 6, 70, 70, 0.7), (5.9, 6, 80, 80, 0.6)]
    keypoints, matches = make_collection(
        "abcde", *(make_matches("a", name, [row]) for name, row in zip("bcde", rows)), cell_px=8
    )
    np.testing.assert_array_equal(keypoints["a"].xy, [(5, 6)])
    assert [len(each) for each in matches.values()] == [1, 1, 0, 1]


def test_points_join_the_nearest_keypoint_across_cells():
    # 7.49 and 7.51 round to two keypoints; with room for one, both go to the better one.
    first = make_matches("a", "b", [(7.49, 3, 50, 50, 0.9), (7.49, 30, 60, 60, 0.1)])
    second = make_matches("a", "c", [(7.51, 3, 50, 50, 0.2)])
    keypoints, matches = make_collection("abc", first, second, cell_px=1, max_keypoints=1)
    np.testing.assert_array_equal(keypoints["a"].xy, [(7, 3)])
    assert [each.indices.tolist() for each in matches.values()] == [[[0, 0]], [[0, 0]]]


def test_matches_are_one_to_one_and_the_best_score_wins():
    rows = [(8.1, 8, 50, 50, 0.3), (8.2, 8, 60, 60, 0.9), (40, 40, 60.3, 60, 0.5)]
    _, matches = make_collection("ab", make_matches("a", "b", rows), cell_px=1)
    np.testing.assert_array_equal(matches["ab"].score, np.float32([0.9]))


@pytest.mark.parametrize("cell_px", [None, 1, 8])
def test_images_without_pairs_and_pairs_without_matches(cell_px):
    keypoints, matches = make_collection(
        "abcd", make_matches("a", "b", []), make_matches("a", "c", [(8, 8, 9, 9, 0.5)]), cell_px=cell_px
    )
    assert [len(points) for points in keypoints.values()] == [1, 0, 1, 0]
    assert [len(each) for each in matches.values()] == [0, 1]
