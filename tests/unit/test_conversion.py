"""Runs in the formats of other programs, read by readers that are not ours: pycolmap, plyfile, h5py, json."""

import json
import shutil
from pathlib import Path

import cv2
import h5py
import numpy as np
import pycolmap
import pytest
from PIL import Image, ImageOps
from plyfile import PlyData

from hm_sfm.colmap.cameras import Cameras
from hm_sfm.colmap.database import write_database
from hm_sfm.config import MaskConfig
from hm_sfm.errors import InputError
from hm_sfm.export.conversion import convert_run, flatten_names
from hm_sfm.formats.pairs_files import write_pairs
from hm_sfm.io.markers import MADE_MARKER
from hm_sfm.photos.exif import write_jpeg
from hm_sfm.photos.images import list_images
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints

WIDTH, HEIGHT = 320, 240
NAMES = ("left/1.png", "left_1.png", "right/1.png", "right/2.png")
ORIENTATION = 0x0112
"""EXIF's tag."""
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


DISTORTIONS = {
    "SIMPLE_PINHOLE": [300, 158, 121],
    "PINHOLE": [300, 310, 158, 121],
    "SIMPLE_RADIAL": [300, 158, 121, 0.08],
    "RADIAL": [300, 158, 121, 0.08, -0.02],
    "OPENCV": [300, 310, 158, 121, 0.08, -0.02, 0.01, -0.01],
    "FULL_OPENCV": [300, 310, 158, 121, 0.08, -0.02, 0.01, -0.01, 0.01, 0, 0.01, 0],
    "FOV": [300, 310, 158, 121, 0.6],
    "SIMPLE_DIVISION": [300, 158, 121, -0.1],
    "DIVISION": [300, 310, 158, 121, -0.1],
    "EUCM": [300, 310, 158, 121, 0.5, 1.1],
    "SIMPLE_FISHEYE": [200, 158, 121],
    "FISHEYE": [200, 210, 158, 121],
    "SIMPLE_RADIAL_FISHEYE": [200, 158, 121, 0.05],
    "RADIAL_FISHEYE": [200, 158, 121, 0.05, -0.01],
    "OPENCV_FISHEYE": [200, 210, 158, 121, 0.05, -0.01, 0, 0],
    "THIN_PRISM_FISHEYE": [200, 210, 158, 121, 0.05, -0.01, 0.01, 0, 0, 0, 0, 0],
    "RAD_TAN_THIN_PRISM_FISHEYE": [200, 210, 158, 121, 0.05, -0.01, 0, 0, 0, 0, 0.01, 0, 0, 0, 0, 0],
}
"""Each model of perspective cameras, and parameters with distortion."""


def test_all_models_of_colmap_are_tested():
    models = set(pycolmap.CameraModelId.__members__) - {"INVALID"}
    cameras = [pycolmap.Camera.create_from_model_name(1, model, 300, WIDTH, HEIGHT) for model in models]
    assert {camera.model_name for camera in cameras if camera.is_perspective()} == set(DISTORTIONS)


@pytest.mark.parametrize("distorted", [True, False], ids=["distorted", "not distorted"])
@pytest.mark.parametrize("model_name", DISTORTIONS)
def test_each_model_of_cameras_becomes_pinhole_with_photos_that_fit(tmp_path, model_name, distorted):
    camera = pycolmap.Camera.create_from_model_name(1, model_name, 300, WIDTH, HEIGHT)
    params = np.array(DISTORTIONS[model_name], float)
    if not distorted:
        params[camera.extra_params_idxs()] = camera.params[camera.extra_params_idxs()]
    camera.params = params
    out = make_run(tmp_path, model_name, params.tolist(), ("a.png", "b/c.png"))
    convert_run(out, "nerfstudio", tmp_path / "ns")
    convert_run(out, "3dgs", tmp_path / "3dgs")

    model = pycolmap.Reconstruction(tmp_path / "3dgs" / "sparse" / "0")
    (pinhole,) = model.cameras.values()
    assert pinhole.model == pycolmap.CameraModelId.PINHOLE
    transforms = json.loads((tmp_path / "ns" / "transforms.json").read_text())
    intrinsics = [transforms[key] for key in ("fl_x", "fl_y", "cx", "cy")]
    assert intrinsics == pinhole.params.tolist() and (transforms["w"], transforms["h"]) == (
        pinhole.width,
        pinhole.height,
    )
    expected = pinhole.img_from_cam(np.append(camera.cam_from_img(np.array(DISC_PX)), 1))
    for path in (tmp_path / "ns" / "images" / "b" / "c.png", tmp_path / "3dgs" / "images" / "b_c.png"):
        assert cv2.imread(str(path)).shape == (pinhole.height, pinhole.width, 3)
        np.testing.assert_allclose(find_disc(path), expected, atol=0.3)
    if not distorted and camera.is_perspective_pinhole() and model_name not in ("FOV", "EUCM"):
        assert intrinsics == [camera.focal_length_x, camera.focal_length_y, 158, 121]
        assert (tmp_path / "ns/images/a.png").read_bytes() == (tmp_path / "photos/a.png").read_bytes()
    for image in model.images.values():
        for point2D in image.get_observation_points2D():
            projected = image.project_point(model.points3D[point2D.point3D_id].xyz)
            np.testing.assert_allclose(projected, point2D.xy, atol=0.1)


