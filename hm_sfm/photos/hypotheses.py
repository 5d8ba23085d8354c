"""Prepared photos, rotated and reduced: the rotation and scale hypotheses under which photos are encoded."""

import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np

from hm_sfm.geometry.frames import homography_to_pixel_index, rotation_matrix
from hm_sfm.photos.images import PreparedImage
from hm_sfm.photos.orientation import CV_ROTATIONS

ROTATIONS_DEG = (0, *CV_ROTATIONS)
TILTS_DEG = (45, 135, 225, 315)
"""Between the quarter turns."""


@dataclass(frozen=True)
class Hypothesis:
    """How a prepared photo is rotated and reduced before it is encoded."""

    rotation_deg: int = 0
    """Clockwise, in [0, 360)."""
    downscale: float = 1
    """By how much it is smaller along both axes."""


IDENTITY = Hypothesis()


def apply_hypothesis(image: PreparedImage, hypothesis: Hypothesis) -> PreparedImage:
    """The image rotated and reduced; its points map back to px of the same stored photo.

    Rotated by other angles than quarter turns, it lies in a larger frame of its mean grey.
    """
    if hypothesis == IDENTITY:
        return image
    quarters_deg = 90 * round(hypothesis.rotation_deg / 90)
    width, height = image.scaled_wh
    reduced_wh = tuple(max(1, round(size / hypothesis.downscale)) for size in image.scaled_wh)
    grey = cv2.resize(image.grey, reduced_wh, interpolation=cv2.INTER_AREA)
    if quarters_deg % 360:
        grey = cv2.rotate(grey, CV_ROTATIONS[quarters_deg % 360])
    scaled_wh = (grey.shape[1], grey.shape[0])
    scaled_from_reduced = np.diag([width / reduced_wh[0], height / reduced_wh[1], 1.0])
    reduced_from_turned = rotation_matrix(scaled_wh, -quarters_deg % 360)
    # Providers of coarse matches that read the photo themselves turn it as its reference says.
    # Its mirrored pixels are flipped after the turn, so they turn the other way.
    turn_deg = -quarters_deg if image.ref.mirrored else quarters_deg
    ref = dataclasses.replace(image.ref, rotation_deg=(image.ref.rotation_deg + turn_deg) % 360)
    turned = PreparedImage(ref, grey, scaled_wh, image.stored_from_scaled @ scaled_from_reduced @ reduced_from_turned)
    tilt_deg = hypothesis.rotation_deg - quarters_deg
    return tilt_image(turned, tilt_deg) if tilt_deg else turned


def tilt_image(image: PreparedImage, tilt_deg: float) -> PreparedImage:
    """The image rotated clockwise about its middle, in a frame that holds all of it; around it, its mean grey."""
    cos, sin = np.cos(np.deg2rad(tilt_deg)), np.sin(np.deg2rad(tilt_deg))
    rotation = np.array([[cos, -sin], [sin, cos]])
    size = np.array(image.scaled_wh)
    width, height = np.ceil(np.abs(rotation) @ size).astype(int).tolist()
    tilted_from_image = np.eye(3)
    tilted_from_image[:2, :2] = rotation
    tilted_from_image[:2, 2] = np.array([width, height]) / 2 - rotation @ size / 2
    grey = cv2.warpAffine(
        image.grey,
        homography_to_pixel_index(tilted_from_image)[:2],
        (width, height),
        flags=cv2.INTER_CUBIC,
        borderValue=float(image.grey.mean()),
    )
    stored_from_scaled = image.stored_from_scaled @ np.linalg.inv(tilted_from_image)
    return PreparedImage(image.ref, grey.clip(0, 1), (width, height), stored_from_scaled)
