"""Pictures as files: the same pixels, and no crash whichever library was imported first."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import hm_sfm
from hm_sfm.io.pictures import encode_drawing, encode_picture, is_drawing
from hm_sfm.photos.images import list_images
from hm_sfm.report.pair_picture import write_picture

ENCODE_AFTER = """
import importlib, os, sys

for module in sys.argv[1:]:
    child = os.fork()
    if child == 0:
        importlib.import_module(module)
        import numpy as np
        from hm_sfm.io.pictures import encode_drawing, encode_picture
        for ending in (".png", ".jpg", ".webp"):
            assert encode_picture(np.zeros((64, 64, 3), np.uint8), ending)
            assert encode_drawing(np.zeros((64, 64, 3), np.uint8), ending)
        os._exit(0)
    print(module, os.waitpid(child, 0)[1])
"""


@pytest.mark.parametrize("ending", [".png", ".jpg", ".jpeg", ".webp"])
def test_a_picture_is_blue_green_red(ending):
    picture = np.zeros((32, 48, 3), np.uint8)
    picture[:, :16], picture[:, 16:32], picture[:, 32:] = (250, 20, 10), (10, 240, 20), (30, 20, 245)
    decoded = cv2.imdecode(np.frombuffer(encode_picture(picture, ending), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_allclose(decoded[:, 4:12], picture[:, 4:12], atol=0 if ending == ".png" else 40)
    if ending == ".png":
        np.testing.assert_array_equal(decoded, picture)
        grey = picture[:, :, 0]
        code = np.frombuffer(encode_picture(grey, ending), np.uint8)
        np.testing.assert_array_equal(cv2.imdecode(code, cv2.IMREAD_UNCHANGED), grey)


@pytest.mark.parametrize("ending", [".png", ".jpg", ".jpeg", ".webp"])
def test_drawings_are_known_as_such_and_are_no_photos(tmp_path, ending, caplog):
    picture = np.zeros((32, 48, 3), np.uint8)
    picture[:, :16], picture[:, 16:32], picture[:, 32:] = (250, 20, 10), (10, 240, 20), (30, 20, 245)
    decoded = cv2.imdecode(np.frombuffer(encode_drawing(picture, ending), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_allclose(decoded[:, 4:12], picture[:, 4:12], atol=0 if ending == ".png" else 40)
    write_picture(tmp_path / f"drawn{ending}", picture)
    (tmp_path / f"photo{ending}").write_bytes(encode_picture(picture, ending))
    assert [is_drawing(path) for path in sorted(tmp_path.iterdir())] == [True, False]
    listing = list_images(tmp_path)
    assert [image.name for image in listing.images] == [f"photo{ending}"]
    assert listing.skipped == (
        (f"drawn{ending}", f"{tmp_path / f'drawn{ending}'} is a picture that hm_sfm drew, not a photo"),
    )
    assert caplog.messages == [f"skipped: {listing.skipped[0][1]}"]


@pytest.mark.parametrize("ending", [".png", ".jpg", ".webp"])
def test_drawings_of_strips_fit_into_any_file(ending):
    picture = np.zeros((40, 25_000, 3), np.uint8)
    picture[:, 12_500:] = 250
    decoded = cv2.imdecode(np.frombuffer(encode_drawing(picture, ending), np.uint8), cv2.IMREAD_COLOR)
    assert decoded.shape == (26, 16_383, 3) and decoded[:, :8000].max() < 20 and decoded[:, 8400:].min() > 230


@pytest.mark.slow
def test_pictures_are_encoded_whichever_module_comes_first():
    """In processes of their own. With pycolmap before all else, OpenCV's PNG encoder ends the process."""
    modules = ["pycolmap", "cv2", "hm_sfm.io.colmap_log", "hm_sfm.photos.masks", "hm_sfm.colmap.mapping",
               "hm_sfm.colmap.database", "hm_sfm.export.conversion", "hm_sfm.synthetic.demo"]  # fmt: skip
    done = subprocess.run([sys.executable, "-c", ENCODE_AFTER, *modules], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [f"{module} 0" for module in modules], done.stderr


def test_nothing_else_encodes_pictures_as_png_by_opencv():
    package = Path(hm_sfm.__file__).parent
    writers = {path.name for path in package.rglob("*.py") if "cv2.imencode" in path.read_text()}
    writers |= {path.name for path in package.rglob("*.py") if "cv2.imwrite" in path.read_text()}
    assert writers == {"pictures.py", "gather.py", "exif.py", "photos.py"}  # the other three: JPEG
