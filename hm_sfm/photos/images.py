"""Stage 1: the photos of a folder, and one photo made ready for the network: grey, upright, reduced.

Photos are read as COLMAP reads them, unrotated. Where EXIF says that a photo is rotated or mirrored it is matched as
viewers show it, and `PreparedImage.stored_from_scaled` maps the points back. HEIC, which COLMAP cannot read, is upright
when decoded.
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from hm_sfm.errors import ConfigError, InputError, MissingPackageError
from hm_sfm.geometry.frames import flip_matrix, homography_to_pixel_index, rotation_matrix
from hm_sfm.io.pictures import is_drawing
from hm_sfm.photos.bitmaps import (
    INSTALL_HEIC,
    JPEG_MAGIC,
    PNG_MAGIC,
    TIFF_MAGICS,
    can_read_heic,
    decode_quietly,
    lacks_range,
    read_bitmap,
    read_deep_tiff,
)
from hm_sfm.photos.folders import find_files
from hm_sfm.photos.orientation import MIRRORED_IN_EXIF, ROTATION_FROM_EXIF, show_upright
from hm_sfm.photos.sizes import MIN_EDGE_PX, check_size, find_scale
from hm_sfm.types import ImageRef, Position, freeze_array

logger = logging.getLogger(__name__)

JPEG_EXTENSIONS = (".jpg", ".jpeg", ".jpe", ".jfif", ".mpo")
EXTENSIONS = (*JPEG_EXTENSIONS, ".png", ".tif", ".tiff", ".bmp", ".ppm", ".pgm", ".webp", ".avif", ".gif", ".jp2")
HEIC_EXTENSIONS = (".heic", ".heif", ".hif")
RAW_EXTENSIONS = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw")
UNREADABLE_EXTENSIONS = (*RAW_EXTENSIONS, ".jxl", ".psd", ".exr", ".hdr")
"""Of photos that no library here reads."""

# ANYDEPTH keeps 16 bits. The conversion to grey drops alpha: COLMAP ignores it too, and compositing would draw
# edges against an invented background.
CV_FLAGS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION

BMP_MAGIC = b"BM"
PNG_END = b"IEND\xaeB`\x82"


@dataclass(frozen=True)
class ImageList:
    """The photos of a folder."""

    images: tuple[ImageRef, ...]
    """Sorted by name."""
    skipped: tuple[tuple[str, str], ...]
    """(name, reason) of the files that are named like images but cannot be used, sorted by name."""


@dataclass(frozen=True)
class PreparedImage:
    """One photo as the network takes it."""

    ref: ImageRef
    grey: np.ndarray
    """(H, W) float32 in [0, 1], upright, reduced; read-only."""
    scaled_wh: tuple[int, int]
    """(W, H) of `grey`, px."""
    stored_from_scaled: np.ndarray
    """(3, 3) float64, affine: px of `grey` -> px of the stored image (COLMAP's frame), flipped where `ref` says so."""

    def __post_init__(self) -> None:
        width, height = self.scaled_wh
        object.__setattr__(self, "grey", freeze_array(self.grey, np.float32, (height, width), "grey"))
        object.__setattr__(
            self, "stored_from_scaled", freeze_array(self.stored_from_scaled, np.float64, (3, 3), "stored_from_scaled")
        )


def list_images(folder: Path) -> ImageList:
    """List the photos below `folder`, subfolders and linked ones included, sorted by name, see find_files.

    A file that is named like an image but is cut short, smaller than 32 px on a side, or of a kind that cannot be read
    is skipped: it is logged as a warning and reported in `skipped`; where the package for HEIC is not installed, HEIC
    photos are skipped with one warning. Mirrored photos are listed as flipped, see ImageRef.

    Raises InputError where the folder does not exist, is not a folder, or holds no usable image.
    """
    folder = Path(folder)
    names = find_files(folder)
    kinds = EXTENSIONS + HEIC_EXTENSIONS if can_read_heic() else EXTENSIONS
    names = _leave_out_twins(names, kinds)
    candidates = [name for name in names if Path(name).suffix.lower() in kinds + UNREADABLE_EXTENSIONS]
    heic = [name for name in names if Path(name).suffix.lower() in set(HEIC_EXTENSIONS).difference(kinds)]
    if not candidates and not heic:
        listed = ", ".join(extension[1:] for extension in kinds)
        raise InputError(f"the image folder {folder} holds {len(names)} files but no image ({listed})")
    images = []
    reason = f"is HEIC, which needs the package pillow-heif: {INSTALL_HEIC}, or convert it to JPEG"
    skipped = [(name, f"{folder / name} {reason}") for name in heic]
    if heic:
        logger.warning("skipped: %s (%d such files)", skipped[0][1], len(heic))
    for name in candidates:
        try:
            if is_drawing(folder / name):
                raise InputError(f"{folder / name} is a picture that hm_sfm drew, not a photo")
            images.append(read_run_ref(folder / name, name))
        except (InputError, MissingPackageError) as error:
            logger.warning("skipped: %s", error)
            skipped.append((name, str(error)))
    if not images:
        raise InputError(
            f"the image folder {folder} holds {len(skipped)} images but none can be used, for example: {skipped[0][1]}"
        )
    return ImageList(tuple(images), tuple(sorted(skipped)))


def _leave_out_twins(names: Sequence[str], kinds: Sequence[str]) -> list[str]:
    """The files without raw photos beside which there is a photo of one of the `kinds` with the same name."""
    photos = {Path(name).with_suffix("") for name in names if Path(name).suffix.lower() in kinds}
    raw = [name for name in names if Path(name).suffix.lower() in RAW_EXTENSIONS]
    twins = [name for name in raw if Path(name).with_suffix("") in photos]
    if twins:
        logger.warning("left out: %d raw photos beside photos of the same name, such as %s", len(twins), twins[0])
    return sorted(set(names).difference(twins))


def read_ref(path: Path, name: str | None = None) -> ImageRef:
    """Check one image file and read its stored size, EXIF rotation and position.

    `name` defaults to the file's own name.

    A JPEG that is damaged inside, but has an end, is logged as a warning. Raises InputError where the file cannot be
    read or decoded, is cut short, or is smaller than 32 px on a side, and MissingPackageError where it needs a package
    that is not installed.
    """
    path = Path(path)
    name = path.name if name is None else name
    if not _is_storable(name):
        raise InputError(f"{str(path)!r} has a line break or bytes that are not UTF-8 in its name")
    if path.suffix.lower() in UNREADABLE_EXTENSIONS:
        raise InputError(f"{path} is of a kind that cannot be read: convert it to JPEG, PNG or TIFF")
    data = _read_bytes(path)
    bitmap = read_bitmap(path, as_rgb=False)
    if bitmap is None:
        raise InputError(f"{path} cannot be decoded as an image")
    if not _is_complete(data):
        raise InputError(f"{path} is cut short or cannot be decoded")
    size_wh = (bitmap.width, bitmap.height)
    check_size(size_wh, str(path))
    orientation = bitmap.exif_orientation() or 1
    rotation_deg, mirrored = ROTATION_FROM_EXIF.get(orientation, 0), orientation in MIRRORED_IN_EXIF
    if data.startswith(JPEG_MAGIC) and (damage := _find_damage(data)):
        logger.warning("%s is damaged, parts of it show nothing or something wrong: %s", path, damage)
    return ImageRef(name, path, size_wh, rotation_deg, _read_gps(bitmap), mirrored)


def read_run_ref(path: Path, name: str) -> ImageRef:
    """read_ref of a photo of a run: a mirrored one is flipped, see ImageRef."""
    ref = read_ref(path, name)
    return replace(ref, flipped=ref.mirrored)


def _read_gps(bitmap: pycolmap.Bitmap) -> Position | None:
    """ImageRef.gps; None where EXIF has no possible position, or the zeros of a receiver without a fix."""
    latitude, longitude, altitude = bitmap.exif_latitude(), bitmap.exif_longitude(), bitmap.exif_altitude()
    if latitude is None or longitude is None or latitude == longitude == 0:
        return None
    if not (abs(latitude) <= 90 and abs(longitude) <= 180):  # nor are infinities and NaN
        return None
    return latitude, longitude, altitude if altitude is not None and math.isfinite(altitude) else None


def prepare_image(ref: ImageRef, long_edge_px: int) -> PreparedImage:
    """Read a photo's pixels, show them upright and reduce them to `long_edge_px`, see find_scale.

    Colour becomes grey, the 16 bits of a PNG or TIFF are kept, alpha is dropped. Never enlarged, never padded.

    Raises InputError where the file cannot be decoded or has changed size since it was listed, ConfigError where
    long_edge_px is below 32.
    """
    grey = _read_grey(ref)
    if grey is None:
        raise InputError(f"{ref.path} cannot be decoded as an image")
    decoded_wh = (grey.shape[1], grey.shape[0])
    if decoded_wh != tuple(ref.size_wh):
        raise InputError(
            f"{ref.path} is {decoded_wh[0]} x {decoded_wh[1]} px but was listed as "
            f"{ref.size_wh[0]} x {ref.size_wh[1]} px"
        )
    return _prepare(ref, grey, long_edge_px)


def _read_grey(ref: ImageRef) -> np.ndarray | None:
    """(H, W) uint8 or uint16, as stored; None where the file cannot be decoded."""
    data = _read_bytes(ref.path)
    if data.startswith((JPEG_MAGIC, PNG_MAGIC)):
        return decode_quietly(data, CV_FLAGS)[0]
    deep = read_deep_tiff(data, ref) if data.startswith(TIFF_MAGICS) else None
    if deep is not None or lacks_range(ref.path):
        return deep
    bitmap = read_bitmap(ref.path, as_rgb=False)
    return None if bitmap is None else bitmap.to_array().reshape(bitmap.height, bitmap.width)


def prepare_array(array: np.ndarray, long_edge_px: int, name: str = "array") -> PreparedImage:
    """Prepare an image that is already in memory: (H, W) grey or (H, W, 3) RGB, uint8, taken as upright.

    Raises InputError on another shape or dtype or a side below 32 px, ConfigError where long_edge_px is below 32.
    """
    array = np.asarray(array)
    if array.dtype != np.uint8 or not (array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3)):
        raise InputError(f"{name} must be an (H, W) or (H, W, 3) uint8 array, got {array.shape} {array.dtype}")
    size_wh = (array.shape[1], array.shape[0])
    check_size(size_wh, name)
    array = np.ascontiguousarray(array)
    grey = array if array.ndim == 2 else cv2.cvtColor(array, cv2.COLOR_RGB2GRAY)
    return _prepare(ImageRef(name, Path(name), size_wh), grey, long_edge_px)


