"""What is kept of an interrupted comparison, and the metrics of a model."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from hm_sfm.colmap.cameras import Cameras
from hm_sfm.colmap.model_folders import replace_models
from hm_sfm.colmap.models import read_tracks
from hm_sfm.config import Config, MappingConfig
from hm_sfm.evaluation.compared_methods import (
    ComparisonTask,
    Method,
    finish_method,
    measure_method,
    read_matched_tracks,
)
from hm_sfm.evaluation.comparison import add_seconds, read_seconds
from hm_sfm.pipeline.collection import Collection
from hm_sfm.types import ImagePair, ImageRef

SECONDS = {"match": 1.239, "keypoints": None, "verify": 0.5, "map": 2.0}


@pytest.fixture
def task(tmp_path) -> ComparisonTask:
    images = tuple(ImageRef(name, Path(name), (640, 480)) for name in ("a.jpg", "b.jpg"))
    pairs = (ImagePair("a.jpg", "b.jpg"),)
    digests = {"a.jpg": "0", "b.jpg": "1"}
    collection = Collection(tmp_path, images, pairs, Cameras((), ()))
    return ComparisonTask(collection, tmp_path, Config(), digests, None, quiet=True)


def write_scene(folder: Path) -> pycolmap.Reconstruction:
    """A synthetic scene's database and its model, which is also in `folder`/sparse/0."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=4, num_points3D=30)
    work_folder = folder / "work"
    work_folder.mkdir(parents=True)
    (folder / "database.db").unlink(missing_ok=True)
    with pycolmap.Database.open(folder / "database.db") as database:
        model = pycolmap.synthesize_dataset(options, database)
    replace_models([model], folder / "sparse", work_folder)
    shutil.rmtree(work_folder)
    return model


@pytest.fixture
def method(task) -> Method:
    """Each build adds a model and a line to OUT/demo/builds."""

    def build():
        write_scene(task.out / "demo")
        with open(task.out / "demo" / "builds", "a") as file:
            file.write("built\n")
        return dict(SECONDS)

    return Method("demo", {"weights": "abc"}, build)


def count_builds(task: ComparisonTask) -> int:
    return len((task.out / "demo" / "builds").read_text().splitlines())


def test_a_finished_method_is_kept(task, method):
    first = finish_method(task, method)
    assert first.registered == 4 and first.models == 1
    assert first.seconds == {"match": 1.24, "keypoints": None, "verify": 0.5, "map": 2.0}
    assert finish_method(task, method) == first
    assert count_builds(task) == 1


@pytest.mark.parametrize("change", ["settings", "matches", "photos", "pairs", "no model", "damaged", "foreign"])
def test_a_stale_method_is_made_anew(task, method, change):
    finish_method(task, method)
    result = task.out / "demo" / "result.json"
    if change == "settings":
        task = dataclasses.replace(task, config=Config(mapping=MappingConfig(seed=1)))
    elif change == "matches":
        method = dataclasses.replace(method, made_by={"weights": "abd"})
    elif change == "photos":
        task = dataclasses.replace(task, digests={"a.jpg": "0", "b.jpg": "2"})
    elif change == "pairs":
        collection = dataclasses.replace(task.collection, pairs=())
        task = dataclasses.replace(task, collection=collection)
    elif change == "no model":
        (task.out / "demo" / "sparse" / "0" / "points3D.bin").unlink()
    else:
        result.write_text('{"made_by"' if change == "damaged" else "[]")
    finish_method(task, method)
    assert count_builds(task) == 2
    finish_method(task, method)
    assert count_builds(task) == 2


def test_an_interrupted_method_leaves_no_result(task, method):
    finish_method(task, method)

    def build():
        raise KeyboardInterrupt

    interrupted = Method("demo", {"weights": "other"}, build)
    with pytest.raises(KeyboardInterrupt):
        finish_method(task, interrupted)
    assert not (task.out / "demo" / "result.json").exists()
    finish_method(task, method)
    assert count_builds(task) == 2


def test_a_method_without_a_model_is_a_result_of_zeros(task):
    def build():
        with pycolmap.Database.open(task.out / "empty" / "database.db"):
            return dict(SECONDS)

    result = finish_method(task, Method("empty", None, build))
    assert (result.registered, result.models, result.points, result.observations) == (0, 0, 0, 0)
    assert (result.matched_tracks, result.mean_matched_track_length) == (0, 0)
    assert (result.mean_track_length, result.median_track_length, result.observations_per_image) == (0, 0, 0)
    assert result.track_length_histogram == {} and result.auc_percent is None
    assert json.loads((task.out / "empty" / "result.json").read_text())["models"] == 0


def test_metrics_count_distinct_images(task):
    model = write_scene(task.out / "demo")
    image = model.images[min(model.images)]
    spare = next(index for index, point in enumerate(image.points2D) if not point.has_point3D())
    seen = next(point.point3D_id for point in image.points2D if point.has_point3D())
    model.add_observation(seen, pycolmap.TrackElement(image.image_id, spare))
    model.write_binary(task.out / "demo" / "sparse" / "0")

    length = np.array([len({e.image_id for e in point.track.elements}) for point in model.points3D.values()])
    finished = {"models": 1, "seconds": SECONDS, "matched_tracks": 30, "mean_matched_track_length": 3.5}
    result = measure_method(task, "demo", finished)
    assert result.points == len(length) == sum(result.track_length_histogram.values())
    assert result.track_length_histogram == {n: int((length == n).sum()) for n in np.unique(length).tolist()}
    assert result.points_in_3_images == (length >= 3).sum()
    assert result.mean_track_length == pytest.approx(length.mean())
    assert result.median_track_length == np.median(length)
    assert result.observations == length.sum() + 1
    assert result.observations_per_image == result.observations / 4


def test_tracks_of_a_model_name_its_keypoints(tmp_path):
    model = write_scene(tmp_path)
    tracks = read_tracks(model)
    image_ids = sorted(model.images)
    assert len(tracks) == model.num_points3D()
    for track, point_id in enumerate(sorted(model.points3D)):
        rows = slice(tracks.offsets[track], tracks.offsets[track + 1])
        images, keypoints = tracks.image_index[rows].tolist(), tracks.keypoint_index[rows].tolist()
        observed = {(image_ids[image], keypoint) for image, keypoint in zip(images, keypoints)}
        assert observed == {(e.image_id, e.point2D_idx) for e in model.points3D[point_id].track.elements}
    assert len(read_tracks(pycolmap.Reconstruction())) == 0


def test_tracks_of_verified_matches_are_those_of_the_scene(tmp_path):
    model = write_scene(tmp_path)

    def list_observations(tracks):
        rows = zip(tracks.image_index.tolist(), tracks.keypoint_index.tolist())
        bounds = zip(tracks.offsets[:-1], tracks.offsets[1:])
        observations = list(rows)
        return {frozenset(observations[low:high]) for low, high in bounds}

    assert list_observations(read_matched_tracks(tmp_path / "database.db")) == list_observations(read_tracks(model))
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        database.clear_two_view_geometries()
    assert len(read_matched_tracks(tmp_path / "database.db")) == 0


def test_seconds_add_up_over_interrupted_runs(tmp_path):
    path = tmp_path / "seconds.json"
    assert read_seconds(path) == 0
    path.write_text('{"match": 100.0}')
    with pytest.raises(KeyboardInterrupt), add_seconds(path):
        raise KeyboardInterrupt
    assert 100 < read_seconds(path) < 101
    before = read_seconds(path)
    with add_seconds(path):
        pass
    assert before < read_seconds(path) < before + 1
