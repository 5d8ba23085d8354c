"""Rigs: a configuration in COLMAP's format becomes rigs and frames of the database, and the mapper keeps to them."""

import copy
import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from hm_sfm.colmap.cameras import Cameras, make_cameras
from hm_sfm.colmap.database import open_database, write_database
from hm_sfm.colmap.mapping import MappingTask, map_images
from hm_sfm.colmap.rigs import lack_poses, read_rigs
from hm_sfm.colmap.verification import verify_database
from hm_sfm.config import CameraConfig, Config, MappingConfig, PairConfig, VerificationConfig
from hm_sfm.errors import ConfigError, InputError
from hm_sfm.photos.exif import write_jpeg
from hm_sfm.pipeline.collection import choose_pairs
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints

RIG = [
    {
        "cameras": [
            {"image_prefix": "left/", "ref_sensor": True},
            {
                "image_prefix": "right/",
                "cam_from_rig_rotation": [1.0, 0.0, 0.0, 0.0],
                "cam_from_rig_translation": [-0.3, 0.0, 0.0],
            },
        ]
    }
]
PARAMS = "1280,512,384,0.05"
"""What pycolmap's synthetic cameras have; SIMPLE_RADIAL."""


def write_rig(folder: Path, tree: object = None, **changes: object) -> str:
    """rig.json: RIG, its second camera with `changes`."""
    tree = copy.deepcopy(RIG) if tree is None else tree
    if changes:
        tree[0]["cameras"][1] |= changes
    (folder / "rig.json").write_text(tree if isinstance(tree, str) else json.dumps(tree))
    return str(folder / "rig.json")


# Mapping


@dataclass(frozen=True)
class Oracle:
    """A synthetic scene of five frames of two cameras, in our types, and the model that it came from."""

    model: pycolmap.Reconstruction
    images: list[ImageRef]
    keypoints: list[Keypoints]
    matches: list[IndexMatches]
    right_from_left: pycolmap.Rigid3d


@pytest.fixture(scope="module")
def oracle(tmp_path_factory) -> Oracle:
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1,
        num_cameras_per_rig=2,
        num_frames_per_rig=5,
        num_points3D=150,
        sensor_from_rig_translation_stddev=0.3,
    )
    with pycolmap.Database.open(tmp_path_factory.mktemp("oracle") / "oracle.db") as database:
        model = pycolmap.synthesize_dataset(options, database)
        (rig,) = database.read_all_rigs()
        folders = {rig.ref_sensor_id.id: "left"}
        names = {
            row.image_id: f"{folders.get(row.camera_id, 'right')}/{row.name.split('_')[1]}"
            for row in database.read_all_images()
        }
        xy = {names[image_id]: database.read_keypoints(image_id)[:, :2] for image_id in names}
        keypoints = [Keypoints(name, xy[name], np.ones(len(xy[name])), np.ones(len(xy[name]))) for name in sorted(xy)]
        matches = []
        for pair_id, indices in zip(*database.read_all_matches()):
            name0, name1 = (names[image_id] for image_id in pycolmap.pair_id_to_image_pair(pair_id))
            indices = indices if name0 < name1 else indices[:, ::-1]
            matches.append(IndexMatches(ImagePair.of(name0, name1), indices, np.ones(len(indices))))
    for image in model.images.values():
        image.name = names[image.image_id]
    (right_from_left,) = rig.non_ref_sensors.values()
    images = [ImageRef(name, Path(name), (1024, 768)) for name in sorted(xy)]
    return Oracle(model, images, keypoints, matches, right_from_left)


def map_oracle(
    folder: Path, oracle: Oracle, cameras: Cameras, config: MappingConfig
) -> tuple[pycolmap.Reconstruction, ...]:
    path = folder / "database.db"
    write_database(path, oracle.images, cameras, oracle.keypoints, oracle.matches)
    verify_database(path, VerificationConfig(min_inliers=15), num_threads=1)
    return map_images(MappingTask(path, folder, folder / "sparse", config), oracle.images, cameras)


