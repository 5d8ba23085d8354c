"""What hm_sfm.colmap.mapping makes of oracle scenes: cameras, points and keypoints known, matches exact or wrong."""

import dataclasses
import itertools
import shutil
import signal
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import pytest

import hm_sfm.colmap.mapping
from hm_sfm.colmap.cameras import Cameras
from hm_sfm.colmap.database import open_database, read_verified_matches, write_database
from hm_sfm.colmap.mapping import MappingTask, map_globally, map_images, map_incrementally, summarise_models
from hm_sfm.colmap.snapshots import digest_inputs
from hm_sfm.colmap.verification import is_convincing, verify_database, verify_pair, verify_pairs
from hm_sfm.config import MappingConfig, VerificationConfig
from hm_sfm.errors import InputError
from hm_sfm.formats.hloc import read_features, read_matches, write_features, write_matches
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints, PairMatches


@dataclass(frozen=True)
class Oracle:
    """A synthetic scene in our types, and the model that it came from."""

    model: pycolmap.Reconstruction
    images: list[ImageRef]
    keypoints: list[Keypoints]
    matches: list[IndexMatches]


def make_oracle(folder: Path, num_images: int, num_points: int, prefix: str = "", seed: int = 1) -> Oracle:
    """A scene of pycolmap's: keypoints and matches are read from its database and renamed to prefix + name."""
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_frames_per_rig=num_images, num_points3D=num_points, num_points2D_without_point3D=3
    )
    with pycolmap.Database.open(folder / f"oracle{seed}.db") as database:
        model = pycolmap.synthesize_dataset(options, database)
        rows = {row.image_id: prefix + row.name for row in database.read_all_images()}
        keypoints = []
        for image_id, name in rows.items():
            xy = database.read_keypoints(image_id)[:, :2]
            keypoints.append(Keypoints(name, xy, np.ones(len(xy)), np.ones(len(xy))))
        matches = []
        for pair_id, indices in zip(*database.read_all_matches()):
            id0, id1 = pycolmap.pair_id_to_image_pair(pair_id)
            if rows[id0] > rows[id1]:
                id0, id1, indices = id1, id0, indices[:, ::-1]
            matches.append(IndexMatches(ImagePair(rows[id0], rows[id1]), indices, np.ones(len(indices))))
    camera = next(iter(model.cameras.values()))
    images = [ImageRef(name, Path(name), (camera.width, camera.height)) for name in rows.values()]
    return Oracle(model, images, keypoints, matches)


@pytest.fixture(scope="module")
def oracle(tmp_path_factory) -> Oracle:
    return make_oracle(tmp_path_factory.mktemp("oracle"), num_images=6, num_points=150)


def make_known_camera(oracle: Oracle) -> pycolmap.Camera:
    camera = pycolmap.Camera(next(iter(oracle.model.cameras.values())).todict())
    camera.camera_id = 1
    camera.has_prior_focal_length = True
    return camera


def make_unknown_camera(oracle: Oracle) -> pycolmap.Camera:
    """COLMAP's guess: 4 % off the true focal length, and no distortion."""
    width, height = oracle.images[0].size_wh
    return pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 1.2 * max(width, height), width, height)


def write_and_verify(folder: Path, oracle: Oracle, camera: pycolmap.Camera) -> Path:
    path = folder / "database.db"
    write_database(path, oracle.images, Cameras((camera,), (0,) * len(oracle.images)), oracle.keypoints, oracle.matches)
    verify_database(path, VerificationConfig(), num_threads=1)
    return path


def assert_same_up_to_similarity(model: pycolmap.Reconstruction, expected: pycolmap.Reconstruction) -> None:
    errors = pycolmap.compare_reconstructions(
        model, expected, alignment_error="proj_center", max_proj_center_error=0.05
    )["errors"]
    assert len(errors) == expected.num_reg_images()
    assert max(error.rotation_error_deg for error in errors) < 0.01
    assert max(error.proj_center_error for error in errors) < 1e-3


# Mapping


@pytest.mark.parametrize("known", [True, False], ids=["known-intrinsics", "unknown-intrinsics"])
def test_model_equals_the_oracle(tmp_path, oracle, known):
    camera = make_known_camera(oracle) if known else make_unknown_camera(oracle)
    path = write_and_verify(tmp_path, oracle, camera)
    registered = []
    models = map_incrementally(
        MappingTask(path, tmp_path, tmp_path / "sparse", fix_intrinsics=known, on_image=lambda: registered.append(1))
    )
    assert len(models) == 1
    assert_same_up_to_similarity(models[0], oracle.model)
    assert len(registered) == 6
    params = models[0].cameras[1].params
    if known:
        np.testing.assert_array_equal(params, camera.params)
    np.testing.assert_allclose(params, next(iter(oracle.model.cameras.values())).params, rtol=1e-3)

    result = summarise_models(models, num_images=8)
    assert (result.num_images, result.registered, result.points) == (8, 6, models[0].num_points3D())
    assert result.points >= 140
    assert result.observations == models[0].compute_num_observations()
    assert result.mean_track_length == pytest.approx(result.observations / result.points)
    assert result.mean_reprojection_px < 0.01


def test_intrinsics_stay_as_given_even_where_they_are_wrong(tmp_path, oracle):
    camera = make_known_camera(oracle)
    camera.focal_length *= 1.002
    path = write_and_verify(tmp_path, oracle, camera)
    fixed = map_incrementally(MappingTask(path, tmp_path, tmp_path / "fixed", fix_intrinsics=True))
    free = map_incrementally(MappingTask(path, tmp_path, tmp_path / "free"))
    np.testing.assert_array_equal(fixed[0].cameras[1].params, camera.params)
    assert abs(free[0].cameras[1].focal_length - camera.focal_length) > 1.0


