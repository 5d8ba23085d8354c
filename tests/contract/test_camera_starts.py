"""Wrong first guesses of cameras, and models that cannot be right: scenes of which the cameras are known."""

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from hm_sfm.colmap import mapping_attempts
from hm_sfm.colmap.camera_starts import correct_focal_lengths, find_doubtful, split_cameras
from hm_sfm.colmap.cameras import Cameras, guess_focal_px
from hm_sfm.colmap.database import open_database, write_database
from hm_sfm.colmap.mapping import MappingTask, map_images, map_incrementally
from hm_sfm.colmap.model_judgement import find_undetermined, is_impossible, judge_model
from hm_sfm.colmap.verification import verify_database
from hm_sfm.config import Config, VerificationConfig
from hm_sfm.pipeline import run
from hm_sfm.pipeline.collection import Collection
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints

SIZE_WH = (640, 480)
FOCAL_PX = 520.0


@dataclass(frozen=True)
class Scene:
    """Photos of points, and the poses that they were taken from."""

    images: tuple[ImageRef, ...]
    keypoints: tuple[Keypoints, ...]
    matches: tuple[IndexMatches, ...]
    cam_from_world: tuple[np.ndarray, ...]


def take_photos(
    points: np.ndarray, poses: Sequence[np.ndarray], lenses: Sequence[pycolmap.Camera], noise_px: float
) -> Scene:
    """points: (P, 3). poses: (3, 4) each, cam_from_world. lenses: one for each photo."""
    rng = np.random.default_rng(1)
    images, keypoints, seen_by = [], [], []
    for number, (pose, lens) in enumerate(zip(poses, lenses, strict=True)):
        in_camera = points @ pose[:, :3].T + pose[:, 3]
        xy = np.array(lens.img_from_cam(in_camera))
        seen = np.flatnonzero(np.all((xy > 0) & (xy < SIZE_WH), axis=1) & (in_camera[:, 2] > 0))
        xy = xy[seen] + rng.normal(0, noise_px, (len(seen), 2))
        images.append(ImageRef(f"{number}.jpg", Path(f"{number}.jpg"), SIZE_WH))
        keypoints.append(Keypoints(f"{number}.jpg", xy, np.ones(len(seen)), np.ones(len(seen))))
        seen_by.append(seen)
    matches = []
    for i, j in itertools.combinations(range(len(images)), 2):
        _, in_i, in_j = np.intersect1d(seen_by[i], seen_by[j], return_indices=True)
        pair = ImagePair(images[i].name, images[j].name)
        matches.append(IndexMatches(pair, np.column_stack([in_i, in_j]), np.ones(len(in_i))))
    return Scene(tuple(images), tuple(keypoints), tuple(matches), tuple(poses))


def look_at(centre: Sequence[float], target: Sequence[float], roll_deg: float) -> np.ndarray:
    forward = np.subtract(target, centre) / np.linalg.norm(np.subtract(target, centre))
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    angle = np.radians(roll_deg)
    down = np.cross(forward, right)
    right, down = np.cos(angle) * right + np.sin(angle) * down, np.cos(angle) * down - np.sin(angle) * right
    rotation = np.stack([right, down, forward])
    return np.column_stack([rotation, -rotation @ np.array(centre)])


def make_street(zooms: Sequence[float] = (1.0,) * 6) -> Scene:
    """Deep: photos along a line, which look at different points."""
    return take_street_photos([make_camera(FOCAL_PX * zoom, prior=True) for zoom in zooms], (5, 3))


def take_street_photos(lenses: Sequence[pycolmap.Camera], half_size: tuple[float, float]) -> Scene:
    """half_size: of the street, across the view."""
    x, y = half_size
    points = np.random.default_rng(0).uniform((-x, -y, 5), (x, y, 12), (400, 3))
    poses = [
        look_at(
            (x, 0.4 * np.sin(2 * x), 0.5 * np.cos(3 * x)),
            (0.6 * x + 0.5 * np.sin(5 * x), 0.3 * np.cos(4 * x), 8),
            9 * x,
        )
        for x in np.linspace(-2.4, 2.4, len(lenses))
    ]
    return take_photos(points, poses, lenses, 0.2)


