"""Pictures of the matches that an evaluation looks at, coloured by their errors against the ground truth."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hm_sfm.evaluation.relative_poses import PosePair
from hm_sfm.geometry.homographies import apply_homographies
from hm_sfm.io.atomic import replace_file
from hm_sfm.io.names import cut_name
from hm_sfm.io.pictures import encode_drawing
from hm_sfm.photos.images import prepare_image, read_ref
from hm_sfm.report.drawn_matches import draw_matches, draw_photo_matches
from hm_sfm.types import PatchMatches

LONG_EDGE_PX = 1024
"""Of each photo in a picture."""


@dataclass
class MatchPictures:
    """A folder of PNG files, numbered in the order of drawing; the methods suit `observe` of the evaluations."""

    folder: Path
    count: int = 0

    def __post_init__(self) -> None:
        self.folder = Path(self.folder)
        self.folder.mkdir(parents=True, exist_ok=True)

    def draw_points(self, images: np.ndarray, matches: PatchMatches, error_px: np.ndarray) -> None:
        """The matches of two grey images, (2, H, W) uint8; error_px: (M,) NaN where there is no ground truth."""
        self._write("pair", draw_matches(images[0], images[1], matches.xy0, matches.xy1, error_px))

    def draw_poses(self, pair: PosePair, matches: PatchMatches) -> None:
        """The matches of two photos, with their epipolar errors against the true pose, px of the picture."""
        self._draw_photos(pair.path0, pair.path1, matches, measure_epipolar_error(matches, pair))

    def draw_homography(self, path0: Path, path1: Path, true: np.ndarray, matches: PatchMatches) -> None:
        """The matches of two photos, with their errors against the true homography (3, 3), px of photo 0 -> 1."""
        true_xy1 = apply_homographies(np.broadcast_to(true, (len(matches), 3, 3)), matches.xy0)
        self._draw_photos(path0, path1, matches, np.linalg.norm(true_xy1 - matches.xy1, axis=1))

    def _draw_photos(self, path0: Path, path1: Path, matches: PatchMatches, error_px: np.ndarray) -> None:
        """error_px: (M,) px of stored image 1."""
        photo0, photo1 = (prepare_image(read_ref(path), LONG_EDGE_PX) for path in (path0, path1))
        picture = draw_photo_matches(photo0, photo1, matches.xy0, matches.xy1, error_px)
        self._write(f"{cut_name(path0.stem, 100)}-{cut_name(path1.stem, 100)}", picture)

    def _write(self, name: str, picture: np.ndarray) -> None:
        with replace_file(self.folder / f"{self.count:04d}_{name}.png") as temporary:
            temporary.write_bytes(encode_drawing(picture, ".png"))
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
