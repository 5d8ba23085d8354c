"""Image files as COLMAP's bitmaps, also those that COLMAP cannot read: HEIC, WebP, AVIF, GIF, TIFF of floats.

What a file is goes by its content: phones and messengers store HEIC under the name of a JPEG, for example.
"""

import os
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from PIL import Image, TiffImagePlugin

from hm_sfm.errors import MissingPackageError
from hm_sfm.io.native_stderr import catch_native_stderr
from hm_sfm.photos.orientation import restore_stored
from hm_sfm.types import ImageRef

INSTALL_HEIC = 'pip install "hm_sfm[heif]"'

JPEG_MAGIC = b"\xff\xd8"
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
TIFF_MAGICS = (b"II*\0", b"MM\0*")
COLMAP_MAGICS = (JPEG_MAGIC, PNG_MAGIC, *TIFF_MAGICS, b"BM", b"P5", b"P6")
"""How files begin that COLMAP can read."""
HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx")
"""One of them is in the list after the 4 bytes of a length and `ftyp`; AVIF has brands of its own."""
HEAD_BYTES = 64

# Numbers of tags and values in the TIFF 6.0 standard.
BITS_PER_SAMPLE, SAMPLE_FORMAT, FLOAT = 258, 339, 3
BLACK_AND_WHITE_PERCENT = (0.5, 99.5)
"""Percentiles of the values of a TIFF without a range of its own that become black and white."""


def can_read_heic() -> bool:
    """Whether the package for HEIC is installed."""
    return find_spec("pillow_heif") is not None


def read_bitmap(path: Path, as_rgb: bool) -> pycolmap.Bitmap | None:
    """The stored pixels of an image file, with its EXIF, in RGB or grey; None where it cannot be decoded.

    HEIC files state the rotation of a photo outside of EXIF: the pixels come upright, and the EXIF orientation says so.
    Of a TIFF that lacks_range the pixels mean nothing, see read_deep_tiff. Raises MissingPackageError where HEIC needs
    a package that is not installed.
    """
    with catch_native_stderr():
        bitmap = pycolmap.Bitmap.read(path, as_rgb=as_rgb)
    if bitmap is not None:
        return bitmap
    try:
        head = _read_head(path)
        with warnings.catch_warnings(action="ignore"):
            if head[4:8] == b"ftyp" and any(brand in head for brand in HEIC_BRANDS):
                return _read_heic(Path(path), as_rgb)
            with Image.open(path) as image:
                return _hand_to_colmap(image, as_rgb)
    except MissingPackageError:
        raise
    except Exception:  # of damaged files: all kinds of errors
        return None


def read_camera_label(bitmap: pycolmap.Bitmap) -> str | None:
    """Make, model, focal length and size as COLMAP compares cameras by them; None where EXIF has no make or model.

    Cameras write their names in any encoding: what is not UTF-8 is taken for Latin-1, which reads every byte.
    """
    try:
        return bitmap.exif_camera_model()
    except UnicodeDecodeError as error:
        return bytes(error.object).decode("latin-1")


def decode_quietly(data: bytes, flags: int) -> tuple[np.ndarray | None, list[str]]:
    """The pixels of a file's bytes by OpenCV, None where it cannot, and the lines that its decoders print."""
    pixels = None
    with catch_native_stderr() as complaints, suppress(cv2.error):
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    return pixels, complaints


def lacks_range(path: Path) -> bool:
    """Whether a file is a TIFF of floats or of more than 16 bits: which value is white, no standard says."""
    try:
        with warnings.catch_warnings(action="ignore"), open(path, "rb") as file:
            head = file.read(8)
            if not head.startswith(TIFF_MAGICS):
                return False
            directory = TiffImagePlugin.ImageFileDirectory_v2(head)
            file.seek(directory.next)
            directory.load(file)
            formats, bits = directory.get(SAMPLE_FORMAT, (1,)), directory.get(BITS_PER_SAMPLE, (1,))
            return FLOAT in formats or max(bits) > 16
    except Exception:  # of damaged files: all kinds of errors; decoding them says so
        return False


def read_deep_tiff(data: bytes, ref: ImageRef) -> np.ndarray | None:
    """(H, W) uint16 grey, as stored, of the bytes of a TIFF of more than 8 bits; None of others and where it fails.

    Floats within [0, 1] are taken as black to white. Of other floats, such as the temperatures of thermal cameras, and
    of whole numbers of more than 16 bits, all but the extreme percent of each photo's values is spread over the range.
    """
    values, _ = decode_quietly(data, cv2.IMREAD_UNCHANGED)
    if values is None or values.dtype.itemsize == 1:
        return None
    values = restore_stored(values, ref)  # OpenCV turns a TIFF as its orientation says, even when told not to
    if values.shape[1::-1] != tuple(ref.size_wh):
        return None
    if values.ndim == 3:
        colours = values if values.dtype == np.uint16 else values.astype(np.float32)
        values = cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY) if colours.shape[2] == 3 else colours[:, :, 0]
    return values if values.dtype == np.uint16 else _spread_values(values)