def test_observations_beyond_the_error_of_verification_are_dropped(tmp_path, oracle):
    rng = np.random.default_rng(0)
    noisy = [
        dataclasses.replace(points, xy=points.xy + rng.normal(0, 0.5, points.xy.shape)) for points in oracle.keypoints
    ]
    path = write_and_verify(
        tmp_path, Oracle(oracle.model, oracle.images, noisy, oracle.matches), make_known_camera(oracle)
    )
    observations = []
    for max_error_px in (3.0, 0.5):
        task = MappingTask(path, tmp_path, tmp_path / "sparse", max_error_px=max_error_px, fix_intrinsics=True)
        (model,) = map_incrementally(task)
        observations.append(model.compute_num_observations())
    assert 0 < observations[1] < 0.8 * observations[0]


def test_disjoint_scenes_give_two_models_largest_first(tmp_path):
    # The smaller scene has more points: the mapper starts there, so its own order is the wrong one.
    small = make_oracle(tmp_path, num_images=4, num_points=260, prefix="small/", seed=2)
    large = make_oracle(tmp_path, num_images=6, num_points=130, prefix="large/", seed=3)
    both = Oracle(
        large.model, small.images + large.images, small.keypoints + large.keypoints, small.matches + large.matches
    )
    path = write_and_verify(tmp_path, both, make_known_camera(large))
    sparse = tmp_path / "sparse"
    models = map_incrementally(MappingTask(path, tmp_path, sparse, fix_intrinsics=True))
    names = [{image.name.split("/")[0] for image in model.images.values()} for model in models]
    assert names == [{"large"}, {"small"}]
    assert [model.num_reg_images() for model in models] == [6, 4]
    assert sorted(folder.name for folder in sparse.glob("*/")) == ["0", "1"]
    for number, model in enumerate(models):
        stored = pycolmap.Reconstruction(sparse / str(number))
        assert stored.num_reg_images() == model.num_reg_images()
        assert stored.num_points3D() == model.num_points3D()


@pytest.mark.parametrize("with_matches", [False, True], ids=["no-matches", "unverified"])
def test_nothing_to_map_gives_no_model(tmp_path, oracle, with_matches):
    path = tmp_path / "database.db"
    matches = oracle.matches if with_matches else []
    camera = make_known_camera(oracle)
    write_database(path, oracle.images, Cameras((camera,), (0,) * 6), oracle.keypoints, matches)
    if not with_matches:
        verify_database(path, VerificationConfig())
    assert map_incrementally(MappingTask(path, tmp_path, tmp_path / "sparse")) == ()
    assert [entry.name for entry in tmp_path.iterdir()] == ["database.db"]

    result = summarise_models((), num_images=6)
    assert (result.models, result.num_images, result.registered, result.points) == ((), 6, 0, 0)
    assert (result.mean_track_length, result.mean_reprojection_px) == (0.0, 0.0)


def test_a_run_without_a_model_leaves_that_of_the_run_before_and_one_with_a_model_its_frame(tmp_path, oracle):
    path = write_and_verify(tmp_path, oracle, make_known_camera(oracle))
    task = MappingTask(path, tmp_path, tmp_path / "sparse", fix_intrinsics=True)
    (model,) = map_incrementally(task)
    model.transform(pycolmap.Sim3d(3.0, pycolmap.Rotation3d(np.array([0.5, 0.1, 2.0])), [500000.0, 4649776.0, 120.0]))
    (tmp_path / "sparse" / "aligned").mkdir()
    for name in ("0", "aligned"):
        model.write_binary(tmp_path / "sparse" / name)
    write_database(path, oracle.images, Cameras((make_known_camera(oracle),), (0,) * 6), oracle.keypoints, [])
    assert map_incrementally(task) == ()
    assert sorted(folder.name for folder in (tmp_path / "sparse").glob("*/")) == ["0", "aligned"]

    write_and_verify(tmp_path, oracle, make_known_camera(oracle))
    (again,) = map_incrementally(task)
    for image_id in model.reg_image_ids():
        placed, before = (one.image(image_id).projection_center() for one in (again, model))
        np.testing.assert_allclose(placed, before, atol=0.05)
    assert sorted(folder.name for folder in (tmp_path / "sparse").glob("*/")) == ["0", "0_kept", "aligned"]


def test_ctrl_c_leaves_the_earlier_models_and_nothing_else(tmp_path, oracle):
    path = write_and_verify(tmp_path, oracle, make_known_camera(oracle))
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    registered = []

    def interrupt() -> None:
        registered.append(1)
        signal.raise_signal(signal.SIGINT)

    # Shells start jobs in the background deaf to Ctrl-C.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            map_incrementally(MappingTask(path, tmp_path, tmp_path / "sparse", fix_intrinsics=True, on_image=interrupt))
    finally:
        signal.signal(signal.SIGINT, before)
    assert len(registered) == 1
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["database.db", "sparse"]
    assert (tmp_path / "sparse" / "0").is_dir()


def test_colmap_keeps_quiet(tmp_path, oracle, capfd):
    level = pycolmap.logging.minloglevel
    pycolmap.logging.info("a message to see that messages are captured")
    path = write_and_verify(tmp_path, oracle, make_known_camera(oracle))
    map_incrementally(MappingTask(path, tmp_path, tmp_path / "sparse", fix_intrinsics=True))
    lines = "".join(capfd.readouterr()).splitlines()
    assert len(lines) == 1 and lines[0].endswith("a message to see that messages are captured")
    assert pycolmap.logging.minloglevel == level


def test_missing_database_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="missing.db"):
        verify_database(tmp_path / "missing.db", VerificationConfig())
    with pytest.raises(InputError, match="missing.db"):
        map_incrementally(MappingTask(tmp_path / "missing.db", tmp_path, tmp_path / "sparse"))
    assert not list(tmp_path.iterdir())


# Photos of other sizes than the matching resolution


