"""Pictures as bytes of an image file; drawings are marked in it, so that they are never taken for photos."""

import io
import struct
import tempfile
import warnings
import zlib
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from PIL import Image

SOFTWARE = 0x0131
"""Exif's number of the tag that names what made a picture."""
MAX_EDGE_PX = 16_383
"""Of a drawing; WebP holds no more."""
PNG_HEADER_BYTES = 33
"""Of a PNG file: its signature and first chunk, after which others may follow."""
DRAWN_BY_US = Image.Exif()
DRAWN_BY_US[SOFTWARE] = "hm_sfm"


def encode_picture(pixels: np.ndarray, ending: str) -> bytes:
    """(H, W) grey or (H, W, 3) BGR uint8 as an image file of the kind of `ending`: .jpg, .jpeg, .png or .webp."""
    if ending == ".png":
        # Where pycolmap 4.2.1 was imported before all else, its copy of zlib is mixed with the system's: whatever else
        # compresses, OpenCV and Pillow too, ends the process. Its own PNG writer is safe in any order.
        with tempfile.TemporaryDirectory() as folder:
            shown = pixels if pixels.ndim == 2 else pixels[:, :, ::-1]
            pycolmap.Bitmap.from_array(np.ascontiguousarray(shown)).write(Path(folder) / "picture.png")
            return (Path(folder) / "picture.png").read_bytes()
    return cv2.imencode(ending, pixels)[1].tobytes()


def encode_drawing(pixels: np.ndarray, ending: str) -> bytes:
    """As encode_picture, with a mark that says that hm_sfm drew it; reduced where it is larger than WebP can be.

    The mark is EXIF's tag of the software, and the text of this name in PNG files.
    """
    height, width = pixels.shape[:2]
    if max(height, width) > MAX_EDGE_PX:
        scale = MAX_EDGE_PX / max(height, width)
        reduced_wh = max(1, round(width * scale)), max(1, round(height * scale))
        pixels = cv2.resize(pixels, reduced_wh, interpolation=cv2.INTER_AREA)
    if ending == ".png":
        code, mark = encode_picture(pixels, ending), b"tEXtSoftware\0" + DRAWN_BY_US[SOFTWARE].encode()
        chunk = struct.pack(">I", len(mark) - 4) + mark + struct.pack(">I", zlib.crc32(mark))
        return code[:PNG_HEADER_BYTES] + chunk + code[PNG_HEADER_BYTES:]
    file = io.BytesIO()
    kind = "WEBP" if ending == ".webp" else "JPEG"
    Image.fromarray(pixels if pixels.ndim == 2 else pixels[:, :, ::-1]).save(file, kind, exif=DRAWN_BY_US, quality=95)
    return file.getvalue()


def is_drawing(path: Path) -> bool:
    """Whether a file is an image that hm_sfm drew."""
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            return DRAWN_BY_US[SOFTWARE] in (image.getexif().get(SOFTWARE), image.info.get("Software"))
    except Exception:  # of damaged files and EXIF: all kinds of errors
        return False
