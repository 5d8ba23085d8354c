"""What hm_sfm.colmap.database promises to COLMAP, and hm_sfm.photos.exif to hm_sfm.colmap.database."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

import hm_sfm
from hm_sfm.colmap.cameras import Cameras, make_cameras
from hm_sfm.colmap.database import copy_database, open_database, replace_database, write_database
from hm_sfm.config import CameraConfig
from hm_sfm.errors import ConfigError, InputError
from hm_sfm.photos.exif import write_jpeg
from hm_sfm.photos.images import list_images
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints


def list_image_ids(path):
    with open_database(path) as database:
        return {image.name: image.image_id for image in database.read_all_images()}


def make_photo(
    folder: Path, name: str, focal_35mm: float | None = None, size_wh: tuple[int, int] = (60, 40), orientation: int = 1
) -> ImageRef:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    write_jpeg(path, np.full((size_wh[1], size_wh[0], 3), 128, np.uint8), focal_35mm, orientation)
    return ImageRef(name, path, size_wh)


def make_keypoints(name: str, count: int, seed: int = 0) -> Keypoints:
    xy = np.random.default_rng(seed).uniform(0, 60, (count, 2))
    return Keypoints(name, xy, np.ones(count), np.ones(count))


def make_index_matches(name0: str, name1: str, indices: list[tuple[int, int]]) -> IndexMatches:
    return IndexMatches(ImagePair(name0, name1), np.reshape(indices, (-1, 2)), np.ones(len(indices)))


# EXIF


@pytest.mark.parametrize("orientation", [1, 6])
def test_written_focal_and_orientation_are_read_back_by_pycolmap(tmp_path, orientation):
    photo = make_photo(tmp_path, "a.jpg", 28.0, (600, 400), orientation)
    bitmap = pycolmap.Bitmap.read(photo.path, as_rgb=True)
    assert bitmap.exif_focal_length() == pytest.approx(28 / 43.27 * np.hypot(600, 400), rel=1e-3)
    assert bitmap.exif_orientation() == orientation
    assert bitmap.to_array().shape == (400, 600, 3)


def test_jpeg_keeps_the_channel_order_and_leaves_no_other_file(tmp_path):
    image = np.zeros((16, 24, 3), np.uint8)
    image[:, :, 0] = 250
    write_jpeg(tmp_path / "red.jpg", image, None)
    bitmap = pycolmap.Bitmap.read(tmp_path / "red.jpg", as_rgb=True)
    assert bitmap.exif_focal_length() is None
    np.testing.assert_allclose(bitmap.to_array(), image, atol=6)
    assert [path.name for path in tmp_path.iterdir()] == ["red.jpg"]


@pytest.mark.parametrize(
    ("image", "focal_35mm", "orientation"),
    [
        (np.zeros((4, 4), np.uint8), None, 1),
        (np.zeros((4, 4, 3), np.float32), None, 1),
        (np.zeros((4, 4, 3), np.uint8), 0.2, 1),
        (np.zeros((4, 4, 3), np.uint8), 28.0, 9),
    ],
)
def test_jpeg_refuses_what_it_cannot_hold(tmp_path, image, focal_35mm, orientation):
    with pytest.raises(ValueError, match="must"):
        write_jpeg(tmp_path / "a.jpg", image, focal_35mm, orientation)
    assert not list(tmp_path.iterdir())


# Cameras


def test_focal_of_exif_is_the_one_that_pycolmap_infers(tmp_path):
    photo = make_photo(tmp_path, "a.jpg", 28.0)
    camera = make_cameras([photo], CameraConfig()).cameras[0]
    expected = pycolmap.infer_camera_from_image(photo.path)
    assert camera.model == expected.model
    assert (camera.width, camera.height) == (60, 40)
    np.testing.assert_array_equal(camera.params, expected.params)
    assert camera.has_prior_focal_length and expected.has_prior_focal_length


def test_an_unknown_focal_is_guessed_from_the_longer_side(tmp_path):
    camera = make_cameras([make_photo(tmp_path, "a.jpg", None)], CameraConfig()).cameras[0]
    assert (camera.width, camera.height) == (60, 40)
    np.testing.assert_array_equal(camera.params, [0.9 * 60, 30, 20, 0])
    assert not camera.has_prior_focal_length


def test_auto_shares_one_camera_across_folders_where_all_agree(tmp_path):
    photos = [make_photo(tmp_path, name, 28.0) for name in ("a.jpg", "left/b.jpg", "right/c.jpg")]
    assert make_cameras(photos, CameraConfig()).camera_index == (0, 0, 0)


def test_auto_splits_by_folder_size_and_focal_where_they_differ(tmp_path):
    photos = [
        make_photo(tmp_path, "x/a.jpg", 28.0),
        make_photo(tmp_path, "x/b.jpg", 50.0),
        make_photo(tmp_path, "x/c.jpg", 28.0),
        make_photo(tmp_path, "y/d.jpg", 28.0),
        make_photo(tmp_path, "x/e.jpg", 28.0, (40, 60)),
        make_photo(tmp_path, "x/f.jpg", None),
    ]
    cameras = make_cameras(photos, CameraConfig())
    assert cameras.camera_index == (0, 1, 0, 2, 3, 4)
    assert [camera.camera_id for camera in cameras.cameras] == [1, 2, 3, 4, 5]
    assert (cameras.cameras[3].width, cameras.cameras[3].height) == (40, 60)
    assert [camera.has_prior_focal_length for camera in cameras.cameras] == [True, True, True, True, False]


@pytest.mark.parametrize(
    ("mode", "expected"), [("single", (0, 0, 0)), ("per-folder", (0, 1, 0)), ("per-image", (0, 1, 2))]
)
def test_modes_group_as_they_say(tmp_path, mode, expected):
    photos = [make_photo(tmp_path, "x/a.jpg"), make_photo(tmp_path, "y/b.jpg"), make_photo(tmp_path, "x/c.jpg", 50.0)]
    cameras = make_cameras(photos, CameraConfig(mode=mode))
    assert cameras.camera_index == expected
    # A camera takes the focal length from whichever of its images has one.
    assert cameras.cameras[expected[2]].has_prior_focal_length


@pytest.mark.parametrize("mode", ["single", "per-folder"])
def test_shared_camera_needs_equal_sizes(tmp_path, mode):
    photos = [make_photo(tmp_path, "a.jpg"), make_photo(tmp_path, "b.jpg", size_wh=(40, 60))]
    with pytest.raises(InputError, match=r"a\.jpg \(60 x 40 px\) and b\.jpg \(40 x 60 px\)"):
        make_cameras(photos, CameraConfig(mode=mode))


def test_known_params_need_one_size_even_in_auto_mode(tmp_path):
    photos = [make_photo(tmp_path, "a.jpg"), make_photo(tmp_path, "b.jpg", size_wh=(62, 42))]
    with pytest.raises(InputError, match="sizes differ"):
        make_cameras(photos, CameraConfig(model="PINHOLE", params="70,71,30,20"))


def test_known_params_are_taken_as_they_are(tmp_path):
    photos = [make_photo(tmp_path, "x/a.jpg", 28.0), make_photo(tmp_path, "y/b.jpg", 50.0)]
    cameras = make_cameras(photos, CameraConfig(model="PINHOLE", params="70, 71.5,30,20"))
    assert cameras.camera_index == (0, 0)
    assert cameras.cameras[0].model_name == "PINHOLE"
    np.testing.assert_array_equal(cameras.cameras[0].params, [70, 71.5, 30, 20])
    assert cameras.cameras[0].has_prior_focal_length


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (CameraConfig(model="PINHOL"), "did you mean 'PINHOLE'"),
        (CameraConfig(model="simple_radial"), "did you mean 'SIMPLE_RADIAL'"),
        (CameraConfig(model="INVALID"), "unknown camera model"),
        (CameraConfig(model="PINHOLE", params="70,30,20"), r"expects 4 numbers \(fx, fy, cx, cy\), found '70,30,20'"),
        (CameraConfig(model="PINHOLE", params="70,70,30,x"), "expects 4 numbers"),
        (CameraConfig(model="PINHOLE", params="70,70,30,nan"), "expects 4 numbers"),
        (CameraConfig(model="PINHOLE", params="-70,70,30,20"), "focal length must be positive"),
        (CameraConfig(model="PINHOLE", params="70,70,300,20"), "principal point within 60 x 40 px"),
    ],
)
def test_bad_camera_configurations_are_refused(tmp_path, config, message):
    with pytest.raises(ConfigError, match=message):
        make_cameras([make_photo(tmp_path, "a.jpg")], config)


def test_unreadable_image_is_named(tmp_path):
    (tmp_path / "broken.jpg").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"broken\.jpg"):
        make_cameras([ImageRef("broken.jpg", tmp_path / "broken.jpg", (60, 40))], CameraConfig())


def test_no_images_need_no_cameras():
    assert make_cameras([], CameraConfig()) == Cameras((), ())


# Cameras of a COLMAP model


def write_known_model(folder: Path, sizes_wh: dict[str, tuple[int, int]], kind: str = "bin") -> Path:
    """One camera per size, its ids not those of a database, and poses that say which image they are of."""
    model = pycolmap.Reconstruction()
    camera_ids: dict[tuple[int, int], int] = {}
    for number, (name, size_wh) in enumerate(sizes_wh.items()):
        if size_wh not in camera_ids:
            camera_ids[size_wh] = 70 - len(camera_ids)
            camera = pycolmap.Camera.create_from_model_name(camera_ids[size_wh], "OPENCV", 50.0 + number, *size_wh)
            model.add_camera_with_trivial_rig(camera)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), [number, 0.0, 0.0])
        image = pycolmap.Image(name=name, camera_id=camera_ids[size_wh], image_id=100 + number)
        model.add_image_with_trivial_frame(image, pose)
    folder.mkdir()
    (model.write_text if kind == "txt" else model.write_binary)(folder)
    return folder


SIZES_WH = {"not asked.jpg": (80, 80), "b.jpg": (60, 40), "x/ab.jpg": (40, 60), "c.jpg": (60, 40)}


@pytest.fixture
def known_photos(tmp_path) -> list[ImageRef]:
    return [make_photo(tmp_path, name, 28.0, SIZES_WH[name]) for name in ("b.jpg", "c.jpg", "x/ab.jpg")]


@pytest.mark.parametrize("kind", ["bin", "txt"])
@pytest.mark.parametrize("whole", [True, False], ids=["folder", "cameras-file-without-points"])
@pytest.mark.parametrize("key", ["file", "poses"])
def test_known_cameras_go_by_the_names_of_the_images(tmp_path, known_photos, kind, whole, key):
    path = write_known_model(tmp_path / "model", SIZES_WH, kind)
    if not whole:
        for part in ("points3D", "rigs", "frames"):
            (path / f"{part}.{kind}").unlink()
        path = path / f"cameras.{kind}"
    cameras = make_cameras(known_photos, CameraConfig(**{key: str(path)}))
    assert cameras.known and cameras.camera_index == (0, 0, 1)
    assert [camera.camera_id for camera in cameras.cameras] == [1, 2]
    assert [camera.model_name for camera in cameras.cameras] == ["OPENCV"] * 2
    assert [camera.focal_length_x for camera in cameras.cameras] == [51.0, 52.0]
    assert all(camera.has_prior_focal_length for camera in cameras.cameras)
    shifts = [pose.translation[0] for pose in cameras.cam_from_world]
    assert shifts == ([1, 3, 2] if key == "poses" else [])


def test_photos_that_the_model_does_not_know(tmp_path, known_photos):
    model = write_known_model(tmp_path / "model", {"b.jpg": (60, 40), "B.jpg": (60, 40), "x-ab.jpg": (40, 60)})
    with pytest.raises(InputError, match=r"model lacks 2 of 3 photos, for example 'c.jpg', 'x/ab.jpg'; it has 3, .*'B"):
        make_cameras(known_photos, CameraConfig(file=str(model)))


def test_names_with_spaces_in_text_files(tmp_path):
    photo = make_photo(tmp_path, "a b.jpg")
    binary = write_known_model(tmp_path / "bin", {"a b.jpg": (60, 40)})
    assert make_cameras([photo], CameraConfig(file=str(binary))).known
    text = write_known_model(tmp_path / "txt", {"a b.jpg": (60, 40)}, "txt")
    with pytest.raises(InputError, match="cannot read names with spaces from text files"):
        make_cameras([photo], CameraConfig(file=str(text)))


def test_a_model_of_photos_of_another_size(tmp_path, known_photos):
    model = write_known_model(tmp_path / "model", {**SIZES_WH, "c.jpg": (600, 400)})
    with pytest.raises(InputError, match=r"camera of 'c.jpg' .*model is of 600 x 400 px, the photo is 60 x 40 px"):
        make_cameras(known_photos, CameraConfig(poses=str(model)))


@pytest.mark.parametrize("content", [{}, {"cameras.txt": b""}, {"images.bin": b"", "cameras.txt": b""}])
def test_no_model(tmp_path, known_photos, content):
    (tmp_path / "model").mkdir()
    for name, data in content.items():
        (tmp_path / "model" / name).write_bytes(data)
    with pytest.raises(InputError, match="model holds no COLMAP model: it lacks cameras.txt and images.txt"):
        make_cameras(known_photos, CameraConfig(file=str(tmp_path / "model")))
    with pytest.raises(InputError, match="none does not exist"):
        make_cameras(known_photos, CameraConfig(file=str(tmp_path / "none")))
    with pytest.raises(InputError, match="b.jpg is neither a folder nor named cameras.txt"):
        make_cameras(known_photos, CameraConfig(file=str(tmp_path / "b.jpg")))


@pytest.mark.parametrize("kind", ["bin", "txt"])
@pytest.mark.parametrize("part", ["cameras", "images"])
def test_a_damaged_model(tmp_path, known_photos, capfd, kind, part):
    model = write_known_model(tmp_path / "model", SIZES_WH, kind)
    file = model / f"{part}.{kind}"
    file.write_bytes(b"1 FISH what 7\n" if kind == "txt" else file.read_bytes()[:20])
    with pytest.raises(InputError, match="the COLMAP model .*model is damaged"):
        make_cameras(known_photos, CameraConfig(file=str(model)))
    assert capfd.readouterr().err == ""


def test_intrinsics_that_are_given_twice(known_photos):
    with pytest.raises(ConfigError, match="cameras.params and cameras.poses both give the intrinsics"):
        make_cameras(known_photos, CameraConfig(params="1,2,3,4", poses="model"))


# Positions from EXIF


def write_gps(path: Path, latitude: tuple, longitude: tuple, altitude: float | None) -> None:
    """A JPEG with the position as cameras write it: degrees, minutes, seconds; south and west."""
    exif = Image.Exif()
    exif[0x8825] = {1: "S", 2: latitude, 3: "W", 4: longitude} | ({5: b"\0", 6: altitude} if altitude else {})
    Image.fromarray(np.full((40, 60, 3), 128, np.uint8)).save(path, exif=exif)


def test_gps_becomes_a_pose_prior_and_zeros_do_not(tmp_path):
    write_gps(tmp_path / "a.jpg", (33.0, 30.0, 36.0), (70.0, 45.0, 0.0), 512.5)
    write_gps(tmp_path / "no fix.jpg", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 12.0)
    write_gps(tmp_path / "no altitude.jpg", (33.0, 30.0, 36.0), (70.0, 45.0, 0.0), None)
    make_photo(tmp_path, "none.jpg")
    images = list_images(tmp_path).images
    keypoints = [make_keypoints(image.name, 2) for image in images]
    write_database(tmp_path / "d.db", images, make_cameras(images, CameraConfig(mode="single")), keypoints, [])
    with pycolmap.Database.open(tmp_path / "d.db") as database:
        (prior,) = database.read_all_pose_priors()
    assert prior.coordinate_system == pycolmap.PosePriorCoordinateSystem.WGS84
    np.testing.assert_allclose(prior.position.ravel(), [-33.51, -70.75, 512.5], atol=1e-4)
    assert prior.has_position() and not prior.has_position_cov()
    assert images[prior.corr_data_id.id - 1].name == "a.jpg"
    assert prior.corr_data_id.sensor_id.type == pycolmap.SensorType.CAMERA


# Database

NAMES = ("b 1.jpg", "sub/ü.jpg", "a.jpg")  # not sorted, with a space, a folder and a letter beyond ASCII


def write_small_database(path: Path) -> tuple[list[Keypoints], list[IndexMatches]]:
    images = [ImageRef(name, Path(name), (60, 40)) for name in NAMES]
    cameras = tuple(
        pycolmap.Camera.create_from_model_name(camera_id, "SIMPLE_RADIAL", 50.0 + camera_id, 60, 40)
        for camera_id in (1, 2)
    )
    cameras[1].has_prior_focal_length = True
    keypoints = [make_keypoints(NAMES[0], 5, 0), make_keypoints(NAMES[1], 0), make_keypoints(NAMES[2], 4, 1)]
    matches = [
        make_index_matches("a.jpg", "b 1.jpg", [(0, 4), (3, 2), (1, 0)]),
        make_index_matches("a.jpg", "sub/ü.jpg", []),
    ]
    write_database(path, images, Cameras(cameras, (0, 1, 0)), keypoints, matches)
    return keypoints, matches


def test_database_holds_what_was_written(tmp_path):
    path = tmp_path / "database.db"
    keypoints, matches = write_small_database(path)
    assert list_image_ids(path) == {"b 1.jpg": 1, "sub/ü.jpg": 2, "a.jpg": 3}
    with pycolmap.Database.open(path) as database:
        for image_id, points in enumerate(keypoints, start=1):
            stored = database.read_keypoints(image_id)
            assert stored.dtype == np.float32
            np.testing.assert_array_equal(stored.reshape(-1, 2), points.xy)
        # Image a.jpg is image 0 of its pair but has the larger id.
        np.testing.assert_array_equal(database.read_matches(3, 1), matches[0].indices)
        np.testing.assert_array_equal(database.read_matches(1, 3), matches[0].indices[:, ::-1])
        assert database.num_matched_image_pairs() == 1
        assert database.num_verified_image_pairs() == 0
        assert [camera.focal_length for camera in database.read_all_cameras()] == [51.0, 52.0]
        assert [camera.has_prior_focal_length for camera in database.read_all_cameras()] == [False, True]


def test_each_camera_has_a_rig_and_each_image_a_frame(tmp_path):
    path = tmp_path / "database.db"
    write_small_database(path)
    with pycolmap.Database.open(path) as database:
        assert database.num_rigs() == 2
        assert database.num_frames() == 3
        for image in database.read_all_images():
            frame = database.read_frame(image.frame_id)
            rig = database.read_rig(frame.rig_id)
            assert [data.id for data in frame.data_ids] == [image.image_id]
            assert rig.ref_sensor_id.id == image.camera_id == {1: 1, 2: 2, 3: 1}[image.image_id]
            assert rig.num_sensors() == 1


def test_an_earlier_database_and_its_leftovers_are_replaced(tmp_path):
    path = tmp_path / "database.db"
    path.write_bytes(b"something else")
    for ending in ("-wal", "-shm", "-journal"):
        (tmp_path / f"database.db{ending}").write_bytes(b"stale")
    write_small_database(path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["database.db"]
    assert len(list_image_ids(path)) == 3


def test_a_failed_write_leaves_the_earlier_database(tmp_path):
    path = tmp_path / "database.db"
    write_small_database(path)
    before = path.read_bytes()
    images = [ImageRef("a.jpg", Path("a.jpg"), (60, 40))] * 2  # names must be unique
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 50.0, 60, 40)
    with pytest.raises(Exception, match="(?i)unique|constraint"):
        write_database(path, images, Cameras((camera,), (0, 0)), [make_keypoints("a.jpg", 2)] * 2, [])
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["database.db"]


@pytest.mark.parametrize(
    ("name1", "indices", "message"),
    [("c.jpg", [(0, 0)], "not in the collection: 'c.jpg'"), ("b.jpg", [(0, 2)], "beyond the 2 keypoints of 'b.jpg'")],
)
def test_matches_that_do_not_fit_the_keypoints_are_refused(tmp_path, name1, indices, message):
    images = [ImageRef(name, Path(name), (60, 40)) for name in ("a.jpg", "b.jpg")]
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 50.0, 60, 40)
    keypoints = [make_keypoints("a.jpg", 3), make_keypoints("b.jpg", 2)]
    matches = [make_index_matches("a.jpg", name1, indices)]
    with pytest.raises(ValueError, match=message):
        write_database(tmp_path / "d.db", images, Cameras((camera,), (0, 0)), keypoints, matches)
    assert not list(tmp_path.iterdir())


def test_keypoints_in_another_order_than_the_images_are_refused(tmp_path):
    images = [ImageRef("a.jpg", Path("a.jpg"), (60, 40)), ImageRef("b.jpg", Path("b.jpg"), (60, 40))]
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 50.0, 60, 40)
    keypoints = [make_keypoints("b.jpg", 2), make_keypoints("a.jpg", 2)]
    with pytest.raises(ValueError, match="a.jpg"):
        write_database(tmp_path / "d.db", images, Cameras((camera,), (0, 0)), keypoints, [])
    with pytest.raises(ValueError, match="2 images"):
        write_database(tmp_path / "d.db", images, Cameras((camera,), (0, 0)), keypoints[:1], [])


def test_reading_ids_of_a_missing_database_does_not_create_it(tmp_path):
    with pytest.raises(InputError, match="missing.db"):
        open_database(tmp_path / "missing.db")
    assert not list(tmp_path.iterdir())


def write_empty(path: Path, count: int) -> None:
    images = [ImageRef(f"{number}.jpg", Path("x.jpg"), (60, 40)) for number in range(count)]
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 50.0, 60, 40)
    write_database(path, images, Cameras((camera,), (0,) * count), [make_keypoints(i.name, 1) for i in images], [])


def test_a_copy_of_a_database_in_use_has_all_that_was_written(tmp_path):
    """COLMAP keeps the latest in database.db-wal for as long as it has the database open."""
    path = tmp_path / "a database?.db"
    write_empty(path, 3)
    with pycolmap.Database.open(path) as in_use:
        in_use.write_image(pycolmap.Image(name="new.jpg", camera_id=1, image_id=9), use_image_id=True)
        before = path.read_bytes()
        assert copy_database(path, tmp_path / "copy.db") == tmp_path / "copy.db"
        assert path.read_bytes() == before
        assert in_use.num_images() == 4
    assert list_image_ids(tmp_path / "copy.db") == {"0.jpg": 1, "1.jpg": 2, "2.jpg": 3, "new.jpg": 9}
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a database?.db", "copy.db"]


def test_copying_leaves_nothing_beside_a_database(tmp_path):
    write_empty(tmp_path / "database.db", 3)
    before = (tmp_path / "database.db").read_bytes()
    copy_database(tmp_path / "database.db", tmp_path / "copy.db")
    assert (tmp_path / "copy.db").read_bytes() == (tmp_path / "database.db").read_bytes() == before
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["copy.db", "database.db"]


def test_what_cannot_be_copied(tmp_path):
    with pytest.raises(InputError, match=r"there is no database .*none\.db"):
        copy_database(tmp_path / "none.db", tmp_path / "copy.db")
    (tmp_path / "text.db").write_text("no database" * 100)
    (tmp_path / "text.db-wal").write_text("nor this")
    with pytest.raises(
        InputError, match=r"cannot read the database .*text\.db, which is in use: file is not a database"
    ):
        copy_database(tmp_path / "text.db", tmp_path / "copy.db")


def test_a_database_that_replaces_another_does_not_get_its_leftovers(tmp_path):
    write_empty(tmp_path / "new.db", 2)
    write_empty(tmp_path / "old.db", 3)
    (tmp_path / "old.db-wal").write_bytes(b"of a writer that was killed")
    replace_database(tmp_path / "new.db", tmp_path / "old.db")
    assert [entry.name for entry in tmp_path.iterdir()] == ["old.db"]
    assert len(list_image_ids(tmp_path / "old.db")) == 2


def test_databases_are_copied_in_one_place_only():
    package = Path(hm_sfm.__file__).parent
    copying = {path.name for path in package.rglob("*.py") if "shutil.copy(" in path.read_text()}
    assert copying == {"database.py", "models.py"}  # the latter: files of models
