"""Runs in the formats of other programs, read by readers that are not ours: pycolmap, plyfile, h5py, json."""

import json
import shutil
from pathlib import Path

import cv2
import h5py
import numpy as np
import pycolmap
import pytest
from plyfile import PlyData

from hm_sfm.colmap.cameras import Cameras
from hm_sfm.colmap.database import write_database
from hm_sfm.errors import InputError
from hm_sfm.export.conversion import convert_run, flatten_names
from hm_sfm.formats.pairs_files import write_pairs
from hm_sfm.io.markers import MADE_MARKER
from hm_sfm.photos.exif import write_jpeg
from hm_sfm.photos.images import list_images
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints

WIDTH, HEIGHT = 320, 240
NAMES = ("left/1.png", "left_1.png", "right/1.png", "right/2.png")
DISC_PX = (250.0, 60.0)
"""Where each photo shows a white disc."""


def make_run(folder: Path, model_name: str, params: list[float], names: tuple[str, ...] = NAMES) -> Path:
    """OUT of a run with photos of a disc in the dark, and the model of a synthetic scene."""
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1,
        num_frames_per_rig=len(names),
        num_points3D=40,
        camera_width=WIDTH,
        camera_height=HEIGHT,
        camera_model_id=getattr(pycolmap.CameraModelId, model_name),
        camera_params=params,
    )
    pycolmap.set_random_seed(1)
    model = pycolmap.synthesize_dataset(options)
    photos = folder / "photos"
    disc = np.full((HEIGHT, WIDTH, 3), 20, np.uint8)
    cv2.circle(disc, (int(DISC_PX[0]) * 16 - 8, int(DISC_PX[1]) * 16 - 8), 6 * 16, (255,) * 3, -1, cv2.LINE_AA, 4)
    for image, name in zip(model.images.values(), names):
        image.name = name
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(photos / name), disc)
    out = folder / "out"
    (out / "sparse" / "0").mkdir(parents=True)
    model.write_binary(out / "sparse" / "0")
    (out / "summary.json").write_text(json.dumps({"image_folder": str(photos)}))
    return out


@pytest.fixture
def out(tmp_path) -> Path:
    return make_run(tmp_path, "SIMPLE_RADIAL", [300.0, 160.0, 120.0, 0.08])


def find_disc(path: Path) -> np.ndarray:
    """(2,) px: the centre of mass of what is bright."""
    weight = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(float)
    weight[weight < 60] = 0
    rows, columns = np.mgrid[: weight.shape[0], : weight.shape[1]] + 0.5
    return np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()


def list_files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


# Gaussian splatting


def test_3dgs_gets_pinhole_cameras_and_images_that_fit_them(out, tmp_path):
    convert_run(out, "3dgs", tmp_path / "3dgs")
    model = pycolmap.Reconstruction(tmp_path / "3dgs" / "sparse" / "0")
    source = pycolmap.Reconstruction(out / "sparse" / "0")
    assert (model.num_reg_images(), model.num_points3D()) == (4, source.num_points3D())
    assert list_files(tmp_path / "3dgs" / "images") == {image.name for image in model.images.values()}
    assert {path.name for path in (tmp_path / "3dgs").iterdir()} == {"images", "sparse", MADE_MARKER}
    assert model.compute_mean_reprojection_error() == pytest.approx(source.compute_mean_reprojection_error(), abs=1e-3)
    (camera,) = model.cameras.values()
    assert camera.model == pycolmap.CameraModelId.PINHOLE
    (distorted,) = source.cameras.values()
    expected = camera.img_from_cam(np.append(distorted.cam_from_img(np.array(DISC_PX)), 1))
    assert np.linalg.norm(expected - DISC_PX) > 1
    for image in model.images.values():
        path = tmp_path / "3dgs" / "images" / image.name
        assert cv2.imread(str(path)).shape == (camera.height, camera.width, 3)
        np.testing.assert_allclose(find_disc(path), expected, atol=0.3)
        for point2D in image.get_observation_points2D():
            projected = image.project_point(model.points3D[point2D.point3D_id].xyz)
            np.testing.assert_allclose(projected, point2D.xy, atol=0.1)