def add_noise(oracle: Oracle, sigma_px: float) -> Oracle:
    rng = np.random.default_rng(0)
    noisy = [
        dataclasses.replace(points, xy=points.xy + rng.normal(0, sigma_px, points.xy.shape))
        for points in oracle.keypoints
    ]
    return dataclasses.replace(oracle, keypoints=noisy)


@dataclass(frozen=True)
class Result:
    """Of one run: its models, the inliers of each pair, and what it was given."""

    models: tuple[pycolmap.Reconstruction, ...]
    inliers: list[int]
    px_scale: dict[str, float]
    keypoints: list[Keypoints]


def map_scaled(folder: Path, oracle: Oracle, scales: list[float], task: MappingTask, known: bool) -> Result:
    """The oracle in photos that are `scales` times as large, each with a camera of its own: database, then models."""
    folder.mkdir(parents=True)
    images, cameras, keypoints = [], [], []
    for number, scale in enumerate(scales):
        camera = make_known_camera(oracle) if known else make_unknown_camera(oracle)
        camera.camera_id = number + 1
        camera.width, camera.height = round(camera.width * scale), round(camera.height * scale)
        camera.params = np.array(camera.params) * [scale, scale, scale, 1.0]
        cameras.append(camera)
        images.append(dataclasses.replace(oracle.images[number], size_wh=(camera.width, camera.height)))
        keypoints.append(dataclasses.replace(oracle.keypoints[number], xy=oracle.keypoints[number].xy * scale))
    all_cameras = Cameras(tuple(cameras), tuple(range(len(images))), known=known)
    px_scale = {image.name: scale for image, scale in zip(images, scales)}
    path = folder / "database.db"
    write_database(path, images, all_cameras, keypoints, oracle.matches)
    verify_database(path, VerificationConfig(), px_scale, num_threads=1)
    task = dataclasses.replace(
        task, database=path, image_folder=folder, sparse_folder=folder / "sparse", px_scale=px_scale
    )
    models = map_images(task, images, all_cameras)
    with open_database(path) as database:
        inliers = [len(geometry.inlier_matches) for geometry in database.read_two_view_geometries()[1]]
    return Result(models, inliers, px_scale, keypoints)


@pytest.mark.slow
@pytest.mark.parametrize("mapper", ["incremental", "global"])
def test_the_model_does_not_depend_on_the_size_of_the_photos(tmp_path, oracle, mapper):
    noisy = add_noise(oracle, 0.7)  # of some observations more than the 3 px that are allowed if it counts six times
    task = MappingTask(tmp_path, tmp_path, tmp_path, MappingConfig(mapper=mapper))
    expected = map_scaled(tmp_path / "1", noisy, [1.0] * 6, task, known=True)
    (model,) = expected.models
    assert model.num_reg_images() == 6
    for name, scales in {"quarter": [0.25] * 6, "six": [6.0] * 6, "mixed": [1.0, 6.0, 0.25, 1.0, 6.0, 1.0]}.items():
        result = map_scaled(tmp_path / name, noisy, scales, task, known=True)
        np.testing.assert_allclose(result.inliers, expected.inliers, atol=1)
        (scaled,) = result.models
        assert scaled.compute_num_observations() == pytest.approx(model.compute_num_observations(), rel=0.01)
        assert scaled.num_points3D() == pytest.approx(model.num_points3D(), abs=2)
        errors = pycolmap.compare_reconstructions(
            scaled, model, alignment_error="proj_center", max_proj_center_error=0.05
        )["errors"]
        assert len(errors) == 6 and max(error.rotation_error_deg for error in errors) < 0.05
        if name != "mixed":
            error_px = scaled.compute_mean_reprojection_error() / scales[0]
            assert error_px == pytest.approx(model.compute_mean_reprojection_error(), rel=0.02)
        stored = pycolmap.Reconstruction(tmp_path / name / "sparse" / "0")
        assert_in_stored_px(stored, result)


def assert_in_stored_px(model: pycolmap.Reconstruction, result: Result) -> None:
    """Keypoints to the last bit, and cameras that project the points onto them."""
    xy_of = {points.name: points.xy for points in result.keypoints}
    for image in model.images.values():
        xy = np.array([point.xy for point in image.points2D])
        np.testing.assert_array_equal(xy, xy_of[image.name])
        seen = image.get_observation_points2D()
        projected = np.array([image.project_point(model.points3D[point.point3D_id].xyz) for point in seen])
        distance_px = np.linalg.norm(projected - [point.xy for point in seen], axis=1)
        assert np.median(distance_px) < 1.5 * result.px_scale[image.name]


def test_unknown_intrinsics_and_colours_of_large_photos(tmp_path, oracle, monkeypatch):
    # Photos of a quarter of the size, to save time: their left half is red, their right half blue.
    pixels = np.zeros((192, 256, 3), np.uint8)
    pixels[:, :128, 0], pixels[:, 128:, 2] = 255, 255
    folder = tmp_path / "run"
    task = MappingTask(tmp_path, tmp_path, tmp_path)
    for image in oracle.images:
        pycolmap.Bitmap.from_array(pixels).write(tmp_path / image.name)
    monkeypatch.setattr(hm_sfm.colmap.mapping, "open_to_colmap", lambda images, _: nullcontext(tmp_path))
    result = map_scaled(folder, oracle, [0.25] * 6, task, known=False)
    (model,) = result.models
    true = next(iter(oracle.model.cameras.values())).params
    for camera in model.cameras.values():
        assert (camera.width, camera.height) == (256, 192)
        np.testing.assert_allclose(camera.params, np.array(true) * [0.25, 0.25, 0.25, 1.0], rtol=1e-2)
    shares = []
    for point in model.points3D.values():
        x = np.array([model.images[seen.image_id].points2D[seen.point2D_idx].xy[0] for seen in point.track.elements])
        if np.all(np.abs(x - 128) > 2):
            shares.append(np.mean(x < 128))
            np.testing.assert_allclose(point.color, (255 * shares[-1], 0, 255 * (1 - shares[-1])), atol=1)
    assert len(shares) > 50 and len(set(shares)) > 2


