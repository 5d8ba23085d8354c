"""Masks: which pixels of which photos must not be matched, in COLMAP's naming.

The mask of the photo a/b.jpg is a/b.jpg.png in the folder of masks, and of the size that the photo is stored in; black
pixels (0) are masked out. A further mask may hold for all photos of its size. Masks act where matches are read, so
that stored matches stay as they are when masks change.
"""

import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pycolmap

from hm_sfm.config import MaskConfig
from hm_sfm.errors import InputError
from hm_sfm.types import ImageRef, PairMatches

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Masks:
    """The masks of a collection; photos without one are not in it."""

    packed: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Image name -> (H, ceil(W / 8)) uint8, np.packbits of the pixels that may be matched along each row."""

    def hides(self, name: str, xy: np.ndarray) -> np.ndarray:
        """(N,) bool: which points of an image lie in masked pixels. xy: (N, 2) px of the stored image.

        A point outside of the image counts as the pixel of the edge that is nearest.
        """
        if name not in self.packed:
            return np.zeros(len(xy), bool)
        packed = self.packed[name]
        column, row = np.floor(xy).astype(np.int64).T
        # The bits that fill up the last byte of a row repeat its last pixel.
        column, row = column.clip(0, packed.shape[1] * 8 - 1), row.clip(0, len(packed) - 1)
        return (packed[row, column >> 3] >> (7 - (column & 7)).astype(np.uint8)) & 1 == 0

    def drop_hidden(self, matches: PairMatches) -> PairMatches:
        """The matches without those that have an end in a masked pixel."""
        pair = matches.pair
        return matches.select(~(self.hides(pair.name0, matches.xy0) | self.hides(pair.name1, matches.xy1)))

    def unpack(self, image: ImageRef) -> np.ndarray | None:
        """(H, W) bool: which pixels of an image may be used, in the frame of its coordinates; None without a mask."""
        if image.name not in self.packed:
            return None
        return np.unpackbits(self.packed[image.name], axis=1, count=image.size_wh[0]).astype(bool)

    def digest(self) -> str:
        """16 hex digits that change when any mask does."""
        digest = hashlib.sha256()
        for name in sorted(self.packed):
            digest.update(f"{name}\n{self.packed[name].shape}".encode() + self.packed[name].tobytes())
        return digest.hexdigest()[:16]


NO_MASKS = Masks()


def read_masks(images: Sequence[ImageRef], config: MaskConfig) -> Masks:
    """The masks of the images: `config.folder` holds one per image, `config.camera` is one for all of its size.

    Images without a mask in the folder are logged as a warning; they are not masked. So are images that are hidden as a
    whole.

    Raises InputError where the folder does not exist, holds no mask of any image, or holds photos of the collection;
    where a mask cannot be read or differs from its image in size; where no image has the size of the camera's mask or
    the mask itself is among the images; and where nothing of any image is left.
    """
    visible: dict[str, np.ndarray] = {}
    if config.folder:
        visible = _read_folder(images, Path(config.folder))
    if config.camera:
        path = Path(config.camera)
        for image in images:
            if path.exists() and path.samefile(image.path):
                raise InputError(f"the mask {path} lies among the photos and would be taken for one: move it elsewhere")
        shared = _read_mask(path)
        of_its_size = [image for image in images if image.size_wh == (shared.shape[1], shared.shape[0])]
        if not of_its_size:
            raise InputError(
                f"the mask {path} is {shared.shape[1]} x {shared.shape[0]} px, but no image is: {images[0].name} is "
                f"{images[0].size_wh[0]} x {images[0].size_wh[1]} px"
            )
        if len(of_its_size) < len(images):
            rest = len(images) - len(of_its_size)
            logger.warning(
                "%d of %d images are not of the size of the mask %s: it is not theirs", rest, len(images), path
            )
        for image in of_its_size:
            own, packed = visible.get(image.name), _pack(_flip_as(image, shared))
            visible[image.name] = packed if own is None else own & packed
    hidden = [name for name, packed in visible.items() if not packed.any()]
    if hidden and len(hidden) == len(images):
        raise InputError(f"the masks hide all pixels of all {len(images)} images: what is black is masked out")
    if hidden:
        logger.warning(
            "%d of %d images are hidden as a whole, such as %s: what is black is masked out",
            len(hidden),
            len(images),
            hidden[0],
        )
    return Masks(visible)


def _read_folder(images: Sequence[ImageRef], folder: Path) -> dict[str, np.ndarray]:
    """Image name -> packed mask, of the images that have one."""
    if not folder.is_dir():
        raise InputError(f"the mask folder {folder} " + ("is not a folder" if folder.exists() else "does not exist"))
    inside = folder.resolve()
    stray = next((image for image in images if inside in image.path.resolve().parents), None)
    if stray:
        raise InputError(
            f"the mask folder {folder} holds {stray.name!r}, which is taken for a photo: keep masks outside of the "
            "folder of photos"
        )
    packed, missing = {}, []
    for image in images:
        path = folder / f"{image.name}.png"
        if not path.exists():
            missing.append(image.name)
            continue
        mask = _read_mask(path)
        if mask.shape != (image.size_wh[1], image.size_wh[0]):
            raise InputError(
                f"the mask {path} is {mask.shape[1]} x {mask.shape[0]} px but its image {image.name} is "
                f"{image.size_wh[0]} x {image.size_wh[1]} px"
            )
        packed[image.name] = _pack(_flip_as(image, mask))
    if not packed:
        raise InputError(
            f"the mask folder {folder} holds no mask of any of the {len(images)} images: that of {images[0].name} "
            f"would be {folder / images[0].name}.png"
        )
    if missing:
        logger.warning("%d of %d images have no mask in %s, such as %s", len(missing), len(images), folder, missing[0])
    return packed


def _read_mask(path: Path) -> np.ndarray:
    """(H, W) bool: which pixels may be matched."""
    bitmap = pycolmap.Bitmap.read(path, as_rgb=False) if path.is_file() else None
    if bitmap is None:
        raise InputError(f"cannot read the mask {path}: it " + ("is no image" if path.exists() else "does not exist"))
    return bitmap.to_array().reshape(bitmap.height, bitmap.width) > 0


def _flip_as(image: ImageRef, mask: np.ndarray) -> np.ndarray:
    """A mask of the stored photo, (H, W) bool, in the frame of the photo's coordinates."""
    return mask[:, ::-1] if image.flipped else mask


def _pack(mask: np.ndarray) -> np.ndarray:
    """(H, W) bool -> (H, ceil(W / 8)) uint8; the bits that fill up a row repeat its last pixel."""
    width = mask.shape[1]
    return np.packbits(np.pad(mask, ((0, 0), (0, -width % 8)), mode="edge"), axis=1)
