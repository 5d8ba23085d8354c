"""Prepared photos, rotated and reduced: the rotation and scale hypotheses under which photos are encoded."""

import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np

from hm_sfm.geometry.frames import rotation_matrix
from hm_sfm.photos.images import PreparedImage
from hm_sfm.photos.orientation import CV_ROTATIONS

ROTATIONS_DEG = (0, *CV_ROTATIONS)


@dataclass(frozen=True)
class Hypothesis:
    """How a prepared photo is rotated and reduced before it is encoded."""

    rotation_deg: int = 0
    """Clockwise: 0, 90, 180 or 270."""
    downscale: float = 1
    """By how much it is smaller along both axes."""


IDENTITY = Hypothesis()


def apply_hypothesis(image: PreparedImage, hypothesis: Hypothesis) -> PreparedImage:
    """The image rotated and reduced; its points map back to px of the same stored photo."""
    if hypothesis == IDENTITY:
        return image
    width, height = image.scaled_wh
    reduced_wh = tuple(max(1, round(size / hypothesis.downscale)) for size in image.scaled_wh)
    grey = cv2.resize(image.grey, reduced_wh, interpolation=cv2.INTER_AREA)
    if hypothesis.rotation_deg:
        grey = cv2.rotate(grey, CV_ROTATIONS[hypothesis.rotation_deg])
    scaled_wh = (grey.shape[1], grey.shape[0])
    scaled_from_reduced = np.diag([width / reduced_wh[0], height / reduced_wh[1], 1.0])
    reduced_from_turned = rotation_matrix(scaled_wh, -hypothesis.rotation_deg % 360)
    # Providers of coarse matches that read the photo themselves turn it as its reference says.
    # Its mirrored pixels are flipped after the turn, so they turn the other way.
    turn_deg = -hypothesis.rotation_deg if image.ref.mirrored else hypothesis.rotation_deg
    ref = dataclasses.replace(image.ref, rotation_deg=(image.ref.rotation_deg + turn_deg) % 360)
    return PreparedImage(ref, grey, scaled_wh, image.stored_from_scaled @ scaled_from_reduced @ reduced_from_turned)