# Snapshots

KILLED_MAPPING = """
import os, signal, sys
from pathlib import Path
from hm_sfm.colmap import mapping

mapping.SNAPSHOT_IMAGES = 3
registered = []

def kill_at_nine():
    registered.append(1)
    if len(registered) == 9:
        os.kill(os.getpid(), signal.SIGKILL)

folder = Path(sys.argv[1])
task = mapping.MappingTask(
    folder / "database.db", folder, folder / "sparse", fix_intrinsics=True, on_image=kill_at_nine
)
mapping.map_incrementally(task)
"""


@pytest.fixture
def inputs_of_mapper(monkeypatch) -> list[Path | str]:
    """Grows by what each call of the mapper goes on from; snapshots are made often."""
    calls: list[Path | str] = []
    run = pycolmap.incremental_mapping
    monkeypatch.setattr(hm_sfm.colmap.mapping, "SNAPSHOT_IMAGES", 3)
    monkeypatch.setattr(
        hm_sfm.colmap.mapping.pycolmap,
        "incremental_mapping",
        lambda *args, **options: (calls.append(options["input_path"]), run(*args, **options))[1],
    )
    return calls


@pytest.mark.slow
def test_a_killed_mapping_goes_on_from_its_newest_snapshot(tmp_path, inputs_of_mapper):
    oracle = make_oracle(tmp_path, num_images=12, num_points=100, seed=5)
    folder = tmp_path / "out"
    folder.mkdir()
    path = write_and_verify(folder, oracle, make_known_camera(oracle))
    killed = subprocess.run([sys.executable, "-c", KILLED_MAPPING, str(folder)], timeout=60, check=False)
    assert killed.returncode == -signal.SIGKILL
    (snapshot,) = (folder / "snapshots").iterdir()
    stored = int(snapshot.suffix[1:])
    assert 5 <= stored <= 9 and pycolmap.Reconstruction(snapshot).num_reg_images() == stored
    (left,) = folder.glob(".sparse.*")  # of the killed process, with a snapshot that it may have been writing
    (left / "growing" / "9999999999999").mkdir(parents=True)
    (left / "growing" / "9999999999999" / "cameras.bin").write_bytes(b"\1")
    other = Path(shutil.copytree(folder, tmp_path / "other"))

    path = write_and_verify(folder, oracle, make_known_camera(oracle))  # as reconstruct does
    registered = []
    models = map_incrementally(
        MappingTask(path, folder, folder / "sparse", fix_intrinsics=True, on_image=lambda: registered.append(1))
    )
    assert inputs_of_mapper == [snapshot]
    assert len(models) == 1 and len(registered) == 12
    assert_same_up_to_similarity(models[0], oracle.model)
    assert sorted(entry.name for entry in folder.iterdir()) == ["database.db", "sparse"]

    # Not with another configuration.
    (model,) = map_incrementally(
        MappingTask(other / "database.db", other, other / "sparse", MappingConfig(seed=1), fix_intrinsics=True)
    )
    assert inputs_of_mapper[1:] == [""] and model.num_reg_images() == 12
    assert sorted(entry.name for entry in other.iterdir()) == ["database.db", "sparse"]


def test_what_snapshots_are_made_from(tmp_path, oracle):
    path = write_and_verify(tmp_path, oracle, make_known_camera(oracle))
    first = digest_inputs(path, MappingConfig(), 3.0, True)
    assert digest_inputs(path, MappingConfig(min_model_size=3), 3.0, True) != first
    assert digest_inputs(path, MappingConfig(), 3.0, False) != first
    assert digest_inputs(path, MappingConfig(), 2.9, True) != first
    write_and_verify(tmp_path, oracle, make_unknown_camera(oracle))
    assert digest_inputs(path, MappingConfig(), 3.0, True) != first
    write_and_verify(tmp_path, oracle, make_known_camera(oracle))
    assert digest_inputs(path, MappingConfig(), 3.0, True) == first
    with open_database(path) as database:
        database.delete_matches(1, 2)
    assert digest_inputs(path, MappingConfig(), 3.0, True) != first


# Other mappers


def read_geometry(path: Path) -> tuple[list, list]:
    """The cameras of a database, and the kinds of its two-view geometries."""
    with open_database(path) as database:
        cameras = [camera.params.tolist() for camera in database.read_all_cameras()]
        return cameras, [geometry.config for geometry in database.read_two_view_geometries()[1]]


@pytest.mark.parametrize("known", [True, False], ids=["known-intrinsics", "unknown-intrinsics"])
def test_the_global_mapper_builds_the_oracle(tmp_path, oracle, known, capfd):
    camera = make_known_camera(oracle) if known else make_unknown_camera(oracle)
    path = write_and_verify(tmp_path, oracle, camera)
    before = read_geometry(path)
    registered = []
    config = MappingConfig(mapper="global")
    cameras = Cameras((camera,), (0,) * 6, known=known)
    capfd.readouterr()
    models = map_images(
        MappingTask(path, tmp_path, tmp_path / "sparse", config, on_image=lambda: registered.append(1)),
        oracle.images,
        cameras,
    )
    assert capfd.readouterr().err == ""
    assert read_geometry(path) == before
    assert len(models) == 1 and len(registered) == 6
    assert_same_up_to_similarity(models[0], oracle.model)
    params = models[0].cameras[1].params
    if known:
        np.testing.assert_array_equal(params, camera.params)
    np.testing.assert_allclose(params, next(iter(oracle.model.cameras.values())).params, rtol=1e-3)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["database.db", "sparse"]
    assert [folder.name for folder in (tmp_path / "sparse").glob("*/")] == ["0"]
    assert pycolmap.Reconstruction(tmp_path / "sparse" / "0").num_points3D() == models[0].num_points3D() >= 140


