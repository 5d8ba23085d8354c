"""What a report shows, gathered from a finished run: metrics per image, points and cameras of the model, weak pairs."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap

from hm_sfm.colmap.database import open_database, read_verified_matches
from hm_sfm.colmap.models import list_observations
from hm_sfm.config import Config, fingerprint
from hm_sfm.judgement.judgement import Judgement
from hm_sfm.keypoints.tracks import build_tracks, count_neighbours
from hm_sfm.photos.images import prepare_image
from hm_sfm.report.diagnosis import Diagnosis
from hm_sfm.report.drawn_matches import draw_photo_matches
from hm_sfm.types import ImagePair, ImageRef, PairMatches, freeze_array

MOST_POINTS = 100_000
"""Shown of a model; 2 MB of the page."""
MOST_WEAK_PAIRS = 8
WEAK_PAIR_EDGE_PX = 560
"""Long edge of each photo in the picture of a weak pair."""
WEAK_PAIR_LINES = 80
"""Matches drawn of it."""
JPEG_QUALITY = 75
BASELINE = "loftr_style"
"""How the names of those methods of a comparison begin that persistent keypoints are compared with."""

# By the clockwise rotation that EXIF asks for: the direction in the stored photo that is up after it.
UP_IN_PHOTO = {0: (0, -1, 0), 90: (-1, 0, 0), 180: (0, 1, 0), 270: (1, 0, 0)}


@dataclass(frozen=True, kw_only=True)
class ImageMetrics:
    """One photo of the collection."""

    name: str
    registered: bool
    """In the largest model."""
    keypoints: int
    observations: int
    """Keypoints that see a point of the model."""
    mean_error_px: float | None
    """Of these, to their reprojected points, px of the stored image; None without observations."""
    neighbours: int
    """Photos that it shares points with."""
    reason: str
    """Why it is not registered; empty where it is."""


@dataclass(frozen=True)
class Scene:
    """The largest model as the page shows it: y is up, the photos look along -z on average, all fits a unit sphere."""

    xyz: np.ndarray
    """(N, 3) float32: at most MOST_POINTS of its points, evenly taken."""
    rgb: np.ndarray
    """(N, 3) uint8."""
    frusta: np.ndarray
    """(F, 5, 3) float32: the centre of each camera and the corners of its image, clockwise from the top left."""
    names: tuple[str, ...]
    """(F,) of the images."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "xyz", freeze_array(self.xyz, np.float32, (None, 3), "xyz"))
        object.__setattr__(self, "rgb", freeze_array(self.rgb, np.uint8, (len(self.xyz), 3), "rgb"))
        object.__setattr__(self, "frusta", freeze_array(self.frusta, np.float32, (len(self.names), 5, 3), "frusta"))


@dataclass(frozen=True)
class WeakPair:
    """One of the verified pairs with the fewest matches."""

    pair: ImagePair
    matches: int
    jpeg: bytes
    """Both photos with the matches drawn: green fits the model's cameras, red is 5 px off or more; grey where one of
    the photos is not registered."""


@dataclass(frozen=True)
class RefutedPair:
    """A verified pair that loops through other photos contradict, see hm_sfm.judgement."""

    pair: ImagePair
    matches: int
    belief: float
    """In [0, 1], higher is better."""
    jpeg: bytes
    """Both photos with the matches drawn; empty for all but those with the most matches."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """Everything that the page shows."""

    title: str
    summary: Mapping[str, Any]
    """As summary.json has it."""
    images: tuple[ImageMetrics, ...]
    num_pairs: int
    """That were matched."""
    verified_pairs: Mapping[tuple[int, int], int]
    """Two indices into `images` -> number of verified matches."""
    scene: Scene | None
    """None where there is no model."""
    track_lengths: Mapping[str, Mapping[int, int]]
    """Method -> track length -> number of points; this run's first."""
    weak_pairs: tuple[WeakPair, ...]
    refuted_pairs: tuple[RefutedPair, ...]
    """Those with the most matches first."""
    diagnoses: tuple[Diagnosis, ...]
    config: Config


