"""Training pairs with real parallax: two views of a rendered scene of planar facets textured with photos.

Items look like those of photos.WarpedPhotos: every facet has an exact homography between the views, and the map of
surfaces says which one a pixel of view A shows, where view B shows the same point; occlusion and depth
discontinuities come for free. Views are grey, lit differently, and rendered by one warp of the photo per facet.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from torch.utils.data import Dataset

from hm_sfm.training.facet_views import measure_depth, relate_views, render_facets
from hm_sfm.training.facets import Facet, make_board, make_box, make_relief
from hm_sfm.training.photos import POINTS, SURFACES, disturb_view
from hm_sfm.types import PinholeView

BACKGROUND_DEPTH = 6.0
BOXES = (1, 4)
BOARDS = (1, 5)
"""Fewest and most of the things that stand before the background."""
CLEARANCE = 1.2
"""Things whose centre is nearer than this to a camera are left out."""


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
        shown = [measure_depth(facets, view) for view in views]
        images = [render_facets(*each) for each in zip(shown, views, draw_lights(rng))]
        b_from_a, surface = relate_views(views, shown)
        return {
            "images": np.stack([disturb_view(image, rng) for image in images]),
            "b_from_a": b_from_a,
            "surface": surface,
            "points": np.full((POINTS, 4), np.nan, np.float32),
        }


def draw_scene(
    photos: list[np.ndarray], views: tuple[PinholeView, PinholeView], rng: np.random.Generator
) -> tuple[Facet, ...]:
    """At most SURFACES facets in front of a camera at the origin that looks along +z: walls, relief, boxes, boards."""
    focal_px = views[0].K[0, 0]

    def draw_board(centre: np.ndarray, tilt_deg: tuple[float, float], side: float) -> Facet:
        photo = photos[rng.integers(len(photos))]
        return make_board(photo, centre, make_rotation(*tilt_deg, rng.uniform(-15, 15)), side, focal_px)

    behind = np.array([0, 0, BACKGROUND_DEPTH])
    facets = [draw_board(behind, (rng.uniform(-40, 40), rng.uniform(-30, 30)), 3.4 * BACKGROUND_DEPTH)]
    if rng.random() < 0.5:
        ground = np.array([0, rng.uniform(1.2, 2.2), BACKGROUND_DEPTH])
        facets.append(draw_board(ground, (0, rng.uniform(75, 95)), 3.4 * BACKGROUND_DEPTH))
    if rng.random() < 0.5:
        photo = photos[rng.integers(len(photos))]
        rotation = make_rotation(rng.uniform(-30, 30), rng.uniform(-30, 30), rng.uniform(-15, 15))
        place = np.array([*rng.uniform(-1, 1, size=2), rng.uniform(0.75, 1.0) * BACKGROUND_DEPTH])
        facets += make_relief(photo, rng, place, rotation, rng.uniform(2.5, 7), focal_px)
    for _ in range(rng.integers(*BOXES, endpoint=True)):
        centre = draw_place(rng)
        rotation = make_rotation(rng.uniform(20, 70), rng.uniform(-35, -5), rng.uniform(-10, 10))
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
    rotation = make_rotation(
        *(rng.uniform(-1, 1) * limit for limit in (views.yaw_deg, views.pitch_deg, views.roll_deg))
    )
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


def make_rotation(yaw_deg: float, pitch_deg: float, roll_deg: float) -> np.ndarray:
    """(3, 3) rotation: about y, then x, then z."""
    rotations = [
        cv2.Rodrigues(np.radians(angle) * np.eye(3)[axis])[0]
        for axis, angle in ((1, yaw_deg), (0, pitch_deg), (2, roll_deg))
    ]
    return rotations[2] @ rotations[1] @ rotations[0]
