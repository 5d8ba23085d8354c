"""Keypoint selection: at most so many keypoints per image, those of long tracks, spread over the image."""

import numpy as np

SELECTION_CELL_PX = 32
"""Side of the square cells over which an image's keypoints are spread, px at the matching resolution."""


def select_keypoints(
    label: np.ndarray, length: np.ndarray, sigma: np.ndarray, xy: np.ndarray, image: np.ndarray, max_keypoints: int
) -> np.ndarray:
    """(K,) bool: the keypoints whose track is among the best `max_keypoints` of at least half of its images.

    Each image takes its longest, then most certain tracks, cell by cell in turns, so that they spread.
    label: the track, length: of the track, sigma: standard deviation, image: all (K,); xy: (K, 2) px at the matching
    resolution.
    """
    if len(label) == 0:
        return np.zeros(0, bool)
    cell = np.floor(xy / SELECTION_CELL_PX).astype(np.int64).clip(-1, 100_000)
    place = (image * 200_000 + cell[:, 1]) * 200_000 + cell[:, 0]
    order = np.lexsort((sigma, -length, place))
    turn = np.empty(len(label), np.int64)
    turn[order] = rank_in_groups(place[order])
    # A cell's second-longest track comes before another cell's track of one pair: turns count less than length.
    order = np.lexsort((sigma, turn // 4 - length, image))
    chosen = np.empty(len(label), bool)
    chosen[order] = rank_in_groups(image[order]) < max_keypoints
    _, track = np.unique(label, return_inverse=True)
    votes = np.bincount(track, chosen) / np.bincount(track)
    return votes[track] >= 0.5


def rank_in_groups(group: np.ndarray) -> np.ndarray:
    """(N,) int64: position of each entry within its run of equal values; group: (N,), sorted."""
    first = np.concatenate([[True], group[1:] != group[:-1]])
    starts = np.flatnonzero(first)
    return np.arange(len(group)) - np.repeat(starts, np.diff(np.append(starts, len(group))))
