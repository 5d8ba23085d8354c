"""Render textured planar quads with exact depth.

World units are metres, z points up. Pixels are in COLMAP's frame, and so are texels: texture column c spans
[c, c+1) / width of edge_u.
"""

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from hm_sfm.types import PinholeView, freeze_array

SKY_RGB = (176.0, 196.0, 218.0)
LIGHT_DIRECTION = np.array([-0.45, -0.65, 0.80]) / np.linalg.norm([-0.45, -0.65, 0.80])
AMBIENT, DIFFUSE = 0.50, 0.60
SAMPLES = 2
"""Colour samples per pixel along each axis. They are symmetric about the pixel's centre, so edges stay unbiased."""
NEAR_M = 1e-3


class Plane(Protocol):
    """What spans a plane of the world: origin + u * edge_u + v * edge_v, (3,) float64 each."""

    @property
    def origin(self) -> np.ndarray: ...

    @property
    def edge_u(self) -> np.ndarray: ...

    @property
    def edge_v(self) -> np.ndarray: ...


@dataclass(frozen=True)
class Quad:
    """A parallelogram seen from both sides: origin + u * edge_u + v * edge_v with u, v in [0, 1]."""

    origin: np.ndarray
    """(3,) float64: the world point of the texture's first corner (row 0, column 0)."""
    edge_u: np.ndarray
    """(3,) float64: along the texture's columns, to its right."""
    edge_v: np.ndarray
    """(3,) float64: along the texture's rows, to its bottom."""
    texture: np.ndarray
    """(Ht, Wt, 3) uint8 RGB."""

    def __post_init__(self) -> None:
        for name in ("origin", "edge_u", "edge_v"):
            object.__setattr__(self, name, freeze_array(getattr(self, name), np.float64, (3,), name))
        object.__setattr__(self, "texture", freeze_array(self.texture, np.uint8, (None, None, 3), "texture"))
        if not np.cross(self.edge_u, self.edge_v).any():
            raise ValueError(f"the edges of a quad must not be parallel, got {self.edge_u} and {self.edge_v}")

    @property
    def corners(self) -> np.ndarray:
        """(4, 3) float64."""
        return self.origin + np.outer([0, 1, 0, 1], self.edge_u) + np.outer([0, 0, 1, 1], self.edge_v)


@dataclass(frozen=True)
class Rendering:
    image: np.ndarray
    """(H, W, 3) uint8 RGB."""
    depth: np.ndarray
    """(H, W) float32: z-depth at the centre of each pixel, inf where nothing is."""


def render_view(
    quads: tuple[Quad, ...], view: PinholeView, background_rgb: tuple[float, float, float] = SKY_RGB
) -> Rendering:
    """Render the quads as `view` sees them, lit by one fixed light, without noise and the same every time."""
    _, inverse_depth = _find_nearest(quads, view, samples=1)
    with np.errstate(divide="ignore"):
        depth = (1.0 / inverse_depth).astype(np.float32)
    nearest, _ = _find_nearest(quads, view, samples=SAMPLES)
    colours = np.empty((*nearest.shape, 3), dtype=np.float32)
    colours[:] = background_rgb
    for index, quad in enumerate(quads):
        box = find_box(quad.corners, view, SAMPLES)
        rows, columns = np.nonzero(nearest[box] == index)
        if len(rows):
            rows, columns = rows + box[0].start, columns + box[1].start
            colours[rows, columns] = _colour_samples(quad, view, columns, rows)
    width, height = view.size_wh
    mean = cv2.resize(colours, (width, height), interpolation=cv2.INTER_AREA)
    return Rendering(np.clip(np.rint(mean), 0, 255).astype(np.uint8), depth)


def frame_in_camera(quad: Plane, view: PinholeView) -> np.ndarray:
    """(3, 3) float64: (u, v, 1) of a plane -> the point in the camera's frame."""
    rotation, translation = view.cam_from_world[:, :3], view.cam_from_world[:, 3]
    return np.column_stack([rotation @ quad.edge_u, rotation @ quad.edge_v, rotation @ quad.origin + translation])


def uvw_from_px(quad: Plane, view: PinholeView) -> np.ndarray | None:
    """(3, 3): px (x, y, 1) -> (u, v, 1) / z-depth of the plane, all affine in x and y. None if edge-on."""
    frame = frame_in_camera(quad, view)
    if abs(np.linalg.det(frame)) < 1e-12:
        return None
    return np.linalg.inv(frame) @ np.linalg.inv(view.K)


