"""The demo's scene: a courtyard of textured boxes, photographed by known cameras. World units are metres, z is up."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hm_sfm.formats.strecha import write_strecha_cameras
from hm_sfm.photos.exif import write_jpeg
from hm_sfm.synthetic.rendering import Quad, render_view
from hm_sfm.synthetic.textures import make_texture
from hm_sfm.types import PinholeView

DEMO_FOCAL_35MM = 28
"""EXIF stores whole millimetres, so that the focal length derived from the photo is exactly the rendered one."""
COLMAP_DIAGONAL_35MM = 43.27
"""COLMAP's rounded diagonal of 35 mm film, which EXIF's equivalent focal length refers to."""


def make_box(
    rng: np.random.Generator,
    material: str,
    center_xy: tuple[float, float],
    size_m: tuple[float, float, float],
    yaw_deg: float = 0.0,
    base_m: float = 0.0,
    texels_per_m: int = 160,
) -> tuple[Quad, ...]:
    """Four sides and the top of an upright box `base_m` above the ground, rotated about the vertical by `yaw_deg`."""
    yaw = np.radians(yaw_deg)
    x, y = np.array([np.cos(yaw), np.sin(yaw), 0]), np.array([-np.sin(yaw), np.cos(yaw), 0])
    length, depth, height = size_m
    top = np.array([*center_xy, base_m + height])
    down = np.array([0, 0, -height])
    faces = []
    sides = ((-y, x, depth, length), (x, y, length, depth), (y, -x, depth, length), (-x, -y, length, depth))
    for out, right, reach, side in sides:
        texture = make_texture(rng, material, (side, height), texels_per_m)
        faces.append(Quad(top + out * reach / 2 - right * side / 2, right * side, down, texture))
    lid = make_texture(rng, material, (length, depth), texels_per_m)
    faces.append(Quad(top - x * length / 2 + y * depth / 2, x * length, -y * depth, lid))
    return tuple(faces)


def make_demo_scene(seed: int = 0) -> tuple[Quad, ...]:
    """A courtyard, about 12 m wide, open towards -y: paved ground, three walls, pillars, boxes, a leaning board.

    The same for the same seed; another seed gives other textures, sizes and rotations.
    """
    rng = np.random.default_rng(seed)
    surfaces = (
        ((-10, -8, 0), (20, 0, 0), (0, 14.5, 0), "paving", (20, 14.5), 80),
        ((-6, 5.5, 4.6), (12, 0, 0), (0, 0, -4.6), "bricks", (12, 4.6), 128),
        ((-6, -0.5, 3.4), (0, 6, 0), (0, 0, -3.4), "plaster", (6, 3.4), 128),
        ((6, 5.5, 3.9), (0, -5, 0), (0, 0, -3.9), "stones", (5, 3.9), 128),
        ((-5.0, 3.2, 1.9), (0.9, 1.5, 0), (0.75, -0.45, -1.9), "mural", (1.75, 2.1), 160),
    )
    quads = [
        Quad(np.array(origin), np.array(edge_u), np.array(edge_v), make_texture(rng, material, size_m, texels_per_m))
        for origin, edge_u, edge_v, material, size_m, texels_per_m in surfaces
    ]
    for x in (-2.6, 2.2):
        quads += make_box(rng, "stones", (x, 5.3), (0.6, 0.5, rng.uniform(3.6, 4.2)))
    quads += make_box(rng, "plaster", (-0.2, 4.6), (2.6, 1.2, 1.5))
    quads += make_box(rng, "planks", (-0.6, 4.5), (0.8, 0.7, 0.6), 20, base_m=1.5)
    places = [(-3.6, 0.6), (-1.9, 2.4), (-0.5, 0.2), (1.4, 1.9), (2.9, -0.1), (4.2, 2.6), (-1.6, -1.3), (1.3, -1.4)]
    materials = ["planks", "paint", "mural", "planks", "paint", "bricks", "stones", "planks"]
    for (x, y), material in zip(places, materials):
        size = rng.uniform(0.7, 1.3), rng.uniform(0.6, 1.0), rng.uniform(0.5, 1.7) if y > 0 else rng.uniform(0.3, 0.8)
        center = x + rng.uniform(-0.15, 0.15), y + rng.uniform(-0.15, 0.15)
        quads += make_box(rng, material, center, size, rng.uniform(-45, 45))
    return tuple(quads)


def make_demo_views(count: int = 12, size_wh: tuple[int, int] = (640, 480)) -> tuple[PinholeView, ...]:
    """Cameras of one K on an arc in front of the courtyard, at most 7.5 degrees apart, at differing heights."""
    k = make_intrinsics(size_wh)
    half_deg = min(7.5 * (count - 1), 82.5) / 2
    views = []
    for index, angle in enumerate(np.radians(np.linspace(-half_deg, half_deg, count))):
        # Incommensurate waves instead of random numbers: every count gives well-mixed heights, aims and tilts.
        radius, height_m = 7.6 + 0.5 * np.sin(2.4 * index), 1.9 + 0.55 * np.sin(1.7 * index + 1)
        center = np.array([radius * np.sin(angle), 1.2 - radius * np.cos(angle), height_m])
        target = np.array([0.5 * np.sin(1.1 * index), 1.2 + 0.4 * np.cos(2.0 * index), 0.95])
        views.append(PinholeView(k, size_wh, aim_camera(center, target, roll=np.radians(3 * np.sin(3.1 * index)))))
    return tuple(views)


def make_intrinsics(size_wh: tuple[int, int]) -> np.ndarray:
    """(3, 3): the K of photos of this size that says what their EXIF does."""
    width, height = size_wh
    focal_px = DEMO_FOCAL_35MM * np.hypot(width, height) / COLMAP_DIAGONAL_35MM
    return np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])


def aim_camera(center: np.ndarray, target: np.ndarray, roll: float = 0.0) -> np.ndarray:
    """cam_from_world (3, 4) of a camera at `center` whose axis meets `target`, upright but for `roll` radians."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    cos, sin = np.cos(roll), np.sin(roll)
    rotation = np.stack([cos * right + sin * down, cos * down - sin * right, forward])
    return np.column_stack([rotation, -rotation @ center])


