"""Tracks from matches: connected components, split where they hold two keypoints of one image.

Keypoints are numbered through all images here: keypoint k of image i has the global index first_keypoint[i] + k.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from hm_sfm.types import Tracks


def label_tracks(
    count: int, source: np.ndarray, target: np.ndarray, score: np.ndarray, image: np.ndarray
) -> np.ndarray:
    """Number the track of every keypoint, so that no track holds two keypoints of one image.

    count: K keypoints; source, target: (E,) int64 matched keypoints; score: (E,) float, higher is stronger;
    image: (K,) int64, the image of each keypoint. Returns (K,) int64 labels: equal labels are one track. Components
    without conflict stay whole; in the others matches are taken strongest first and refused where they would join
    two keypoints of one image.
    """
    label = label_components(count, source, target)
    order = np.lexsort((image, label))
    twice = (np.diff(label[order]) == 0) & (np.diff(image[order]) == 0)
    conflicted = np.zeros(count, bool)
    conflicted[label[order[1:][twice]]] = True
    edges = np.flatnonzero(conflicted[label[source]])
    edges = edges[np.argsort(-score[edges], kind="stable")]
    parent: dict[int, int] = {}
    images_of: dict[int, set[int]] = {}
    for a, b in zip(source[edges].tolist(), target[edges].tolist()):
        root_a, root_b = _find_root(parent, a), _find_root(parent, b)
        if root_a == root_b:
            continue
        seen_a = images_of.setdefault(root_a, {int(image[root_a])})
        seen_b = images_of.setdefault(root_b, {int(image[root_b])})
        if seen_a.isdisjoint(seen_b):
            parent[root_b] = root_a
            seen_a |= seen_b
    members = np.flatnonzero(conflicted[label])
    label = label.copy()
    label[members] = [_find_root(parent, k) for k in members.tolist()]
    return label


def _find_root(parent: dict[int, int], k: int) -> int:
    root = k
    while parent.get(root, root) != root:
        root = parent[root]
    while parent.get(k, k) != root and k != root:
        parent[k], k = root, parent[k]
    return root


def label_components(count: int, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Connected components: (count,) int64 labels, each the lowest index of its component."""
    edges = coo_array((np.ones(len(source), bool), (source, target)), shape=(count, count))
    _, component = connected_components(edges, directed=False)
    _, lowest = np.unique(component, return_index=True)
    return lowest[component]


def build_tracks(label: np.ndarray, image: np.ndarray, keypoint: np.ndarray, min_length: int = 2) -> Tracks:
    """Tracks of at least `min_length` observations, in order of their labels.

    label, image, keypoint: (K,) int64 per keypoint: its track, its image and its index within that image.
    """
    order = np.lexsort((image, label))
    _, length = np.unique(label[order], return_counts=True)
    kept = length >= min_length
    inside = np.repeat(kept, length)
    offsets = np.r_[0, np.cumsum(length[kept])]
    return Tracks(offsets, image[order][inside], keypoint[order][inside])


def measure_lengths(label: np.ndarray) -> np.ndarray:
    """(K,) int64: for each keypoint, how many keypoints its track holds."""
    _, inverse, count = np.unique(label, return_inverse=True, return_counts=True)
    return count[inverse]


def count_neighbours(tracks: Tracks, num_images: int) -> np.ndarray:
    """(num_images,) int64: with how many others each image shares a track."""
    image = tracks.image_index
    track = np.repeat(np.arange(len(tracks)), np.diff(tracks.offsets))
    shared = np.zeros((num_images, num_images), bool)
    first = np.arange(len(track))
    step = 0
    # Observations that lie `step` apart in one track: there are fewer with each step.
    while len(first):
        step += 1
        first = first[first + step < len(track)]
        first = first[track[first] == track[first + step]]
        shared[image[first], image[first + step]] = True
    return (shared | shared.T).sum(axis=1)
