"""EXIF's orientation: how the stored pixels of a photo are turned and flipped to show it as it was seen."""

import cv2
import numpy as np

from hm_sfm.types import ImageRef

# Clockwise turn that brings the top of the scene to the top, and the orientations that are mirrored then.
ROTATION_FROM_EXIF = {1: 0, 2: 0, 3: 180, 4: 180, 5: 90, 6: 90, 7: 270, 8: 270}
MIRRORED_IN_EXIF = (2, 4, 5, 7)
CV_ROTATIONS = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}


def show_upright(stored: np.ndarray, ref: ImageRef) -> np.ndarray:
    """Pixels as stored, (H, W) or (H, W, C) -> turned and flipped as EXIF asks."""
    turned = cv2.rotate(stored, CV_ROTATIONS[ref.rotation_deg]) if ref.rotation_deg else stored
    return cv2.flip(turned, 1) if ref.mirrored else turned


def restore_stored(upright: np.ndarray, ref: ImageRef) -> np.ndarray:
    """The inverse of show_upright."""
    turned = cv2.flip(upright, 1) if ref.mirrored else upright
    return cv2.rotate(turned, CV_ROTATIONS[360 - ref.rotation_deg]) if ref.rotation_deg else turned
