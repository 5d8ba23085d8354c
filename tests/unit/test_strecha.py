import numpy as np
import pycolmap
import pytest

from hm_sfm.errors import InputError
from hm_sfm.formats.strecha import read_strecha_cameras, write_strecha_cameras
from hm_sfm.types import PinholeView

CAMERA_FILE = "500 0 319.5\n0 500 239.5\n0 0 1\n0 0 0\n1 0 0\n0 0 -1\n0 1 0\n1 2 3\n640 480\n"


def test_strecha_file_means_what_its_formula_says(tmp_path):
    (tmp_path / "0.jpg.camera").write_text(CAMERA_FILE)
    view = read_strecha_cameras(tmp_path)["0.jpg"]
    point = np.array([1.4, 5.0, 2.7])
    rotation = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    x = np.array([[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]]) @ rotation.T @ (point - [1, 2, 3])
    xy_px, depth = view.project(point[None])
    assert xy_px[0] == pytest.approx(x[:2] / x[2] + 0.5) and depth[0] == pytest.approx(x[2])
    assert view.size_wh == (640, 480) and view.center == pytest.approx([1, 2, 3])


def test_strecha_files_round_trip(tmp_path):
    rng = np.random.default_rng(3)
    views = {}
    for name in ("0.jpg", "1.jpg", "2.jpg"):
        rotation = pycolmap.Rotation3d(rng.normal(size=3)).matrix()
        pose = np.column_stack([rotation, rng.uniform(-2, 2, 3)])
        views[name] = PinholeView(np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), (640, 480), pose)
    write_strecha_cameras(tmp_path / "new", views)
    again = read_strecha_cameras(tmp_path / "new")
    assert list(again) == list(views)
    for name, view in views.items():
        np.testing.assert_allclose(again[name].cam_from_world, view.cam_from_world, atol=1e-12)
        np.testing.assert_allclose(again[name].K, view.K, atol=1e-12)
        assert again[name].size_wh == view.size_wh
    assert len(list((tmp_path / "new").iterdir())) == len(views)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "26 finite numbers"),
        (CAMERA_FILE.replace("640 480", "640"), "26 finite numbers"),
        (CAMERA_FILE.replace("1 2 3", "1 nan 3"), "26 finite numbers"),
        (CAMERA_FILE.replace("1 2 3", "1 two 3"), "two"),
        (CAMERA_FILE.replace("0 0 -1", "0 0 1"), "rotation"),
        (CAMERA_FILE.replace("0 0 -1", "0 0 -2"), "rotation"),
        (CAMERA_FILE.replace("640 480", "640 0"), "width and height"),
    ],
)
def test_malformed_strecha_files_are_named(tmp_path, text, reason):
    (tmp_path / "0.jpg.camera").write_text(text)
    with pytest.raises(InputError, match=rf"0\.jpg\.camera.*{reason}"):
        read_strecha_cameras(tmp_path)


@pytest.mark.parametrize("folder", ["", "absent"])
def test_folder_without_ground_truth_is_named(tmp_path, folder):
    with pytest.raises(InputError, match="holds no ground truth"):
        read_strecha_cameras(tmp_path / folder)