def make_flight() -> Scene:
    """Flat ground from straight above: height and focal length are one number."""
    points = np.random.default_rng(0).uniform((-8, -8, 0), (8, 8, 0.001), (900, 3))
    rotation = np.diag([1.0, -1.0, -1.0])
    poses = [
        np.column_stack([rotation, -rotation @ np.array([x, y, 6.0])]) for x in (-2.0, 0.0, 2.0) for y in (-1.5, 1.0)
    ]
    return take_photos(points, poses, [make_camera(FOCAL_PX, prior=True)] * len(poses), 0.1)


def make_camera(focal_px: float, prior: bool) -> pycolmap.Camera:
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal_px, *SIZE_WH)
    camera.has_prior_focal_length = prior
    return camera


def write_verified(folder: Path, scene: Scene, camera: pycolmap.Camera) -> tuple[Path, Cameras]:
    """The verified database of photos that share a camera."""
    path = folder / "database.db"
    cameras = Cameras((camera,), (0,) * len(scene.images))
    write_database(path, scene.images, cameras, scene.keypoints, scene.matches)
    verify_database(path, VerificationConfig(), num_threads=1)
    return path, cameras


def reconstruct(
    folder: Path, scene: Scene, camera: pycolmap.Camera, split_cameras: bool = True, correct: bool = True
) -> tuple[pycolmap.Reconstruction, ...]:
    """The models of photos that share a camera; their database is in the folder, too."""
    path, cameras = write_verified(folder, scene, camera)
    if correct:
        correct_focal_lengths(path)
    task = MappingTask(path, folder, folder / "sparse", split_cameras=split_cameras)
    return map_images(task, scene.images, cameras)


def read_cameras(folder: Path) -> list[pycolmap.Camera]:
    with open_database(folder / "database.db") as database:
        return database.read_all_cameras()


def measure_worst_rotation(model: pycolmap.Reconstruction, scene: Scene) -> float:
    """Degrees, over all pairs."""
    rotation = {
        image.name: image.cam_from_world().rotation.matrix() for image in model.images.values() if image.has_pose
    }
    assert len(rotation) == len(scene.images)
    worst = 0.0
    for i, j in itertools.combinations(range(len(scene.images)), 2):
        true = scene.cam_from_world[j][:, :3] @ scene.cam_from_world[i][:, :3].T
        estimate = rotation[scene.images[j].name] @ rotation[scene.images[i].name].T
        worst = max(worst, np.degrees(np.arccos(np.clip((np.trace(true @ estimate.T) - 1) / 2, -1, 1))))
    return worst


@pytest.fixture
def attempts(monkeypatch) -> list[str]:
    """Grows by the start of each attempt."""
    names: list[str] = []
    attempt = mapping_attempts._attempt
    monkeypatch.setattr(
        mapping_attempts,
        "_attempt",
        lambda task, start, *rest: (names.append(start.name if start else "as given"), attempt(task, start, *rest))[1],
    )
    return names


@pytest.mark.parametrize("factor", [0.12, 0.5, 1.0, 4.0])
def test_a_wrong_focal_length_in_exif_is_corrected(tmp_path, attempts, caplog, factor):
    scene = make_street()
    (model,) = reconstruct(tmp_path, scene, make_camera(factor * FOCAL_PX, prior=True))
    assert measure_worst_rotation(model, scene) < 0.15
    assert model.camera(1).focal_length == pytest.approx(FOCAL_PX, rel=0.01)
    assert len(attempts) == 1  # found before a model is built with it
    (camera,) = read_cameras(tmp_path)
    assert camera.has_prior_focal_length == (factor >= 1)
    if factor < 1:
        assert camera.focal_length == pytest.approx(FOCAL_PX, rel=0.05)
        (message,) = caplog.messages
        assert message.startswith("the focal length in EXIF contradicts the matches")
        assert f"{factor * FOCAL_PX:.0f} px by 5" in message
    else:  # adjustment finds it
        assert caplog.messages == []
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["database.db", "sparse"]