def read_rgb(image: PreparedImage) -> np.ndarray:
    """(H, W, 3) uint8 RGB of a prepared image, rotated and reduced as it is; grey where there is no file to read."""
    bitmap = read_bitmap(image.ref.path, as_rgb=True) if image.ref.path.is_file() else None
    is_usable = bitmap is not None and not lacks_range(image.ref.path)
    if bitmap is None or not is_usable or (bitmap.width, bitmap.height) != tuple(image.ref.size_wh):
        return np.repeat(np.rint(image.grey * 255).astype(np.uint8)[:, :, None], 3, axis=2)
    rgb = bitmap.to_array()
    bitmap_from_scaled = image.stored_from_scaled
    if image.ref.flipped:
        bitmap_from_scaled = flip_matrix(bitmap.width) @ bitmap_from_scaled
    if np.count_nonzero(abs(bitmap_from_scaled[:2, :2]) > 1e-9) == 2:  # not tilted
        return cv2.resize(show_upright(rgb, image.ref), image.scaled_wh, interpolation=cv2.INTER_AREA)
    scale = np.sqrt(abs(np.linalg.det(bitmap_from_scaled[:2, :2])))
    reduced_wh = tuple(max(1, round(size / scale)) for size in image.ref.size_wh)
    reduced = cv2.resize(rgb, reduced_wh, interpolation=cv2.INTER_AREA)
    bitmap_from_reduced = np.diag([bitmap.width / reduced_wh[0], bitmap.height / reduced_wh[1], 1.0])
    scaled_from_reduced = np.linalg.inv(bitmap_from_scaled) @ bitmap_from_reduced
    border = reduced.mean(axis=(0, 1)).tolist()
    return cv2.warpAffine(
        reduced, homography_to_pixel_index(scaled_from_reduced)[:2], image.scaled_wh, borderValue=border
    )


