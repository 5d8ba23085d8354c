"""Training pairs with real parallax: two views of a rendered scene of planar surfaces that carry photos.

Items look like those of photos.WarpedPhotos: every surface has an exact homography between the views, and the map of
surfaces says which one a pixel of view A shows, where view B shows the same point; occlusion and depth
discontinuities come for free.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from torch.utils.data import Dataset

from hm_sfm.rendering import Quad, find_surfaces, render_view
from hm_sfm.training.photos import SURFACES, disturb_view
from hm_sfm.types import PinholeView

BACKGROUND_DEPTH = 6.0
BOXES = (1, 4)
BOARDS = (1, 5)
"""Fewest and most of the things that stand before the background."""
EXPOSURE = 1.6
"""Surfaces that face the cameras turn away from the renderer's light."""


@dataclass(frozen=True)
class ViewRange:
    """How far the two views of a rendered pair are apart."""

    yaw_deg: float = 28.0
    pitch_deg: float = 12.0
    roll_deg: float = 20.0
    distance_ratio: float = 1.5
    """The second camera is between 1 / ratio and ratio times as far from the scene."""


class RenderedScenes(Dataset):
    """Items as photos.WarpedPhotos; item i depends on the seed and on i alone."""

    def __init__(self, photos: list[np.ndarray], size_px: int, seed: int, count: int, views: ViewRange) -> None:
        self.photos, self.size_px, self.seed, self.count, self.views = photos, size_px, seed, count, views

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng([self.seed, index, 1])
        quads = draw_scene(self.photos, rng)
        view_a, view_b = draw_cameras(self.size_px, self.views, rng)
        images = [cv2.cvtColor(render_view(quads, view).image, cv2.COLOR_RGB2GRAY) for view in (view_a, view_b)]
        b_from_a, surface = relate_views(quads, view_a, view_b)
        return {
            "images": np.stack([disturb_view(EXPOSURE * image.astype(np.float32), rng) for image in images]),
            "b_from_a": b_from_a,
            "surface": surface,
        }


def draw_scene(photos: list[np.ndarray], rng: np.random.Generator) -> tuple[Quad, ...]:
    """At most SURFACES quads in front of a camera at the origin that looks along +z: walls, boxes, boards."""
    tilt = rng.uniform(-40, 40), rng.uniform(-30, 30)
    quads = [make_board(photos, rng, np.array([0, 0, BACKGROUND_DEPTH]), tilt, 3.4 * BACKGROUND_DEPTH)]
    if rng.random() < 0.5:
        ground = np.array([0, rng.uniform(1.2, 2.2), BACKGROUND_DEPTH])
        quads.append(make_board(photos, rng, ground, (0, rng.uniform(75, 95)), 3.4 * BACKGROUND_DEPTH))
    for _ in range(rng.integers(*BOXES, endpoint=True)):
        quads += make_photo_box(photos, rng)
    for _ in range(rng.integers(*BOARDS, endpoint=True)):
        tilt = rng.uniform(-60, 60), rng.uniform(-45, 45)
        quads.append(make_board(photos, rng, draw_place(rng), tilt, rng.uniform(0.6, 2.2)))
    return tuple(quads[:SURFACES])


def make_board(
    photos: list[np.ndarray], rng: np.random.Generator, centre: np.ndarray, tilt_deg: tuple[float, float], side: float
) -> Quad:
    """A rectangle with a photo on it: turned by tilt_deg about the vertical, then about the horizontal axis."""
    photo = photos[rng.integers(len(photos))]
    # Large boards carry the photo several times, mirrored, so that it keeps about its own resolution.
    copies = min(max(1, round(side / 3)), 4)
    tile = np.concatenate([photo if i % 2 == 0 else photo[:, ::-1] for i in range(copies)], axis=1)
    texture = np.concatenate([tile if i % 2 == 0 else tile[::-1] for i in range(copies)], axis=0)
    height = side * texture.shape[0] / texture.shape[1]
    rotation = turn(*tilt_deg, rng.uniform(-15, 15))
    right, down = rotation @ [side, 0, 0], rotation @ [0, height, 0]
    return Quad(centre - right / 2 - down / 2, right, down, np.repeat(texture[..., None], 3, axis=2))


def make_photo_box(photos: list[np.ndarray], rng: np.random.Generator) -> list[Quad]:
    """Three faces of a box, those that a camera before it may see, each with a photo."""
    rotation = turn(rng.uniform(20, 70), rng.uniform(-35, -5), rng.uniform(-10, 10))
    size = rng.uniform(0.5, 1.6, size=3)
    corner = draw_place(rng)
    x, y, z = (rotation[:, axis] * size[axis] for axis in range(3))
    faces = ((corner, x, y), (corner, z, y), (corner, x, z))
    quads = []
    for origin, edge_u, edge_v in faces:
        photo = photos[rng.integers(len(photos))]
        quads.append(Quad(origin, edge_u, edge_v, np.repeat(photo[..., None], 3, axis=2)))
    return quads


