"""What views of a scene of facets show: depth, grey images, and the exact correspondence of two views."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from hm_sfm.geometry.frames import homography_to_pixel_index
from hm_sfm.synthetic.rendering import NEAR_M, find_box, frame_in_camera, uvw_from_px
from hm_sfm.training.facets import Facet, Texture
from hm_sfm.training.photos import SURFACES
from hm_sfm.types import PinholeView

SKY = 185.0
SUBSAMPLES = np.array([[0.125, 0.375], [0.375, 0.875], [0.625, 0.125], [0.875, 0.625]], np.float32)
"""Where a pixel at an edge is sampled, px from its corner: a rotated grid, symmetric so that edges stay unbiased."""
EDGE = -2
"""In place of an index: a pixel beside an edge."""
BAND = 1.5
"""Largest ratio of depths that share one resolution of the texture."""
LARGEST_DEPTH_RATIO = 100.0
"""Of a facet's parts in one view, beyond which its texture is not resolved further."""
LAMBERT_GAIN = 1.4
"""What faces the light directly gets more than the mean."""
DEPTH_TOLERANCE = 1e-5
"""Relative: facets that meet are not in front of each other there."""


@dataclass(frozen=True)
class SeenFacet:
    """A facet as a view sees it."""

    facet: Facet
    index: int
    """Of the facet in its scene."""
    uvw_from_px: np.ndarray
    """(3, 3) float64: px (x, y, 1) -> (u, v, 1) / z-depth."""
    box: tuple[slice, slice]
    """Rows and columns of the view that hold all of it."""

    def hit(self, x: np.ndarray, y: np.ndarray, inverse_depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where it lies before what is at inverse_depth, and its own inverse depth, in the precision of x and y.

        x, y: px, of shapes that broadcast to that of inverse_depth.
        """
        # u and v are still divided by the depth, so they are compared with w = 1 / depth instead of 1.
        u, v, w = self.uvw_from_px.tolist()
        w = w[0] * x + (w[1] * y + w[2])
        seen = w > inverse_depth
        if seen.any():
            u, v = (a * x + (b * y + c) for a, b, c in (u, v))
            seen &= w < 1 / NEAR_M
            seen &= u >= 0
            seen &= v >= 0
            if self.facet.is_triangle:
                seen &= np.add(u, v, out=u) <= w
            else:
                seen &= u <= w
                seen &= v <= w
        return seen, w


@dataclass(frozen=True)
class DepthMap:
    """What a view shows."""

    facets: tuple[SeenFacet, ...]
    """Those that may be in the image, in the order of the scene."""
    index: np.ndarray
    """(H, W) int32: of the nearest facet at each pixel's centre, -1 where there is none."""
    inverse_depth: np.ndarray
    """(H, W) float32: 1 / z-depth there, 0 where nothing is."""


def measure_depth(facets: Sequence[Facet], view: PinholeView) -> DepthMap:
    """Z-buffer at the pixel centres of a view."""
    x, y = pixel_centres(view.size_wh)
    nearest = np.full((y.size, x.size), -1, dtype=np.int32)
    inverse_depth = np.zeros((y.size, x.size), np.float32)
    in_view = []
    for index, facet in enumerate(facets):
        box, matrix = find_box(facet.corners, view), uvw_from_px(facet, view)
        if matrix is None or box[0].start == box[0].stop or box[1].start == box[1].stop:
            continue
        in_view.append(SeenFacet(facet, index, matrix, box))
        seen, w = in_view[-1].hit(x[:, box[1]], y[box[0]], inverse_depth[box])
        np.copyto(nearest[box], index, where=seen)
        np.copyto(inverse_depth[box], w, where=seen)
    return DepthMap(tuple(in_view), nearest, inverse_depth)


def pixel_centres(size_wh: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """X (1, W) and y (H, 1) float32 px of the pixels' centres."""
    return np.arange(size_wh[0], dtype=np.float32)[None] + 0.5, np.arange(size_wh[1], dtype=np.float32)[:, None] + 0.5


def cast_rays(facets: Sequence[SeenFacet], x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a view shows at any points: (K, N) int32 index of the nearest facet or -1, and (K, N) 1 / z-depth.

    x, y: (K, N) float32 px; the K points of a column lie in one row of pixels, and these rows ascend.
    """
    rows = np.floor(y[0])
    nearest = np.full(x.shape, -1, dtype=np.int32)
    inverse_depth = np.zeros(x.shape, np.float32)
    for seen_facet in facets:
        near = slice(*np.searchsorted(rows, (seen_facet.box[0].start, seen_facet.box[0].stop)))
        seen, w = seen_facet.hit(x[:, near], y[:, near], inverse_depth[:, near])
        np.copyto(nearest[:, near], seen_facet.index, where=seen)
        np.copyto(inverse_depth[:, near], w, where=seen)
    return nearest, inverse_depth


def render_facets(shown: DepthMap, view: PinholeView, light: np.ndarray) -> np.ndarray:
    """(H, W) float32 in [0, 255], grey: what a view shows, without noise; edges are smooth.

    light: (3,), see draw_lights.
    """
    rows, columns = np.nonzero(find_edges(shown.index))
    samples, _ = cast_rays(
        shown.facets, *(np.add.outer(s, i, dtype=np.float32) for s, i in zip(SUBSAMPLES.T, (columns, rows)))
    )
    image = SKY * (shown.index < 0).astype(np.float32)
    image[rows, columns] = SKY * (samples < 0).mean(axis=0)
    counts = np.bincount(shown.index.ravel() + 1, minlength=SURFACES + 1)
    counts += np.bincount(samples.ravel() + 1, minlength=SURFACES + 1)
    for seen_facet in shown.facets:
        if not counts[seen_facet.index + 1]:
            continue
        box = seen_facet.box
        share = (shown.index[box] == seen_facet.index).astype(np.float32)
        edge = slice(*np.searchsorted(rows, (box[0].start, box[0].stop)))
        i, j = rows[edge] - box[0].start, columns[edge] - box[1].start
        inside = (j >= 0) & (j < share.shape[1])
        share[i[inside], j[inside]] = (samples[:, edge] == seen_facet.index).mean(axis=0, dtype=np.float32)[inside]
        share *= shade_facet(seen_facet.facet, view, light)
        paint_facet(image[box], seen_facet, share)
    return image


def find_edges(index: np.ndarray) -> np.ndarray:
    """(H, W) bool: which pixels of an (H, W) int32 map of indices have another one among their eight neighbours."""
    index = index.astype(np.int16)
    around = np.ones((3, 3), np.uint8)
    return cv2.erode(index, around) != cv2.dilate(index, around)


def shade_facet(facet: Facet, view: PinholeView, light: np.ndarray) -> float:
    """The light that falls on the side of a facet that a view sees."""
    facing = np.sign(facet.measure_side(view)) * facet.normal
    return 1 - float(np.linalg.norm(light)) + LAMBERT_GAIN * max(0.0, float(facing @ light))


def paint_facet(image: np.ndarray, seen_facet: SeenFacet, share: np.ndarray) -> None:
    """Add a facet's texture, times `share` (h, w) float32, to the part (h, w) of an image that is the facet's box.

    The texture is reduced to the view's resolution first, each axis on its own, anew for each band of similar depth.
    """
    box_rows, box_columns = seen_facet.box
    to_view = np.array([[1, 0, box_columns.start], [0, 1, box_rows.start], [0, 0, 1]])
    texel_from_px = seen_facet.facet.texel_from_uv @ seen_facet.uvw_from_px @ to_view
    left, top, width, height = cv2.boundingRect((share > 0).view(np.uint8))
    if width == 0:
        return
    part = slice(top, top + height), slice(left, left + width)
    x, y = pixel_centres(share.shape[::-1])
    # Affine, so it is most and least at corners; beyond the horizon it is negative.
    a, b, c = texel_from_px[2].tolist()
    ends = a * x[:, [left, left + width - 1]] + b * y[[top, top + height - 1]] + c
    if ends.min() * BAND >= ends.max():
        _add_texture(image, seen_facet.facet.texture, texel_from_px, share[part], part)
        return
    inverse_depth = a * x[:, part[1]] + (b * y[part[0]] + c)
    seen = share[part] > 0
    high = inverse_depth.max(where=seen, initial=0)
    if high <= 0:
        return
    # A pixel that the facet covers in part may have its centre beyond the facet's horizon.
    low = max(inverse_depth.min(where=seen, initial=np.inf), high / LARGEST_DEPTH_RATIO)
    bands = max(1, math.ceil(math.log(high / low, BAND)))
    limits = [0.0, *np.geomspace(low, high, bands + 1)[1:-1].tolist(), math.inf]
    for low, high in pairwise(limits):
        members = (inverse_depth >= low) & (inverse_depth < high) & seen
        left, top, width, height = cv2.boundingRect(members.view(np.uint8))
        if width:
            inner = slice(top, top + height), slice(left, left + width)
            rows, columns = (slice(i.start + p.start, i.stop + p.start) for i, p in zip(inner, part))
            there = rows, columns
            _add_texture(image, seen_facet.facet.texture, texel_from_px, share[there] * members[inner], there)


def _add_texture(
    image: np.ndarray, texture: Texture, texel_from_px: np.ndarray, share: np.ndarray, part: tuple[slice, slice]
) -> None:
    """Add a texture that is seen through a homography to a part of an image, at the resolution that fits its middle.

    share: of the part's shape, factors.
    """
    rows, columns = part
    mapped = texel_from_px @ ((columns.start + columns.stop) / 2, (rows.start + rows.stop) / 2, 1)
    texel = mapped[:2] / mapped[2]
    # Rows: the texels that a step of one px crosses along the texture's columns, and along its rows.
    crossed = (texel_from_px[:2, :2] - np.outer(texel, texel_from_px[2, :2])) / mapped[2]
    steps = np.clip(np.round(2 * np.log2(np.linalg.norm(crossed, axis=1))), 0, 20).astype(int)
    reduced, reduced_from_texel = texture.reduce(*steps)
    to_box = np.array([[1, 0, columns.start], [0, 1, rows.start], [0, 0, 1]])
    warped = cv2.warpPerspective(
        reduced,
        homography_to_pixel_index(reduced_from_texel @ texel_from_px @ to_box),
        (columns.stop - columns.start, rows.stop - rows.start),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
    )
    image[part] += warped * share


def relate_views(views: Sequence[PinholeView], shown: Sequence[DepthMap]) -> tuple[np.ndarray, np.ndarray]:
    """Exact correspondence of two views A and B, given what each one shows.

    Returns b_from_a (SURFACES, 3, 3) float32, px of view A -> px of view B over the plane of each facet (identity
    where A does not show it), and surface (H, W) int64: the facet at each pixel centre of A, -1 where B does not see
    the same point (hidden, outside, the facet's other side, or nothing there).
    """
    view_a, view_b = views
    width, height = view_b.size_wh
    x, y = pixel_centres(view_a.size_wh)
    b_from_a = np.tile(np.eye(3), (SURFACES, 1, 1))
    surface = np.full(shown[0].index.shape, -1, dtype=np.int64)
    settled = np.where(find_edges(shown[1].index), EDGE, shown[1].index).ravel()
    unclear = []
    counts = np.bincount(shown[0].index.ravel() + 1, minlength=SURFACES + 1)
    for seen_facet in shown[0].facets:
        index, box, facet = seen_facet.index, seen_facet.box, seen_facet.facet
        b_from_a[index] = plane_homography(facet, view_a, view_b)
        if not counts[index + 1] or facet.measure_side(view_a) * facet.measure_side(view_b) <= 0:
            continue
        xw, yw, w = (a * x[:, box[1]] + (b * y[box[0]] + c) for a, b, c in b_from_a[index].tolist())
        inside = (shown[0].index[box] == index) & (w > 0)
        inside &= (xw >= 0) & (xw < width * w) & (yw >= 0) & (yw < height * w)
        w = w[inside]
        xy = np.stack([xw[inside] / w, yw[inside] / w])
        # Just below the limit, the quotient may round up to it.
        cell_x, cell_y = np.minimum(xy.astype(np.int32), [[width - 1], [height - 1]])
        there = settled[cell_y * width + cell_x]
        surface[box][inside] = np.where(there == index, index, -1)
        at_edge = there == EDGE
        rows, columns = np.divmod(np.flatnonzero(inside)[at_edge], inside.shape[1])
        inverse_depth = shown[0].inverse_depth[box][rows, columns] / w[at_edge]
        rows, columns = rows + box[0].start, columns + box[1].start
        unclear.append((rows, columns, np.full(len(rows), index), *xy[:, at_edge], inverse_depth))
    # Near edges the pixel centres of B do not tell: look at the very points.
    if unclear:
        rows, columns, index, x, y, inverse_depth = (np.concatenate(parts) for parts in zip(*unclear))
        order = np.argsort(y)
        rows, columns, index = rows[order], columns[order], index[order]
        _, nearest = cast_rays(shown[1].facets, x[None, order], y[None, order])
        same = nearest[0] <= inverse_depth[order] * (1 + DEPTH_TOLERANCE)
        surface[rows[same], columns[same]] = index[same]
    return b_from_a.astype(np.float32), surface


def plane_homography(facet: Facet, view_a: PinholeView, view_b: PinholeView) -> np.ndarray:
    """(3, 3) float64: px of A -> px of B for the points of the facet's plane; w is depth in B over depth in A.

    The identity for a plane that A sees edge-on.
    """
    uvw_from_a = uvw_from_px(facet, view_a)
    return np.eye(3) if uvw_from_a is None else view_b.K @ frame_in_camera(facet, view_b) @ uvw_from_a