def test_the_global_mapper_without_matches_gives_no_model(tmp_path, oracle):
    path = tmp_path / "database.db"
    write_database(path, oracle.images, Cameras((make_known_camera(oracle),), (0,) * 6), oracle.keypoints, [])
    assert map_globally(MappingTask(path, tmp_path, tmp_path / "sparse")) == ()
    assert not (tmp_path / "sparse").exists()


def make_posed_cameras(oracle: Oracle) -> Cameras:
    poses = {image.name: image.cam_from_world() for image in oracle.model.images.values()}
    names = [image.name.removeprefix("posed/") for image in oracle.images]
    return Cameras(
        (make_known_camera(oracle),), (0,) * len(names), known=True, cam_from_world=tuple(poses[name] for name in names)
    )


def test_known_poses_are_kept_and_points_triangulated(tmp_path):
    oracle = make_oracle(tmp_path, num_images=6, num_points=150, prefix="posed/", seed=4)
    cameras = make_posed_cameras(oracle)
    # The last image has no match: it keeps its pose.
    lonely = oracle.images[-1].name
    matches = [some for some in oracle.matches if lonely not in (some.pair.name0, some.pair.name1)]
    path = write_and_verify(
        tmp_path, Oracle(oracle.model, oracle.images, oracle.keypoints, matches), cameras.cameras[0]
    )
    config = MappingConfig(mapper="global")  # has nothing to say
    registered = []
    sparse = tmp_path / "sparse"
    models = map_images(
        MappingTask(path, tmp_path, sparse, config, on_image=lambda: registered.append(1)), oracle.images, cameras
    )
    assert len(models) == 1 and len(registered) == 6
    stored = pycolmap.Reconstruction(sparse / "0")
    assert {image.name for image in stored.images.values()} == {image.name for image in oracle.images}
    for image in stored.images.values():
        expected = cameras.cam_from_world[image.image_id - 1].matrix()
        np.testing.assert_allclose(image.cam_from_world().matrix(), expected, atol=1e-12)
    np.testing.assert_array_equal(stored.cameras[1].params, cameras.cameras[0].params)
    assert stored.num_points3D() >= 140
    true_points = np.array([point.xyz for point in oracle.model.points3D.values()])
    points = np.array([point.xyz for point in stored.points3D.values()])
    distance = np.linalg.norm(points[:, None] - true_points[None], axis=2).min(axis=1)
    assert np.quantile(distance, 0.9) < 1e-3


def test_wrong_poses_give_no_model(tmp_path, oracle):
    cameras = make_posed_cameras(oracle)
    backwards = tuple(
        pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, np.pi * number / 3, 0.0])), [9.0 * number, 5, 0])
        for number in range(6)
    )
    wrong = Cameras(cameras.cameras, cameras.camera_index, known=True, cam_from_world=backwards)
    path = write_and_verify(tmp_path, oracle, cameras.cameras[0])
    models = map_images(MappingTask(path, tmp_path, tmp_path / "sparse"), oracle.images, wrong)
    assert sum(model.num_points3D() for model in models) < 30
    assert bool(models) == (tmp_path / "sparse").exists()


def take_photos(oracle: Oracle, chosen: list[int]) -> Oracle:
    """Some photos of the scene, and the matches between them."""
    names = {oracle.images[index].name for index in chosen}
    return Oracle(
        oracle.model,
        [oracle.images[index] for index in chosen],
        [oracle.keypoints[index] for index in chosen],
        [some for some in oracle.matches if {some.pair.name0, some.pair.name1} <= names],
    )


def choose_near_pair(oracle: Oracle, prefix: str = "") -> list[int]:
    """The two photos whose directions of view differ least, but by more than 7 degrees."""
    directions = {prefix + image.name: image.viewing_direction() for image in oracle.model.images.values()}
    angle_deg = {
        (i, j): np.degrees(np.arccos(directions[oracle.images[i].name] @ directions[oracle.images[j].name]))
        for i, j in itertools.combinations(range(len(oracle.images)), 2)
    }
    return list(min((pair for pair in angle_deg if angle_deg[pair] > 7), key=angle_deg.get))


@pytest.mark.parametrize("mapper", ["incremental", "global", "poses"])
def test_two_photos_give_a_model(tmp_path, oracle, mapper):
    chosen = choose_near_pair(oracle)
    two = take_photos(oracle, chosen)
    camera = make_known_camera(oracle)
    path = write_and_verify(tmp_path, two, camera)
    cameras = Cameras((camera,), (0, 0), known=True)
    if mapper == "poses":
        poses = make_posed_cameras(oracle).cam_from_world
        cameras = dataclasses.replace(cameras, cam_from_world=tuple(poses[index] for index in chosen))
    config = MappingConfig() if mapper == "poses" else MappingConfig(mapper=mapper)
    registered = []
    task = MappingTask(path, tmp_path, tmp_path / "sparse", config, on_image=lambda: registered.append(1))
    (model,) = map_images(task, two.images, cameras)
    assert model.num_reg_images() == len(registered) == 2 and model.num_points3D() > 100
    poses = {image.name: image.cam_from_world() for image in oracle.model.images.values()}
    true = poses[two.images[1].name] * poses[two.images[0].name].inverse()
    names = {image.name: image.cam_from_world() for image in model.images.values()}
    estimate = names[two.images[1].name] * names[two.images[0].name].inverse()
    assert np.degrees((estimate.rotation * true.rotation.inverse()).angle()) < 0.05


def test_two_photos_of_another_place_are_a_second_model(tmp_path, oracle):
    other = make_oracle(tmp_path, num_images=6, num_points=150, prefix="other/", seed=7)
    two = take_photos(other, choose_near_pair(other, "other/"))
    both = Oracle(
        oracle.model, oracle.images + two.images, oracle.keypoints + two.keypoints, oracle.matches + two.matches
    )
    path = write_and_verify(tmp_path, both, make_known_camera(oracle))
    first, second = map_incrementally(MappingTask(path, tmp_path, tmp_path / "sparse", fix_intrinsics=True))
    assert_same_up_to_similarity(first, oracle.model)
    assert {image.name for image in second.images.values() if image.has_pose} == {image.name for image in two.images}