@pytest.mark.parametrize("known", [True, False], ids=["given", "exif"])
def test_runs_correct_exif_but_not_what_the_user_gave(tmp_path, known, capfd):
    scene = make_street()
    cameras = Cameras((make_camera(0.5 * FOCAL_PX, True),), (0,) * len(scene.images), known=known)
    collection = Collection(tmp_path, scene.images, tuple(some.pair for some in scene.matches), cameras)
    run.write_verified(tmp_path / "database.db", collection, Config(), scene.keypoints, scene.matches)
    assert capfd.readouterr().err == ""  # COLMAP says nothing
    (camera,) = read_cameras(tmp_path)
    assert camera.has_prior_focal_length == known
    assert camera.focal_length == pytest.approx((0.5 if known else 1.0) * FOCAL_PX, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.12, 9.0])
def test_models_with_a_wrong_focal_length_in_exif_are_built_again(tmp_path, attempts, caplog, factor):
    scene = make_street()
    (model,) = reconstruct(tmp_path, scene, make_camera(factor * FOCAL_PX, prior=True), correct=False)
    assert measure_worst_rotation(model, scene) < 0.15
    assert attempts == ["as given", "focal lengths estimated from the pairs"]
    (message,) = caplog.messages
    assert message.startswith(
        f"the focal length in EXIF ({factor * FOCAL_PX:.0f} px) led to no good model: it was built with focal lengths"
    )


@pytest.mark.parametrize(("factor", "doubtful"), [(0.4, (1,)), (0.95, ()), (1.1, ())])
def test_pairs_contradict_a_focal_length_that_is_far_off(tmp_path, factor, doubtful):
    path, _ = write_verified(tmp_path, make_street(), make_camera(factor * FOCAL_PX, prior=True))
    assert find_doubtful(path) == doubtful
    path, _ = write_verified(tmp_path, make_street(), make_camera(factor * FOCAL_PX, prior=False))
    assert find_doubtful(path) == ()  # a guess contradicts nothing


ZOOMS = (1.0, 1.6, 1.0, 2.0, 1.3, 1.6)


@pytest.mark.slow
@pytest.mark.parametrize("prior", [True, False], ids=["exif", "guess"])
def test_zoomed_photos_get_cameras_of_their_own(tmp_path, attempts, caplog, prior):
    scene = make_street(ZOOMS)
    (model,) = reconstruct(tmp_path, scene, make_camera(576.0, prior))
    assert measure_worst_rotation(model, scene) < 0.15
    for image in model.images.values():
        zoom = ZOOMS[int(image.name[0])]
        assert model.camera(image.camera_id).focal_length == pytest.approx(FOCAL_PX * zoom, rel=0.01)
    assert attempts == ["as given", "focal lengths estimated from the pairs", "a camera for each photo"]
    assert "built with a camera for each photo (519 px, 674 px, 830 px and 1 more)" in caplog.text
    # The database has the cameras of the model: COLMAP's own mapper can go on from it.
    stored = {camera.camera_id for camera in read_cameras(tmp_path)}
    assert stored == {image.camera_id for image in model.images.values()} and len(stored) == 6


def test_fisheye_photos_need_no_focal_length(tmp_path, attempts, caplog):
    model = pycolmap.CameraModelId.OPENCV_FISHEYE
    lens = pycolmap.Camera.create_from_model_id(1, model, 281.0, *SIZE_WH)  # a view of 130 degrees
    scene = take_street_photos([lens] * 6, (14, 9))
    guess = pycolmap.Camera.create_from_model_id(1, model, guess_focal_px(model, SIZE_WH), *SIZE_WH)
    (reconstruction,) = reconstruct(tmp_path, scene, guess)
    assert measure_worst_rotation(reconstruction, scene) < 0.15
    np.testing.assert_allclose(reconstruction.camera(1).params[:4], lens.params[:4], rtol=0.02)
    assert attempts == ["as given"] and caplog.messages == []
    assert not read_cameras(tmp_path)[0].has_prior_focal_length


@pytest.mark.slow
def test_cameras_stay_shared_where_that_was_asked_for(tmp_path, attempts, caplog):
    models = reconstruct(tmp_path, make_street(ZOOMS), make_camera(576.0, False), split_cameras=False)
    assert "a camera for each photo" not in attempts and len(attempts) == 4
    assert len(read_cameras(tmp_path)) == 1
    assert "--camera-mode per-image" in caplog.text
    for model in models:
        assert not any(is_impossible(camera) for camera in model.cameras.values())


