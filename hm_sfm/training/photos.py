"""Training pairs made of single photos: two random warps of one photo, with the exact homography between them.

Deterministic: item i of a dataset depends on its seed and on i alone, so a resumed run sees the same pairs.
"""

import logging
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from torch.utils.data import Dataset

from hm_sfm.coordinates import homography_to_pixel_index
from hm_sfm.errors import InputError

SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"}
LONG_EDGE_PX = 640
SURFACES = 24
"""Homographies per item: a rendered scene has one per surface, a warped photo the same one throughout."""

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

    Unreadable files are skipped with a warning. Raises InputError where nothing usable is found.
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
    """Items: images (2, S, S) uint8, b_from_a (SURFACES, 3, 3) float32 (px of view A -> px of view B, by surface) and
    surface (S, S) int64 (the surface at each pixel of A, -1 where B does not show it)."""

    def __init__(self, photos: list[np.ndarray], size_px: int, seed: int, count: int, warp: WarpRange) -> None:
        self.photos, self.size_px, self.seed, self.count, self.warp = photos, size_px, seed, count, warp

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng([self.seed, index])
        photo = self.photos[rng.integers(len(self.photos))]
        a_from_photo, b_from_photo = draw_views(photo.shape, self.size_px, self.warp, rng)
        views = [render_view(photo, matrix, self.size_px) for matrix in (a_from_photo, b_from_photo)]
        images = np.stack([disturb_view(view, rng) for view in views])
        b_from_a = b_from_photo @ np.linalg.inv(a_from_photo)
        return {
            "images": images,
            "b_from_a": np.tile((b_from_a / b_from_a[2, 2]).astype(np.float32), (SURFACES, 1, 1)),
            "surface": np.zeros((self.size_px, self.size_px), np.int64),
        }


def draw_views(
    shape_hw: tuple[int, int], size_px: int, warp: WarpRange, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Two random homographies (3, 3) float64, px of the photo -> px of a square view."""
    height, width = shape_hw
    ratio = np.exp(rng.uniform(-1, 1) * np.log(warp.scale))
    rotation = np.radians(rng.uniform(-warp.rotation_deg, warp.rotation_deg))
    # The closer view shows the photo at about its own resolution: enlarging it would show blur only.
    scale = np.exp(rng.uniform(np.log(0.7), np.log(1.15))) / max(ratio**0.5, ratio**-0.5)
    margin = 0.35 * size_px / scale
    centre = np.array(
        [rng.uniform(min(margin, width / 2), max(width - margin, width / 2)),
         rng.uniform(min(margin, height / 2), max(height - margin, height / 2))]
    )  # fmt: skip
    views = []
    for sign in (-1.0, 1.0):
        s, angle = scale * ratio ** (sign / 2), sign * rotation / 2
        cosine, sine = s * np.cos(angle), s * np.sin(angle)
        shift = size_px * (0.5 + rng.uniform(-0.12, 0.12, size=2))
        similarity = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])
        similarity[:2, 2] = shift - similarity[:2, :2] @ centre
        square = size_px * np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
        moved = square + size_px * warp.perspective * rng.uniform(-0.5, 0.5, (4, 2)).astype(np.float32)
        views.append(cv2.getPerspectiveTransform(square, moved.astype(np.float32)) @ similarity)
    return views[0], views[1]


def render_view(photo: np.ndarray, view_from_photo: np.ndarray, size_px: int) -> np.ndarray:
    """The photo seen through a homography: (S, S) float32 in [0, 255], grey (mirrored) beyond the photo's border."""
    local_scale = np.sqrt(abs(np.linalg.det(view_from_photo / view_from_photo[2, 2])))
    source = photo.astype(np.float32)
    if local_scale < 0.9:
        # Linear interpolation aliases when it shrinks: low-pass to the view's resolution first.
        source = cv2.GaussianBlur(source, (0, 0), 0.45 * np.sqrt(local_scale**-2 - 1))
    return cv2.warpPerspective(
        source,
        homography_to_pixel_index(view_from_photo),
        (size_px, size_px),
        flags=cv2.INTER_CUBIC if local_scale > 0.9 else cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT_101,
    )


def disturb_view(view: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Another camera, another light: contrast, gamma, shading, blur, noise, JPEG. float32 [0, 255] -> uint8."""
    x = np.clip(view / 255, 0, 1) ** np.exp(rng.uniform(-0.45, 0.45))
    x = (x - 0.5) * rng.uniform(0.6, 1.3) + 0.5 + rng.uniform(-0.15, 0.15)
    if rng.random() < 0.5:
        side = x.shape[0]
        ramp = np.linspace(-0.5, 0.5, side, dtype=np.float32)
        angle = rng.uniform(0, 2 * np.pi)
        shade = np.cos(angle) * ramp[None, :] + np.sin(angle) * ramp[:, None]
        x = x * (1 + rng.uniform(0, 0.6) * shade)
    if rng.random() < 0.35:
        x = cv2.GaussianBlur(x, (0, 0), rng.uniform(0.3, 1.2))
    x = x + rng.normal(0, rng.uniform(0, 0.03), x.shape)
    view = np.clip(x * 255 + 0.5, 0, 255).astype(np.uint8)
    if rng.random() < 0.4:
        _, code = cv2.imencode(".jpg", view, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(40, 95))])
        view = cv2.imdecode(code, cv2.IMREAD_GRAYSCALE)
    return view