def test_3dgs_names_have_no_folders_and_stay_different(out, tmp_path):
    convert_run(out, "3dgs", tmp_path / "3dgs")
    names = {"left_1.png", "_left_1.png", "right_1.png", "right_2.png"}
    assert list_files(tmp_path / "3dgs" / "images") == names
    assert not [path for path in (tmp_path / "3dgs" / "images").iterdir() if path.is_dir()]
    poses = {image.name: image.cam_from_world().matrix() for image in read_model(out / "sparse" / "0")}
    flat = {image.name: image.cam_from_world().matrix() for image in read_model(tmp_path / "3dgs" / "sparse" / "0")}
    np.testing.assert_array_equal(flat["_left_1.png"], poses["left/1.png"])
    np.testing.assert_array_equal(flat["left_1.png"], poses["left_1.png"])


def read_model(folder: Path) -> list[pycolmap.Image]:
    read_model.model = pycolmap.Reconstruction(folder)  # images live as long as their model
    return list(read_model.model.images.values())


@pytest.mark.parametrize(("model", "params"), [("SIMPLE_PINHOLE", [300, 160, 120]), ("PINHOLE", [300, 310, 160, 120])])
def test_3dgs_of_cameras_without_distortion(tmp_path, model, params):
    out = make_run(tmp_path, model, params)
    convert_run(out, "3dgs", tmp_path / "3dgs")
    (camera,) = pycolmap.Reconstruction(tmp_path / "3dgs" / "sparse" / "0").cameras.values()
    assert camera.model == pycolmap.CameraModelId.PINHOLE
    assert camera.params.tolist() == [300, params[-3] if model == "PINHOLE" else 300, 160, 120]
    np.testing.assert_allclose(find_disc(tmp_path / "3dgs" / "images" / "right_1.png"), DISC_PX, atol=0.1)


@pytest.mark.parametrize("to", ["3dgs", "nerfstudio"])
def test_undistorted_copies_beside_the_photos_are_no_photos(out, tmp_path, to, caplog):
    convert_run(out, to, tmp_path / "photos" / "converted")
    assert {image.name for image in list_images(tmp_path / "photos").images} == set(NAMES)
    assert caplog.messages == [f"left out: the folder {tmp_path / 'photos' / 'converted'} was made by hm_sfm"]
    assert len(list_images(tmp_path / "photos" / "converted" / "images").images) == 4


def test_mirrored_photos_are_undistorted_as_the_model_sees_them(tmp_path):
    names = ("1.jpg", "2.jpg")
    out = make_run(tmp_path, "SIMPLE_RADIAL", [300.0, 160.0, 120.0, 0.08], names)
    stored = cv2.imread(str(tmp_path / "photos" / names[0]))
    write_jpeg(tmp_path / "photos" / names[1], stored[:, ::-1].copy(), None, orientation=2)
    convert_run(out, "3dgs", tmp_path / "3dgs")
    discs = [find_disc(tmp_path / "3dgs" / "images" / name) for name in names]
    np.testing.assert_allclose(discs[0], discs[1], atol=0.3)


def test_flat_names_differ_where_case_does_not_count():
    names = ["a/b.jpg", "A/B.jpg", "a_b.jpg", "c.jpg", "a/b/c.jpg", "a_b/c.jpg"]
    flat = flatten_names(names)
    assert set(flat) == set(names)
    assert (flat["a_b.jpg"], flat["c.jpg"]) == ("a_b.jpg", "c.jpg")
    assert len({name.lower() for name in flat.values()}) == len(names)
    assert not any("/" in name for name in flat.values())


# nerfstudio


