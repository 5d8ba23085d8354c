"""One picture of how two photos match: their matches, and the second photo warped into the first."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hm_sfm.colmap.cameras import make_cameras
from hm_sfm.colmap.verification import is_convincing, verify_pair
from hm_sfm.config import CameraConfig, VerificationConfig
from hm_sfm.errors import InputError
from hm_sfm.geometry.homographies import apply_homographies
from hm_sfm.io.atomic import replace_file
from hm_sfm.io.pictures import encode_drawing
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.photos.images import PreparedImage, prepare_image, read_ref
from hm_sfm.photos.sizes import measure_px_scale
from hm_sfm.report.drawn_matches import GAP_PX, WORST_PX, draw_photo_matches, make_grey, place_points
from hm_sfm.types import PatchMatches

LONG_EDGE_PX = 800
"""Of each photo in the picture."""
TILE_PX = 64
ENDINGS = (".jpg", ".jpeg", ".png", ".webp")


@dataclass(frozen=True)
class PairPicture:
    """The picture, (H, W, 3) uint8 BGR, and what it shows."""

    picture: np.ndarray
    matches: int
    good: int
    """With a score of at least `min_score`; these are drawn."""
    agreeing: int
    """Of these, with one two-view geometry."""
    is_verified: bool
    """reconstruct would use the pair."""


def check_picture_path(path: Path) -> None:
    """Raises InputError where no picture can be written to such a file: better before matching than after."""
    if Path(path).suffix.lower() not in ENDINGS:
        raise InputError(f"the picture {path} must end in {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}")
    if not Path(path).parent.is_dir():
        raise InputError(f"there is no folder {Path(path).parent} for the picture {Path(path).name}")


def write_picture(path: Path, picture: np.ndarray) -> None:
    """Write (H, W, 3) uint8 BGR, atomically; the format goes by the file's ending."""
    with replace_file(path) as temporary:
        temporary.write_bytes(encode_drawing(picture, Path(path).suffix.lower()))


def draw_pair(matcher: HomoMatcher, path_a: Path, path_b: Path, checks: VerificationConfig) -> PairPicture:
    """Match two photos and draw them.

    Above are the good matches, green where they agree with one two-view geometry and red where not. Below are photo B
    warped into A by the homographies, black where there are none, and a checkerboard of that and A.

    Raises InputError where a photo cannot be read.
    """
    refs = [read_ref(path) for path in (path_a, path_b)]
    matches = matcher.match(path_a, path_b)
    good = matches.select(matches.score >= checks.min_score)
    # One by one: photos of two folders may have the same name.
    camera_a, camera_b = (make_cameras([ref], CameraConfig()).cameras[0] for ref in refs)
    scale_a, scale_b = (measure_px_scale(ref.size_wh, matcher.images.long_edge_px) for ref in refs)
    agreeing = verify_pair(good, camera_a, camera_b, checks, (scale_a, scale_b))
    count = int(np.count_nonzero(agreeing))
    is_verified = is_convincing(count, len(good), checks)

    photo_a, photo_b = (prepare_image(ref, LONG_EDGE_PX) for ref in refs)
    caption = f"{len(good)} good matches, {count} agree: {'verified' if is_verified else 'not verified'}"
    above = draw_photo_matches(photo_a, photo_b, good.xy0, good.xy1, np.where(agreeing, 0.0, WORST_PX), caption)
    warped, is_covered = warp_photo(photo_a, photo_b, good.select(agreeing) if is_verified else good)
    grey = make_grey(photo_a)
    row, column = np.indices(grey.shape) // TILE_PX
    # What no match covers is A, darkened.
    board = np.where((row + column) % 2 == 0, grey, np.where(is_covered, warped, grey // 3))
    gap = np.zeros((len(grey), GAP_PX), np.uint8)
    below = cv2.cvtColor(np.concatenate([warped, gap, board], axis=1), cv2.COLOR_GRAY2BGR)
    picture = np.zeros((len(above) + GAP_PX + len(below), max(above.shape[1], below.shape[1]), 3), np.uint8)
    picture[: len(above), : above.shape[1]] = above
    picture[len(above) + GAP_PX :, : below.shape[1]] = below
    return PairPicture(picture, len(matches), len(good), count, is_verified)


def warp_photo(photo_a: PreparedImage, photo_b: PreparedImage, matches: PatchMatches) -> tuple[np.ndarray, np.ndarray]:
    """Photo B as seen from A.

    Returns an (H, W) uint8 image of A's size, black where no match covers a pixel, and which pixels are covered,
    (H, W) bool.
    """
    height, width = photo_a.grey.shape
    row, column = np.indices((height, width))
    pixels = np.stack([column.ravel(), row.ravel()], axis=1) + 0.5
    stored_a = apply_homographies(np.broadcast_to(photo_a.stored_from_scaled, (len(pixels), 3, 3)), pixels)
    stored_b, valid = matches.warp(stored_a)
    # OpenCV counts the centre of the top-left pixel as (0, 0); far outside it reads black.
    place = np.where(valid[:, None], place_points(photo_b, stored_b) - 0.5, -10).astype(np.float32)
    place = place.reshape(height, width, 2)
    warped = cv2.remap(make_grey(photo_b), place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderValue=0)
    return warped, valid.reshape(height, width)
