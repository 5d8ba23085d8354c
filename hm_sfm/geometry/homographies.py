"""Homographies on arrays: points mapped by them, and their derivatives."""

import numpy as np


def apply_homographies(homography: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Map point i by homography i: (N, 3, 3) and (N, 2) px -> (N, 2) float32 px (computed in float64)."""
    homography = homography.astype(np.float64)
    mapped = np.einsum("nij,nj->ni", homography[:, :, :2], xy) + homography[:, :, 2]
    return (mapped[:, :2] / mapped[:, 2:]).astype(np.float32)


def differentiate(homography: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """(N, 2, 2): the derivative of homography i (N, 3, 3) at point i (N, 2)."""
    ones = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    x, y, w = np.einsum("nij,nj->in", homography, ones)
    top = homography[:, :2, :2] * w[:, None, None] - np.stack([x, y], 1)[:, :, None] * homography[:, 2:, :2]
    return top / w[:, None, None] ** 2