def _spread_values(values: np.ndarray) -> np.ndarray:
    """(H, W) numbers of any kind -> (H, W) uint16, see read_deep_tiff; what is no number becomes black."""
    with np.errstate(invalid="ignore"):  # of what is no number
        values = values.astype(np.float64)
    known = values[np.isfinite(values)]
    if not len(known):
        return np.zeros(values.shape, np.uint16)
    low, high = known.min(), known.max()
    low, high = (0.0, 1.0) if 0 <= low <= high <= 1 else np.percentile(known, BLACK_AND_WHITE_PERCENT)
    shares = np.nan_to_num((values - low) / max(high - low, np.finfo(np.float64).tiny), nan=0.0)
    return np.rint(shares.clip(0, 1) * np.iinfo(np.uint16).max).astype(np.uint16)


def _read_heic(path: Path, as_rgb: bool) -> pycolmap.Bitmap | None:
    if not can_read_heic():
        raise MissingPackageError(f"{path} is HEIC, which needs the package pillow-heif: {INSTALL_HEIC}")
    import pillow_heif

    return _hand_to_colmap(pillow_heif.open_heif(path).to_pillow(), as_rgb)


def _hand_to_colmap(image: Image.Image, as_rgb: bool) -> pycolmap.Bitmap | None:
    """Through an uncompressed TIFF: COLMAP reads EXIF from files only."""
    exif = image.info.get("exif")
    pixels = image.convert("RGB" if as_rgb else "L")
    with tempfile.NamedTemporaryFile(suffix=".tif") as tiff:
        try:
            pixels.save(tiff, "TIFF", **({"exif": exif} if exif else {}))
        except Exception:  # of EXIF that is damaged: all kinds of errors
            tiff.seek(0)
            tiff.truncate()
            pixels.save(tiff, "TIFF")
        tiff.flush()
        return pycolmap.Bitmap.read(tiff.name, as_rgb=as_rgb)


def is_read_by_colmap(path: Path) -> bool:
    """Whether COLMAP can read a file that is an image. Raises OSError where it cannot be read."""
    return _read_head(path).startswith(COLMAP_MAGICS) and not lacks_range(path)


def _read_head(path: Path) -> bytes:
    with open(path, "rb") as file:
        return file.read(HEAD_BYTES)


@contextmanager
def open_to_colmap(images: Sequence[ImageRef], image_folder: Path) -> Iterator[Path]:
    """A folder in which COLMAP can read all the images by their names, in the frame of their coordinates.

    That is image_folder, where COLMAP can read them all and none is flipped. Otherwise it is a temporary one with
    symbolic links to the files, and with JPEGs in place of the others. These keep their names: COLMAP goes by the
    content. Photos that are gone are left to COLMAP, which gives their points no colour.
    """
    there = [image for image in images if image.path.is_file()]
    copied = {image.name for image in there if image.flipped or not is_read_by_colmap(image.path)}
    if not copied:
        yield Path(image_folder)
        return
    with tempfile.TemporaryDirectory(prefix="hm_sfm.") as temporary:
        for image in images:
            target = Path(temporary) / image.name
            target.parent.mkdir(parents=True, exist_ok=True)
            if image.name not in copied:
                target.symlink_to(image.path.absolute())
            elif (pixels := read_frame(image)) is not None:
                jpeg = Path(temporary) / "written.jpg"
                pycolmap.Bitmap.from_array(pixels).write(jpeg)
                os.replace(jpeg, target)
        yield Path(temporary)


def read_frame(image: ImageRef) -> np.ndarray | None:
    """(H, W, 3) uint8 RGB in the frame of the image's coordinates; None where the file cannot be decoded."""
    if lacks_range(image.path):
        grey = read_deep_tiff(image.path.read_bytes(), image)
        pixels = None if grey is None else np.dstack([(grey >> 8).astype(np.uint8)] * 3)
    else:
        bitmap = read_bitmap(image.path, as_rgb=True)
        pixels = None if bitmap is None else bitmap.to_array()
    return np.ascontiguousarray(pixels[:, ::-1]) if image.flipped and pixels is not None else pixels


def read_alpha(image: ImageRef) -> np.ndarray | None:
    """(H, W) uint8 in the frame of the image's coordinates, 0 is transparent; None where all of the photo is opaque."""
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(image.path) as file:
            alpha = np.array(file.convert("RGBA").getchannel("A")) if file.has_transparency_data else None
    except Exception:  # of damaged files: all kinds of errors, and that they cannot be read is said elsewhere
        return None
    if alpha is None or alpha.shape != (image.size_wh[1], image.size_wh[0]) or (alpha == 255).all():
        return None
    return np.ascontiguousarray(alpha[:, ::-1]) if image.flipped else alpha
