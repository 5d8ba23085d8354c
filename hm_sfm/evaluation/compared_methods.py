"""The methods of a comparison: what each is made from, whether it has finished, and the metrics of its model."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from hm_sfm.colmap.database import open_database
from hm_sfm.colmap.mapping import summarise_models
from hm_sfm.colmap.model_folders import count_latest
from hm_sfm.colmap.models import read_tracks
from hm_sfm.config import Config, fingerprint
from hm_sfm.evaluation.poses import score_model
from hm_sfm.io.atomic import replace_file
from hm_sfm.keypoints.tracks import build_tracks, label_tracks
from hm_sfm.pipeline.collection import Collection
from hm_sfm.types import PinholeView, Tracks

AUC_SHOWN_DEG = (0.25, 0.5, 1, 3)
RESULT_FILE = "result.json"


@dataclass(frozen=True, kw_only=True)
class MethodResult:
    """What became of one method. Metrics are of its largest model, 0 where there is none."""

    name: str
    registered: int
    models: int
    matched_tracks: int
    """Tracks of the verified matches: what the mapper is given. It ignores those of two images."""
    mean_matched_track_length: float
    points: int
    points_in_3_images: int
    """Points that at least three distinct images see."""
    observations: int
    observations_per_image: float
    """Per registered image."""
    mean_track_length: float
    """In distinct images, as everywhere here."""
    median_track_length: float
    track_length_histogram: dict[int, int]
    """Track length -> number of points."""
    mean_reprojection_px: float
    auc_percent: dict[float, float] | None
    """Threshold in degrees -> pose AUC over all pairs of images; None without ground truth."""
    seconds: dict[str, float | None]
    """match, keypoints, verify, map; None where another program did it. Methods that share matches share `match`."""


@dataclass(frozen=True)
class ComparisonTask:
    """What all methods share."""

    collection: Collection
    out: Path
    config: Config
    digests: Mapping[str, str]
    """Image name -> digest of the photo."""
    ground_truth: dict[str, PinholeView] | None
    """Image name -> its true camera."""
    quiet: bool = False


@dataclass(frozen=True)
class Method:
    """One way from matches to a model."""

    name: str
    made_by: Any
    """What the result depends on beside what all methods share."""
    build: Callable[[], dict[str, float | None]]
    """Leaves the database and the models, if any, in OUT/name; returns the seconds of each stage."""


def finish_method(task: ComparisonTask, method: Method) -> MethodResult:
    """The metrics of a method: of the model that an earlier run left, if it was made in the same way, or of a new one.

    Raises what the method raises.
    """
    folder = task.out / method.name
    made_by = describe_method(task, method)
    finished = read_finished(folder, made_by)
    if finished is None:
        folder.mkdir(exist_ok=True)
        (folder / RESULT_FILE).unlink(missing_ok=True)
        seconds = {stage: spent if spent is None else round(spent, 2) for stage, spent in method.build().items()}
        # Opening the database changes the file: it is read once.
        matched = np.diff(read_matched_tracks(folder / "database.db").offsets)
        finished = {
            "made_by": made_by,
            "models": count_latest(folder / "sparse"),
            "seconds": seconds,
            "matched_tracks": len(matched),
            "mean_matched_track_length": float(matched.mean()) if len(matched) else 0.0,
        }
        with replace_file(folder / RESULT_FILE) as temporary:
            temporary.write_text(json.dumps(finished, indent=2) + "\n")
    return measure_method(task, method.name, finished)


def describe_method(task: ComparisonTask, method: Method) -> str:
    """A fingerprint of all that the result of a method depends on."""
    collection, config = task.collection, task.config
    cameras = collection.cameras
    shared = [version("hm_sfm"), dict(task.digests), list(map(str, collection.pairs)), collection.masks.digest()]
    # What the files say that the configuration only names.
    shared += [[camera.params.tolist() for camera in cameras.cameras], cameras.camera_index]
    shared += [[pose.matrix().tolist() for pose in cameras.cam_from_world]]
    shared += map(str, cameras.rigs)
    return fingerprint(*shared, config.cameras, config.verification, config.mapping, method.made_by)


def read_finished(folder: Path, made_by: str) -> dict[str, Any] | None:
    """The content of RESULT_FILE; None where it is missing, unreadable, of other settings, or without its models."""
    try:
        finished = json.loads((folder / RESULT_FILE).read_text())
        same = (finished["made_by"], finished["models"]) == (made_by, count_latest(folder / "sparse"))
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return finished if same else None


def measure_method(task: ComparisonTask, name: str, finished: Mapping[str, Any]) -> MethodResult:
    """The metrics of OUT/name/sparse/0, all 0 where there are no models; `finished` is the content of RESULT_FILE."""
    models = finished["models"]
    model = pycolmap.Reconstruction(task.out / name / "sparse" / "0") if models else pycolmap.Reconstruction()
    metrics = summarise_models((model,) if models else (), len(task.collection.images))
    length = np.diff(read_tracks(model).offsets)
    score = score_model(model, task.ground_truth) if task.ground_truth else None
    return MethodResult(
        name=name,
        registered=metrics.registered,
        models=models,
        matched_tracks=finished["matched_tracks"],
        mean_matched_track_length=finished["mean_matched_track_length"],
        points=metrics.points,
        points_in_3_images=int(np.count_nonzero(length >= 3)),
        observations=metrics.observations,
        observations_per_image=metrics.observations / max(1, metrics.registered),
        mean_track_length=metrics.mean_track_length,
        median_track_length=float(np.median(length)) if len(length) else 0.0,
        track_length_histogram=dict(zip(*(column.tolist() for column in np.unique(length, return_counts=True)))),
        mean_reprojection_px=metrics.mean_reprojection_px,
        auc_percent={limit: score.auc_percent[limit] for limit in AUC_SHOWN_DEG} if score else None,
        seconds=finished["seconds"],
    )


def read_matched_tracks(database_path: Path) -> Tracks:
    """The tracks of a database's verified matches; images are numbered in the order of their ids.

    Tracks that would hold two keypoints of one image are split. Raises InputError where there is no database.
    """
    with open_database(database_path) as database:
        image_ids = sorted(image.image_id for image in database.read_all_images())
        counts = np.array([database.num_keypoints_for_image(image_id) for image_id in image_ids], np.int64)
        pair_ids, geometries = database.read_two_view_geometries()
    first = dict(zip(image_ids, np.concatenate([[0], np.cumsum(counts)]).tolist()))
    edges = [np.zeros((0, 2), np.int64)]
    for pair_id, geometry in zip(pair_ids, geometries):
        id0, id1 = pycolmap.pair_id_to_image_pair(pair_id)
        edges.append(geometry.inlier_matches.astype(np.int64).reshape(-1, 2) + [first[id0], first[id1]])
    source, target = np.concatenate(edges).T
    image = np.repeat(np.arange(len(image_ids)), counts)
    keypoint = np.arange(len(image)) - np.repeat(np.cumsum(counts) - counts, counts)
    label = label_tracks(len(image), source, target, np.ones(len(source)), image)
    return build_tracks(label, image, keypoint)
