"""The validation set: pairs made of the photos that no training sees, the same for everybody.

It is a definition, not a folder of files: every 15th photo of the training folder, one seed, both kinds of pairs.
"""

import numpy as np

from hm_sfm.errors import InputError
from hm_sfm.training.photos import WarpedPhotos, WarpRange, split_photos
from hm_sfm.training.scenes import RenderedScenes, ViewRange

VALIDATION_SIZE_WH = (640, 480)
VALIDATION_SEED = 411_06700
KINDS = ("rendered", "warped")


def make_validation_pairs(photos: list[np.ndarray], kind: str, count: int) -> WarpedPhotos | RenderedScenes:
    """`count` pairs of a kind, rendered or warped; fewer are the first of more.

    photos: all of the training folder, as load_photos reads them; the held-out ones are taken here. Items as
    photos.WarpedPhotos, 640 x 480 px. Raises InputError on another kind and on a count below 1.
    """
    if kind not in KINDS:
        raise InputError(f"the kind of validation pairs must be {' or '.join(KINDS)}, found {kind!r}")
    if count < 1:
        raise InputError(f"the number of validation pairs must be at least 1, found {count}")
    _, held_out = split_photos(photos)
    if kind == "warped":
        return WarpedPhotos(held_out, VALIDATION_SIZE_WH, VALIDATION_SEED, count, WarpRange())
    return RenderedScenes(held_out, VALIDATION_SIZE_WH, VALIDATION_SEED, count, ViewRange())
