"""JPEG files with a focal length and an orientation in EXIF, as a camera writes them.

Only writing: reading EXIF is pycolmap's job.
"""

import struct
from pathlib import Path

import cv2
import numpy as np

from hm_sfm.io.atomic import replace_file

# Types of EXIF values and the tags used, by their numbers in the EXIF 2.3 standard.
SHORT, LONG = 3, 4
ORIENTATION = 0x0112
EXIF_FOLDER = 0x8769
FOCAL_LENGTH_IN_35MM_FILM = 0xA405


def write_jpeg(
    path: Path, image_rgb: np.ndarray, focal_35mm: float | None, orientation: int = 1, quality: int = 95
) -> None:
    """Write a JPEG with EXIF.

    image_rgb: (H, W, 3) uint8, as stored: it is not rotated, `orientation` is only noted.
    focal_35mm: 35 mm equivalent focal length in mm, or None for no focal length. EXIF keeps whole mm, so it is
    rounded. COLMAP reads it as focal_px = focal_35mm / 43.27 * hypot(W, H).
    orientation: EXIF orientation 1..8, 1 is upright; 6 asks for a turn of 90 degrees clockwise to show it upright.

    Raises ValueError on an image of another shape or dtype, and on values that EXIF cannot hold.
    """
    if image_rgb.dtype != np.uint8 or image_rgb.ndim != 3 or image_rgb.shape[2] != 3:
        raise ValueError(f"image_rgb must be (H, W, 3) uint8, got {image_rgb.shape} {image_rgb.dtype}")
    if not 1 <= orientation <= 8:
        raise ValueError(f"orientation must be 1 to 8, got {orientation}")
    if focal_35mm is not None and not 1 <= round(focal_35mm) <= 65535:
        raise ValueError(f"focal_35mm must round to 1 to 65535 mm, got {focal_35mm}")

    _, encoded = cv2.imencode(".jpg", image_rgb[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    jpeg = encoded.tobytes()
    start_of_image, rest = jpeg[:2], jpeg[2:]
    with replace_file(path) as temporary:
        temporary.write_bytes(start_of_image + _exif_segment(focal_35mm, orientation) + rest)


def _exif_segment(focal_35mm: float | None, orientation: int) -> bytes:
    """The APP1 segment: a small big-endian TIFF whose main folder points to the EXIF folder."""
    header = b"MM" + struct.pack(">HI", 42, 8)  # byte order, magic number, offset of the first folder
    exif = {} if focal_35mm is None else {FOCAL_LENGTH_IN_35MM_FILM: (SHORT, round(focal_35mm))}
    main = {ORIENTATION: (SHORT, orientation), EXIF_FOLDER: (LONG, 0)}
    main[EXIF_FOLDER] = (LONG, len(header) + len(_tiff_folder(main)))  # the EXIF folder follows the main one
    payload = b"Exif\0\0" + header + _tiff_folder(main) + _tiff_folder(exif)
    return b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload


def _tiff_folder(entries: dict[int, tuple[int, int]]) -> bytes:
    """A TIFF folder {tag: (type, value)} of single values, tags in rising order, with no folder after it."""
    packed = b"".join(
        # Tag, type, count 1, then the value left-aligned in four bytes.
        struct.pack(">HHI", tag, kind, 1) + struct.pack(">H" if kind == SHORT else ">I", value).ljust(4, b"\0")
        for tag, (kind, value) in entries.items()
    )
    return struct.pack(">H", len(entries)) + packed + struct.pack(">I", 0)