def draw_place(rng: np.random.Generator) -> np.ndarray:
    """(3,) a point in front of the background, within the first camera's view."""
    depth = rng.uniform(0.45, 0.9) * BACKGROUND_DEPTH
    return np.array([rng.uniform(-0.45, 0.45) * depth, rng.uniform(-0.4, 0.4) * depth, depth])


def draw_cameras(size_px: int, views: ViewRange, rng: np.random.Generator) -> tuple[PinholeView, PinholeView]:
    """A camera at the origin and one that looks at about the same place from elsewhere; square images."""
    focal_px = size_px * rng.uniform(0.75, 1.3)
    k = np.array([[focal_px, 0, size_px / 2], [0, focal_px, size_px / 2], [0, 0, 1]])
    pivot = np.array([*rng.uniform(-0.6, 0.6, size=2), rng.uniform(0.6, 0.95) * BACKGROUND_DEPTH])
    rotation = turn(*(rng.uniform(-1, 1) * limit for limit in (views.yaw_deg, views.pitch_deg, views.roll_deg)))
    ratio = np.exp(rng.uniform(-1, 1) * np.log(views.distance_ratio))
    aim = np.array([*rng.uniform(-0.4, 0.4, size=2), pivot[2] * ratio])
    # Both cameras see the pivot: B at `aim` in its own frame.
    second = np.column_stack([rotation, aim - rotation @ pivot])
    size_wh = (size_px, size_px)
    return PinholeView(k, size_wh, np.eye(3, 4)), PinholeView(k, size_wh, second)


def turn(yaw_deg: float, pitch_deg: float, roll_deg: float) -> np.ndarray:
    """(3, 3) rotation: about y, then x, then z."""
    rotations = [
        cv2.Rodrigues(np.radians(angle) * np.eye(3)[axis])[0]
        for axis, angle in ((1, yaw_deg), (0, pitch_deg), (2, roll_deg))
    ]
    return rotations[2] @ rotations[1] @ rotations[0]


def relate_views(quads: tuple[Quad, ...], view_a: PinholeView, view_b: PinholeView) -> tuple[np.ndarray, np.ndarray]:
    """Exact correspondence of two views.

    Returns b_from_a (SURFACES, 3, 3) float32, px of view A -> px of view B over the plane of each quad (identity
    beyond their number), and surface (S, S) int64: the quad at each pixel centre of A, -1 where B does not see the
    same point (hidden, outside, or nothing there).
    """
    b_from_a = np.tile(np.eye(3), (SURFACES, 1, 1))
    for index, quad in enumerate(quads):
        b_from_a[index] = plane_homography(quad, view_a, view_b)
    shown_a, shown_b = (find_surfaces(quads, view) for view in (view_a, view_b))
    rows, columns = np.nonzero(shown_a >= 0)
    index = shown_a[rows, columns]
    centres = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1)
    mapped = np.einsum("nij,nj->ni", b_from_a[index], centres)
    with np.errstate(divide="ignore", invalid="ignore"):
        cell = np.floor(mapped[:, :2] / mapped[:, 2:])
    height, width = shown_b.shape
    # A positive denominator, by plane_homography's sign, is a point before both cameras.
    inside = (mapped[:, 2] > 0) & np.all((cell >= 0) & (cell < (width, height)), axis=1)
    x, y = cell[inside].astype(np.int64).T
    same = np.zeros(len(rows), dtype=bool)
    same[inside] = shown_b[y, x] == index[inside]
    surface = np.full(shown_a.shape, -1, dtype=np.int64)
    surface[rows[same], columns[same]] = index[same]
    return b_from_a.astype(np.float32), surface


def plane_homography(quad: Quad, view_a: PinholeView, view_b: PinholeView) -> np.ndarray:
    """(3, 3) float64: px of A -> px of B for the points of the quad's plane; w is depth in B over depth in A."""
    frames = []
    for view in (view_a, view_b):
        rotation, translation = view.cam_from_world[:, :3], view.cam_from_world[:, 3]
        frames.append(
            np.column_stack([rotation @ quad.edge_u, rotation @ quad.edge_v, rotation @ quad.origin + translation])
        )
    return view_b.K @ frames[1] @ np.linalg.inv(frames[0]) @ np.linalg.inv(view_a.K)


class MixedPairs(Dataset):
    """Warped photos, and rendered scenes for a share of the items."""

    def __init__(self, photos: Dataset, scenes: Dataset, rendered_share: float, seed: int) -> None:
        self.photos, self.scenes, self.rendered_share, self.seed = photos, scenes, rendered_share, seed

    def __len__(self) -> int:
        return len(self.photos)

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        rendered = np.random.default_rng([self.seed, index, 2]).random() < self.rendered_share
        return (self.scenes if rendered else self.photos)[index]
