"""Photos of kinds that COLMAP cannot read: HEIC, turned as phones store it, WebP, AVIF, GIF; and their EXIF."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pillow_heif
import pycolmap
import pytest
from PIL import Image

from hm_sfm.colmap.cameras import make_cameras
from hm_sfm.colmap.database import open_database, write_database
from hm_sfm.config import CameraConfig
from hm_sfm.errors import InputError, MissingPackageError
from hm_sfm.pairs.selection import pair_spatially
from hm_sfm.photos.bitmaps import open_to_colmap, read_bitmap
from hm_sfm.photos.images import list_images, prepare_image, read_ref
from hm_sfm.types import Keypoints


def textured(width: int, height: int) -> np.ndarray:
    """(H, W, 3) uint8, smooth."""
    small = np.random.default_rng(0).integers(20, 236, (height // 16, width // 16, 3), dtype=np.uint8)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)


def write_photo(path: Path, stored: np.ndarray, orientation: int = 1) -> Path:
    """A HEIC or JPEG with the EXIF of a phone; HEIC says by itself, too, how it is turned."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif[0x010F], exif[0x0110] = "Phone", "Twelve"
    exif[0x8769] = {0xA405: 28}
    exif[0x8825] = {1: "S", 2: (33.0, 30.0, 36.0), 3: "W", 4: (70.0, 45.0, 0.0), 5: b"\0", 6: 512.5}
    image = Image.fromarray(stored)
    if path.suffix.lower() not in (".heic", ".heif"):
        image.save(path, "JPEG" if path.suffix == ".jpe" else None, exif=exif, quality=98)
    else:
        pillow_heif.from_pillow(image).save(path, quality=98, exif=exif.tobytes())
    return path


@pytest.mark.parametrize(("orientation", "turn"), [(1, None), (3, cv2.ROTATE_180), (6, cv2.ROTATE_90_CLOCKWISE)])
def test_heic_comes_upright_and_is_not_turned_again(tmp_path, orientation, turn):
    stored = textured(320, 240)
    write_photo(tmp_path / "a.HEIC", stored, orientation)
    write_photo(tmp_path / "b.jpg", stored, orientation)
    upright = stored if turn is None else cv2.rotate(stored, turn)

    heic, jpeg = list_images(tmp_path).images

    assert heic.size_wh == upright.shape[1::-1] and heic.rotation_deg == 0
    assert heic.gps == jpeg.gps is not None
    prepared = [prepare_image(photo, 160) for photo in (heic, jpeg)]
    assert prepared[0].scaled_wh == prepared[1].scaled_wh
    assert np.abs(prepared[0].grey - prepared[1].grey).mean() < 0.01
    np.testing.assert_allclose(prepared[0].stored_from_scaled, np.diag([2, 2, 1]))
    rgb = read_bitmap(heic.path, as_rgb=True).to_array()
    assert np.abs(rgb.astype(int) - upright).mean() < 4


def test_the_focal_length_arrives_as_it_does_of_a_jpeg(tmp_path):
    for name in ("a.heic", "b.jpg"):
        write_photo(tmp_path / name, textured(320, 240))
    images = list_images(tmp_path).images
    (camera,) = make_cameras(images, CameraConfig()).cameras  # one: same size, same lens
    assert camera.has_prior_focal_length
    assert camera.focal_length == pycolmap.infer_camera_from_image(tmp_path / "b.jpg").focal_length


def test_heic_that_is_grey_transparent_or_without_exif(tmp_path):
    rgb = textured(64, 48)
    images = {"grey": Image.fromarray(rgb).convert("L"), "rgba": Image.fromarray(np.dstack([rgb, rgb[:, :, 0]]))}
    for name, image in images.items():
        pillow_heif.from_pillow(image).save(tmp_path / f"{name}.heif", quality=98)
    photos = list_images(tmp_path).images
    assert [photo.name for photo in photos] == ["grey.heif", "rgba.heif"]
    expected = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) / 255
    for photo in photos:
        assert photo.gps is None and np.abs(prepare_image(photo, 64).grey - expected).mean() < 0.02


def test_a_jpeg_that_is_named_heic_is_read_as_what_it_is(tmp_path):
    write_photo(tmp_path / "a.jpg", textured(320, 240), 6).rename(tmp_path / "a.heic")
    (photo,) = list_images(tmp_path).images
    assert (photo.size_wh, photo.rotation_deg) == ((320, 240), 90)
    assert prepare_image(photo, 320).scaled_wh == (240, 320)


