"""hm-sfm show: one pair of photos, drawn."""

import cv2
import numpy as np
import pytest

from hm_sfm.photos.exif import write_jpeg
from hm_sfm.report.drawn_matches import GAP_PX


def test_show_draws_matches_and_the_warped_photo(scene, tmp_path, run):
    a, b = scene.images / "view_00.jpg", scene.images / "view_01.jpg"
    finished = run("show", a, b, tmp_path / "pair.png")
    assert finished.code == 0, finished.err
    first, second = finished.out.splitlines()
    assert first.startswith("view_00.jpg, view_01.jpg: ") and first.endswith("agree with one geometry: verified")
    assert second == f"picture: {tmp_path / 'pair.png'}"
    picture = cv2.imread(str(tmp_path / "pair.png"))
    assert picture.shape == (480 + GAP_PX, 640 + GAP_PX, 3)
    above, below = picture[:240], picture[240 + GAP_PX :]
    assert (above[..., 1].astype(int) - above[..., 2] > 60).mean() > 0.01  # green lines
    # Where B was warped it looks like A, and less so where it was not warped.
    photo_a, photo_b = (cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(float) for path in (a, b))
    warped = below[:, :320, 0].astype(float)
    covered = warped > 0
    assert covered.mean() > 0.3
    error, unwarped = (np.abs(image - photo_a)[covered].mean() for image in (warped, photo_b))
    assert error < 0.6 * unwarped


@pytest.mark.slow
def test_a_photo_on_its_side_and_one_of_the_same_name(scene, tmp_path, run):
    a = scene.images / "view_00.jpg"
    photo = cv2.cvtColor(cv2.imread(str(scene.images / "view_01.jpg")), cv2.COLOR_BGR2RGB)
    write_jpeg(tmp_path / "view_00.jpg", cv2.rotate(photo, cv2.ROTATE_90_COUNTERCLOCKWISE), 28, orientation=6)
    finished = run("show", a, tmp_path / "view_00.jpg", tmp_path / "pair.png")
    assert finished.code == 0, finished.err
    assert finished.out.splitlines()[0].endswith("geometry: verified")
    picture = cv2.imread(str(tmp_path / "pair.png"))
    assert picture.shape == (480 + GAP_PX, 640 + GAP_PX, 3)  # upright again


def test_photos_of_different_places_are_not_verified(scene, tmp_path, run):
    noise = np.random.default_rng(0).integers(0, 255, (200, 100), np.uint8)
    cv2.imwrite(str(tmp_path / "noise.png"), noise)
    finished = run("show", scene.images / "view_00.jpg", tmp_path / "noise.png", tmp_path / "pair.jpg")
    assert finished.code == 0, finished.err
    assert "not verified" in finished.out
    assert cv2.imread(str(tmp_path / "pair.jpg")).shape == (480 + GAP_PX, 640 + GAP_PX, 3)


@pytest.mark.parametrize("fault", ["missing photo", "no picture", "missing folder"])
def test_bad_input_is_said_in_one_line(fault, scene, tmp_path, run):
    a = scene.images / "view_00.jpg"
    b = tmp_path / "none.jpg" if fault == "missing photo" else a
    picture = tmp_path / {"no picture": "pair.txt", "missing folder": "none/pair.png"}.get(fault, "pair.png")
    finished = run("show", a, b, picture)
    assert finished.code == 2
    (line,) = finished.err.splitlines()
    assert line.startswith("hm-sfm: ") and str(tmp_path) in line
    assert not list(tmp_path.iterdir())
