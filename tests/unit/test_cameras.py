"""The first guess of each camera."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from hm_sfm.colmap.cameras import make_cameras
from hm_sfm.colmap.scaled_database import scale_camera
from hm_sfm.config import CameraConfig
from hm_sfm.photos.exif import write_jpeg
from hm_sfm.photos.images import read_ref
from hm_sfm.types import ImageRef


def write_photos(folder: Path, focal_35mm: list[float | None]) -> list[ImageRef]:
    pixels = np.full((48, 64, 3), 128, np.uint8)
    names = [f"{number}.jpg" for number in range(len(focal_35mm))]
    for name, focal in zip(names, focal_35mm):
        write_jpeg(folder / name, pixels, focal)
    return [read_ref(folder / name, name) for name in names]


@pytest.mark.parametrize("absurd", [1, 600])
def test_impossible_focal_lengths_in_exif_count_as_none(tmp_path, caplog, absurd):
    images = write_photos(tmp_path, [absurd, absurd, absurd])
    cameras = make_cameras(images, CameraConfig())
    (camera,) = cameras.cameras
    assert camera.focal_length == 0.9 * 64 and not camera.has_prior_focal_length
    (message,) = caplog.messages
    focal_px = absurd / 43.27 * 80  # 64 x 48 px have a diagonal of 80 px
    assert "ignored for 3 of 3 photos" in message and "0.jpg (64 x 48 px)" in message
    assert float(message.split(" px for")[0].split()[-1]) == pytest.approx(focal_px, rel=1e-3)


@pytest.mark.parametrize("focal_35mm", [10, 28, 300])
def test_extreme_lenses_are_believed(tmp_path, caplog, focal_35mm):
    (camera,) = make_cameras(write_photos(tmp_path, [focal_35mm] * 2), CameraConfig()).cameras
    assert camera.has_prior_focal_length and caplog.messages == []
    assert camera.focal_length == pytest.approx(focal_35mm / 43.27 * 80, rel=1e-3)


def test_one_impossible_focal_length_does_not_cost_the_others_theirs(tmp_path, caplog):
    cameras = make_cameras(write_photos(tmp_path, [28, 1, 28]), CameraConfig())
    priors = [cameras.cameras[index].has_prior_focal_length for index in cameras.camera_index]
    assert priors == [True, False, True] and "1 of 3" in caplog.text


@pytest.mark.parametrize(
    ("model", "view_deg"), [("SIMPLE_RADIAL", 58), ("OPENCV", 58), ("OPENCV_FISHEYE", 140), ("SIMPLE_FISHEYE", 140)]
)
def test_the_first_guess_spans_the_view_of_a_usual_lens_of_its_kind(tmp_path, model, view_deg):
    (camera,) = make_cameras(write_photos(tmp_path, [None]), CameraConfig(model=model)).cameras
    edges = camera.cam_ray_from_img(np.array([[0.0, 24.0], [64.0, 24.0]]))
    cosine = edges[0] @ edges[1] / np.prod(np.linalg.norm(edges, axis=1))
    assert np.degrees(np.arccos(cosine)) == pytest.approx(view_deg, abs=1)
    assert isinstance(camera, pycolmap.Camera) and not camera.has_prior_focal_length


MODELS = [model for model in pycolmap.CameraModelId.__members__.values() if model != pycolmap.CameraModelId.INVALID]


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_a_reduced_photo_shows_the_same_at_reduced_places(model):
    camera = pycolmap.Camera.create_from_model_id(1, model, 500.0, 640, 480)
    params = np.array(camera.params)
    params[list(camera.extra_params_idxs())] += 0.01  # distorted
    camera.params = params.tolist()
    points = np.random.default_rng(0).uniform((-2, -1, 4), (2, 1, 6), (20, 3))
    scaled = scale_camera(camera, 4.0)
    assert (scaled.width, scaled.height) == (160, 120) and scaled.model == model
    np.testing.assert_allclose(scaled.img_from_cam(points), np.array(camera.img_from_cam(points)) / 4, atol=1e-9)
    np.testing.assert_allclose(scale_camera(scaled, 0.25).params, camera.params)
