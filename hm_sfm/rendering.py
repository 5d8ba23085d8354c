"""Render textured planar quads with exact depth, and the demo's scene made of them.

World units are metres, z points up. Pixels are in COLMAP's frame, and so are texels: texture column c spans
[c, c+1) / width of edge_u.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hm_sfm.evaluation import write_strecha_cameras
from hm_sfm.exif import write_jpeg
from hm_sfm.types import PinholeView, freeze_array

SKY_RGB = (176.0, 196.0, 218.0)
LIGHT_DIRECTION = np.array([-0.45, -0.65, 0.80]) / np.linalg.norm([-0.45, -0.65, 0.80])
AMBIENT, DIFFUSE = 0.50, 0.60
SAMPLES = 2
"""Colour samples per pixel along each axis. They are symmetric about the pixel's centre, so edges stay unbiased."""
NEAR_M = 1e-3
DEMO_FOCAL_35MM = 28
"""EXIF stores whole millimetres, so that the focal length derived from the photo is exactly the rendered one."""
COLMAP_DIAGONAL_35MM = 43.27
"""COLMAP's rounded diagonal of 35 mm film, which EXIF's equivalent focal length refers to."""


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
        box = _find_box(quad, view, SAMPLES)
        rows, columns = np.nonzero(nearest[box] == index)
        if len(rows):
            rows, columns = rows + box[0].start, columns + box[1].start
            colours[rows, columns] = _colour_samples(quad, view, columns, rows)
    width, height = view.size_wh
    mean = cv2.resize(colours, (width, height), interpolation=cv2.INTER_AREA)
    return Rendering(np.clip(np.rint(mean), 0, 255).astype(np.uint8), depth)


def _uvw_from_px(quad: Quad, view: PinholeView) -> np.ndarray | None:
    """(3, 3): px (x, y, 1) -> (u, v, 1) / z-depth of the quad's plane, all affine in x and y. None if edge-on."""
    rotation, translation = view.cam_from_world[:, :3], view.cam_from_world[:, 3]
    frame = np.column_stack([rotation @ quad.edge_u, rotation @ quad.edge_v, rotation @ quad.origin + translation])
    if abs(np.linalg.det(frame)) < 1e-12:
        return None
    return np.linalg.inv(frame) @ np.linalg.inv(view.K)


def _find_box(quad: Quad, view: PinholeView, samples: int) -> tuple[slice, slice]:
    """Rows and columns of the sample grid that hold all of the quad that is in the image."""
    corners = quad.origin + np.outer([0, 1, 0, 1], quad.edge_u) + np.outer([0, 0, 1, 1], quad.edge_v)
    size = np.array(view.size_wh) * samples
    xy_px, depth = view.project(corners)
    if (depth < NEAR_M).all():
        return slice(0, 0), slice(0, 0)
    if (depth < NEAR_M).any():  # the quad reaches behind the camera: its corners don't bound it
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
        uvw_from_px = _uvw_from_px(quad, view)
        if uvw_from_px is None:
            continue
        box = _find_box(quad, view, samples)
        x = (np.arange(box[1].start, box[1].stop) + 0.5) / samples
        y = (np.arange(box[0].start, box[0].stop) + 0.5) / samples
        u, v, w = (a * x + (b * y + c)[:, None] for a, b, c in uvw_from_px)
        # u and v are still divided by the depth, so they are compared with w = 1 / depth instead of 1.
        seen = (w > inverse_depth[box]) & (w < 1 / NEAR_M) & (u >= 0) & (u <= w) & (v >= 0) & (v <= w)
        nearest[box][seen] = index
        inverse_depth[box][seen] = w[seen]
    return nearest, inverse_depth


