"""Procedural textures of building materials, rich down to the texel; texels are in COLMAP's frame."""

import cv2
import numpy as np


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
    vertical: bool = False,
) -> np.ndarray:
    """Courses of stones, bricks or planks (vertical: upright), no two alike: (H, W, 3) float32."""
    if vertical:
        args = ((size_hw[1], size_hw[0]), stone_wh, joint_px, colours, joint_colour, bend_px)
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
    vertical = bool(rng.integers(0, 2))
    wood = _make_masonry(rng, size_hw, (1.3 * m, 0.13 * m), 0.008 * m, colours, (48, 36, 28), 0.003 * m, vertical)
    along = (0.02 * m, 0.5 * m) if vertical else (0.5 * m, 0.02 * m)
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