def _prepare(ref: ImageRef, stored: np.ndarray, long_edge_px: int) -> PreparedImage:
    """Reduce and turn a stored grey image, (H, W) uint8 or uint16."""
    if long_edge_px < MIN_EDGE_PX:
        raise ConfigError(f"images.long_edge_px must be at least {MIN_EDGE_PX}, found {long_edge_px}")
    scale = find_scale(ref.size_wh, long_edge_px)
    width, height = ref.size_wh
    reduced_wh = (max(1, round(width * scale)), max(1, round(height * scale)))
    reduced = stored if scale == 1.0 else cv2.resize(stored, reduced_wh, interpolation=cv2.INTER_AREA)
    grey = reduced.astype(np.float32) / np.iinfo(reduced.dtype.type).max
    grey = show_upright(grey, ref)
    scaled_wh = (grey.shape[1], grey.shape[0])
    stored_from_scaled = rotation_matrix(scaled_wh, -ref.rotation_deg % 360)
    if ref.mirrored:
        stored_from_scaled = stored_from_scaled @ flip_matrix(scaled_wh[0])
    stored_from_scaled = np.diag([width / reduced_wh[0], height / reduced_wh[1], 1.0]) @ stored_from_scaled
    if ref.flipped:
        stored_from_scaled = flip_matrix(width) @ stored_from_scaled
    return PreparedImage(ref, grey, scaled_wh, stored_from_scaled)


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read the image {path}: {error.strerror}") from error


