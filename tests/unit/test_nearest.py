"""Neighbours against brute force, and in the order that sums depend on."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hm_sfm.geometry.nearest import find_nearest, find_pairs_within

# Quarters are exact in floating point: points exactly `radius` away count as within.
quarters = st.integers(-40, 40).map(lambda n: n / 4)
points = st.lists(st.tuples(quarters, quarters), max_size=25).map(lambda rows: np.array(rows).reshape(-1, 2))
radii = st.sampled_from((0.25, 0.5, 0.75, 1.0, 2.5, 7.0, 100.0))


def find_by_brute_force(queries, points, radius):
    distance = np.linalg.norm(queries[:, None] - points[None], axis=2)
    query, point = np.nonzero(distance <= radius)
    return query, point, distance[query, point]


@given(queries=points, points=points, radius=radii)
def test_pairs_within_equal_brute_force(queries, points, radius):
    query, point, distance = find_pairs_within(queries, points, radius)
    assert (np.diff(query) >= 0).all()
    order = np.lexsort((point, query))
    expected_query, expected_point, expected_distance = find_by_brute_force(queries, points, radius)
    assert np.array_equal(query[order], expected_query)
    assert np.array_equal(point[order], expected_point)
    np.testing.assert_allclose(distance[order], expected_distance)


def test_the_points_of_a_query_come_row_by_row():
    x, y = np.meshgrid(np.arange(4.0), np.arange(4.0))
    points = np.stack([x.ravel(), y.ravel()], axis=1)[::-1]
    query, point, _ = find_pairs_within(np.array([[1.5, 1.5], [0.0, 0.0]]), points, 2.0)
    # Squares of 2 x 2 points: that of (0, 0) holds the last ones, each square by index.
    assert query.tolist() == [0] * 12 + [1] * 6
    assert point[:4].tolist() == [10, 11, 14, 8] and point[12:].tolist() == [10, 11, 14, 15, 13, 7]


@given(queries=points, points=points, radius=radii)
def test_nearest_equals_brute_force_and_ties_go_to_the_lower_index(queries, points, radius):
    index, distance = find_nearest(queries, points, radius)
    for query, nearest, apart in zip(queries, index, distance):
        away = np.linalg.norm(points - query, axis=1)
        if len(points) and away.min() <= radius:
            assert nearest == away.argmin()
            assert apart == pytest.approx(away.min())
        else:
            assert nearest == -1 and apart == np.inf


def test_many_points_of_single_precision():
    rng = np.random.default_rng(0)
    queries, points = (rng.uniform(-300, 500, (2000, 2)).astype(np.float32) for _ in range(2))
    query, point, _ = find_pairs_within(queries, points, 9.0)
    expected_query, expected_point, _ = find_by_brute_force(queries.astype(float), points.astype(float), 9.0)
    order = np.lexsort((point, query))
    assert len(query) > 1000
    assert np.array_equal(query[order], expected_query) and np.array_equal(point[order], expected_point)


@pytest.mark.parametrize("far", [1e3, 1e9, 1e18, 1e300, np.inf, np.nan])
def test_queries_far_away_have_no_neighbours(far):
    points = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0)), axis=-1).reshape(-1, 2)
    queries = np.array([[far, 3.0], [-far, 3.0], [3.0, far], [3.0, -far], [far, -far], [3.0, 3.0]])
    index, distance = find_nearest(queries, points, 0.5)
    assert index.tolist() == [-1] * 5 + [3 * 20 + 3]
    assert distance.tolist() == [np.inf] * 5 + [0.0]


def test_a_query_beside_the_last_column_does_not_wrap_into_the_next_row():
    points = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 1.0], [10.0, 1.0]])
    queries = np.array([[11.5, 0.0], [12.5, 0.5], [-1.5, 1.0], [-2.5, 1.0]])
    assert find_nearest(queries, points, 1.0)[0].tolist() == [-1] * 4


@pytest.mark.parametrize("counts", [(0, 0), (0, 3), (3, 0)])
def test_nothing_has_no_neighbours(counts):
    queries, points = (np.zeros((n, 2)) for n in counts)
    assert [len(near) for near in find_pairs_within(queries, points, 1.0)] == [0, 0, 0]
    index, distance = find_nearest(queries, points, 1.0)
    assert index.tolist() == [-1] * counts[0] and distance.tolist() == [np.inf] * counts[0]


def test_duplicates_are_all_found():
    query, point, distance = find_pairs_within(np.zeros((2, 2)), np.zeros((3, 2)), 1.0)
    assert sorted(zip(query.tolist(), point.tolist())) == [(q, p) for q in range(2) for p in range(3)]
    assert not distance.any()
