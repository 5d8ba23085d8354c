"""Neighbours among points of the plane."""

import itertools
from typing import Any

import numpy as np
from scipy.spatial import KDTree


def find_pairs_within(
    queries: np.ndarray, points: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All (query, point) pairs at most `radius` apart.

    queries: (Q, 2), points: (N, 2), any float dtype, same unit as radius > 0; points are finite. Returns query_index
    (P,) int64 ascending, point_index (P,) int64, distance (P,) float64. The points of a query come row by row of
    squares as large as the radius, by index within a square: sums over them are always the same to the last digit.
    """
    if len(queries) == 0 or len(points) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    lowest, highest = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    # The tree takes no query that is not finite, or so far away that the square of its distance overflows.
    inside = np.all((queries >= lowest - 2 * radius) & (queries <= highest + 2 * radius), axis=1).nonzero()[0]
    # A bit farther, because the tree rounds distances otherwise.
    near: Any = KDTree(points).query_ball_point(queries[inside], radius * (1 + 1e-9))
    query_index = np.repeat(inside, np.fromiter(map(len, near), np.int64, len(near)))
    point_index = np.fromiter(itertools.chain.from_iterable(near), np.int64, len(query_index))
    offset = queries[query_index].astype(np.float64) - points[point_index]
    distance = np.hypot(offset[:, 0], offset[:, 1])
    column, row = np.floor((points - lowest) / radius).T
    order = np.lexsort((point_index, column[point_index], row[point_index], query_index))
    order = order[distance[order] <= radius]
    return query_index[order], point_index[order], distance[order]


def find_nearest(queries: np.ndarray, points: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """For each query the nearest point within `radius`.

    queries: (Q, 2), points: (N, 2). Returns index (Q,) int64, -1 where there is none, and distance (Q,) float64,
    inf where there is none. Of equally near points the one with the lower index is taken.
    """
    index = np.full(len(queries), -1, np.int64)
    distance = np.full(len(queries), np.inf)
    query, point, apart = find_pairs_within(queries, points, radius)
    order = np.lexsort((point, apart, query))
    query, point, apart = query[order], point[order], apart[order]
    first = np.r_[True, query[1:] != query[:-1]] if len(query) else np.zeros(0, bool)
    index[query[first]] = point[first]
    distance[query[first]] = apart[first]
    return index, distance
