"""Neighbours among points of the plane, by a grid of buckets; vectorised, no tree, no loop over points."""

import numpy as np


def find_pairs_within(
    queries: np.ndarray, points: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All (query, point) pairs at most `radius` apart.

    queries: (Q, 2), points: (N, 2), any float dtype, same unit as radius > 0. Returns query_index (P,) int64 ascending,
    point_index (P,) int64, distance (P,) float64. Meant for radii that hold few points.
    """
    none = np.zeros(0, np.int64)
    if len(queries) == 0 or len(points) == 0:
        return none, none, np.zeros(0)
    origin = points.min(axis=0).astype(np.float64)
    bucket = np.floor((points - origin) / radius).astype(np.int64) + 1
    row_length = int(bucket[:, 0].max()) + 3
    key = bucket[:, 1] * row_length + bucket[:, 0]
    order = np.argsort(key, kind="stable")
    sorted_key = key[order]
    # Queries far outside would wrap into other rows: they are moved to a bucket that has no neighbours.
    target = np.floor((queries - origin) / radius) + 1
    outside = ~np.all((target >= -1) & (target <= bucket.max(axis=0) + 1), axis=1)
    target = np.where(outside[:, None], -3, target).astype(np.int64)

    first, count = [], []
    for step in (-1, 0, 1):
        row = (target[:, 1] + step) * row_length + target[:, 0]
        left = np.where(target[:, 0] < 1, row - target[:, 0] + 1, row - 1)
        right = np.minimum(row + 1, (target[:, 1] + step) * row_length + row_length - 1)
        low = np.searchsorted(sorted_key, left)
        first.append(low)
        count.append(np.maximum(np.searchsorted(sorted_key, right, side="right") - low, 0))
    counts = np.stack(count, axis=1).ravel()
    starts = np.stack(first, axis=1).ravel()
    query_index = np.repeat(np.arange(len(queries)), counts.reshape(-1, 3).sum(axis=1))
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    point_index = order[np.repeat(starts, counts) + within]
    offset = queries[query_index].astype(np.float64) - points[point_index]
    distance = np.hypot(offset[:, 0], offset[:, 1])
    near = distance <= radius
    return query_index[near], point_index[near], distance[near]


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