def test_verification_replaces_earlier_geometries_and_drops_planted_outliers(tmp_path, oracle):
    path = write_and_verify(tmp_path, oracle, make_known_camera(oracle))
    first = oracle.matches[0]
    with open_database(path) as database:
        image_ids = {image.name: image.image_id for image in database.read_all_images()}
    id0, id1 = image_ids[first.pair.name0], image_ids[first.pair.name1]
    wrong = first.indices.copy()
    wrong[:20, 1] = np.roll(wrong[:20, 1], 7)
    with pycolmap.Database.open(path) as database:
        database.delete_matches(id0, id1)
        database.write_matches(id0, id1, wrong)
    verify_database(path, VerificationConfig(max_error_px=1.0), num_threads=1)
    with pycolmap.Database.open(path) as database:
        inliers = {tuple(row) for row in database.read_two_view_geometry(id0, id1).inlier_matches.tolist()}
    assert {tuple(row) for row in wrong[20:].tolist()} <= inliers
    assert len(inliers & {tuple(row) for row in wrong[:20].tolist()}) <= 2  # a wrong one may lie on its epipolar line

    verify_database(path, VerificationConfig(max_error_px=1.0, min_inliers=10_000), num_threads=1)
    with pycolmap.Database.open(path) as database:
        assert database.num_inlier_matches() == 0
    assert map_incrementally(MappingTask(path, tmp_path, tmp_path / "sparse", fix_intrinsics=True)) == ()


def test_a_large_photo_does_not_loosen_the_limits_of_other_pairs(tmp_path):
    pair, camera, right = make_pair(300, 0.3, True)
    camera.camera_id = 1
    xy0, xy1 = pair.xy0, pair.xy1.copy()
    xy1[~right] = xy1[~right] + np.random.default_rng(1).choice([-1, 1], ((~right).sum(), 2)) * [7.0, 9.0]
    images = [ImageRef(name, Path(name), SIZE_WH) for name in ("a.jpg", "b.jpg", "large.jpg")]
    keypoints = [
        Keypoints(image.name, xy, np.ones(len(xy)), np.ones(len(xy)))
        for image, xy in zip(images, (xy0, xy1, np.zeros((0, 2))))
    ]
    matches = IndexMatches(pair.pair, np.repeat(np.arange(300)[:, None], 2, axis=1), np.ones(300))
    path = tmp_path / "database.db"
    write_database(path, images, Cameras((camera,), (0, 0, 0)), keypoints, [matches])
    verify_database(path, VerificationConfig(), num_threads=1)
    (expected,) = read_verified_matches(path).values()
    verify_database(path, VerificationConfig(), {"a.jpg": 1.0, "b.jpg": 1.0, "large.jpg": 30.0}, num_threads=1)
    (inliers,) = read_verified_matches(path).values()
    np.testing.assert_array_equal(inliers, expected)
    assert len(expected) == pytest.approx(right.sum(), abs=6)


@pytest.mark.parametrize(("prior", "factor"), [(True, 1.0), (False, 0.46), (False, 1.4)])
def test_a_dominant_plane_keeps_what_stands_before_it_in_the_database(tmp_path, prior, factor):
    both, camera = make_facade(prior, factor)
    camera.camera_id = 1
    images = [ImageRef(name, Path(name), SIZE_WH) for name in ("a.jpg", "b.jpg")]
    count = len(both)
    keypoints = [
        Keypoints(image.name, xy, np.ones(count), np.ones(count)) for image, xy in zip(images, (both.xy0, both.xy1))
    ]
    matches = IndexMatches(both.pair, np.repeat(np.arange(count)[:, None], 2, axis=1), np.ones(count))
    path = tmp_path / "database.db"
    write_database(path, images, Cameras((camera,), (0, 0)), keypoints, [matches])
    for px_scale in ({}, dict.fromkeys(("a.jpg", "b.jpg"), 1.5)):
        verify_database(path, VerificationConfig(), px_scale, num_threads=1)
        (inliers,) = read_verified_matches(path).values()
        assert len(inliers) >= 0.99 * count
        with open_database(path) as database:
            (stored,) = database.read_two_view_geometries()[1]
            assert database.read_all_cameras()[0].has_prior_focal_length == prior
        # F and H are px of the stored photos again.
        homogeneous = np.column_stack([both.xy0, np.ones(count)]) @ stored.H.T
        distance_px = np.linalg.norm(homogeneous[:400, :2] / homogeneous[:400, 2:] - both.xy1[:400], axis=1)
        assert np.median(distance_px) < 1.0
    assert [entry.name for entry in tmp_path.iterdir()] == ["database.db"]


def test_track_length_counts_distinct_images(oracle):
    model = pycolmap.Reconstruction(oracle.model)
    before = summarise_models([model], 6)
    image = model.images[min(model.images)]
    spare = next(index for index, point in enumerate(image.points2D) if not point.has_point3D())
    seen = next(point.point3D_id for point in image.points2D if point.has_point3D())
    model.add_observation(seen, pycolmap.TrackElement(image.image_id, spare))
    after = summarise_models([model], 6)
    assert after.observations == before.observations + 1
    assert after.mean_track_length == before.mean_track_length > 2


# Verification of one pair

SIZE_WH = (1024, 768)


def make_matches(xy0: np.ndarray, xy1: np.ndarray, name0: str = "a.jpg", name1: str = "b.jpg") -> PairMatches:
    return PairMatches(
        pair=ImagePair(name0, name1),
        xy0=xy0,
        xy1=xy1,
        score=np.ones(len(xy0)),
        homography=np.tile(np.eye(3), (len(xy0), 1, 1)),
        patch_radius_px=8.0,
    )