def test_a_flight_over_flat_ground_does_not_determine_the_focal_length(tmp_path, caplog):
    scene = make_flight()
    (model,) = reconstruct(tmp_path, scene, make_camera(576.0, False))
    assert find_undetermined(model) == (1,)
    (message,) = caplog.messages
    assert message.startswith(f"the photos do not determine the focal length ({model.camera(1).focal_length:.0f} px")
    assert "--camera-params" in message


def test_exif_is_kept_where_the_photos_do_not_determine_the_focal_length(tmp_path, caplog):
    scene = make_flight()
    (model,) = reconstruct(tmp_path, scene, make_camera(FOCAL_PX, True))
    assert model.camera(1).focal_length == FOCAL_PX and measure_worst_rotation(model, scene) < 0.15
    assert caplog.messages == []


def test_good_models_need_one_attempt(tmp_path, attempts, caplog):
    scene = make_street()
    (model,) = reconstruct(tmp_path, scene, make_camera(576.0, False))
    assert attempts == ["as given"] and caplog.messages == []
    assert find_undetermined(model) == ()
    assert model.camera(1).focal_length == pytest.approx(FOCAL_PX, rel=0.01)


def test_known_intrinsics_are_not_judged(tmp_path, attempts, caplog):
    scene = make_street()
    path, cameras = write_verified(tmp_path, scene, make_camera(1.3 * FOCAL_PX, True))
    known = dataclasses.replace(cameras, known=True)
    models = map_images(MappingTask(path, tmp_path, tmp_path / "sparse"), scene.images, known)
    assert attempts == ["as given"] and caplog.messages == []
    assert models[0].camera(1).focal_length == 1.3 * FOCAL_PX


def test_what_a_model_is_judged_by(tmp_path):
    scene = make_street()
    path, _ = write_verified(tmp_path, scene, make_camera(FOCAL_PX, True))
    (model,) = map_incrementally(MappingTask(path, tmp_path, tmp_path / "sparse"))
    with open_database(path) as database:
        rows = zip(*database.read_two_view_geometries())
        verified = {pycolmap.pair_id_to_image_pair(row): geometry.inlier_matches for row, geometry in rows}
    judgement = judge_model(model, verified)
    assert judgement.is_good and judgement.agreement == 1.0 and judgement.registered == 1.0
    # In a majority of the pairs a tenth of the matches leads to other points.
    for pair in list(verified)[:9]:
        verified[pair][::10, 1] = np.roll(verified[pair][::10, 1], 1)
    wrong = judge_model(model, verified)
    assert wrong.agreement == pytest.approx(0.9, abs=0.02) and not wrong.is_good
    assert wrong.explained < judgement.explained
    # Photos that belong to the model are not in it.
    for image_id in sorted(model.reg_image_ids())[:4]:
        model.deregister_frame(model.image(image_id).frame_id)
    assert judge_model(model, verified).registered == pytest.approx(2 / 6)


@pytest.mark.parametrize(
    ("params", "impossible"),
    [
        ([520.0, 320, 240, -0.2], False),
        ([2.5, 320, 240, 0.0], True),
        ([9000.0, 320, 240, 0.0], True),
        ([1022.0, 320, 240, 123.6], True),
    ],
)
def test_lenses_that_do_not_exist(params, impossible):
    camera = make_camera(520.0, False)
    camera.params = params
    assert is_impossible(camera) == impossible


def test_split_cameras_keep_intrinsics_and_images(tmp_path, capfd):
    scene = make_street()
    path, _ = write_verified(tmp_path, scene, make_camera(500.0, True))
    capfd.readouterr()
    split_cameras(path)
    assert capfd.readouterr().err == ""
    with open_database(path) as database:
        images, cameras = database.read_all_images(), database.read_all_cameras()
        assert sorted(image.camera_id for image in images) == sorted(camera.camera_id for camera in cameras)
        assert len(cameras) == 6 and {camera.focal_length for camera in cameras} == {500.0}
        assert [image.name for image in images] == [image.name for image in scene.images]
        assert database.num_frames() == database.num_rigs() == 6
        assert database.num_verified_image_pairs() == 15