def _colour_samples(quad: Quad, view: PinholeView, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Lit colours (N, 3) float32 of a quad at samples of the SAMPLES-fold grid that see it."""
    m = _uvw_from_px(quad, view)
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


# Textures


def make_texture(rng: np.random.Generator, material: str, size_m: tuple[float, float], texels_per_m: int) -> np.ndarray:
    """A texture of `material` (a key of MATERIALS) for a surface of `size_m` (width, height), rich down to the texel.

    Returns (Ht, Wt, 3) uint8 RGB, the same for the same state of `rng`.
    """
    size_hw = (max(round(size_m[1] * texels_per_m), 8), max(round(size_m[0] * texels_per_m), 8))
    texture = MATERIALS[material](rng, size_hw, texels_per_m)
    texture *= 1 + 0.10 * _make_noise(rng, size_hw, (1.2 * texels_per_m, 1.2 * texels_per_m), 3)[..., None]
    texture *= 1 + 0.05 * _make_noise(rng, size_hw, (6, 6), 3)[..., None]
    _scatter_specks(rng, texture, count=round(30 * size_m[0] * size_m[1]), radius_px=0.02 * texels_per_m)
    return np.clip(np.rint(texture), 0, 255).astype(np.uint8)


def _make_noise(
    rng: np.random.Generator, size_hw: tuple[int, int], cell_wh: tuple[float, float], octaves: int
) -> np.ndarray:
    """Value noise (H, W) float32, mean 0, deviation 1: the coarsest octave has `cell_wh` px, each next one half."""
    height, width = size_hw
    total = np.zeros(size_hw, dtype=np.float32)
    for octave in range(octaves):
        cell_w, cell_h = (max(round(cell / 2**octave), 1) for cell in cell_wh)
        grid = rng.standard_normal((height // cell_h + 3, width // cell_w + 3), dtype=np.float32)
        fine = cv2.resize(grid, (grid.shape[1] * cell_w, grid.shape[0] * cell_h), interpolation=cv2.INTER_CUBIC)
        top, left = rng.integers(0, cell_h + 1), rng.integers(0, cell_w + 1)
        total += 0.65**octave * fine[top : top + height, left : left + width]
    return (total - total.mean()) / (total.std() + 1e-6)


def _make_masonry(
    rng: np.random.Generator,
    size_hw: tuple[int, int],
    stone_wh: tuple[float, float],
    joint_px: float,
    colours: list[tuple[int, int, int]],
    joint_colour: tuple[int, int, int],
    bend_px: float,
    turned: bool = False,
) -> np.ndarray:
    """Courses of stones, bricks or planks (turned: upright), no two alike: (H, W, 3) float32."""
    if turned:
        args = (size_hw[::-1], stone_wh, joint_px, colours, joint_colour, bend_px)
        return np.ascontiguousarray(_make_masonry(rng, *args).transpose(1, 0, 2))
    height, width = size_hw
    stone_w, stone_h = stone_wh
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    y += bend_px * _make_noise(rng, size_hw, (stone_w, stone_h), 4)
    x += bend_px * _make_noise(rng, size_hw, (stone_w, stone_h), 4)
    tops = np.cumsum(stone_h * rng.uniform(0.8, 1.25, int(height / stone_h / 0.8) + 12)) - 6 * stone_h
    row = np.clip(np.searchsorted(tops, y.ravel()).reshape(size_hw) - 1, 0, len(tops) - 2)
    place = x / stone_w + 4 + rng.uniform(0, 1, len(tops))[row].astype(np.float32)
    starts = rng.uniform(0, 0.45, (len(tops), int(width / stone_w) + 12)).astype(np.float32)
    column = np.clip(place.astype(np.int64), 1, starts.shape[1] - 2)
    column -= place - column < starts[row, column]
    to_edge = np.minimum(place - column - starts[row, column], column + 1 + starts[row, column + 1] - place) * stone_w
    to_edge = np.minimum(to_edge, np.minimum(y - tops[row], tops[row + 1] - y))

    palette = np.array(colours, dtype=np.float32)[rng.integers(0, len(colours), starts.shape)]
    palette *= rng.uniform(0.72, 1.22, (*starts.shape, 1)).astype(np.float32)
    palette += rng.normal(0, 2.5, palette.shape).astype(np.float32)
    stone = palette[row, column]
    grain = _make_noise(rng, size_hw, (stone_w / 3, stone_h / 3 + 2), 5)
    stone *= 1 + 0.16 * grain[..., None]
    cover = np.clip(to_edge / joint_px, 0, 1).astype(np.float32)[..., None]
    rim = np.clip(to_edge / (3 * joint_px), 0, 1).astype(np.float32)[..., None]
    joint = np.array(joint_colour, dtype=np.float32) * (1 + 0.12 * _make_noise(rng, size_hw, (8, 8), 3)[..., None])
    return cover * stone * (0.85 + 0.15 * rim) + (1 - cover) * joint


def _make_bricks(rng: np.random.Generator, size_hw: tuple[int, int], texels_per_m: int) -> np.ndarray:
    m = texels_per_m
    colours = [(156, 84, 62), (138, 70, 54), (172, 104, 78), (120, 66, 58), (186, 128, 100)]
    wall = _make_masonry(rng, size_hw, (0.27 * m, 0.11 * m), 0.012 * m, colours, (178, 170, 158), 0.008 * m)
    lime = _make_noise(rng, size_hw, (0.9 * m, 0.9 * m), 6)
    _blend(wall, (206, 198, 184), 0.75 * np.clip((lime - 1.1) * 2.5, 0, 1))
    _stain(rng, wall, m)
    return wall


def _make_stones(rng: np.random.Generator, size_hw: tuple[int, int], texels_per_m: int) -> np.ndarray:
    m = texels_per_m
    colours = [(150, 142, 128), (126, 122, 116), (168, 154, 130), (108, 106, 104), (142, 126, 106)]
    wall = _make_masonry(rng, size_hw, (0.50 * m, 0.30 * m), 0.025 * m, colours, (92, 86, 78), 0.025 * m)
    _crack(rng, wall, m)
    moss = _make_noise(rng, size_hw, (0.7 * m, 0.7 * m), 6)
    _blend(wall, (92, 104, 60), 0.6 * np.clip((moss - 1.0) * 2, 0, 1))
    return wall


def _make_paving(rng: np.random.Generator, size_hw: tuple[int, int], texels_per_m: int) -> np.ndarray:
    m = texels_per_m
    colours = [(148, 144, 138), (128, 124, 122), (166, 158, 148), (138, 126, 114), (112, 112, 116)]
    ground = _make_masonry(rng, size_hw, (0.75 * m, 0.55 * m), 0.02 * m, colours, (86, 82, 72), 0.02 * m)
    _crack(rng, ground, m)
    moss = _make_noise(rng, size_hw, (1.5 * m, 1.5 * m), 7)
    _blend(ground, (98, 104, 66), 0.7 * np.clip((moss - 1.0) * 2, 0, 1))
    leaves = round(size_hw[0] * size_hw[1] / m**2 * 8)
    _scatter_specks(rng, ground, leaves, 0.035 * m, [(152, 106, 48), (120, 78, 40), (178, 142, 64), (84, 96, 48)])
    return ground


def _make_plaster(rng: np.random.Generator, size_hw: tuple[int, int], texels_per_m: int) -> np.ndarray:
    m = texels_per_m
    wall = np.empty((*size_hw, 3), dtype=np.float32)
    wall[:] = (204, 182, 146)
    wall *= 1 + 0.07 * _make_noise(rng, size_hw, (0.25 * m, 0.25 * m), 6)[..., None]
    bricks = _make_bricks(rng, size_hw, m)
    fallen = _make_noise(rng, size_hw, (1.1 * m, 1.1 * m), 6)
    hole = np.clip((fallen - 0.75) * 12, 0, 1)[..., None]
    rim = np.exp(-(((fallen - 0.72) / 0.06) ** 2))[..., None]
    wall = wall * (1 - hole) * (1 - 0.35 * rim) + bricks * hole
    _crack(rng, wall, m)
    _stain(rng, wall, m)
    for _ in range(max(1, round(size_hw[0] * size_hw[1] / m**2 / 4))):
        _paste_poster(rng, wall, m)
    return wall


def _make_planks(rng: np.random.Generator, size_hw: tuple[int, int], texels_per_m: int) -> np.ndarray:
    m = texels_per_m
    colours = [(150, 112, 74), (128, 92, 60), (170, 132, 90), (112, 88, 66), (140, 120, 96)]
    turned = bool(rng.integers(0, 2))
    wood = _make_masonry(rng, size_hw, (1.3 * m, 0.13 * m), 0.008 * m, colours, (48, 36, 28), 0.003 * m, turned)
    along = (0.02 * m, 0.5 * m) if turned else (0.5 * m, 0.02 * m)
    wood *= 1 + 0.13 * _make_noise(rng, size_hw, along, 4)[..., None]
    knots = round(size_hw[0] * size_hw[1] / m**2 * 12)
    _scatter_specks(rng, wood, knots, 0.02 * m, [(66, 44, 30), (84, 58, 38)])
    _paste_text(rng, wood, m, (46, 40, 38))
    return wood


def _make_paint(rng: np.random.Generator, size_hw: tuple[int, int], texels_per_m: int) -> np.ndarray:
    """Flaking paint over rusty metal, with stencilled text."""
    m = texels_per_m
    colours = [(60, 96, 128), (70, 110, 84), (160, 64, 48), (190, 150, 60), (120, 124, 128)]
    panel = np.empty((*size_hw, 3), dtype=np.float32)
    panel[:] = colours[rng.integers(0, len(colours))]
    panel *= 1 + 0.10 * _make_noise(rng, size_hw, (0.3 * m, 0.3 * m), 6)[..., None]
    for _ in range(3):
        _paste_text(rng, panel, m, (222, 216, 200))
    rust = _make_noise(rng, size_hw, (0.5 * m, 0.5 * m), 7)
    _blend(panel, (112, 62, 36), np.clip((rust - 0.6) * 6, 0, 1))
    _blend(panel, (58, 38, 30), np.clip((rust - 1.3) * 6, 0, 1))
    _stain(rng, panel, m)
    return panel


def _make_mural(rng: np.random.Generator, size_hw: tuple[int, int], texels_per_m: int) -> np.ndarray:
    """Blotches of many colours, as of a painted wall or a printed cloth."""
    m = texels_per_m
    mural = np.empty((*size_hw, 3), dtype=np.float32)
    mural[:] = rng.uniform(110, 170) + rng.uniform(-25, 25, 3)
    for scale in (0.6, 0.45, 0.3, 0.3, 0.2, 0.2, 0.12, 0.12):
        shape = _make_noise(rng, size_hw, (scale * m, scale * m), 4)
        _blend(mural, tuple(rng.uniform(45, 200) + rng.uniform(-45, 45, 3)), 0.8 * np.clip((shape - 0.9) * 5, 0, 1))
    _crack(rng, mural, m)
    return mural


MATERIALS = {
    "bricks": _make_bricks,
    "stones": _make_stones,
    "paving": _make_paving,
    "plaster": _make_plaster,
    "planks": _make_planks,
    "paint": _make_paint,
    "mural": _make_mural,
}


def _blend(texture: np.ndarray, colour: tuple[float, float, float], cover: np.ndarray) -> None:
    """Lay `colour` over the texture, in place; cover (H, W) in [0, 1]."""
    texture += cover[..., None] * (np.array(colour, dtype=np.float32) - texture)


def _stain(rng: np.random.Generator, texture: np.ndarray, m: int) -> None:
    """Dark streaks, as water leaves them on a wall."""
    streaks = _make_noise(rng, texture.shape[:2], (0.10 * m, 1.2 * m), 4)
    where = _make_noise(rng, texture.shape[:2], (1.5 * m, 1.5 * m), 2)
    texture *= 1 - 0.35 * (np.clip(streaks - 0.3, 0, 1) * np.clip(where, 0, 1))[..., None]


def _crack(rng: np.random.Generator, texture: np.ndarray, m: int) -> None:
    """Thin dark lines along the zero level of a noise, where another noise is high."""
    noise = _make_noise(rng, texture.shape[:2], (0.6 * m, 0.6 * m), 6)
    where = _make_noise(rng, texture.shape[:2], (1.0 * m, 1.0 * m), 3)
    texture *= 1 - 0.6 * (np.exp(-((noise / 0.04) ** 2)) * np.clip(2 * where, 0, 1))[..., None]


def _scatter_specks(
    rng: np.random.Generator,
    texture: np.ndarray,
    count: int,
    radius_px: float,
    colours: list[tuple[int, int, int]] | None = None,
) -> None:
    """Small ragged spots at random places: of one of `colours`, or lighter and darker than what they lie on."""
    height, width = texture.shape[:2]
    for y, x, radius, tone in zip(
        rng.integers(0, height, count),
        rng.integers(0, width, count),
        radius_px * rng.uniform(0.5, 1.6, count),
        rng.uniform(-1, 1, count),
    ):
        reach = int(2 * radius) + 1
        rows, columns = slice(max(y - reach, 0), y + reach + 1), slice(max(x - reach, 0), x + reach + 1)
        patch = texture[rows, columns]
        dy = np.arange(rows.start - y, rows.start - y + patch.shape[0], dtype=np.float32)[:, None]
        dx = np.arange(columns.start - x, columns.start - x + patch.shape[1], dtype=np.float32)
        cos, sin = np.float32(np.cos(7 * tone)), np.float32(np.sin(7 * tone))
        along, across = dx * cos + dy * sin, dy * cos - dx * sin
        cover = np.clip((radius - np.hypot(along, across * (1.3 + abs(tone)))) + 0.5, 0, 1).astype(np.float32)
        if colours:
            _blend(patch, colours[int(abs(tone) * 1000) % len(colours)], 0.85 * cover)
        else:
            patch *= 1 + 0.45 * tone * cover[..., None]


def _paste_text(
    rng: np.random.Generator, texture: np.ndarray, m: int, ink: tuple[float, float, float], height_m: float = 0.0
) -> None:
    """A line of glyph-like marks at a random place, as wide as fits, in place."""
    height, width = texture.shape[:2]
    dot = max(round((height_m or rng.uniform(0.05, 0.16)) * m / 7), 1)
    letters = min(int(width / (6 * dot)) - 1, int(rng.integers(5, 22)))
    if letters < 1 or height <= 8 * dot:
        return
    bits = np.zeros((7, 6 * letters), dtype=np.float32)
    for letter in range(letters):
        if letter == 0 or rng.random() > 0.15:
            # Strokes along a few rows and columns of a 7 x 5 box look like print; free dots would look like noise.
            glyph = bits[:, 6 * letter : 6 * letter + 5]
            for column in rng.choice([0, 0, 2, 4], 2):
                start = rng.integers(0, 4)
                glyph[start : start + rng.integers(3, 8), column] = 1
            for row in rng.choice([0, 3, 6], 2):
                start = rng.integers(0, 2)
                glyph[row, start : start + rng.integers(2, 6)] = 1
    ink_cover = cv2.GaussianBlur(np.kron(bits, np.ones((dot, dot), dtype=np.float32)), (0, 0), 0.3 * dot + 0.3)
    top = rng.integers(0, height - 7 * dot)
    left = rng.integers(0, width - ink_cover.shape[1] + 1)
    _blend(texture[top : top + 7 * dot, left : left + ink_cover.shape[1]], ink, 0.9 * np.clip(ink_cover * 1.6, 0, 1))


def _paste_poster(rng: np.random.Generator, texture: np.ndarray, m: int) -> None:
    """A sheet with a picture and lines of text at a random place, in place."""
    height, width = texture.shape[:2]
    sheet_h, sheet_w = round(rng.uniform(0.6, 1.1) * m), round(rng.uniform(0.45, 0.8) * m)
    if sheet_h >= height or sheet_w >= width:
        return
    top, left = rng.integers(0, height - sheet_h), rng.integers(0, width - sheet_w)
    sheet = texture[top : top + sheet_h, left : left + sheet_w]
    sheet[:] = 0.25 * sheet + 0.75 * rng.uniform(150, 240, 3)
    edge = round(0.04 * m)
    picture = sheet[edge : sheet_h // 2, edge:-edge]
    picture[:] = _make_mural(rng, picture.shape[:2], m // 2)
    for row in range(sheet_h // 2 + edge, sheet_h - 2 * edge, round(0.09 * m)):
        line = sheet[row : row + round(0.085 * m), edge:-edge]
        _paste_text(rng, line, m, tuple(rng.uniform(20, 90, 3)), rng.uniform(0.04, 0.07))


# The demo's scene


def make_box(
    rng: np.random.Generator,
    material: str,
    center_xy: tuple[float, float],
    size_m: tuple[float, float, float],
    yaw_deg: float = 0.0,
    base_m: float = 0.0,
    texels_per_m: int = 160,
) -> tuple[Quad, ...]:
    """Four sides and the top of an upright box `base_m` above the ground, turned about the vertical by `yaw_deg`."""
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

    The same for the same seed; another seed gives other textures, sizes and turns.
    """
    rng = np.random.default_rng(seed)
    quads = [
        Quad((-10, -8, 0), (20, 0, 0), (0, 14.5, 0), make_texture(rng, "paving", (20, 14.5), 80)),
        Quad((-6, 5.5, 4.6), (12, 0, 0), (0, 0, -4.6), make_texture(rng, "bricks", (12, 4.6), 128)),
        Quad((-6, -0.5, 3.4), (0, 6, 0), (0, 0, -3.4), make_texture(rng, "plaster", (6, 3.4), 128)),
        Quad((6, 5.5, 3.9), (0, -5, 0), (0, 0, -3.9), make_texture(rng, "stones", (5, 3.9), 128)),
        Quad((-5.0, 3.2, 1.9), (0.9, 1.5, 0), (0.75, -0.45, -1.9), make_texture(rng, "mural", (1.75, 2.1), 160)),
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
    width, height = size_wh
    focal_px = DEMO_FOCAL_35MM * np.hypot(width, height) / COLMAP_DIAGONAL_35MM
    k = np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])
    half_deg = min(7.5 * (count - 1), 82.5) / 2
    views = []
    for index, angle in enumerate(np.radians(np.linspace(-half_deg, half_deg, count))):
        # Incommensurate waves instead of random numbers: every count gives well-mixed heights, aims and tilts.
        radius, height_m = 7.6 + 0.5 * np.sin(2.4 * index), 1.9 + 0.55 * np.sin(1.7 * index + 1)
        center = np.array([radius * np.sin(angle), 1.2 - radius * np.cos(angle), height_m])
        target = np.array([0.5 * np.sin(1.1 * index), 1.2 + 0.4 * np.cos(2.0 * index), 0.95])
        views.append(PinholeView(k, size_wh, _look_at(center, target, roll=np.radians(3 * np.sin(3.1 * index)))))
    return tuple(views)


def _look_at(center: np.ndarray, target: np.ndarray, roll: float) -> np.ndarray:
    """cam_from_world (3, 4) of a camera at `center` whose axis meets `target`, upright but for `roll` radians."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    cos, sin = np.cos(roll), np.sin(roll)
    rotation = np.stack([cos * right + sin * down, cos * down - sin * right, forward])
    return np.column_stack([rotation, -rotation @ center])


def expose_photo(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What a camera makes of a rendered (H, W, 3) uint8 image: its own exposure, white balance and sensor noise."""
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
    folder = Path(folder)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    quads = make_demo_scene(seed)
    views = {f"view_{index:02d}.jpg": view for index, view in enumerate(make_demo_views(count, size_wh))}
    for index, (name, view) in enumerate(views.items()):
        photo = expose_photo(render_view(quads, view).image, np.random.default_rng([seed, index]))
        write_jpeg(folder / "images" / name, photo, DEMO_FOCAL_35MM)
    write_strecha_cameras(folder / "ground_truth", views)
    return views
