"""Scenes that repeat themselves, photographed by known cameras: what models fold onto. Units: metres, z is up."""

from pathlib import Path

import numpy as np

from hm_sfm.synthetic.demo import aim_camera, make_box, make_intrinsics, write_photos
from hm_sfm.synthetic.rendering import Quad
from hm_sfm.synthetic.textures import make_texture
from hm_sfm.types import PinholeView

Scene = tuple[tuple[Quad, ...], tuple[PinholeView, ...]]


def make_twin_faced_box(count: int = 20, size_wh: tuple[int, int] = (640, 480)) -> Scene:
    """A house with equal front and back on unlike ground, seen from all around: the classic folding object."""
    rng = np.random.default_rng(1)
    face, side = (make_texture(rng, material, (5.0, 3.2), 128) for material in ("mural", "bricks"))
    other_side = make_texture(rng, "stones", (5.0, 3.2), 128)
    down = np.array([0, 0, -3.2])
    quads = [Quad(np.array([-12, -12, 0]), np.array([24, 0, 0]), np.array([0, 24, 0]), _make_ground(rng, (24, 24)))]
    for yaw_deg, texture in ((0, face), (90, side), (180, face), (270, other_side)):
        right, out = _turn(yaw_deg, (1, 0)), _turn(yaw_deg, (0, -1))
        quads.append(Quad(2.5 * out - 2.5 * right + (0, 0, 3.2), 5.0 * right, down, texture))
    # What stands around tells front from back, if one looks.
    for number, (x, y) in enumerate([(4.3, -3.5), (-4.0, -4.6), (3.4, 4.4), (-4.6, 3.2)]):
        quads += make_box(rng, ("planks", "paint", "stones", "plaster")[number], (x, y), (0.8, 0.7, 0.6), 30 * number)
    views = []
    for number in range(count):
        angle = 2 * np.pi * number / count
        center = np.array([8.5 * np.sin(angle), -8.5 * np.cos(angle), 1.8 + 0.4 * np.sin(1.7 * number)])
        views.append(PinholeView(make_intrinsics(size_wh), size_wh, aim_camera(center, np.array([0, 0, 1.4]))))
    return tuple(quads), tuple(views)


def make_corridor(count: int = 16, size_wh: tuple[int, int] = (640, 480)) -> Scene:
    """A corridor with six equal doors in an uneven wall, passed sideways."""
    rng = np.random.default_rng(2)
    length, doors = 24.0, 6
    wall = make_texture(rng, "plaster", (length, 3.0), 96)
    door = make_texture(rng, "mural", (1.6, 2.3), 128)
    quads = [
        Quad(np.array([0, 2.0, 3.0]), np.array([length, 0, 0]), np.array([0, 0, -3.0]), wall),
        Quad(np.array([0, -2, 0]), np.array([length, 0, 0]), np.array([0, 4, 0]), _make_ground(rng, (length, 4))),
    ]
    for number in range(doors):
        x = length * (number + 0.5) / doors - 0.8
        quads.append(Quad(np.array([x, 1.97, 2.3]), np.array([1.6, 0, 0]), np.array([0, 0, -2.3]), door))
    for number in range(5):
        place = length * (number + 1) / doors, 1.55
        quads += make_box(rng, ("planks", "paint", "stones", "mural", "bricks")[number], place, (0.5, 0.4, 0.7))
    views = []
    for number in range(count):
        x = 2.5 + (length - 5.0) * number / (count - 1)
        center = np.array([x, -1.7, 1.5 + 0.15 * np.sin(2.1 * number)])
        target = center + (0.5 * np.sin(1.3 * number), 3.5, -0.2)
        views.append(PinholeView(make_intrinsics(size_wh), size_wh, aim_camera(center, target)))
    return tuple(quads), tuple(views)


def make_courtyard(count: int = 24, size_wh: tuple[int, int] = (640, 480)) -> Scene:
    """A yard of four equal facades with unlike things before them, seen from its middle outwards."""
    rng = np.random.default_rng(3)
    facade = make_texture(rng, "mural", (12.0, 4.5), 96)
    down = np.array([0, 0, -4.5])
    quads = [Quad(np.array([-6, -6, 0]), np.array([12, 0, 0]), np.array([0, 12, 0]), _make_ground(rng, (12, 12)))]
    for yaw_deg in (0, 90, 180, 270):
        right, out = _turn(yaw_deg, (1, 0)), _turn(yaw_deg, (0, 1))
        quads.append(Quad(6.0 * out - 6.0 * right + (0, 0, 4.5), 12.0 * right, down, facade))
    materials = ("planks", "paint", "stones", "bricks")
    for number in range(8):
        x, y, _ = _turn(45 * number + 10 * (number % 3), (0, 4.6))
        quads += make_box(rng, materials[number % 4], (x, y), (0.9, 0.7, 0.7 + 0.2 * (number % 3)), 20 * number)
    views = []
    for number in range(count):
        angle = 2 * np.pi * number / count
        ahead = np.array([np.sin(angle), np.cos(angle), 0])
        center = -2.5 * ahead + (0, 0, 1.7 + 0.3 * np.sin(1.9 * number))
        views.append(PinholeView(make_intrinsics(size_wh), size_wh, aim_camera(center, 6 * ahead + (0, 0, 1.3))))
    return tuple(quads), tuple(views)


REPEATED_SCENES = {"box": make_twin_faced_box, "corridor": make_corridor, "courtyard": make_courtyard}


def write_repeated(folder: Path, name: str, size_wh: tuple[int, int] = (640, 480)) -> dict[str, PinholeView]:
    """Write one of REPEATED_SCENES as write_demo writes the demo. Returns image name -> its camera."""
    quads, views = REPEATED_SCENES[name](size_wh=size_wh)
    return write_photos(Path(folder), quads, views, seed=0)


def _turn(yaw_deg: float, xy: tuple[float, float]) -> np.ndarray:
    """(3,) float64: a horizontal vector, rotated about the vertical."""
    cos, sin = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    return np.array([cos * xy[0] - sin * xy[1], sin * xy[0] + cos * xy[1], 0])


def _make_ground(rng: np.random.Generator, size_m: tuple[float, float]) -> np.ndarray:
    return make_texture(rng, "paving", size_m, 64)
