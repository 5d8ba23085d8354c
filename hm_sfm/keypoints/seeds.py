"""Seeds: well-localised points at which keypoints may start."""

import cv2
import numpy as np

from hm_sfm.geometry.frames import px_from_pixel_index
from hm_sfm.geometry.nearest import find_pairs_within
from hm_sfm.photos.images import PreparedImage

SEED_CELL_PX = 8


def find_seeds(image: PreparedImage) -> np.ndarray:
    """The best-localised pixel (Shi-Tomasi) of each 8 x 8 px cell.

    Returns (N, 2) float64 px of the stored image, best first.
    """
    height, width = image.grey.shape
    rows, columns = height // SEED_CELL_PX, width // SEED_CELL_PX
    response = cv2.cornerMinEigenVal(image.grey, blockSize=3, ksize=3)
    cells = response[: rows * SEED_CELL_PX, : columns * SEED_CELL_PX]
    cells = cells.reshape(rows, SEED_CELL_PX, columns, SEED_CELL_PX).transpose(0, 2, 1, 3).reshape(rows, columns, -1)
    best = cells.argmax(axis=2)
    y = np.arange(rows)[:, None] * SEED_CELL_PX + best // SEED_CELL_PX
    x = np.arange(columns)[None, :] * SEED_CELL_PX + best % SEED_CELL_PX
    xy = px_from_pixel_index(np.stack([x, y], axis=-1).reshape(-1, 2))
    order = np.argsort(-cells.max(axis=2).ravel(), kind="stable")
    stored = image.stored_from_scaled
    return xy[order] @ stored[:2, :2].T + stored[:2, 2]


def thin_points(xy: np.ndarray, spacing: float) -> np.ndarray:
    """(N,) bool: the points that have no earlier point within `spacing`; xy: (N, 2), best first."""
    later, earlier, _ = find_pairs_within(xy, xy, spacing)
    keep = np.ones(len(xy), bool)
    keep[later[earlier < later]] = False
    return keep
