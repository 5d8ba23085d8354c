"""Training pairs of real photos: views of scenes that were reconstructed by teachers, supervised by their tracks.

Only the tracks of its models are known of a scene (pipelines/training/make_teacher_tracks.py): which point is seen
where. Two photos that share tracks are a pair, however far apart they are, even if no teacher matched them directly.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import cv2
import h5py
import numpy as np
import pycolmap
from torch.utils.data import Dataset

from hm_sfm.errors import InputError
from hm_sfm.geometry.frames import homography_to_pixel_index
from hm_sfm.io.arrays import read_array
from hm_sfm.io.atomic import replace_file
from hm_sfm.training.photos import POINTS, SURFACES, disturb_view, render_view

LARGEST_ERROR_PX = 1.5
"""Observations with a larger reprojection error are left out."""
FEWEST_SHARED = 30
"""Points that two photos must share to be a pair."""
LARGEST_RATIO = 1.4
"""Of the two views' scales, beyond that of the photos themselves."""
TURN_DEG = 10.0
"""Standard deviation of the rotation between the views of every third pair."""
VALIDATION_SCENES = (
    "as_meganerf_rubble",
    "british_museum",
    "cmsc_building",
    "cut3r_001",
    "cyprus",
    "deepv2d_nyu_2",
    "kotor_cathedral",
    "nle_tower",
    "stream_building",
    "vggsfm_statue",
)
"""Never trained on: facades, repeated windows, interiors, drone flights, a statue, wide baselines, internet photos."""


def write_tracks(path: Path, models: Sequence[pycolmap.Reconstruction]) -> None:
    """Write where each photo sees which 3D point; atomic.

    A group an image name of (N,) int64 `point`, unique over the models, and (N, 2) float32 `xy`: the projection of the
    point, px of the stored photo. A photo that several models hold counts in the first one.
    """
    with replace_file(Path(path)) as temporary, h5py.File(temporary, "w") as file:
        first_point = 0
        for model in models:
            for image in model.images.values():
                if image.has_pose and image.name not in file:
                    point, xy = _project_observations(model, image)
                    group = file.create_group(image.name)
                    group["point"], group["xy"] = point + first_point, xy
            first_point += max(model.points3D, default=0) + 1


def _project_observations(model: pycolmap.Reconstruction, image: pycolmap.Image) -> tuple[np.ndarray, np.ndarray]:
    """(N,) int64 point ids and (N, 2) float32 px: the points that the image observes well, each once."""
    xy_of = {}
    for observation in image.get_observation_points2D():
        projected = image.project_point(model.points3D[observation.point3D_id].xyz)
        if projected is not None and np.linalg.norm(projected - observation.xy) <= LARGEST_ERROR_PX:
            xy_of[observation.point3D_id] = projected
    point = np.array(sorted(xy_of), dtype=np.int64)
    return point, np.array([xy_of[key] for key in point.tolist()], dtype=np.float32).reshape(-1, 2)


@dataclass(frozen=True)
class PhotoPair:
    """Two photos of a scene and the points that both show."""

    path0: Path
    path1: Path
    xy0: np.ndarray
    xy1: np.ndarray
    """(N, 2) float32, px of the photos."""


def read_photo_pairs(tracks: Path, photos: Path, names: Sequence[str] | None = None) -> list[list[PhotoPair]]:
    """The pairs of each scene, for the scenes of `tracks` (all but VALIDATION_SCENES, or those of `names`).

    tracks: folder of <scene>/tracks.h5; photos: folder of <scene>/ with the photos. Scenes without a pair are left
    out. Raises InputError where nothing is left, or a tracks file names a photo that is not there.
    """
    path_of = {path.parent.name: path for path in sorted(Path(tracks).glob("*/tracks.h5"))}
    chosen = [name for name in path_of if (name not in VALIDATION_SCENES if names is None else name in names)]
    scenes = [pairs for name in chosen if (pairs := _read_scene(path_of[name], Path(photos) / name))]
    if not scenes:
        raise InputError(f"{tracks} holds no tracks of scenes to train on: make them with make_teacher_tracks.py")
    return scenes