def _is_complete(data: bytes) -> bool:
    """Whether an image file is whole. Bytes after the end of a JPEG or PNG are allowed: phones append videos."""
    if data.startswith(JPEG_MAGIC):
        return _has_jpeg_end(data)
    if data.startswith(PNG_MAGIC):
        return PNG_END in data and decode_quietly(data, CV_FLAGS)[0] is not None
    if data.startswith((*TIFF_MAGICS, BMP_MAGIC)):
        return decode_quietly(data, cv2.IMREAD_UNCHANGED)[0] is not None
    return True  # the decoders of all other kinds refuse what is cut short


def _find_damage(data: bytes) -> str:
    """What is wrong inside a JPEG that decoders read nevertheless: they fill it with grey or with noise."""
    _, complaints = decode_quietly(data, cv2.IMREAD_REDUCED_GRAYSCALE_8)
    return complaints[0] if complaints else ""


def _has_jpeg_end(data: bytes) -> bool:
    """Whether a JPEG has the end-of-image marker: without it, decoders fill the rest with grey and report success.

    Segments before the scan are stepped over, because a thumbnail in one of them has an end marker of its own. In
    the scan, the bytes of the marker occur nowhere else.
    """
    at = len(JPEG_MAGIC)
    while (at := data.find(b"\xff", at)) >= 0 and at + 4 <= len(data):
        marker = data[at + 1]
        if marker == 0xDA:
            return data.find(b"\xff\xd9", at) >= 0
        is_padding = marker == 0xFF
        at += 1 if is_padding else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return False


def _is_storable(name: str) -> bool:
    """Whether a pairs file (lines) and a COLMAP database (UTF-8) can hold the name."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return "\n" not in name and "\r" not in name