def make_pair(
    num_matches: int, wrong_part: float, prior: bool, shape: str = "deep"
) -> tuple[PairMatches, pycolmap.Camera, np.ndarray]:
    """Exact matches of two cameras side by side, some moved far off their (level) epipolar lines.

    They are moved in both axes: on a plane, matches that were all moved in one direction would fit an epipolar
    geometry of their own.

    Returns the matches, the camera of both images, and (M,) bool: which are right.
    """
    rng = np.random.default_rng(0)
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 1000.0, *SIZE_WH)
    camera.params = [1000.0, 512.0, 384.0, -0.05]
    camera.has_prior_focal_length = prior
    xy0 = rng.uniform((150, 20), (1004, 748), (num_matches, 2))
    rays = np.column_stack([camera.cam_from_img(xy0), np.ones(num_matches)])
    depth = rng.uniform(4, 9, num_matches) if shape == "deep" else np.full(num_matches, 5.0)
    shift = 0.0 if shape == "turning" else 0.6
    angle = 0.1
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    xy1 = camera.img_from_cam((rays * depth[:, None]) @ turn.T - [shift, 0, 0])
    right = rng.random(num_matches) >= wrong_part
    moved = ((~right).sum(), 2)
    xy1[~right] += rng.choice([-1, 1], moved) * rng.uniform(25, 90, moved)
    return make_matches(xy0, xy1), camera, right


@pytest.mark.parametrize("prior", [True, False], ids=["calibrated", "uncalibrated"])
@pytest.mark.parametrize("shape", ["deep", "planar", "turning"])
@pytest.mark.parametrize("num_matches", [200, 3000])
def test_planted_outliers_are_rejected(num_matches, shape, prior):
    # Exact where one geometry alone can fit. An essential matrix that only a plane determines is free to take in a few
    # wrong matches, and a fundamental matrix or a homography fits distorted images only roughly.
    tolerance = 0.0 if prior and shape == "deep" else 0.04
    pair, camera, right = make_pair(num_matches, 0.3, prior, shape)
    mask = verify_pair(pair, camera, camera, VerificationConfig())
    assert mask.shape == (num_matches,) and mask.dtype == bool
    assert np.mean(mask != right) <= tolerance
    np.testing.assert_array_equal(mask, verify_pair(pair, camera, camera, VerificationConfig()))


def make_facade(prior: bool, factor: float = 1.0) -> tuple[PairMatches, pycolmap.Camera]:
    """400 matches on a plane, then 60 before it; the focal length of the camera is off by a factor."""
    rng = np.random.default_rng(0)
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 2000.0, *SIZE_WH)
    xy0 = rng.uniform((20, 20), (1004, 748), (460, 2))
    rays = np.column_stack([camera.cam_from_img(xy0), np.ones(460)])
    points = rays * np.r_[np.full(400, 5.0), rng.uniform(3, 4.5, 60)][:, None]
    angle = 0.15
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    xy1 = np.array(camera.img_from_cam(points @ turn.T - [0.7, 0.1, 0]))
    camera.focal_length *= factor
    camera.has_prior_focal_length = prior
    noise = rng.normal(0, 0.3, (2, 460, 2))
    return make_matches(xy0 + noise[0], xy1 + noise[1]), camera


@pytest.mark.parametrize(("prior", "factor"), [(True, 1.0), (False, 0.3), (False, 0.46), (False, 1.4), (False, 2.5)])
def test_a_dominant_plane_does_not_cost_what_stands_before_it(prior, factor):
    both, camera = make_facade(prior, factor)
    inliers = verify_pair(both, camera, camera, VerificationConfig())
    assert inliers[:400].mean() >= 0.99 and inliers[400:].mean() >= 0.95


def make_fisheye_pair() -> tuple[PairMatches, pycolmap.Camera]:
    """Matches all over two fisheye images of 130 degrees, a tenth wrong, and the first guess of their camera."""
    rng = np.random.default_rng(0)
    true = pycolmap.Camera.create_from_model_name(1, "OPENCV_FISHEYE", 211.0, 480, 360)
    guess = pycolmap.Camera.create_from_model_name(1, "OPENCV_FISHEYE", 0.41 * 480, 480, 360)
    directions = rng.normal(size=(3000, 3)) * [1.0, 1.0, 0.6]
    points = directions[directions[:, 2] > 0.1] * rng.uniform(3, 9, ((directions[:, 2] > 0.1).sum(), 1))
    angle = 0.2
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    other = points @ turn.T - [0.8, 0.1, 0.1]
    xy0, xy1 = np.array(true.img_from_cam(points)), np.array(true.img_from_cam(other))
    inside = np.all((xy0 > 0) & (xy0 < (480, 360)) & (xy1 > 0) & (xy1 < (480, 360)), axis=1) & (other[:, 2] > 0.1)
    xy0, xy1 = xy0[inside][:400], xy1[inside][:400]
    xy1[::10] = rng.uniform((0, 0), (480, 360), (40, 2))
    return make_matches(xy0, xy1), guess


def test_fisheye_pairs_are_verified_without_a_known_focal_length(tmp_path):
    pair, camera = make_fisheye_pair()
    right = np.arange(400) % 10 > 0
    config = VerificationConfig()
    mask = verify_pair(pair, camera, camera, config)
    assert mask[right].mean() > 0.9 and mask[~right].mean() < 0.3

    images = [ImageRef(name, Path(name), (480, 360)) for name in ("a.jpg", "b.jpg")]
    keypoints = [Keypoints(i.name, xy, np.ones(400), np.ones(400)) for i, xy in zip(images, (pair.xy0, pair.xy1))]
    matches = IndexMatches(pair.pair, np.repeat(np.arange(400)[:, None], 2, axis=1), np.ones(400))
    path = tmp_path / "database.db"
    write_database(path, images, Cameras((camera,), (0, 0)), keypoints, [matches])
    verify_database(path, config, num_threads=1)
    (inliers,) = read_verified_matches(path).values()
    assert np.isin(np.flatnonzero(right), inliers[:, 0]).mean() > 0.9
    with open_database(path) as database:
        assert not database.read_all_cameras()[0].has_prior_focal_length