def gather_report(
    out: Path,
    images: Sequence[ImageRef],
    num_pairs: int,
    models: Sequence[pycolmap.Reconstruction],
    judgement: Judgement,
    read: Callable[[ImagePair], PairMatches],
    diagnoses: Sequence[Diagnosis],
    config: Config,
) -> Report:
    """The report of the run in OUT, from its summary.json and database.db; compare.json where it fits this run.

    models: the largest first, of any number. read: all matches of a pair. Raises InputError where there is no database,
    or where a photo of a pair that is drawn cannot be read.
    """
    out = Path(out)
    summary = json.loads((out / "summary.json").read_text())
    verified = read_verified_matches(out / "database.db")
    keypoints = read_keypoints(out / "database.db")
    model = models[0] if models else pycolmap.Reconstruction()
    reasons = {name: reason for diagnosis in diagnoses for name, reason in diagnosis.reasons.items()}
    index = {image.name: number for number, image in enumerate(images)}
    point, image, keypoint = list_observations(model)
    tracks = build_tracks(point, image, keypoint)
    length, count = np.unique(np.diff(tracks.offsets), return_counts=True)
    this_run = dict(zip(length.tolist(), count.tolist()))
    return Report(
        title=out.resolve().name,
        summary=summary,
        images=tuple(measure_images(images, model, keypoints, (point, image, keypoint), reasons)),
        num_pairs=num_pairs,
        verified_pairs={(index[pair.name0], index[pair.name1]): len(rows) for pair, rows in verified.items()},
        scene=lay_out_scene(model, {ref.name: _turn_to_upright(ref) for ref in images}) if models else None,
        track_lengths={"this run": this_run, **read_baselines(out / "compare.json", len(images), config)},
        weak_pairs=draw_weak_pairs({ref.name: ref for ref in images}, model, verified, keypoints),
        refuted_pairs=draw_refuted_pairs({ref.name: ref for ref in images}, model, judgement, read),
        diagnoses=tuple(diagnoses),
        config=config,
    )


def read_keypoints(database_path: Path) -> dict[str, np.ndarray]:
    """Image name -> its keypoints (K, 2) float64 px. Raises InputError where there is no database."""
    with open_database(database_path) as database:
        return {
            row.name: database.read_keypoints(row.image_id)[:, :2].astype(np.float64).reshape(-1, 2)
            for row in database.read_all_images()
        }


def measure_images(
    images: Sequence[ImageRef],
    model: pycolmap.Reconstruction,
    keypoints: Mapping[str, np.ndarray],
    observations: tuple[np.ndarray, np.ndarray, np.ndarray],
    reasons: Mapping[str, str],
) -> list[ImageMetrics]:
    """The metrics of each image. observations: of the model, as list_observations returns them."""
    point, image, keypoint = observations
    registered = [model.image(image_id) for image_id in sorted(model.reg_image_ids())]
    neighbours = count_neighbours(build_tracks(point, image, keypoint), len(registered))
    ids = np.array(sorted(model.points3D), np.int64)
    xyz = np.array([model.points3D[point_id].xyz for point_id in ids.tolist()]).reshape(-1, 3)
    bounds = np.searchsorted(image, np.arange(len(registered) + 1))
    errors: dict[str, float | None] = {}
    for number, posed in enumerate(registered):
        rows = slice(bounds[number], bounds[number + 1])
        seen = posed.cam_from_world() * xyz[np.searchsorted(ids, point[rows])]
        projected = model.cameras[posed.camera_id].img_from_cam(seen) if len(seen) else np.zeros((0, 2))
        error_px = np.linalg.norm(projected - keypoints[posed.name][keypoint[rows]], axis=1)
        errors[posed.name] = float(np.nanmean(error_px)) if np.isfinite(error_px).any() else None
    number_of = {posed.name: number for number, posed in enumerate(registered)}
    metrics = []
    for ref in images:
        number = number_of.get(ref.name)
        metrics.append(
            ImageMetrics(
                name=ref.name,
                registered=number is not None,
                keypoints=len(keypoints[ref.name]),
                observations=0 if number is None else int(bounds[number + 1] - bounds[number]),
                mean_error_px=errors.get(ref.name),
                neighbours=0 if number is None else int(neighbours[number]),
                reason=reasons.get(ref.name, ""),
            )
        )
    return metrics