def test_what_no_pinhole_camera_can_show_is_left_out(tmp_path):
    """Keypoints where the camera model has no ray."""
    out = make_run(tmp_path, "EUCM", [150, 150, 160, 120, 0.9, 2.0], ("a.png", "b.png"))
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    image = next(iter(model.images.values()))
    index = next(i for i in range(len(image.points2D)) if image.points2D[i].has_point3D())
    image.points2D[index].xy = (2, 120)
    observations = model.compute_num_observations()
    model.write_binary(out / "sparse" / "0")
    convert_run(out, "3dgs", tmp_path / "3dgs")
    converted = pycolmap.Reconstruction(tmp_path / "3dgs" / "sparse" / "0")
    assert 0 < converted.compute_num_observations() < observations
    assert all(np.isfinite(p.xy).all() for i in converted.images.values() for p in i.get_observation_points2D())


def test_photos_of_another_size_than_their_camera(out, tmp_path):
    cv2.imwrite(str(tmp_path / "photos" / NAMES[2]), np.zeros((HEIGHT, WIDTH // 2, 3), np.uint8))
    with pytest.raises(InputError, match=f"{NAMES[2]} is 160 x 240 px but its camera in the model is of 320 x 240 px"):
        convert_run(out, "3dgs", tmp_path / "3dgs")


def test_a_full_disk_is_no_success(out, tmp_path, monkeypatch):
    monkeypatch.setattr(pycolmap.Bitmap, "write", lambda *_: False)
    with pytest.raises(InputError, match=r"cannot write the undistorted photo .*left/1.png"):
        convert_run(out, "3dgs", tmp_path / "3dgs")
    assert not (tmp_path / "3dgs").exists()


# Orientation, transparency, masks


@pytest.mark.parametrize("params", [[300.0, 160.0, 120.0, 0.08], [300.0, 160.0, 120.0, 0.0]], ids=["distorted", "not"])
@pytest.mark.parametrize("orientation", [1, 2, 3, 6, 8])
def test_nobody_turns_undistorted_copies(tmp_path, orientation, params):
    out = make_run(tmp_path, "SIMPLE_RADIAL", params, ("a.jpg", "b.jpg"))
    for name in ("a.jpg", "b.jpg"):
        pixels = cv2.cvtColor(cv2.imread(str(tmp_path / "photos" / name)), cv2.COLOR_BGR2RGB)
        write_jpeg(tmp_path / "photos" / name, pixels, 28, orientation=orientation)
    convert_run(out, "nerfstudio", tmp_path / "ns")
    transforms = json.loads((tmp_path / "ns" / "transforms.json").read_text())
    with Image.open(tmp_path / "ns" / "images" / "a.jpg") as photo:
        assert ImageOps.exif_transpose(photo).size == photo.size == (transforms["w"], transforms["h"])
        assert photo.getexif().get(ORIENTATION, 1) == 1
    if orientation != 2:  # the model's coordinates are those of the flipped photo then
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 300, WIDTH, HEIGHT)
        camera.params = params
        x, y = camera.cam_from_img(np.array(DISC_PX))
        expected = transforms["fl_x"] * x + transforms["cx"], transforms["fl_y"] * y + transforms["cy"]
        np.testing.assert_allclose(find_disc(tmp_path / "ns" / "images" / "a.jpg"), expected, atol=0.3)


def write_transparent(path: Path) -> None:
    """The disc in front of nothing."""
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    Image.fromarray(np.dstack([grey, grey, grey, np.where(grey > 60, 255, 0).astype(np.uint8)])).save(path)


@pytest.mark.parametrize("to", ["3dgs", "nerfstudio"])
@pytest.mark.parametrize("k", [0.08, 0.0])
def test_transparency_stays(tmp_path, to, k):
    out = make_run(tmp_path, "SIMPLE_RADIAL", [300.0, 160.0, 120.0, k], ("a.png", "b.png"))
    write_transparent(tmp_path / "photos" / "a.png")
    convert_run(out, to, tmp_path / "to")
    with Image.open(tmp_path / "to" / "images" / "a.png") as photo, Image.open(tmp_path / "to/images/b.png") as opaque:
        assert (photo.mode, opaque.mode) == ("RGBA", "RGB") and photo.size == opaque.size
        alpha = np.array(photo.getchannel("A"))
    Image.fromarray(alpha).save(tmp_path / "alpha.png")
    np.testing.assert_allclose(find_disc(tmp_path / "alpha.png"), find_disc(tmp_path / "to/images/b.png"), atol=0.3)
    assert not (tmp_path / "to" / "masks").exists()


def add_masks(tmp_path: Path, out: Path, names: tuple[str, ...]) -> Path:
    """Masks in which the disc alone is not masked out, known to the run."""
    folder = tmp_path / "masks"
    folder.mkdir()
    for name in names:
        grey = cv2.imread(str(tmp_path / "photos" / name), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(folder / f"{name}.png"), np.where(grey > 60, 255, 0).astype(np.uint8))
    summary = json.loads((out / "summary.json").read_text()) | {"masks": {"folder": str(folder), "camera": ""}}
    (out / "summary.json").write_text(json.dumps(summary))
    return folder


@pytest.mark.parametrize("k", [0.08, 0.0])
def test_masks_become_files_for_nerfstudio_and_transparent_for_3dgs(tmp_path, k):
    names = ("a.jpg", "b.jpg")
    out = make_run(tmp_path, "SIMPLE_RADIAL", [300.0, 160.0, 120.0, k], names)
    add_masks(tmp_path, out, names[:1])
    convert_run(out, "nerfstudio", tmp_path / "ns")
    frames = {f["file_path"]: f for f in json.loads((tmp_path / "ns" / "transforms.json").read_text())["frames"]}
    assert {path: frame["mask_path"] for path, frame in frames.items()} == {
        "images/a.jpg": "masks/a.jpg.png", "images/b.jpg": "masks/b.jpg.png",
    }  # fmt: skip
    place = find_disc(tmp_path / "ns" / "images" / "a.jpg")
    np.testing.assert_allclose(find_disc(tmp_path / "ns" / "masks" / "a.jpg.png"), place, atol=0.3)
    unmasked = cv2.imread(str(tmp_path / "ns" / "masks" / "b.jpg.png"), cv2.IMREAD_GRAYSCALE)
    assert unmasked.shape == cv2.imread(str(tmp_path / "ns/images/b.jpg")).shape[:2] and unmasked.min() == 255

    convert_run(out, "3dgs", tmp_path / "3dgs")
    assert list_files(tmp_path / "3dgs" / "images") == {"a.jpg.png", "b.jpg"}
    with Image.open(tmp_path / "3dgs" / "images" / "a.jpg.png") as photo:
        photo.getchannel("A").save(tmp_path / "alpha.png")
    np.testing.assert_allclose(find_disc(tmp_path / "alpha.png"), place, atol=0.3)
    model = pycolmap.Reconstruction(tmp_path / "3dgs" / "sparse" / "0")
    assert {image.name for image in model.images.values()} == {"a.jpg.png", "b.jpg"}


def test_masks_that_were_moved(tmp_path):
    out = make_run(tmp_path, "PINHOLE", [300.0, 310.0, 160.0, 120.0], ("a.png", "b.png"))
    masks = add_masks(tmp_path, out, ("a.png", "b.png"))
    moved = masks.rename(tmp_path / "moved")
    with pytest.raises(InputError, match="made with the masks .*masks, which do not exist: name them with --masks"):
        convert_run(out, "3dgs", tmp_path / "3dgs")
    convert_run(out, "3dgs", tmp_path / "3dgs", masks=MaskConfig(str(moved)))
    with Image.open(tmp_path / "3dgs" / "images" / "b.png") as photo:
        assert photo.mode == "RGBA"


# Large coordinates


UTM = np.array([500000.0, 4649776.0, 120.0])


@pytest.fixture
def utm(out) -> Path:
    """The run with its model moved to UTM coordinates."""
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), UTM))
    model.write_binary(out / "sparse" / "0")
    return out