def assert_is_the_rig(rigs: list[pycolmap.Rig], oracle: Oracle, scale_is_known: bool) -> None:
    (rig,) = rigs
    (pose,) = rig.non_ref_sensors.values()
    assert rig.num_sensors() == 2
    assert np.degrees(pose.rotation.angle_to(oracle.right_from_left.rotation)) < 0.05
    actual, expected = pose.translation, oracle.right_from_left.translation
    if not scale_is_known:
        actual, expected = actual / np.linalg.norm(actual), expected / np.linalg.norm(expected)
    np.testing.assert_allclose(actual, expected, atol=0.005)


@pytest.mark.parametrize("mapper", ["incremental", "global"])
def test_the_mapper_keeps_to_the_poses_of_the_rig(tmp_path, oracle, mapper, capfd):
    x, y, z, w = oracle.right_from_left.rotation.quat
    rig = write_rig(
        tmp_path,
        cam_from_rig_rotation=[w, x, y, z],
        cam_from_rig_translation=oracle.right_from_left.translation.tolist(),
    )
    cameras = make_cameras(oracle.images, CameraConfig(params=PARAMS, rig=rig))
    assert cameras.camera_index == (0,) * 5 + (1,) * 5 and not lack_poses(cameras.rigs)

    (model,) = map_oracle(tmp_path, oracle, cameras, MappingConfig(mapper=mapper))

    assert capfd.readouterr().err == ""
    with open_database(tmp_path / "database.db") as database:
        frames = database.read_all_frames()
        assert_is_the_rig(database.read_all_rigs(), oracle, scale_is_known=True)
    assert [len(frame.data_ids) for frame in frames] == [2] * 5
    assert (model.num_reg_images(), model.num_reg_frames()) == (10, 5)
    assert_is_the_rig(list(model.rigs.values()), oracle, scale_is_known=mapper == "incremental")
    assert pycolmap.Reconstruction(tmp_path / "sparse" / "0").num_reg_frames() == 5
    errors = pycolmap.compare_reconstructions(
        model, oracle.model, alignment_error="proj_center", max_proj_center_error=0.05
    )["errors"]
    assert len(errors) == 10 and max(error.proj_center_error for error in errors) < 1e-2


@pytest.mark.slow
def test_poses_that_the_rig_lacks_are_estimated(tmp_path, oracle):
    rig = write_rig(tmp_path, [{"cameras": [RIG[0]["cameras"][0], {"image_prefix": "right/"}]}])
    cameras = make_cameras(oracle.images, CameraConfig(params=PARAMS, rig=rig))
    assert lack_poses(cameras.rigs)
    (model,) = map_oracle(tmp_path, oracle, cameras, MappingConfig())
    assert (model.num_reg_images(), model.num_reg_frames()) == (10, 5)
    assert_is_the_rig(list(model.rigs.values()), oracle, scale_is_known=False)
    with open_database(tmp_path / "database.db") as database:
        assert_is_the_rig(database.read_all_rigs(), oracle, scale_is_known=False)
        assert database.num_keypoints() == sum(map(len, oracle.keypoints))
    assert {entry.name for entry in tmp_path.iterdir()} == {"database.db", "rig.json", "sparse"}


def test_rigs_whose_poses_cannot_be_estimated_are_left_out(tmp_path, oracle, caplog):
    rig = write_rig(tmp_path, [{"cameras": [RIG[0]["cameras"][0], {"image_prefix": "right/"}]}])
    cameras = make_cameras(oracle.images, CameraConfig(params=PARAMS, rig=rig))
    left = [some for some in oracle.matches if some.pair.name1.startswith("left/")]
    alone = Oracle(oracle.model, oracle.images, oracle.keypoints, left, oracle.right_from_left)
    (model,) = map_oracle(tmp_path, alone, cameras, MappingConfig())
    assert model.num_reg_images() == 5
    (message,) = caplog.messages
    assert "the rigs are left out" in message
    with open_database(tmp_path / "database.db") as database:
        assert all(rig.num_sensors() == 1 for rig in database.read_all_rigs())
        assert database.num_frames() == 10


