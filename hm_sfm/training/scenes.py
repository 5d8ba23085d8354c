"""Training pairs with real parallax: two views of a rendered scene of planar facets that carry photos.

Items look like those of photos.WarpedPhotos: every facet has an exact homography between the views, and the map of
surfaces says which one a pixel of view A shows, where view B shows the same point; occlusion and depth
discontinuities come for free. Views are grey, lit differently, and rendered by one warp of the photo per facet.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import cv2
import numpy as np
from torch.utils.data import Dataset

from hm_sfm.geometry.frames import homography_to_pixel_index
from hm_sfm.synthetic.rendering import NEAR_M, find_box, frame_in_camera, uvw_from_px
from hm_sfm.training.photos import POINTS, SURFACES, disturb_view
from hm_sfm.types import PinholeView

BACKGROUND_DEPTH = 6.0
BOXES = (1, 4)
BOARDS = (1, 5)
"""Fewest and most of the things that stand before the background."""
RELIEF_CELLS = (5, 4)
"""Columns and rows of a height field; each is two triangles."""
CLEARANCE = 1.2
"""Things whose centre is nearer than this to a camera are left out."""
SKY = 185.0
SUBSAMPLES = np.array([[0.125, 0.375], [0.375, 0.875], [0.625, 0.125], [0.875, 0.625]], np.float32)
"""Where a pixel at an edge is sampled, px from its corner: a turned grid, symmetric so that edges stay unbiased."""
EDGE = -2
"""In place of an index: a pixel beside an edge."""
BAND = 1.5
"""Largest ratio of depths that share one resolution of the texture."""
LARGEST_DEPTH_RATIO = 100.0
"""Of a facet's parts in one view, beyond which its texture is not resolved further."""
MARGIN = 8
"""Texels around a texture, for pixels at its edge."""
LAMBERT_GAIN = 1.4
"""What faces the light directly gets more than the mean."""
DEPTH_TOLERANCE = 1e-5
"""Relative: facets that meet are not in front of each other there."""


@dataclass(frozen=True)
class ViewRange:
    """How far the two views of a rendered pair are apart."""

    yaw_deg: float = 28.0
    pitch_deg: float = 12.0
    roll_deg: float = 20.0
    distance_ratio: float = 1.5
    """The second camera is between 1 / ratio and ratio times as far from the scene."""


class Texture:
    """A photo, repeated in both directions and mirrored each time, with its reductions as they are asked for."""

    def __init__(self, photo: np.ndarray, copies: int = 1) -> None:
        """photo: (H, W) uint8, grey. The texture measures copies * W by copies * H of its px."""
        self.photo, self.copies = photo, copies
        self.reduced: dict[tuple[int, int], np.ndarray] = {}

    def reduce(self, steps_u: int, steps_v: int) -> tuple[np.ndarray, np.ndarray]:
        """The texture with its columns reduced by 2^(steps_u / 2), its rows by 2^(steps_v / 2), (H', W') uint8, and
        the (3, 3) transform from px of the photo to px of that.
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


class RenderedScenes(Dataset):
    """Items as photos.WarpedPhotos; item i depends on the seed and on i alone."""

    def __init__(
        self, photos: list[np.ndarray], size_wh: tuple[int, int], seed: int, count: int, views: ViewRange
    ) -> None:
        self.photos, self.size_wh, self.seed, self.count, self.views = photos, size_wh, seed, count, views

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng([self.seed, index, 1])
        views = draw_cameras(self.size_wh, self.views, rng)
        facets = draw_scene(self.photos, views, rng)
        shown = [find_nearest(facets, view) for view in views]
        images = [render_facets(*each) for each in zip(shown, views, draw_lights(rng))]
        b_from_a, surface = relate_views(facets, views, shown)
        return {
            "images": np.stack([disturb_view(image, rng) for image in images]),
            "b_from_a": b_from_a,
            "surface": surface,
            "points": np.full((POINTS, 4), np.nan, np.float32),
        }


# Scenes


def draw_scene(
    photos: list[np.ndarray], views: tuple[PinholeView, PinholeView], rng: np.random.Generator
) -> tuple[Facet, ...]:
    """At most SURFACES facets in front of a camera at the origin that looks along +z: walls, relief, boxes, boards."""
    focal_px = views[0].K[0, 0]

    def draw_board(centre: np.ndarray, tilt_deg: tuple[float, float], side: float) -> Facet:
        photo = photos[rng.integers(len(photos))]
        return make_board(photo, centre, turn(*tilt_deg, rng.uniform(-15, 15)), side, focal_px)

    behind = np.array([0, 0, BACKGROUND_DEPTH])
    facets = [draw_board(behind, (rng.uniform(-40, 40), rng.uniform(-30, 30)), 3.4 * BACKGROUND_DEPTH)]
    if rng.random() < 0.5:
        ground = np.array([0, rng.uniform(1.2, 2.2), BACKGROUND_DEPTH])
        facets.append(draw_board(ground, (0, rng.uniform(75, 95)), 3.4 * BACKGROUND_DEPTH))
    if rng.random() < 0.5:
        photo = photos[rng.integers(len(photos))]
        rotation = turn(rng.uniform(-30, 30), rng.uniform(-30, 30), rng.uniform(-15, 15))
        place = np.array([*rng.uniform(-1, 1, size=2), rng.uniform(0.75, 1.0) * BACKGROUND_DEPTH])
        facets += make_relief(photo, rng, place, rotation, rng.uniform(2.5, 7), focal_px)
    for _ in range(rng.integers(*BOXES, endpoint=True)):
        centre = draw_place(rng)
        rotation = turn(rng.uniform(20, 70), rng.uniform(-35, -5), rng.uniform(-10, 10))
        covers = [photos[i] for i in rng.integers(len(photos), size=6)]
        faces = make_box(covers, centre, rotation, rng.uniform(0.5, 1.6, size=3), focal_px)
        if is_clear(centre, views):
            facets += [face for face in faces if any(face.measure_side(view) > 0 for view in views)]
    for _ in range(rng.integers(*BOARDS, endpoint=True)):
        centre = draw_place(rng)
        board = draw_board(centre, (rng.uniform(-60, 60), rng.uniform(-45, 45)), rng.uniform(0.6, 2.2))
        if is_clear(centre, views):
            facets.append(board)
    return tuple(facets[:SURFACES])


def make_board(photo: np.ndarray, centre: np.ndarray, rotation: np.ndarray, side: float, focal_px: float) -> Facet:
    """A rectangle of the photo's shape, `side` wide, with the photo on it; rotation (3, 3) turns it about its centre.

    Large ones carry the photo several times, mirrored, so that cameras of focal_px see it about as large as it is.
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
        copies = count_copies(np.linalg.norm(edge_u), centre[2], photo.shape[1], focal_px)
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