def test_nerfstudio_projects_as_colmap_does(out, tmp_path):
    convert_run(out, "nerfstudio", tmp_path / "ns")
    transforms = json.loads((tmp_path / "ns" / "transforms.json").read_text())
    assert "applied_transform" not in transforms
    source = pycolmap.Reconstruction(out / "sparse" / "0")
    (distorted,) = source.cameras.values()
    poses = {f"images/{image.name}": image.cam_from_world() for image in source.images.values()}
    assert [frame["file_path"] for frame in transforms["frames"]] == sorted(poses)
    points = np.array([point.xyz for point in source.points3D.values()])
    undistorted = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), distorted)
    for frame in transforms["frames"]:
        height, width = cv2.imread(str(tmp_path / "ns" / frame["file_path"])).shape[:2]
        assert (transforms["w"], transforms["h"]) == (width, height)
        cam_from_world = np.linalg.inv(np.array(frame["transform_matrix"]))
        x, y, z = cam_from_world[:3, :3] @ points.T + cam_from_world[:3, 3:]
        assert (z < 0).all()  # in front of a camera of OpenGL
        u = transforms["cx"] + transforms["fl_x"] * x / -z
        v = transforms["cy"] - transforms["fl_y"] * y / -z
        expected = undistorted.img_from_cam(poses[frame["file_path"]] * points)
        np.testing.assert_allclose(np.stack([u, v], axis=1), expected, atol=1e-6)
    cloud = PlyData.read(tmp_path / "ns" / transforms["ply_file_path"])["vertex"]
    assert len(cloud) == len(points)


def test_nerfstudio_with_cameras_of_their_own(out, tmp_path):
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    (camera,) = model.cameras.values()
    second = pycolmap.Camera(camera.todict())
    second.camera_id, second.focal_length = 2, 330.0
    model.add_camera_with_trivial_rig(second)
    image = pycolmap.Image(name="third.png", camera_id=2, image_id=77)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    model.write_binary(out / "sparse" / "0")
    shutil.copy(tmp_path / "photos" / NAMES[0], tmp_path / "photos" / "third.png")
    convert_run(out, "nerfstudio", tmp_path / "ns")
    transforms = json.loads((tmp_path / "ns" / "transforms.json").read_text())
    assert "fl_x" not in transforms
    focals = {frame["file_path"]: frame["fl_x"] for frame in transforms["frames"]}
    assert focals["images/third.png"] == pytest.approx(330) and focals["images/left_1.png"] == pytest.approx(300)


# The others


def test_ply_has_the_points(out, tmp_path):
    convert_run(out, "ply", tmp_path / "new" / "points.ply")
    cloud = PlyData.read(tmp_path / "new" / "points.ply")["vertex"]
    actual = np.stack([cloud["x"], cloud["y"], cloud["z"]], axis=1)
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    expected = np.array([point.xyz for point in model.points3D.values()])
    order, other = np.lexsort(actual.T), np.lexsort(expected.T)
    np.testing.assert_allclose(actual[order], expected[other], rtol=1e-5, atol=1e-6)
    assert {"red", "green", "blue"} <= {field.name for field in cloud.properties}


def test_txt_is_the_same_model(out, tmp_path):
    (tmp_path / "txt").mkdir()  # an empty folder is fine
    convert_run(out, "txt", tmp_path / "txt")
    assert {"cameras.txt", "images.txt", "points3D.txt"} <= list_files(tmp_path / "txt")
    text, binary = pycolmap.Reconstruction(tmp_path / "txt"), pycolmap.Reconstruction(out / "sparse" / "0")
    assert text.num_points3D() == binary.num_points3D()
    assert text.compute_mean_reprojection_error() == pytest.approx(binary.compute_mean_reprojection_error())


def test_txt_warns_of_names_that_cannot_be_read_back(tmp_path, caplog):
    out = make_run(tmp_path, "PINHOLE", [300, 310, 160, 120], ("my photo.png", "b.png", "c.png"))
    convert_run(out, "txt", tmp_path / "txt")
    assert caplog.messages == ["COLMAP cannot read names with spaces from text files, such as 'my photo.png'"]