def _turn_to_upright(image: ImageRef) -> int:
    """Clockwise, of the photo as its coordinates are: a flipped one turns the other way."""
    return -image.rotation_deg % 360 if image.flipped else image.rotation_deg


def lay_out_scene(model: pycolmap.Reconstruction, rotation_deg: Mapping[str, int]) -> Scene:
    """Points and cameras, rotated upright and scaled. rotation_deg: clockwise, to show a photo upright, by its name."""
    posed = [model.image(image_id) for image_id in sorted(model.reg_image_ids())]
    ids = sorted(model.points3D)
    shown = np.unique(np.linspace(0, len(ids) - 1, min(len(ids), MOST_POINTS)).round().astype(np.int64))
    points = [model.points3D[ids[row]] for row in shown.tolist()]
    xyz = np.array([point.xyz for point in points], np.float64).reshape(-1, 3)
    rgb = np.array([point.color for point in points], np.uint8).reshape(-1, 3)

    world_from_cam = [image.cam_from_world().inverse() for image in posed]
    centres = np.array([pose.translation for pose in world_from_cam]).reshape(-1, 3)
    rotations = [pose.rotation.matrix() for pose in world_from_cam]
    up = np.sum([matrix @ UP_IN_PHOTO[rotation_deg[image.name]] for matrix, image in zip(rotations, posed)], axis=0)
    view_from_world = make_upright(up, np.sum([matrix[:, 2] for matrix in rotations], axis=0))

    # A few points far behind everything else must not shrink the rest to a speck.
    inner = np.percentile(xyz, (3, 97), axis=0) if len(xyz) else np.zeros((0, 3))
    extent = np.concatenate([inner, centres]) @ view_from_world.T
    middle = (extent.min(axis=0) + extent.max(axis=0)) / 2
    scale = 1 / max(np.linalg.norm(np.ptp(extent, axis=0)) / 2, np.finfo(np.float32).tiny)

    apart = np.linalg.norm(centres[:, None] - centres, axis=2) * scale
    np.fill_diagonal(apart, np.inf)
    depth = float(np.clip(0.4 * np.median(apart.min(axis=1)), 0.02, 0.08))
    frusta = [outline_camera(model.cameras[image.camera_id], float(depth / scale)) for image in posed]
    corners = np.array([pose * outline for pose, outline in zip(world_from_cam, frusta)]).reshape(-1, 5, 3)

    def show(world: np.ndarray) -> np.ndarray:
        return (world @ view_from_world.T - middle) * scale

    return Scene(show(xyz), rgb, show(corners), tuple(image.name for image in posed))


def make_upright(up: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """(3, 3) float64 rotation that maps `up` to +y and `forward`, about it, to -z; each (3,), of any length."""
    # Where the photos' directions cancel each other, any will do.
    y = up / np.linalg.norm(up) if np.linalg.norm(up) > 1e-6 else np.array([0.0, -1.0, 0.0])
    back = -(forward - (forward @ y) * y)
    if np.linalg.norm(back) < 1e-6:
        back = np.cross(y, np.eye(3)[np.argmin(np.abs(y))])
    z = back / np.linalg.norm(back)
    return np.stack([np.cross(y, z), y, z])


def outline_camera(camera: pycolmap.Camera, depth: float) -> np.ndarray:
    """(5, 3) float64 in the camera's frame: its centre and the corners of its image at `depth`, without distortion."""
    corners = np.array([[0, 0, 1], [camera.width, 0, 1], [camera.width, camera.height, 1], [0, camera.height, 1]])
    rays = corners @ np.linalg.inv(camera.calibration_matrix()).T
    return np.concatenate([np.zeros((1, 3)), depth * rays])


def read_baselines(path: Path, num_images: int, config: Config) -> dict[str, dict[int, int]]:
    """Track lengths of LoFTR-style matches by method, from a compare.json: as matched, and the best snapped ones.

    None where there is no such file, or one of other images or settings.
    """
    try:
        comparison = json.loads(path.read_text())
        is_same = (comparison["num_images"], comparison["config_fingerprint"]) == (num_images, fingerprint(config))
        methods = {name: method for name, method in comparison["methods"].items() if name.startswith(BASELINE)}
        histograms = {
            name: {int(length): int(points) for length, points in method["track_length_histogram"].items()}
            for name, method in methods.items()
        }
        snapped = [name for name in methods if not name.endswith("_raw")]
        best = max(snapped, key=lambda name: methods[name]["mean_track_length"], default="")
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}
    return {name: histograms[name] for name in (f"{BASELINE}_raw", best) if is_same and name in histograms}


