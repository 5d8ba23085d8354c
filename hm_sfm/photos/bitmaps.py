"""Image files as COLMAP's bitmaps, also those of kinds that COLMAP cannot read: HEIC and WebP."""

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import cv2
import pycolmap

from hm_sfm.errors import MissingPackageError
from hm_sfm.types import ImageRef

HEIC_EXTENSIONS = (".heic", ".heif")
WEBP_EXTENSIONS = (".webp",)
FOREIGN_EXTENSIONS = HEIC_EXTENSIONS + WEBP_EXTENSIONS
"""Of files that COLMAP cannot read."""
INSTALL_HEIC = 'pip install "hm_sfm[heif]"'


def can_read_heic() -> bool:
    """Whether the package for HEIC is installed."""
    return find_spec("pillow_heif") is not None


def read_bitmap(path: Path, as_rgb: bool) -> pycolmap.Bitmap | None:
    """The stored pixels of an image file, with its EXIF, in RGB or grey; None where it cannot be decoded.

    HEIC files state the rotation of a photo outside of EXIF: the pixels come upright, and the EXIF orientation says so.
    EXIF of WebP is not read. Raises MissingPackageError where HEIC needs a package that is not installed.
    """
    bitmap = pycolmap.Bitmap.read(path, as_rgb=as_rgb)
    extension = Path(path).suffix.lower()
    if bitmap is None and extension in HEIC_EXTENSIONS:
        return _read_heic(Path(path), as_rgb)
    if bitmap is None and extension in WEBP_EXTENSIONS:
        return _read_webp(Path(path), as_rgb)
    return bitmap


def read_camera_label(bitmap: pycolmap.Bitmap) -> str | None:
    """Make, model, focal length and size as COLMAP compares cameras by them; None where EXIF has no make or model.

    Cameras write their names in any encoding: what is not UTF-8 is taken for Latin-1, which reads every byte.
    """
    try:
        return bitmap.exif_camera_model()
    except UnicodeDecodeError as error:
        return bytes(error.object).decode("latin-1")


def _read_heic(path: Path, as_rgb: bool) -> pycolmap.Bitmap | None:
    if not can_read_heic():
        raise MissingPackageError(f"{path} is HEIC, which needs the package pillow-heif: {INSTALL_HEIC}")
    import pillow_heif

    # An uncompressed TIFF between the two libraries: COLMAP reads EXIF from files only.
    with tempfile.NamedTemporaryFile(suffix=".tif") as tiff:
        try:
            image = pillow_heif.open_heif(path).to_pillow()
            exif = image.info.get("exif")
            image.convert("RGB" if as_rgb else "L").save(tiff, "TIFF", **({"exif": exif} if exif else {}))
        except (ValueError, OSError, RuntimeError, SyntaxError, EOFError):
            return None
        tiff.flush()
        return pycolmap.Bitmap.read(tiff.name, as_rgb=as_rgb)


def _read_webp(path: Path, as_rgb: bool) -> pycolmap.Bitmap | None:
    flags = cv2.IMREAD_COLOR_RGB if as_rgb else cv2.IMREAD_GRAYSCALE
    pixels = cv2.imread(str(path), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    return None if pixels is None else pycolmap.Bitmap.from_array(pixels)


@contextmanager
def open_to_colmap(images: Sequence[ImageRef], image_folder: Path) -> Iterator[Path]:
    """A folder in which COLMAP can read all the images by their names.

    That is image_folder, where COLMAP can read them all. Otherwise it is a temporary one with symbolic links to the
    files, and with JPEGs in place of those that COLMAP cannot read. These keep their names: COLMAP goes by the content.
    """
    if not any(image.path.suffix.lower() in FOREIGN_EXTENSIONS for image in images):
        yield Path(image_folder)
        return
    with tempfile.TemporaryDirectory(prefix="hm_sfm.") as temporary:
        for image in images:
            target = Path(temporary) / image.name
            target.parent.mkdir(parents=True, exist_ok=True)
            if image.path.suffix.lower() not in FOREIGN_EXTENSIONS:
                target.symlink_to(image.path.absolute())
            elif (bitmap := read_bitmap(image.path, as_rgb=True)) is not None:
                jpeg = Path(temporary) / "written.jpg"
                bitmap.write(jpeg)
                os.replace(jpeg, target)
        yield Path(temporary)