def read_cloud(path: Path) -> np.ndarray:
    """(N, 3) in the order of y."""
    cloud = PlyData.read(path)["vertex"]
    xyz = np.stack([cloud["x"], cloud["y"], cloud["z"]], axis=1)
    return xyz[np.argsort(xyz[:, 1])]


def read_points(folder: Path) -> np.ndarray:
    xyz = np.array([point.xyz for point in pycolmap.Reconstruction(folder).points3D.values()])
    return xyz[np.argsort(xyz[:, 1])]


def test_a_ply_of_utm_coordinates_loses_nothing(utm, tmp_path):
    convert_run(utm, "ply", tmp_path / "points.ply")
    np.testing.assert_array_equal(read_cloud(tmp_path / "points.ply"), read_points(utm / "sparse" / "0"))


def test_text_of_utm_coordinates_loses_nothing(utm, tmp_path):
    convert_run(utm, "txt", tmp_path / "txt")
    np.testing.assert_allclose(read_points(tmp_path / "txt"), read_points(utm / "sparse" / "0"), rtol=1e-15)


@pytest.mark.parametrize("to", ["3dgs", "nerfstudio"])
def test_models_for_single_precision_are_moved_and_say_so(utm, tmp_path, to, caplog):
    convert_run(utm, to, tmp_path / "to")
    offset = np.array(json.loads((tmp_path / "to" / "offset.json").read_text())["offset"])
    assert np.abs(offset - UTM).max() < 20 and (offset == offset.round()).all()
    assert [record.message[:33] for record in caplog.records] == ["the coordinates are too large for"]
    source = pycolmap.Reconstruction(utm / "sparse" / "0")
    centres = {image.name.replace("/", "_"): image.projection_center() for image in source.images.values()}
    if to == "3dgs":
        points = read_points(tmp_path / "to" / "sparse" / "0")
        moved = {image.name: image.projection_center() for image in read_model(tmp_path / "to" / "sparse" / "0")}
        moved = {name.removeprefix("_") if name == "_left_1.png" else name: xyz for name, xyz in moved.items()}
        centres.pop("left_1.png"), moved.pop("left_1.png")
    else:
        points = read_cloud(tmp_path / "to" / "points3D.ply")
        frames = json.loads((tmp_path / "to" / "transforms.json").read_text())["frames"]
        moved = {
            frame["file_path"][7:].replace("/", "_"): np.array(frame["transform_matrix"])[:3, 3] for frame in frames
        }
        centres.pop("left_1.png"), moved.pop("left_1.png")
    np.testing.assert_allclose(points + offset, read_points(utm / "sparse" / "0"), atol=1e-6)
    assert len(np.unique(points[:, 1].astype(np.float32))) == len(points)
    assert moved.keys() == centres.keys()
    for name, centre in centres.items():
        np.testing.assert_allclose(moved[name].astype(np.float32) + offset, centre, atol=1e-5)


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