# Pairs


def refuse_encoding():
    raise AssertionError("no photo is to be encoded")


def test_a_sequence_joins_the_photos_of_all_cameras(tmp_path):
    names = [f"{folder}/{number}.jpg" for folder in ("left", "right") for number in range(4)] + ["other.jpg"]
    images = [ImageRef(name, tmp_path / name, (60, 40)) for name in names]
    config = Config(pairs=PairConfig(mode="sequential", window=1), cameras=CameraConfig(rig=write_rig(tmp_path)))
    pairs = choose_pairs(images, tmp_path / "out", config, refuse_encoding)
    assert len(pairs) == len(set(pairs))
    for number in range(4):
        assert ImagePair(f"left/{number}.jpg", f"right/{number}.jpg") in pairs
    for number in range(3):
        assert ImagePair(f"left/{number}.jpg", f"right/{number + 1}.jpg") in pairs
        assert ImagePair(f"left/{number + 1}.jpg", f"right/{number}.jpg") in pairs
    assert ImagePair("other.jpg", "right/3.jpg") in pairs
    plain = choose_pairs(images, tmp_path / "out", dataclasses.replace(config, cameras=CameraConfig()), refuse_encoding)
    assert set(plain) < set(pairs) and ImagePair("left/1.jpg", "right/1.jpg") not in plain


# Cameras


def make_photos(folder: Path, sizes_wh: dict[str, tuple[int, int]]) -> list[ImageRef]:
    for name, (width, height) in sizes_wh.items():
        (folder / name).parent.mkdir(exist_ok=True)
        write_jpeg(folder / name, np.full((height, width, 3), 128, np.uint8), 28.0)
    return [ImageRef(name, folder / name, size_wh) for name, size_wh in sizes_wh.items()]


SIZES_WH = {"left/1.jpg": (60, 40), "left/2.jpg": (60, 40), "other.jpg": (60, 40), "right/1.jpg": (60, 40)}


@pytest.fixture
def photos(tmp_path) -> list[ImageRef]:
    return make_photos(tmp_path, SIZES_WH)


@pytest.mark.parametrize("mode", ["auto", "per-folder"])
def test_each_camera_of_a_rig_is_one_for_itself(tmp_path, photos, mode):
    cameras = make_cameras(photos, CameraConfig(mode=mode, rig=write_rig(tmp_path)))
    assert cameras.camera_index == (0, 0, 1, 2)
    assert all(camera.has_prior_focal_length for camera in cameras.cameras)
    write_database(
        tmp_path / "d.db", photos, cameras, [Keypoints(p.name, np.zeros((0, 2)), [], []) for p in photos], []
    )
    with open_database(tmp_path / "d.db") as database:
        names = {row.image_id: row.name for row in database.read_all_images()}
        frames = [{names[data.id] for data in frame.data_ids} for frame in database.read_all_frames()]
    assert sorted(map(sorted, frames)) == [["left/1.jpg", "right/1.jpg"], ["left/2.jpg"], ["other.jpg"]]


def test_intrinsics_of_the_configuration_are_taken_and_refined(tmp_path, photos):
    rig = write_rig(tmp_path, camera_model_name="PINHOLE", camera_params=[70, 71.5, 30, 20])
    cameras = make_cameras(photos, CameraConfig(rig=rig))
    assert [camera.model_name for camera in cameras.cameras] == ["SIMPLE_RADIAL", "SIMPLE_RADIAL", "PINHOLE"]
    np.testing.assert_array_equal(cameras.cameras[2].params, [70, 71.5, 30, 20])
    assert cameras.cameras[2].has_prior_focal_length and not cameras.known
    with pytest.raises(ConfigError, match="cameras.params and the rig configuration .*rig.json both give"):
        make_cameras(photos, CameraConfig(params="1,2,3,4", rig=rig))
    rig = write_rig(tmp_path, camera_model_name="PINHOLE", camera_params=[70, 71.5, 300, 20])
    with pytest.raises(ConfigError, match="do not fit right/1.jpg: .* principal point within 60 x 40 px"):
        make_cameras(photos, CameraConfig(rig=rig))


