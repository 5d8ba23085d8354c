"""Training pairs made of single photos: two random warps of one photo, with the exact homography between them.

Deterministic: item i of a dataset depends on its seed and on i alone, so a resumed run sees the same pairs.
"""

import logging
import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from torch.utils.data import Dataset

from hm_sfm.errors import InputError
from hm_sfm.geometry.frames import homography_to_pixel_index

SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"}
LONG_EDGE_PX = 640
SURFACES = 64
"""Homographies per item: a rendered scene has one per surface, a warped photo the same one throughout."""
POINTS = 1024
"""Rows for point correspondences per item, filled by kinds of pairs that know single points only."""
MOSAIC_BELOW = 1.6
"""A photo of fewer times the view's size goes into a mosaic: mirrored borders repeat, and no matcher can tell which."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class WarpRange:
    """How far the two views of a pair are apart."""

    scale: float = 2.0
    """Ratio of the two scales: between 1 / scale and scale."""
    rotation_deg: float = 45.0
    perspective: float = 0.25
    """Range of the corner shifts of each view, as a share of its side: half of it to either side."""


def load_photos(folder: Path) -> list[np.ndarray]:
    """All photos of a folder tree, sorted by path, grey (H, W) uint8, long edge at most 640 px.

    Unreadable files are skipped with a warning. Raises InputError where there is no usable photo.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"the training images {folder} are not a folder")
    photos = []
    for path in sorted(p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES):
        photo = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if photo is None or min(photo.shape) < 128:
            logger.warning("skipped %s: not a photo of at least 128 px", path)
            continue
        scale = LONG_EDGE_PX / max(photo.shape)
        if scale < 1:
            photo = cv2.resize(photo, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        photos.append(photo)
    if not photos:
        raise InputError(f"{folder} holds no usable training image (jpg, png, ... of at least 128 px)")
    return photos


def split_photos(photos: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """(training, validation): every 15th photo validates."""
    training = [photo for i, photo in enumerate(photos) if i % 15]
    return training or photos, photos[::15]


class WarpedPhotos(Dataset):
    """Pairs of warped views of photos.

    Items, of views of size_wh = (W, H) px: images (2, H, W) uint8, b_from_a (SURFACES, 3, 3) float32 (px of view
    A -> px of view B, by surface), surface (H, W) int64 (the surface at each pixel of A, -1 where B does not show it)
    and points (POINTS, 4) float32, all NaN: x0, y0, x1, y1 px of single points for kinds of pairs without surfaces.
    """

    def __init__(
        self, photos: list[np.ndarray], size_wh: tuple[int, int], seed: int, count: int, warp: WarpRange
    ) -> None:
        self.photos, self.size_wh, self.seed, self.count, self.warp = photos, size_wh, seed, count, warp

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng([self.seed, index])
        photo = draw_photo(self.photos, self.size_wh, rng)
        a_from_photo, b_from_photo = draw_views(photo.shape, self.size_wh, self.warp, rng)
        views = [render_view(photo, matrix, self.size_wh) for matrix in (a_from_photo, b_from_photo)]
        images = np.stack([disturb_view(view, rng) for view in views])
        b_from_a = b_from_photo @ np.linalg.inv(a_from_photo)
        return {
            "images": images,
            "b_from_a": np.tile((b_from_a / b_from_a[2, 2]).astype(np.float32), (SURFACES, 1, 1)),
            "surface": find_shown(b_from_a, self.size_wh),
            "points": np.full((POINTS, 4), np.nan, np.float32),
        }


def draw_photo(photos: list[np.ndarray], size_wh: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """(H, W) uint8: one of the photos, or a mosaic of four where it is small for views of size_wh px."""
    photo = photos[rng.integers(len(photos))]
    height, width = photo.shape
    if width >= MOSAIC_BELOW * size_wh[0] and height >= MOSAIC_BELOW * size_wh[1]:
        return photo
    others = [photos[i] for i in rng.integers(len(photos), size=3)]
    tiles = [photo, *(cv2.resize(other, (width, height), interpolation=cv2.INTER_AREA) for other in others)]
    return np.vstack([np.hstack(tiles[:2]), np.hstack(tiles[2:])])


def draw_views(
    shape_hw: tuple[int, int], size_wh: tuple[int, int], warp: WarpRange, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Two random homographies (3, 3) float64, px of the photo -> px of a view of size_wh px."""
    photo_wh, view_wh = np.array(shape_hw[::-1]), np.array(size_wh)
    ratio = np.exp(rng.uniform(-1, 1) * np.log(warp.scale))
    rotation = np.radians(rng.uniform(-warp.rotation_deg, warp.rotation_deg))
    # The closer view shows the photo at about its own resolution: enlarging it would show blur only.
    scale = np.exp(rng.uniform(np.log(0.7), np.log(1.15))) / max(ratio**0.5, ratio**-0.5)
    margin = 0.35 * view_wh / scale
    centre = rng.uniform(np.minimum(margin, photo_wh / 2), np.maximum(photo_wh - margin, photo_wh / 2))
    views = []
    for sign in (-1.0, 1.0):
        s, angle = scale * ratio ** (sign / 2), sign * rotation / 2
        cosine, sine = s * np.cos(angle), s * np.sin(angle)
        shift = view_wh * (0.5 + rng.uniform(-0.12, 0.12, size=2))
        similarity = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])
        similarity[:2, 2] = shift - similarity[:2, :2] @ centre
        corners = view_wh * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        moved = corners + view_wh * warp.perspective * rng.uniform(-0.5, 0.5, (4, 2))
        views.append(cv2.getPerspectiveTransform(corners.astype(np.float32), moved.astype(np.float32)) @ similarity)
    return views[0], views[1]


def render_view(photo: np.ndarray, view_from_photo: np.ndarray, size_wh: tuple[int, int]) -> np.ndarray:
    """The photo seen through a homography: (H, W) float32 in [0, 255], grey (mirrored) beyond the photo's border."""
    local_scale = measure_scale(view_from_photo, size_wh)
    source = photo.astype(np.float32)
    if local_scale < 0.9:
        # Linear interpolation aliases when it shrinks: low-pass to the view's resolution first.
        source = cv2.GaussianBlur(source, (0, 0), 0.45 * np.sqrt(local_scale**-2 - 1))
    return cv2.warpPerspective(
        source,
        homography_to_pixel_index(view_from_photo),
        size_wh,
        flags=cv2.INTER_CUBIC if local_scale > 0.9 else cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT_101,
    )


def measure_scale(view_from_photo: np.ndarray, size_wh: tuple[int, int]) -> float:
    """Px of the view per px of the photo at the centre of the view: the root of the Jacobian's determinant there."""
    centre = np.linalg.solve(view_from_photo, [size_wh[0] / 2, size_wh[1] / 2, 1])
    # det(H) / w^3 at (x, y, 1), and w is 1 / centre[2].
    return float(np.sqrt(abs(np.linalg.det(view_from_photo) * centre[2] ** 3)))


def find_shown(b_from_a: np.ndarray, size_wh: tuple[int, int]) -> np.ndarray:
    """(H, W) int64: 0 at the pixels of A whose centre lies within B, -1 elsewhere; both views are of size_wh px.

    b_from_a: (3, 3) px of A -> px of B, scaled so that its denominator is positive before the camera.
    """
    x, y = np.arange(size_wh[0]) + 0.5, np.arange(size_wh[1])[:, None] + 0.5
    mapped_x, mapped_y, w = (a * x + (b * y + c) for a, b, c in b_from_a)
    shown = (w > 0) & (mapped_x >= 0) & (mapped_x < size_wh[0] * w) & (mapped_y >= 0) & (mapped_y < size_wh[1] * w)
    return shown.astype(np.int64) - 1


def disturb_view(view: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Another camera, another light: contrast, gamma, shade, blur, noise, JPEG. (H, W) float32 in [0, 255] -> uint8."""
    # Plain floats leave the array in float32.
    x = np.clip(view / 255, 0, 1) ** float(np.exp(rng.uniform(-0.45, 0.45)))
    x = (x - 0.5) * float(rng.uniform(0.6, 1.3)) + float(0.5 + rng.uniform(-0.15, 0.15))
    if rng.random() < 0.5:
        ramp_y, ramp_x = (np.linspace(-0.5, 0.5, side, dtype=np.float32) for side in x.shape)
        angle = float(rng.uniform(0, 2 * np.pi))
        strength = float(rng.uniform(0, 0.6))
        x = x * (1 + strength * math.cos(angle) * ramp_x[None, :] + strength * math.sin(angle) * ramp_y[:, None])
    if rng.random() < 0.35:
        x = cv2.GaussianBlur(x, (0, 0), rng.uniform(0.3, 1.2))
    x = x + float(rng.uniform(0, 0.03)) * rng.standard_normal(x.shape, dtype=np.float32)
    view = np.clip(x * 255 + 0.5, 0, 255).astype(np.uint8)
    if rng.random() < 0.4:
        _, code = cv2.imencode(".jpg", view, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(40, 95))])
        decoded = cv2.imdecode(code, cv2.IMREAD_GRAYSCALE)
        assert decoded is not None
        return decoded
    return view