def test_pairs_below_the_limits_are_rejected():
    pair, camera, right = make_pair(200, 0.3, True)
    count = int(right.sum())

    def limit(min_inliers: int, min_inlier_ratio: float) -> VerificationConfig:
        return VerificationConfig(min_inliers=min_inliers, min_inlier_ratio=min_inlier_ratio)

    assert verify_pair(pair, camera, camera, limit(count, count / 200)).sum() == count
    assert not verify_pair(pair, camera, camera, limit(count + 1, 0.25)).any()
    assert not verify_pair(pair, camera, camera, limit(30, (count + 1) / 200)).any()


def test_random_matches_are_rejected():
    rng = np.random.default_rng(0)
    _, camera, _ = make_pair(10, 0.0, True)
    matches = make_matches(*rng.uniform((0, 0), SIZE_WH, (2, 500, 2)))
    assert not verify_pair(matches, camera, camera, VerificationConfig()).any()


@pytest.mark.parametrize("count", [0, 1, 7])
def test_too_few_matches_are_rejected(count):
    pair, camera, _ = make_pair(count, 0.0, True)
    mask = verify_pair(pair, camera, camera, VerificationConfig(min_inliers=0, min_inlier_ratio=0.0))
    assert mask.shape == (count,) and not mask.any()


def test_many_pairs_keep_those_that_agree_with_spread_inliers_as_the_strongest():
    spread, camera, right = make_pair(400, 0.3, True)
    # As many inliers, but all within one corner of image 0.
    corner, _, _ = make_pair(4000, 0.0, True)
    chosen = np.flatnonzero((corner.xy0[:, 0] > 700) & (corner.xy0[:, 1] > 500))[: right.sum()]
    images = [ImageRef(name, Path(name), SIZE_WH) for name in ("a.jpg", "b.jpg", "c.jpg")]
    stored = {
        matches.pair: matches
        for matches in (
            spread,
            make_matches(corner.xy0[chosen], corner.xy1[chosen], "a.jpg", "c.jpg"),
            make_matches(spread.xy0, spread.xy1[::-1], "b.jpg", "c.jpg"),
        )
    }
    cameras = dict.fromkeys(("a.jpg", "b.jpg", "c.jpg"), camera)
    # The limit is 3 px of an image that was reduced to a tenth: 30 px, far enough for some of the wrong matches.
    reduced = {"a.jpg": 1.0, "b.jpg": 10.0, "c.jpg": 1.0}
    config = VerificationConfig()
    verified = verify_pairs(images, list(stored), stored.get, cameras, dict.fromkeys(cameras, 1.0), config, quiet=True)
    assert list(verified) == [ImagePair("a.jpg", "b.jpg"), ImagePair("a.jpg", "c.jpg")]
    np.testing.assert_array_equal(verified[spread.pair].inliers, right)
    assert verified[ImagePair("a.jpg", "c.jpg")].strength < verified[spread.pair].strength <= right.sum()
    loose = verify_pairs(images, [spread.pair], stored.get, cameras, reduced, config, quiet=True)
    assert loose[spread.pair].inliers.sum() > right.sum()


def test_no_pairs_verify_to_nothing():
    assert verify_pairs([], [], None, {}, {}, VerificationConfig(), quiet=True) == {}


# Through the files of hloc


def test_oracle_matches_through_hlocs_files_give_the_oracles_model(tmp_path, oracle):
    pairs = [matches.pair for matches in oracle.matches]
    px_scales = {image.name: 1.0 for image in oracle.images}
    write_features(tmp_path / "features.h5", oracle.images, oracle.keypoints, px_scales)
    write_matches(tmp_path / "matches.h5", pairs, oracle.keypoints, oracle.matches)
    keypoints = list(read_features(tmp_path / "features.h5", oracle.images))
    matches = list(read_matches(tmp_path / "matches.h5", pairs, keypoints))
    read = Oracle(oracle.model, oracle.images, keypoints, matches)
    path = write_and_verify(tmp_path, read, make_known_camera(oracle))
    (model,) = map_incrementally(MappingTask(path, tmp_path, tmp_path / "sparse", fix_intrinsics=True))
    assert_same_up_to_similarity(model, oracle.model)
    assert summarise_models([model], 6).mean_reprojection_px < 0.01


def test_few_inliers_must_be_most_of_the_matches():
    config = VerificationConfig(min_inliers=30, min_inlier_ratio=0.25, doubtful_inlier_ratio=0.6, sure_inliers=300)
    assert is_convincing(300, 1200, config) and not is_convincing(299, 1200, config)
    assert is_convincing(40, 60, config) and not is_convincing(40, 110, config)
    assert is_convincing(150, 350, config) and not is_convincing(150, 360, config)
    assert not is_convincing(0, 0, config)


def test_a_pair_with_few_true_matches_among_wrong_ones_is_not_verified():
    pair, camera, right = make_pair(120, 0.65, True)
    cameras = dict.fromkeys((pair.pair.name0, pair.pair.name1), camera)
    images = [ImageRef(name, Path(name), SIZE_WH) for name in cameras]

    def verify(doubtful_inlier_ratio: float) -> dict:
        config = VerificationConfig(doubtful_inlier_ratio=doubtful_inlier_ratio)
        px_scales = dict.fromkeys(cameras, 1.0)
        return verify_pairs(images, [pair.pair], lambda _: pair, cameras, px_scales, config, quiet=True)

    assert 30 <= right.sum() <= 50
    assert list(verify(0.25)) == [pair.pair] and not verify(0.6)
