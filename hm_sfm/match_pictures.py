"""Match pictures: two images side by side and a sample of their matches, coloured by error from green to red."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hm_sfm.atomic import replace_file
from hm_sfm.images import prepare_image, read_ref
from hm_sfm.pair_evaluation import PosePair
from hm_sfm.types import PatchMatches, apply_homographies

LONG_EDGE_PX = 1024
"""Of each photo in a picture."""
WORST_PX = 5.0
"""Errors from here on are red."""
MOST_LINES = 300
GAP_PX = 8
SUBPIXEL_BITS = 4
GREY = (150, 150, 150)


@dataclass
class MatchPictures:
    """A folder of PNG files, numbered as they are drawn; the methods suit `observe` of the evaluations."""

    folder: Path
    count: int = 0

    def __post_init__(self) -> None:
        self.folder = Path(self.folder)
        self.folder.mkdir(parents=True, exist_ok=True)

    def draw_points(self, images: Sequence[np.ndarray], matches: PatchMatches, error_px: np.ndarray) -> None:
        """The matches of two grey images (H, W) uint8, error_px (M,) NaN where there is no truth."""
        self._write("pair", draw_matches(images[0], images[1], matches.xy0, matches.xy1, error_px))

    def draw_poses(self, pair: PosePair, matches: PatchMatches) -> None:
        """The matches of two photos, with their epipolar errors against the true pose, px of the picture."""
        self._draw_photos(pair.path0, pair.path1, matches, measure_epipolar_error(matches, pair))

    def draw_homography(self, path0: Path, path1: Path, truth: np.ndarray, matches: PatchMatches) -> None:
        """The matches of two photos, with their errors against the homography truth (3, 3), px of stored image 0 -> 1."""
        true = apply_homographies(np.broadcast_to(truth, (len(matches), 3, 3)), matches.xy0)
        self._draw_photos(path0, path1, matches, np.linalg.norm(true - matches.xy1, axis=1))

    def _draw_photos(self, path0: Path, path1: Path, matches: PatchMatches, error_px: np.ndarray) -> None:
        """error_px: (M,) px of stored image 1."""
        images, places = [], []
        for path, xy in ((path0, matches.xy0), (path1, matches.xy1)):
            photo = prepare_image(read_ref(path), LONG_EDGE_PX)
            scaled_from_stored = np.linalg.inv(photo.stored_from_scaled)
            images.append(np.rint(photo.grey * 255).astype(np.uint8))
            places.append(apply_homographies(np.broadcast_to(scaled_from_stored, (len(xy), 3, 3)), xy))
        scale = np.sqrt(abs(np.linalg.det(scaled_from_stored[:2, :2])))
        self._write(f"{path0.stem}-{path1.stem}", draw_matches(*images, *places, error_px * scale))

    def _write(self, name: str, picture: np.ndarray) -> None:
        _, code = cv2.imencode(".png", picture)
        with replace_file(self.folder / f"{self.count:04d}_{name}.png") as temporary:
            temporary.write_bytes(code.tobytes())
        self.count += 1


def measure_epipolar_error(matches: PatchMatches, pair: PosePair) -> np.ndarray:
    """(M,) float64 px of the stored images: Sampson's distance of the matches from the true epipolar geometry."""
    rotation, translation = pair.cam1_from_cam0[:, :3], pair.cam1_from_cam0[:, 3]
    cross = np.array([np.cross(translation, axis) for axis in np.eye(3)]).T
    fundamental = np.linalg.inv(pair.k1).T @ cross @ rotation @ np.linalg.inv(pair.k0)
    points0, points1 = (np.column_stack([xy, np.ones(len(xy))]) for xy in (matches.xy0, matches.xy1))
    lines1, lines0 = points0 @ fundamental.T, points1 @ fundamental
    steepness = np.linalg.norm(np.column_stack([lines1[:, :2], lines0[:, :2]]), axis=1)
    return np.abs((points1 * lines1).sum(axis=1)) / np.maximum(steepness, 1e-12)


def draw_matches(
    image0: np.ndarray, image1: np.ndarray, xy0: np.ndarray, xy1: np.ndarray, error_px: np.ndarray
) -> np.ndarray:
    """One picture of two grey images (H, W) uint8 and at most MOST_LINES of their matches, evenly taken in their order.

    xy0, xy1: (M, 2) px; error_px: (M,), NaN where it is unknown, which is drawn grey. Returns (max H, W0 + W1 + gap, 3)
    uint8 BGR.
    """
    shift = image0.shape[1] + GAP_PX
    picture = np.zeros((max(image0.shape[0], image1.shape[0]), shift + image1.shape[1], 3), np.uint8)
    picture[: image0.shape[0], : image0.shape[1]] = image0[:, :, None]
    picture[: image1.shape[0], shift:] = image1[:, :, None]
    chosen = np.unique(np.linspace(0, len(xy0) - 1, min(len(xy0), MOST_LINES)).round().astype(int))
    # The worst come last, so that none of them is hidden; the unknown ones come first.
    chosen = chosen[np.argsort(np.nan_to_num(error_px[chosen], nan=-1.0), kind="stable")]
    for i in chosen:
        colour = pick_colour(error_px[i])
        # OpenCV's drawing counts the centre of the top-left pixel as (0, 0).
        ends = [np.rint((xy - 0.5) * 2**SUBPIXEL_BITS).astype(int).tolist() for xy in (xy0[i], xy1[i] + (shift, 0))]
        cv2.line(picture, *ends, colour, 1, cv2.LINE_AA, SUBPIXEL_BITS)
        for end in ends:
            cv2.circle(picture, end, 2 * 2**SUBPIXEL_BITS, colour, cv2.FILLED, cv2.LINE_AA, SUBPIXEL_BITS)
    known = error_px[~np.isnan(error_px)]
    text = f"{len(xy0)} matches"
    if len(known):
        text += f", {100 * (known < 1).mean():.0f} % within 1 px, {100 * (known < WORST_PX).mean():.0f} % within 5 px"
    for colour, width in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(picture, text, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, width, cv2.LINE_AA)
    return picture


def pick_colour(error_px: float) -> tuple[int, int, int]:
    """BGR: green at 0, yellow at half of WORST_PX, red from there on; grey where the error is NaN."""
    if np.isnan(error_px):
        return GREY
    share = min(float(error_px) / WORST_PX, 1.0)
    return 0, round(255 * min(1.0, 2 - 2 * share)), round(255 * min(1.0, 2 * share))
