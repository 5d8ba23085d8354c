"""Planar facets textured with photos, and the things made of them: boards, boxes and reliefs."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from hm_sfm.types import PinholeView

RELIEF_CELLS = (5, 4)
"""Columns and rows of a height field; each is two triangles."""
MARGIN = 8
"""Texels around a texture, for pixels at its edge."""


class Texture:
    """A photo, repeated in both directions and mirrored each time, with its reductions as they are asked for."""

    def __init__(self, photo: np.ndarray, copies: int = 1) -> None:
        """photo: (H, W) uint8, grey. The texture measures copies * W by copies * H of its px."""
        self.photo, self.copies = photo, copies
        self.reduced: dict[tuple[int, int], np.ndarray] = {}

    def reduce(self, steps_u: int, steps_v: int) -> tuple[np.ndarray, np.ndarray]:
        """The texture with its columns reduced by 2^(steps_u / 2) and its rows by 2^(steps_v / 2).

        Returns (H', W') uint8 and the (3, 3) transform from px of the photo to px of it.
        """
        height, width = self.photo.shape
        size_wh = max(1, round(width * 2 ** (-steps_u / 2))), max(1, round(height * 2 ** (-steps_v / 2)))
        key = steps_u, steps_v
        if key not in self.reduced:
            small = cv2.resize(self.photo, size_wh, interpolation=cv2.INTER_AREA) if any(key) else self.photo
            beyond_x, beyond_y = ((self.copies - 1) * side + MARGIN for side in size_wh)
            # Repeated here, and not by warpPerspective, which takes ten times as long beyond a border.
            self.reduced[key] = cv2.copyMakeBorder(small, MARGIN, beyond_y, MARGIN, beyond_x, cv2.BORDER_REFLECT)
        return self.reduced[key], np.array(
            [[size_wh[0] / width, 0, MARGIN], [0, size_wh[1] / height, MARGIN], [0, 0, 1]]
        )


@dataclass(frozen=True)
class Facet:
    """A flat piece of a surface: origin + u * edge_u + v * edge_v with u and v in [0, 1]."""

    origin: np.ndarray
    edge_u: np.ndarray
    edge_v: np.ndarray
    """(3,) float64 each, world."""
    texture: Texture
    texel_from_uv: np.ndarray
    """(3, 3) float64, affine: (u, v, 1) -> px of the texture's photo."""
    is_triangle: bool = False
    """Only where u + v <= 1."""

    @property
    def corners(self) -> np.ndarray:
        """(3 or 4, 3) float64, world."""
        corners = self.origin, self.origin + self.edge_u, self.origin + self.edge_v
        return np.array(corners if self.is_triangle else (*corners, corners[1] + self.edge_v))

    @cached_property
    def normal(self) -> np.ndarray:
        """(3,) of unit length; which of the two it is follows from the edges."""
        normal = np.cross(self.edge_u, self.edge_v)
        return normal / np.linalg.norm(normal)

    def measure_side(self, view: PinholeView) -> float:
        """Distance of a view's camera from the plane; its sign is the side that the camera sees."""
        return float(self.normal @ (view.center - self.origin))


def make_board(photo: np.ndarray, centre: np.ndarray, rotation: np.ndarray, side: float, focal_px: float) -> Facet:
    """A rectangle of the photo's shape, `side` wide, with the photo on it; rotation (3, 3) is about its centre.

    Large ones repeat the photo, mirrored, so that cameras of focal_px see it at about its own resolution.
    """
    height, width = photo.shape
    copies = count_copies(side, centre[2], width, focal_px)
    right, down = side * rotation[:, 0], side * height / width * rotation[:, 1]
    texel_from_uv = np.diag([copies * width, copies * height, 1.0])
    return Facet(centre - right / 2 - down / 2, right, down, Texture(photo, copies), texel_from_uv)


def count_copies(side: float, depth: float, width: int, focal_px: float) -> int:
    """How often something `side` wide at a depth repeats a photo of `width` px, to be seen at about its resolution."""
    return int(np.clip(round(side * focal_px / (depth * width)), 1, 4))


def make_box(
    photos: Sequence[np.ndarray], centre: np.ndarray, rotation: np.ndarray, size: np.ndarray, focal_px: float
) -> list[Facet]:
    """The six faces of a box with the edges rotation * size (3,), a photo on each; their normals point outwards."""
    faces = []
    for axis, sign in ((0, -1), (0, 1), (1, -1), (1, 1), (2, -1), (2, 1)):
        edge_u, edge_v = (rotation[:, (axis + step) % 3] * size[(axis + step) % 3] for step in (1, 2))
        if sign < 0:
            edge_u, edge_v = edge_v, edge_u
        origin = centre + sign * rotation[:, axis] * size[axis] / 2 - edge_u / 2 - edge_v / 2
        photo = photos[len(faces)]
        copies = count_copies(float(np.linalg.norm(edge_u)), centre[2], photo.shape[1], focal_px)
        texel_from_uv = np.diag([copies * photo.shape[1], copies * photo.shape[0], 1.0])
        faces.append(Facet(origin, edge_u, edge_v, Texture(photo, copies), texel_from_uv))
    return faces


def make_relief(
    photo: np.ndarray,
    rng: np.random.Generator,
    centre: np.ndarray,
    rotation: np.ndarray,
    side: float,
    focal_px: float,
) -> list[Facet]:
    """A height field of triangles, `side` wide, under one photo; its heights are along the rotation's third axis."""
    height, width = photo.shape
    columns, rows = RELIEF_CELLS
    copies = count_copies(side, centre[2], width, focal_px)
    texture, cell_wh = Texture(photo, copies), copies * np.array([width / columns, height / rows])
    heights = rng.normal(size=(rows + 1, columns + 1)) * rng.uniform(0.1, 0.35) * side / columns
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, columns + 1), np.linspace(-0.5, 0.5, rows + 1))
    vertices = centre + np.stack([x * side, y * side * height / width, heights], axis=-1) @ rotation.T
    facets = []
    for row in range(rows):
        for column in range(columns):
            # One triangle starts at the cell's first corner, the other at its last, where texels run backwards.
            for start, sign in ((0, 1), (1, -1)):
                i, j = row + start, column + start
                origin = vertices[i, j]
                texel_from_uv = np.diag([*(sign * cell_wh), 1.0])
                texel_from_uv[:2, 2] = (j, i) * cell_wh
                edges = vertices[i, j + sign] - origin, vertices[i + sign, j] - origin
                facets.append(Facet(origin, *edges, texture, texel_from_uv, is_triangle=True))
    return facets