def _read_scene(path: Path, folder: Path) -> list[PhotoPair]:
    seen: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def read(name: str, node: object) -> None:
        if isinstance(node, h5py.Group) and "point" in node:
            seen[name] = read_array(node, "point"), read_array(node, "xy")

    try:
        with h5py.File(path) as file:
            file.visititems(read)
    except (OSError, KeyError) as error:
        raise InputError(f"{path} is damaged or no file of tracks: {error}") from error
    for name in seen:
        if not (folder / name).is_file():
            raise InputError(f"{path} names the photo {name!r}, which is not in {folder}")
    pairs = []
    for name0, name1 in combinations(sorted(seen), 2):
        (point0, xy0), (point1, xy1) = seen[name0], seen[name1]
        _, index0, index1 = np.intersect1d(point0, point1, assume_unique=True, return_indices=True)
        if len(index0) >= FEWEST_SHARED:
            pairs.append(PhotoPair(folder / name0, folder / name1, xy0[index0], xy1[index1]))
    return pairs


class PhotoPairs(Dataset):
    """Items like those of WarpedPhotos, of real photos: known by their `points` only, no pixel has a surface.

    Scenes come equally often, whatever their number of pairs. Deterministic per seed and index.
    """

    def __init__(self, scenes: list[list[PhotoPair]], size_wh: tuple[int, int], seed: int, count: int) -> None:
        self.scenes, self.size_wh, self.seed, self.count = scenes, size_wh, seed, count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng([self.seed, index])
        scene = self.scenes[rng.integers(len(self.scenes))]
        pair = scene[rng.integers(len(scene))]
        anchor = rng.integers(len(pair.xy0))
        ratio = np.exp(rng.uniform(-0.5, 0.5) * np.log(LARGEST_RATIO))
        longer_px = rng.uniform(0.95, 1.6) * max(self.size_wh)
        rotation_deg = rng.normal(0, TURN_DEG) if rng.random() < 0.3 else 0.0
        images, mapped = [], []
        for path, xy, sign in ((pair.path0, pair.xy0, 1), (pair.path1, pair.xy1, -1)):
            photo = read_grey(path)
            scale = min(longer_px * ratio**sign / max(photo.shape), 1.2)
            view_from_photo = self._draw_window(photo.shape, xy[anchor], scale, sign * rotation_deg / 2, rng)
            view = render_view(photo, view_from_photo, self.size_wh)
            shown = cv2.warpPerspective(np.ones_like(photo), homography_to_pixel_index(view_from_photo), self.size_wh)
            # Where the photo ends there is nothing to see, not its mirror image, which could be matched.
            images.append(disturb_view(np.where(shown, view, photo.mean()).astype(np.float32), rng))
            mapped.append(xy @ view_from_photo[:2, :2].T + view_from_photo[:2, 2])
        points = np.concatenate(mapped, axis=1)
        inside = np.all((points >= 0) & (points < self.size_wh * 2), axis=1)
        points = rng.permutation(points[inside])[:POINTS]
        height, width = images[0].shape
        return {
            "images": np.stack(images),
            "b_from_a": np.tile(np.eye(3, dtype=np.float32), (SURFACES, 1, 1)),
            "surface": np.full((height, width), -1, np.int64),
            "points": np.pad(points, ((0, POINTS - len(points)), (0, 0)), constant_values=np.nan).astype(np.float32),
        }

    def _draw_window(
        self, shape_hw: tuple[int, int], anchor: np.ndarray, scale: float, rotation_deg: float, rng: np.random.Generator
    ) -> np.ndarray:
        """(3, 3) px of the photo -> px of the view.

        The view shows the photo's point `anchor`, and, but for the rotation, no more than it must of what lies beyond
        the photo's borders.
        """
        cosine, sine = scale * np.cos(np.radians(rotation_deg)), scale * np.sin(np.radians(rotation_deg))
        matrix = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])
        view, photo = np.array(self.size_wh), scale * np.array(shape_hw[::-1])
        corner = view * rng.uniform(0.25, 0.75, size=2) - scale * anchor
        corner = np.clip(corner, np.minimum(view - photo, 0), np.maximum(view - photo, 0))
        matrix[:2, 2] = corner + (scale * anchor - matrix[:2, :2] @ anchor)
        return matrix


def read_grey(path: Path) -> np.ndarray:
    """(H, W) uint8, unrotated, as COLMAP reads it. Raises InputError where it cannot be read."""
    photo = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if photo is None:
        raise InputError(f"{path} cannot be read as an image")
    return photo
