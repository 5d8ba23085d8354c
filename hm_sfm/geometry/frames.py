"""The one frame of coordinates, and every conversion into it.

COLMAP's frame: the pixel in column c spans [c, c+1); the centre of the top-left pixel is (0.5, 0.5). Resizing is
then a pure scaling. OpenCV and most CNN code put the centre of the top-left pixel at (0, 0): half a pixel apart.
"""

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

Array = TypeVar("Array", bound=Any)  # numpy array or torch tensor


@dataclass(frozen=True)
class Grid:
    """Where the cells of a feature map sit: the centre of cell i is at stride * i + offset px."""

    stride: int
    offset: float

    def to_px(self, cells: Array) -> Array:
        """Cell indices (..., any) -> px of the network's input image."""
        return cells * self.stride + self.offset

    def from_px(self, xy_px: Array) -> Array:
        """Px of the network's input image (..., any) -> real-valued cell indices."""
        return (xy_px - self.offset) / self.stride

    def count_cells(self, size_px: int) -> int:
        """Cells along an axis whose centre lies within `size_px`."""
        return int(np.ceil((size_px - self.offset) / self.stride))


def px_from_pixel_index(index: Array) -> Array:
    """OpenCV's indices (..., 2), where pixel centres are integers -> COLMAP px."""
    return index + 0.5


def pixel_index_from_px(xy_px: Array) -> Array:
    """COLMAP px (..., 2) -> OpenCV's indices, where pixel centres are integers."""
    return xy_px - 0.5


def homography_to_pixel_index(homography_px: np.ndarray) -> np.ndarray:
    """(..., 3, 3) homographies between COLMAP px -> the same between OpenCV's indices (for warpPerspective)."""
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    back = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    return back @ homography_px @ half


def homography_from_pixel_index(homography: np.ndarray) -> np.ndarray:
    """(..., 3, 3) homographies between OpenCV's indices (as data sets state them) -> the same between COLMAP px."""
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    back = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    return half @ homography @ back


def rotation_matrix(size_wh: tuple[int, int], rotation_deg: int) -> np.ndarray:
    """(3, 3) float64: px of an image of size `size_wh` -> px of that image rotated clockwise by `rotation_deg`."""
    width, height = size_wh
    matrices = {
        0: [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        90: [[0, -1, height], [1, 0, 0], [0, 0, 1]],
        180: [[-1, 0, width], [0, -1, height], [0, 0, 1]],
        270: [[0, 1, 0], [-1, 0, width], [0, 0, 1]],
    }
    return np.array(matrices[rotation_deg], dtype=np.float64)


def flip_matrix(width: int) -> np.ndarray:
    """(3, 3) float64: px of an image of that width -> px of that image flipped left to right, and back."""
    return np.array([[-1, 0, width], [0, 1, 0], [0, 0, 1]], dtype=np.float64)