def test_flat_names_are_no_longer_than_names_of_files_may_be(tmp_path):
    folder, file = "f" * 150, "p" * 116 + ".jpg"
    names = [f"{folder}/{file}", f"{folder}x/{file}", f"{'ü' * 75}/{'ä' * 75}.jpg"]
    flat = flatten_names(names)
    assert len(set(flat.values())) == 3 and max(len(name.encode()) for name in flat.values()) <= 240
    assert all(flat[name].endswith(f"_{name.split('/')[1]}") for name in names)
    out = make_run(tmp_path, "SIMPLE_RADIAL", [300.0, 160.0, 120.0, 0.08], tuple(names))
    convert_run(out, "3dgs", tmp_path / "3dgs")
    assert list_files(tmp_path / "3dgs" / "images") == set(flat.values())


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


def test_kinds_that_colmap_cannot_read_become_jpegs(tmp_path):
    out = make_run(tmp_path, "SIMPLE_RADIAL", [300.0, 160.0, 120.0, 0.08], ("1.png", "2.webp"))
    convert_run(out, "3dgs", tmp_path / "3dgs")
    assert list_files(tmp_path / "3dgs" / "images") == {"1.png", "2.webp.jpg"}
    first, second = (find_disc(tmp_path / "3dgs" / "images" / name) for name in ("1.png", "2.webp.jpg"))
    np.testing.assert_allclose(first, second, atol=0.3)


def test_a_photo_that_cannot_be_read(out, tmp_path, capfd):
    (tmp_path / "photos" / NAMES[1]).write_bytes(b"no image")
    with pytest.raises(InputError, match=f"{NAMES[1]} cannot be decoded as an image"):
        convert_run(out, "3dgs", tmp_path / "3dgs")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "photos"]
    assert capfd.readouterr().err == ""