def find_box(corners: np.ndarray, view: PinholeView, samples: int = 1) -> tuple[slice, slice]:
    """Rows and columns of the grid of samples x samples points per pixel that hold all of a polygon in the image.

    corners: (N, 3) world. Two empty slices where there is nothing of it.
    """
    size = np.array(view.size_wh) * samples
    xy_px, depth = view.project(corners)
    if (depth < NEAR_M).all():
        return slice(0, 0), slice(0, 0)
    if (depth < NEAR_M).any():  # it reaches behind the camera: its corners don't bound it
        low, high = np.zeros(2, int), size
    else:
        low = np.clip(np.floor(xy_px.min(axis=0) * samples), 0, size).astype(int)
        high = np.clip(np.ceil(xy_px.max(axis=0) * samples), 0, size).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])


def _find_nearest(quads: tuple[Quad, ...], view: PinholeView, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Z-buffer at samples x samples points per pixel: (h, w) int32 nearest quad or -1, (h, w) 1 / z-depth or 0."""
    width, height = view.size_wh
    nearest = np.full((height * samples, width * samples), -1, dtype=np.int32)
    inverse_depth = np.zeros(nearest.shape)
    for index, quad in enumerate(quads):
        matrix = uvw_from_px(quad, view)
        if matrix is None:
            continue
        box = find_box(quad.corners, view, samples)
        x = (np.arange(box[1].start, box[1].stop) + 0.5) / samples
        y = (np.arange(box[0].start, box[0].stop) + 0.5) / samples
        u, v, w = (a * x + (b * y + c)[:, None] for a, b, c in matrix)
        # u and v are still divided by the depth, so they are compared with w = 1 / depth instead of 1.
        seen = (w > inverse_depth[box]) & (w < 1 / NEAR_M) & (u >= 0) & (u <= w) & (v >= 0) & (v <= w)
        nearest[box][seen] = index
        inverse_depth[box][seen] = w[seen]
    return nearest, inverse_depth


def _colour_samples(quad: Quad, view: PinholeView, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Lit colours (N, 3) float32 of a quad at samples of the SAMPLES-fold grid that see it."""
    m = uvw_from_px(quad, view)
    assert m is not None  # no sample sees a plane edge-on
    x, y = (columns + 0.5) / SAMPLES, (rows + 0.5) / SAMPLES
    u, v, w = (a * x + b * y + c for a, b, c in m)
    u, v = u / w, v / w
    height, width = quad.texture.shape[:2]
    # Texels that the step from one sample to the next crosses, from the derivatives of u and v by x and y.
    step_u = [(m[0, axis] - u * m[2, axis]) / w * (width / SAMPLES) for axis in (0, 1)]
    step_v = [(m[1, axis] - v * m[2, axis]) / w * (height / SAMPLES) for axis in (0, 1)]
    area = np.abs(step_u[0] * step_v[1] - step_u[1] * step_v[0])
    level = np.clip(0.5 * np.log2(np.maximum(area, 1e-12)), 0, None).astype(np.float32)

    normal = np.cross(quad.edge_u, quad.edge_v)
    normal *= np.sign(normal @ (view.center - quad.origin)) / np.linalg.norm(normal)
    light = AMBIENT + DIFFUSE * max(0.0, float(normal @ LIGHT_DIRECTION))
    return light * _sample_pyramid(quad.texture, u, v, level)


def _sample_pyramid(texture: np.ndarray, u: np.ndarray, v: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Trilinear lookup: (N, 3) float32 at u, v in [0, 1], `level` 0 being the full texture, 1 its half and so on."""
    colours = np.zeros((len(u), 3), dtype=np.float32)
    last = min(int(np.ceil(level.max())), min(texture.shape[:2]).bit_length() - 1)
    level = np.minimum(level, last)
    for step in range(last + 1):
        weight = 1 - np.abs(level - step)
        chosen = np.flatnonzero(weight > 0)
        if len(chosen):
            colours[chosen] += weight[chosen, None] * _sample_bilinear(texture, u[chosen], v[chosen])
        height, width = texture.shape[:2]
        texture = cv2.resize(texture, (max(width // 2, 1), max(height // 2, 1)), interpolation=cv2.INTER_AREA)
    return colours


def _sample_bilinear(texture: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(N, 3) float32; the edge texels reach out to the border."""
    height, width = texture.shape[:2]
    x = np.clip(u * width - 0.5, 0, width - 1)
    y = np.clip(v * height - 0.5, 0, height - 1)
    x0, y0 = x.astype(np.int64), y.astype(np.int64)
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    right = (x - x0).astype(np.float32)[:, None]
    down = (y - y0).astype(np.float32)[:, None]
    flat = texture.reshape(-1, 3)
    above = flat[y0 * width + x0] * (1 - right) + flat[y0 * width + x1] * right
    below = flat[y1 * width + x0] * (1 - right) + flat[y1 * width + x1] * right
    return above * (1 - down) + below * down
