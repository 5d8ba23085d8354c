"""Tracks from matches: connected components, split where they hold two keypoints of one image.

Keypoints are numbered through all images here: keypoint k of image i has the global index first_keypoint[i] + k.
"""

import numpy as np
import pycolmap

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
    """Connected components: (count,) int64 labels, each the lowest index of its component. No loop over edges."""
    label = np.arange(count)
    while True:
        low = np.minimum(label[source], label[target])
        new = label.copy()
        np.minimum.at(new, label[source], low)
        np.minimum.at(new, label[target], low)
        # Follow labels to their ends: path lengths halve, so a long chain needs few rounds.
        while not np.array_equal(new, new[new]):
            new = new[new]
        if np.array_equal(new, label):
            return label
        label = new


def build_tracks(label: np.ndarray, image: np.ndarray, keypoint: np.ndarray, min_length: int = 2) -> Tracks:
    """Tracks of at least `min_length` observations, in order of their labels.

    label, image, keypoint: (K,) int64 per keypoint: its track, its image and its index within that image.
    """
    order = np.lexsort((image, label))
    _, first, length = np.unique(label[order], return_index=True, return_counts=True)
    kept = length >= min_length
    inside = np.repeat(kept, length)
    offsets = np.r_[0, np.cumsum(length[kept])]
    return Tracks(offsets, image[order][inside], keypoint[order][inside])


def measure_lengths(label: np.ndarray) -> np.ndarray:
    """(K,) int64: for each keypoint, how many keypoints its track holds."""
    _, inverse, count = np.unique(label, return_inverse=True, return_counts=True)
    return count[inverse]


def list_observations(model: pycolmap.Reconstruction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the images of a model see: (O,) int64 each, the id of the point, the image and the index of the keypoint.

    Images are numbered in the order of their ids, which is also the order of the observations; within an image they go
    by the ids of the points. Where an image observes a point twice, the first observation counts.
    """
    rows = [np.zeros((3, 0), np.int64)]
    for number, image_id in enumerate(sorted(model.reg_image_ids())):
        image = model.image(image_id)
        point = np.array([seen.point3D_id for seen in image.get_observation_points2D()], np.int64)
        keypoint = np.array(image.get_observation_point2D_idxs(), np.int64)
        point, first = np.unique(point, return_index=True)
        rows.append(np.stack([point, np.full(len(point), number), keypoint[first]]))
    point, number, keypoint = np.concatenate(rows, axis=1)
    return point, number, keypoint


def read_tracks(model: pycolmap.Reconstruction) -> Tracks:
    """The tracks of a model's points, in the order of their ids; images are numbered in the order of their ids."""
    return build_tracks(*list_observations(model))


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