def draw_place(rng: np.random.Generator) -> np.ndarray:
    """(3,) a point in front of the background, within the first camera's view."""
    depth = rng.uniform(0.45, 0.9) * BACKGROUND_DEPTH
    return np.array([rng.uniform(-0.45, 0.45) * depth, rng.uniform(-0.4, 0.4) * depth, depth])


def is_clear(place: np.ndarray, views: tuple[PinholeView, PinholeView]) -> bool:
    """Whether something may stand there without blocking a camera's view."""
    return all(np.linalg.norm(place - view.center) > CLEARANCE for view in views)


def draw_cameras(
    size_wh: tuple[int, int], views: ViewRange, rng: np.random.Generator
) -> tuple[PinholeView, PinholeView]:
    """A camera at the origin and one that looks at about the same place from elsewhere; images of size_wh px."""
    focal_px = max(size_wh) * rng.uniform(0.75, 1.3)
    k = np.array([[focal_px, 0, size_wh[0] / 2], [0, focal_px, size_wh[1] / 2], [0, 0, 1]])
    pivot = np.array([*rng.uniform(-0.6, 0.6, size=2), rng.uniform(0.6, 0.95) * BACKGROUND_DEPTH])
    rotation = turn(*(rng.uniform(-1, 1) * limit for limit in (views.yaw_deg, views.pitch_deg, views.roll_deg)))
    ratio = np.exp(rng.uniform(-1, 1) * np.log(views.distance_ratio))
    aim = np.array([*rng.uniform(-0.4, 0.4, size=2), pivot[2] * ratio])
    # Both cameras see the pivot: B at `aim` in its own frame.
    second = np.column_stack([rotation, aim - rotation @ pivot])
    return PinholeView(k, size_wh, np.eye(3, 4)), PinholeView(k, size_wh, second)


def draw_lights(rng: np.random.Generator) -> list[np.ndarray]:
    """For each view a light (3,): its direction in the world, as long as its share of all light; the sun moves on."""
    direction = np.array([0, -0.5, -1.0]) + 0.8 * rng.normal(size=3)
    return [
        rng.uniform(0.1, 0.5) * moved / np.linalg.norm(moved)
        for moved in (direction, direction + 0.4 * rng.normal(size=3))
    ]


def turn(yaw_deg: float, pitch_deg: float, roll_deg: float) -> np.ndarray:
    """(3, 3) rotation: about y, then x, then z."""
    rotations = [
        cv2.Rodrigues(np.radians(angle) * np.eye(3)[axis])[0]
        for axis, angle in ((1, yaw_deg), (0, pitch_deg), (2, roll_deg))
    ]
    return rotations[2] @ rotations[1] @ rotations[0]


# Rendering


def find_nearest(facets: Sequence[Facet], view: PinholeView) -> DepthMap:
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
            there = tuple(slice(i.start + p.start, i.stop + p.start) for i, p in zip(inner, part))
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


# Truth


def relate_views(
    facets: Sequence[Facet], views: Sequence[PinholeView], shown: Sequence[DepthMap]
) -> tuple[np.ndarray, np.ndarray]:
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