def test_heic_that_is_named_jpg_is_read_as_what_it_is(tmp_path, monkeypatch, caplog):
    write_photo(tmp_path / "a.heic", textured(320, 240), 6).rename(tmp_path / "a.jpg")
    (photo,) = list_images(tmp_path).images
    assert (photo.size_wh, photo.rotation_deg) == ((240, 320), 0) and prepare_image(photo, 320).scaled_wh == (240, 320)
    write_photo(tmp_path / "b.jpg", textured(320, 240))
    monkeypatch.setattr("hm_sfm.photos.bitmaps.can_read_heic", lambda: False)
    listing = list_images(tmp_path)
    assert [photo.name for photo in listing.images] == ["b.jpg"]
    assert caplog.messages == [f"skipped: {listing.skipped[0][1]}"] and "a.jpg is HEIC" in caplog.text


@pytest.mark.parametrize("name", ["a.webp", "a.avif", "a.jpe", "a.jfif", "a.mpo", "a.gif", "a.jp2"])
@pytest.mark.parametrize("orientation", [1, 5, 6])
def test_other_kinds_of_photos(tmp_path, name, orientation):
    stored = textured(320, 240)
    write_photo(tmp_path / name, stored, orientation)
    write_photo(tmp_path / "b.jpg", stored, orientation)
    photo, jpeg = list_images(tmp_path).images
    assert photo.size_wh == (320, 240)
    if name not in ("a.gif", "a.jp2"):  # they have no EXIF
        assert (photo.gps, photo.rotation_deg, photo.mirrored) == (jpeg.gps, jpeg.rotation_deg, jpeg.mirrored)
        assert len(make_cameras([photo, jpeg], CameraConfig()).cameras) == 1
    expected = cv2.cvtColor(stored, cv2.COLOR_RGB2GRAY) / 255
    shown = prepare_image(replace(photo, rotation_deg=0, mirrored=False), 320).grey
    assert np.abs(shown - expected).mean() < 0.04
    with open_to_colmap([photo], tmp_path) as folder:
        seen = pycolmap.Bitmap.read(folder / photo.name, as_rgb=True).to_array()
    assert np.abs(seen[:, :: -1 if photo.flipped else 1].astype(float) - stored).mean() < 15


def test_exif_that_pillow_cannot_write_again_loses_no_photo(tmp_path):
    image = Image.fromarray(textured(64, 48))
    image.save(tmp_path / "a.webp", exif=b"Exif\0\0MM\0*\0\0\0\x08\xff\xff" + bytes(range(200)))
    assert read_ref(tmp_path / "a.webp").size_wh == (64, 48)


def test_damaged_heic_is_skipped(tmp_path, capfd):
    whole = write_photo(tmp_path / "good.heic", textured(320, 240)).read_bytes()
    for name, data in {"cut": whole[:-10], "half": whole[: len(whole) // 2], "empty": b"", "text": b"no image"}.items():
        (tmp_path / f"{name}.heic").write_bytes(data)
    listing = list_images(tmp_path)
    assert [photo.name for photo in listing.images] == ["good.heic"]
    assert [name for name, _ in listing.skipped] == ["cut.heic", "empty.heic", "half.heic", "text.heic"]
    assert all("cannot be decoded as an image" in reason for _, reason in listing.skipped)
    assert capfd.readouterr().err == ""


def test_without_the_package_one_line_says_how_to_install_it(tmp_path, monkeypatch):
    path = write_photo(tmp_path / "a.heic", textured(64, 48))
    monkeypatch.setattr("hm_sfm.photos.bitmaps.can_read_heic", lambda: False)
    with pytest.raises(MissingPackageError, match=r'a.heic is HEIC, .* pip install "hm_sfm\[heif\]"'):
        read_ref(path)


@pytest.mark.parametrize("flags", [[], [cv2.IMWRITE_WEBP_QUALITY, 101]], ids=["lossy", "lossless"])
def test_webp(tmp_path, flags):
    rgb = textured(64, 48)
    cv2.imwrite(str(tmp_path / "a.webp"), rgb[:, :, ::-1], flags)
    photo = read_ref(tmp_path / "a.webp")
    assert photo.size_wh == (64, 48) and not make_cameras([photo], CameraConfig()).cameras[0].has_prior_focal_length
    expected = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) / 255
    assert np.abs(prepare_image(photo, 64).grey - expected).mean() < 0.03
    assert np.abs(read_bitmap(photo.path, as_rgb=True).to_array().astype(int) - rgb).mean() < 8
    whole = photo.path.read_bytes()
    photo.path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="a.webp"):
        read_ref(photo.path)


