"""Drawn matches: two images side by side and a sample of their matches, coloured by error from green to red."""

import cv2
import numpy as np

from hm_sfm.geometry.homographies import apply_homographies
from hm_sfm.photos.images import PreparedImage

WORST_PX = 5.0
"""Errors from here on are red."""
MOST_LINES = 300
GAP_PX = 8
SUBPIXEL_BITS = 4
GREY = (150, 150, 150)


def draw_photo_matches(
    photo0: PreparedImage, photo1: PreparedImage, xy0: np.ndarray, xy1: np.ndarray, error_px: np.ndarray,
    caption: str | None = None,
) -> np.ndarray:  # fmt: skip
    """As draw_matches, of two photos and matches in px of the stored images; error_px: (M,) px of stored image 1."""
    scale = np.sqrt(abs(np.linalg.det(photo1.stored_from_scaled[:2, :2])))
    places = place_points(photo0, xy0), place_points(photo1, xy1)
    return draw_matches(make_grey(photo0), make_grey(photo1), *places, error_px / scale, caption)


def place_points(photo: PreparedImage, xy: np.ndarray) -> np.ndarray:
    """Points (M, 2) px of the stored image -> (M, 2) float32 px of the prepared one."""
    scaled_from_stored = np.linalg.inv(photo.stored_from_scaled)
    return apply_homographies(np.broadcast_to(scaled_from_stored, (len(xy), 3, 3)), xy)


def make_grey(photo: PreparedImage) -> np.ndarray:
    """(H, W) uint8 of a prepared image."""
    return np.rint(photo.grey * 255).astype(np.uint8)


def draw_matches(
    image0: np.ndarray, image1: np.ndarray, xy0: np.ndarray, xy1: np.ndarray, error_px: np.ndarray,
    caption: str | None = None,
) -> np.ndarray:  # fmt: skip
    """One picture of two grey images (H, W) uint8 and at most MOST_LINES of their matches, evenly taken in their order.

    xy0, xy1: (M, 2) px; error_px: (M,), NaN where it is unknown, which is drawn grey. caption: instead of one that
    counts the matches and their errors. Returns (max H, W0 + W1 + gap, 3) uint8 BGR.
    """
    shift = image0.shape[1] + GAP_PX
    picture = np.zeros((max(image0.shape[0], image1.shape[0]), shift + image1.shape[1], 3), np.uint8)
    picture[: image0.shape[0], : image0.shape[1]] = image0[:, :, None]
    picture[: image1.shape[0], shift:] = image1[:, :, None]
    chosen = np.unique(np.linspace(0, len(xy0) - 1, min(len(xy0), MOST_LINES)).round().astype(int))
    # The worst come last, so that none of them is hidden; the unknown ones come first.
    chosen = chosen[np.argsort(np.nan_to_num(error_px[chosen], nan=-1.0), kind="stable")]
    for i in chosen:
        colour = pick_colour(float(error_px[i]))
        # OpenCV's drawing counts the centre of the top-left pixel as (0, 0).
        ends = [np.rint((xy - 0.5) * 2**SUBPIXEL_BITS).astype(int).tolist() for xy in (xy0[i], xy1[i] + (shift, 0))]
        cv2.line(picture, ends[0], ends[1], colour, 1, cv2.LINE_AA, SUBPIXEL_BITS)
        for end in ends:
            cv2.circle(picture, end, 2 * 2**SUBPIXEL_BITS, colour, cv2.FILLED, cv2.LINE_AA, SUBPIXEL_BITS)
    text = count_errors(error_px) if caption is None else caption
    if text:
        # On a bar: an outline in a heavier weight has wider letters in OpenCV 5.
        (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
        cv2.rectangle(picture, (0, 0), (width + 12, 19), (0, 0, 0), cv2.FILLED)
        cv2.putText(picture, text, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


def count_errors(error_px: np.ndarray) -> str:
    """How many matches there are, and which part of those with a known error is right. error_px: (M,), NaN unknown."""
    known = error_px[~np.isnan(error_px)]
    text = f"{len(error_px)} matches"
    if len(known):
        text += f", {100 * (known < 1).mean():.0f} % within 1 px, {100 * (known < WORST_PX).mean():.0f} % within 5 px"
    return text


def pick_colour(error_px: float) -> tuple[int, int, int]:
    """BGR: green at 0, yellow at half of WORST_PX, red from there on; grey where the error is NaN."""
    if np.isnan(error_px):
        return GREY
    share = min(float(error_px) / WORST_PX, 1.0)
    return 0, round(255 * min(1.0, 2 - 2 * share)), round(255 * min(1.0, 2 * share))