def write_known_model(folder: Path, camera_ids: dict[str, int]) -> str:
    model = pycolmap.Reconstruction()
    for camera_id in sorted(set(camera_ids.values())):
        model.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_name(camera_id, "PINHOLE", 50, 60, 40))
    for image_id, (name, camera_id) in enumerate(camera_ids.items(), start=1):
        row = pycolmap.Image(name=name, camera_id=camera_id, image_id=image_id)
        model.add_image_with_trivial_frame(row, pycolmap.Rigid3d())
    folder.mkdir()
    model.write_binary(folder)
    return str(folder)


def test_known_cameras_of_a_rig(tmp_path, photos):
    shared = write_known_model(tmp_path / "shared", dict.fromkeys(SIZES_WH, 7))
    cameras = make_cameras(photos, CameraConfig(file=shared, rig=write_rig(tmp_path)))
    assert cameras.camera_index == (0, 0, 1, 2) and cameras.known
    assert [camera.camera_id for camera in cameras.cameras] == [1, 2, 3]
    each = write_known_model(tmp_path / "each", {name: number for number, name in enumerate(SIZES_WH, start=1)})
    with pytest.raises(InputError, match="one camera for each image_prefix in .*rig.json, .*each has several"):
        make_cameras(photos, CameraConfig(file=each, rig=write_rig(tmp_path)))
    with pytest.raises(ConfigError, match="cameras.poses .* leaves nothing to cameras.rig"):
        make_cameras(photos, CameraConfig(poses=shared, rig=write_rig(tmp_path)))


@pytest.mark.parametrize("mode", ["single", "per-image"])
def test_camera_modes_that_contradict_a_rig(tmp_path, photos, mode):
    with pytest.raises(
        ConfigError, match=f"each camera of a rig intrinsics of its own: leave out camera mode '{mode}'"
    ):
        make_cameras(photos, CameraConfig(mode=mode, rig=write_rig(tmp_path)))


def test_photos_of_one_camera_have_one_size(tmp_path):
    photos = make_photos(tmp_path, SIZES_WH | {"left/2.jpg": (40, 60)})
    with pytest.raises(InputError, match=r"left/1.jpg .* and left/2.jpg .* as .*rig.json asks for: their sizes differ"):
        make_cameras(photos, CameraConfig(rig=write_rig(tmp_path)))


# Configurations that do not match the photos


@pytest.mark.parametrize(
    ("prefix", "names", "message"),
    [
        ("middle/", ["left/1.jpg", "right/1.jpg"], "rig.json does not match: no photo .* begins with 'middle/'"),
        ("l", ["left/1.jpg", "right/1.jpg"], "'left/1.jpg' is of two cameras .* 'left/' and 'l': end each .* with a /"),
        (
            "right/",
            ["left/1.jpg", "right/2.jpg"],
            "does not match: no photo in 'left/' has the same name as one of another",
        ),
        (
            "right/",
            ["left/1.jpg", "left/left/1.jpg", "right/1.jpg"],
            "'left/1.jpg' and 'left/left/1.jpg' photos of one",
        ),
    ],
)
def test_rigs_of_other_photos(tmp_path, prefix, names, message):
    rig = write_rig(tmp_path, image_prefix=prefix)
    photos = [ImageRef(name, Path(name), (60, 40)) for name in names]
    with pytest.raises(InputError, match=message):
        make_cameras(photos, CameraConfig(model="PINHOLE", params="70,70,30,20", rig=rig))