def expose_photo(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A rendered (H, W, 3) uint8 image with a camera's exposure, white balance and sensor noise."""
    gains = np.exp(rng.normal(0, 0.07) + rng.normal(0, 0.015, 3)).astype(np.float32)
    light = image * gains
    light += rng.standard_normal(image.shape, dtype=np.float32) * np.sqrt(1.5 + 0.03 * light)
    return np.clip(np.rint(light), 0, 255).astype(np.uint8)


def write_demo(
    folder: Path, seed: int = 0, count: int = 12, size_wh: tuple[int, int] = (640, 480)
) -> dict[str, PinholeView]:
    """Write the demo: `folder`/images/view_00.jpg ... with EXIF, and `folder`/ground_truth/<name>.camera.

    Returns image name -> the camera that it was rendered with. The same seed gives the same files.
    """
    return write_photos(Path(folder), make_demo_scene(seed), make_demo_views(count, size_wh), seed)


def write_photos(
    folder: Path, quads: tuple[Quad, ...], views: Sequence[PinholeView], seed: int
) -> dict[str, PinholeView]:
    """Write the photos that `views` take of a scene and their cameras, as write_demo does; seed: of the noise."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    named = {f"view_{index:02d}.jpg": view for index, view in enumerate(views)}
    for index, (name, view) in enumerate(named.items()):
        photo = expose_photo(render_view(quads, view).image, np.random.default_rng([seed, index]))
        write_jpeg(folder / "images" / name, photo, DEMO_FOCAL_35MM)
    write_strecha_cameras(folder / "ground_truth", named)
    return named