def draw_weak_pairs(
    images: Mapping[str, ImageRef],
    model: pycolmap.Reconstruction,
    verified: Mapping[ImagePair, np.ndarray],
    keypoints: Mapping[str, np.ndarray],
) -> tuple[WeakPair, ...]:
    """The verified pairs with the fewest matches, weakest first. Raises InputError where a photo cannot be read."""
    posed = {model.image(image_id).name: model.image(image_id) for image_id in model.reg_image_ids()}
    drawn = []
    for pair, rows in sorted(verified.items(), key=lambda item: (len(item[1]), item[0]))[:MOST_WEAK_PAIRS]:
        xy0, xy1 = keypoints[pair.name0][rows[:, 0]], keypoints[pair.name1][rows[:, 1]]
        drawn.append(WeakPair(pair, len(rows), draw_pair(images, model, posed, pair, xy0, xy1)))
    return tuple(drawn)


def draw_refuted_pairs(
    images: Mapping[str, ImageRef],
    model: pycolmap.Reconstruction,
    judgement: Judgement,
    read: Callable[[ImagePair], PairMatches],
) -> tuple[RefutedPair, ...]:
    """The pairs that were given up, those with the most matches first. Raises InputError as draw_weak_pairs does."""
    posed = {model.image(image_id).name: model.image(image_id) for image_id in model.reg_image_ids()}
    drawn = []
    for number, lost in enumerate(
        sorted(judgement.given_up, key=lambda lost: (-np.count_nonzero(lost.verified.inliers), lost.verified.pair))
    ):
        pair, jpeg = lost.verified.pair, b""
        if number < MOST_WEAK_PAIRS:
            matches = read(pair).select(lost.verified.inliers)
            jpeg = draw_pair(images, model, posed, pair, matches.xy0.astype(np.float64), matches.xy1.astype(np.float64))
        drawn.append(RefutedPair(pair, int(np.count_nonzero(lost.verified.inliers)), lost.belief, jpeg))
    return tuple(drawn)


def draw_pair(
    images: Mapping[str, ImageRef],
    model: pycolmap.Reconstruction,
    posed: Mapping[str, pycolmap.Image],
    pair: ImagePair,
    xy0: np.ndarray,
    xy1: np.ndarray,
) -> bytes:
    """The JPEG of two photos and some of their matches (M, 2) px, coloured by their errors in the model."""
    chosen = np.unique(np.linspace(0, len(xy0) - 1, min(len(xy0), WEAK_PAIR_LINES)).round().astype(int))
    xy0, xy1 = xy0[chosen], xy1[chosen]
    error_px = np.full(len(chosen), np.nan)
    if pair.name0 in posed and pair.name1 in posed:
        error_px = measure_epipolar_px(model, posed[pair.name0], posed[pair.name1], xy0, xy1)
    photo0, photo1 = (prepare_image(images[name], WEAK_PAIR_EDGE_PX) for name in (pair.name0, pair.name1))
    picture = draw_photo_matches(photo0, photo1, xy0, xy1, error_px, caption="")
    _, code = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return code.tobytes()


def measure_epipolar_px(
    model: pycolmap.Reconstruction, image0: pycolmap.Image, image1: pycolmap.Image, xy0: np.ndarray, xy1: np.ndarray
) -> np.ndarray:
    """(M,) float64 px: Sampson's distance of matches (M, 2) px from the epipolar geometry of a model's two cameras."""
    cameras = [model.cameras[image.camera_id] for image in (image0, image1)]
    essential = pycolmap.essential_matrix_from_pose(image1.cam_from_world() * image0.cam_from_world().inverse())
    rays0, rays1 = (np.asarray(camera.cam_from_img(xy), np.float64) for camera, xy in zip(cameras, (xy0, xy1)))
    squared = np.array(pycolmap.compute_squared_sampson_error(rays0, rays1, essential))
    return np.sqrt(squared) * np.mean([camera.mean_focal_length() for camera in cameras])