# Unusable configurations


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ("{nope", "rig.json is not valid JSON: Expecting property name .*line 1"),
        ("", "rig.json is not valid JSON"),
        ({}, "rig.json must be a list of rigs, found '{}'"),
        ([], "rig.json must be a list of rigs"),
        ([["left/"]], "rig 1 of .*rig.json has no list of cameras"),
        ([{"cameras": "left/"}], "rig 1 of .*rig.json has no list of cameras"),
        ([{"cameras": []}], "rig 1 of .*rig.json needs one camera with ref_sensor true, found 0"),
        ([{"cameras": [{"image_prefix": "left/"}]}], "needs one camera with ref_sensor true, found 0"),
        ([{"cameras": [{"image_prefix": "a", "ref_sensor": True}] * 2}], "one camera with ref_sensor true, found 2"),
        ([{"cameras": [{"ref_sensor": True}]}], "camera 1 of rig 1 in .*rig.json lacks the key 'image_prefix'"),
        ([{"cameras": [{"image_prefix": "", "ref_sensor": True}]}], "needs an image_prefix"),
        (
            [RIG[0], {"cameras": [{"image_prefix": "a", "ref_sensor": True}, {"image_prefix": "b"}]}],
            "for some cameras only",
        ),
        ([{"cameras": ["left/"]}], "camera 1 of rig 1 in .*rig.json must be a mapping"),
    ],
)
def test_a_file_that_is_no_rig_configuration(tmp_path, tree, message):
    with pytest.raises((InputError, ConfigError), match=message):
        read_rigs(write_rig(tmp_path, tree))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cam_from_rig_rotaton": []}, "unknown key 'cam_from_rig_rotaton' .* did you mean 'cam_from_rig_rotation'"),
        ({"ref_sensor": "no"}, "ref_sensor must be of type bool, found 'no'"),
        ({"ref_sensor": True}, "'right/' in .*rig.json is the reference of its rig: it must not have a cam_from_rig"),
        ({"cam_from_rig_rotation": [1, 0, 0]}, r"needs 4 numbers as .*, found \[1, 0, 0\] and \[-0.3, 0.0, 0.0\]"),
        ({"cam_from_rig_rotation": [1, 0, 0, 0, 0]}, "needs 4 numbers"),
        ({"cam_from_rig_rotation": []}, "needs 4 numbers"),
        ({"cam_from_rig_translation": [1, 0, "x"]}, "and 3 as cam_from_rig_translation"),
        ({"cam_from_rig_translation": [1, 0, float("nan")]}, "and 3 as cam_from_rig_translation"),
        ({"cam_from_rig_rotation": [0, 0, 0, 0]}, "needs a cam_from_rig_rotation of length 1"),
        ({"camera_model_name": "PINHOLE"}, "needs both camera_model_name and camera_params"),
        ({"camera_model_name": "PINHOL", "camera_params": [1, 2, 3, 4]}, "an unknown camera_model_name"),
        ({"camera_model_name": "PINHOLE", "camera_params": [1, 2, 3]}, "another number of camera_params than 3"),
    ],
)
def test_a_camera_that_makes_no_sense(tmp_path, changes, message, capfd):
    with pytest.raises((InputError, ConfigError), match=message):
        read_rigs(write_rig(tmp_path, **changes))
    assert capfd.readouterr().err == ""


def test_a_missing_file(tmp_path):
    with pytest.raises(InputError, match="cannot read the rig configuration .*none.json: No such file"):
        read_rigs(tmp_path / "none.json")


def test_rounded_rotations_are_made_exact(tmp_path):
    (rig,) = read_rigs(write_rig(tmp_path, cam_from_rig_rotation=[0.707, 0, 0.707, 0]))
    assert rig.cameras[1].cam_from_rig.rotation.norm() == pytest.approx(1, abs=1e-12)