def test_hloc_gets_keypoints_and_matches_of_the_database(tmp_path):
    images = [ImageRef(name, Path(name), (WIDTH, HEIGHT)) for name in ("b.png", "a/c.png", "z.png")]
    keypoints = [Keypoints(i.name, np.full((n, 2), 10.5) + np.arange(n)[:, None], np.ones(n), np.ones(n))
                 for i, n in zip(images, (3, 4, 0))]  # fmt: skip
    pair = ImagePair("a/c.png", "b.png")
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 300, WIDTH, HEIGHT)
    out = tmp_path / "out"
    out.mkdir()
    matches = [IndexMatches(pair, [(3, 0), (1, 2)], [1, 1])]
    write_database(out / "database.db", images, Cameras((camera,), (0, 0, 0)), keypoints, matches)
    write_pairs(out / "pairs.txt", [pair, ImagePair("b.png", "z.png")])
    convert_run(out, "hloc", tmp_path / "hloc")
    assert list_files(tmp_path / "hloc") == {"features.h5", "matches.h5", "pairs.txt"}
    with h5py.File(tmp_path / "hloc" / "matches.h5") as h5:
        assert h5["a-c.png/b.png/matches0"][()].tolist() == [-1, 2, -1, 0]
        assert h5["b.png/z.png/matches0"][()].tolist() == [-1, -1, -1]
    with h5py.File(tmp_path / "hloc" / "features.h5") as h5:
        np.testing.assert_array_equal(h5["a/c.png/keypoints"][()], np.full((4, 2), 10) + np.arange(4)[:, None])
        assert h5["z.png/keypoints"].shape == (0, 2)


# What does not fit


def test_a_run_without_a_model(tmp_path):
    (tmp_path / "out").mkdir()
    for to in ("3dgs", "nerfstudio", "ply", "txt"):
        with pytest.raises(InputError, match="out holds no model"):
            convert_run(tmp_path / "out", to, tmp_path / "target")
    with pytest.raises(InputError, match="there is no database"):
        convert_run(tmp_path / "out", "hloc", tmp_path / "target")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("to", ["3dgs", "nerfstudio", "ply", "txt", "hloc"])
def test_a_target_that_is_there_already(out, tmp_path, to):
    target = tmp_path / "target"
    if to == "ply":
        target.write_text("mine")
    else:
        target.mkdir()
        (target / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="target is there already"):
        convert_run(out, to, target)
    assert (target if to == "ply" else target / "notes.txt").read_text() == "mine"


def test_photos_that_are_elsewhere(out, tmp_path):
    moved = (tmp_path / "photos").rename(tmp_path / "moved")
    with pytest.raises(InputError, match="photos does not exist: name it with --images"):
        convert_run(out, "3dgs", tmp_path / "3dgs")
    (out / "summary.json").unlink()
    with pytest.raises(InputError, match="summary.json does not say where the photos are"):
        convert_run(out, "3dgs", tmp_path / "3dgs")
    convert_run(out, "3dgs", tmp_path / "3dgs", moved)
    (moved / NAMES[2]).unlink()
    with pytest.raises(InputError, match="lacks 1 of 4 photos of the model, for example 'right/1.png'"):
        convert_run(out, "nerfstudio", tmp_path / "ns", moved)
    assert not (tmp_path / "ns").exists()


@pytest.mark.parametrize("to", ["3dgs", "nerfstudio"])
def test_what_colmap_cannot_undistort(tmp_path, to):
    out = make_run(tmp_path, "SIMPLE_RADIAL", [300.0, 160.0, 120.0, 0.08], ("1.png", "2.webp", "3.png", "4.webp"))
    (tmp_path / "photos" / "2.webp").rename(tmp_path / "photos" / "2.HEIC")
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    next(image for image in model.images.values() if image.name == "2.webp").name = "2.HEIC"
    model.write_binary(out / "sparse" / "0")
    with pytest.raises(InputError, match=r"cannot undistort photos of the kind of .*2.HEIC: convert the 2 of them to"):
        convert_run(out, to, tmp_path / "target")
    convert_run(out, "txt", tmp_path / "txt")
    assert not (tmp_path / "target").exists() and (tmp_path / "txt" / "images.txt").exists()


def test_a_photo_that_cannot_be_read(out, tmp_path, capfd):
    (tmp_path / "photos" / NAMES[1]).write_bytes(b"no image")
    with pytest.raises(InputError, match=f"{NAMES[1]} cannot be decoded as an image"):
        convert_run(out, "3dgs", tmp_path / "3dgs")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "photos"]
    assert capfd.readouterr().err == ""