def test_colmap_gets_files_that_it_can_read(tmp_path):
    (tmp_path / "left").mkdir()
    write_photo(tmp_path / "left" / "a.heic", textured(64, 48))
    write_photo(tmp_path / "a.jpg", textured(64, 48))
    images = list_images(tmp_path).images
    with open_to_colmap(images, tmp_path) as folder:
        read = [pycolmap.Bitmap.read(folder / image.name, as_rgb=True).to_array().astype(int) for image in images]
    assert np.abs(read[0] - read[1]).mean() < 4
    assert not folder.exists() and folder != tmp_path
    with open_to_colmap(images[:1], tmp_path) as folder:
        assert folder == tmp_path  # nothing to do


def test_colmap_gets_mirrored_photos_flipped_and_thermal_ones_in_grey(tmp_path):
    stored = textured(64, 48)
    write_photo(tmp_path / "a.jpg", stored, 7)
    grey = cv2.cvtColor(stored, cv2.COLOR_RGB2GRAY)
    cv2.imwrite(str(tmp_path / "b.tif"), 280 + grey.astype(np.float32) / 10)
    images = list_images(tmp_path).images
    with open_to_colmap(images, tmp_path) as folder:
        bitmaps = [pycolmap.Bitmap.read(folder / image.name, as_rgb=True) for image in images]
    assert np.abs(bitmaps[0].to_array()[:, ::-1].astype(int) - stored).mean() < 4
    assert bitmaps[0].exif_orientation() in (None, 1)
    spread = (grey.astype(float) - np.percentile(grey, 0.5)) / np.ptp(np.percentile(grey, (0.5, 99.5)))
    assert np.abs(bitmaps[1].to_array()[..., 0] - 255 * spread.clip(0, 1)).mean() < 3


@pytest.mark.parametrize("altitude_m", [None, 512.5])
def test_positions_without_altitude(tmp_path, altitude_m):
    exif = Image.Exif()
    exif[0x8825] = {1: "S", 2: (33.0, 30.0, 36.0), 3: "W", 4: (70.0, 45.0, 0.0)}
    if altitude_m:
        exif[0x8825] |= {5: b"\0", 6: altitude_m}
    for name in ("a.jpg", "b.jpg"):
        Image.fromarray(textured(64, 48)).save(tmp_path / name, exif=exif)
    images = list_images(tmp_path).images
    assert images[0].gps == pytest.approx((-33.51, -70.75, altitude_m))
    positions = {image.name: image.gps for image in images}
    assert len(pair_spatially(positions, 1, 10.0)) == 1
    none = [Keypoints(image.name, np.zeros((0, 2)), np.zeros(0), np.zeros(0)) for image in images]
    write_database(tmp_path / "a.db", images, make_cameras(images, CameraConfig()), none, [])
    with open_database(tmp_path / "a.db") as database:
        assert database.num_pose_priors() == (2 if altitude_m else 0)


def test_names_of_cameras_in_any_encoding(tmp_path):
    for name, maker in {"a": "Plötz", "b": "Plötz", "c": "Plätz"}.items():
        write_photo(tmp_path / f"{name}.jpg", textured(64, 48))
        data = (tmp_path / f"{name}.jpg").read_bytes()
        assert data.count(b"Phone") == 1
        (tmp_path / f"{name}.jpg").write_bytes(data.replace(b"Phone", maker.encode("latin-1")))
    cameras = make_cameras(list_images(tmp_path).images, CameraConfig())
    assert cameras.camera_index == (0, 0, 1) and all(camera.has_prior_focal_length for camera in cameras.cameras)


def test_no_byte_of_exif_ends_a_run(tmp_path):
    path = write_photo(tmp_path / "a.jpg", textured(64, 48), 6)
    whole = path.read_bytes()
    start = whole.index(b"Exif")
    end = start - 2 + int.from_bytes(whole[start - 2 : start], "big")
    rng = np.random.default_rng(0)
    for count in (1, 3, 30) * 20:
        data = np.frombuffer(whole, np.uint8).copy()
        data[rng.integers(start, end, count)] = rng.integers(0, 256, count)
        path.write_bytes(data.tobytes())
        photo = read_ref(path)
        assert photo.size_wh == (64, 48) and len(make_cameras([photo], CameraConfig()).cameras) == 1
