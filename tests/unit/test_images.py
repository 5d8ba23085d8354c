"""Listing and preparing photos: odd formats, turned photos, damaged files."""

import base64
import contextlib
import logging
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from hm_sfm.errors import ConfigError, InputError
from hm_sfm.photos.images import ImageList, list_images, prepare_array, prepare_image, read_ref, read_rgb

# 48 x 32 px, the left upper quarter 220, the rest 40; OpenCV cannot write CMYK.
CMYK_JPEG = base64.b64decode(
    "/9j/7gAOQWRvYmUAZAAAAAAA/9sAQwADAgIDAgIDAwMDBAMDBAUIBQUEBAUKBwcGCAwKDAwLCgsLDQ4SEA0OEQ4LCxAWEBETFBUVFQwPFxgWFBgS"
    "FBUU/8AAFAgAIAAwBEMRAE0RAFkRAEsRAP/EABYAAQEBAAAAAAAAAAAAAAAAAAAJCP/EABQQAQAAAAAAAAAAAAAAAAAAAAD/2gAOBEMATQBZAEsA"
    "AD8A3q3q3qqmAACD6D6D4AAC8C8C8AAACD6D6D4AAAAAAAAAAAAAAAAAAD//2Q=="
)


def textured(width: int, height: int, seed: int = 0) -> np.ndarray:
    """(H, W) uint8, smooth enough to survive JPEG."""
    small = np.random.default_rng(seed).integers(20, 236, (height // 8 + 2, width // 8 + 2), dtype=np.uint8)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)


def spotted(width: int, height: int, xy: tuple[float, float], sigma: float = 4.0) -> np.ndarray:
    """(H, W) uint8, a bright spot centred at `xy` px of COLMAP's frame."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.round(255 * np.exp(-((x - xy[0]) ** 2 + (y - xy[1]) ** 2) / (2 * sigma**2))).astype(np.uint8)


def spot_of(grey: np.ndarray) -> np.ndarray:
    """(2,) px: the centroid of the brightness."""
    x, y = np.meshgrid(np.arange(grey.shape[1]) + 0.5, np.arange(grey.shape[0]) + 0.5)
    return np.array([(grey * x).sum(), (grey * y).sum()]) / grey.sum()


def encode(image: np.ndarray, extension: str = ".jpg", *params: int) -> bytes:
    return cv2.imencode(extension, image, params)[1].tobytes()


def with_exif(jpeg: bytes, orientation: int, thumbnail: bytes = b"") -> bytes:
    tiff = b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 0x112, 3, 1, orientation, 0, 0)
    payload = b"Exif\0\0" + tiff + thumbnail
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload + jpeg[2:]


def grey_tiff(image: np.ndarray, orientation: int, sample_format: int = 1) -> bytes:
    height, width = image.shape
    tags = [(256, width), (257, height), (258, 8 * image.itemsize), (259, 1), (262, 1), (273, 8), (274, orientation)]
    tags += [(277, 1), (278, height), (279, image.nbytes), (339, sample_format)]
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    directory = struct.pack("<H", len(tags)) + entries + struct.pack("<I", 0)
    return b"II*\0" + struct.pack("<I", 8 + image.nbytes) + image.tobytes() + directory


def write(path: Path, data: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def skipped_reason(listing: ImageList, name: str) -> str:
    reason = dict(listing.skipped)[name]
    assert "\n" not in reason and name in reason
    return reason


def test_lists_images_of_all_kinds_sorted_by_their_path(tmp_path):
    image = textured(64, 48)
    for name in ("b.png", "a.JPG", "sub/deep/c.jpeg", "sub/a photo.tif", "sub.bmp", "Ünïcode.TIFF"):
        write(tmp_path / name, encode(image, Path(name).suffix.lower()))
    for name in (".hidden.png", ".thumbnails/a.png", "notes.txt", "model.ply"):
        write(tmp_path / name, encode(image, ".png"))
    (tmp_path / "folder.jpg").mkdir()

    listing = list_images(tmp_path)

    names = [ref.name for ref in listing.images]
    assert names == ["a.JPG", "b.png", "sub.bmp", "sub/a photo.tif", "sub/deep/c.jpeg", "Ünïcode.TIFF"]
    assert listing.skipped == ()
    for ref in listing.images:
        assert (ref.size_wh, ref.rotation_deg, ref.path) == ((64, 48), 0, tmp_path / ref.name)


def test_one_image_is_a_list(tmp_path):
    write(tmp_path / "a.png", encode(textured(32, 32), ".png"))
    assert len(list_images(tmp_path).images) == 1


def test_unusable_images_are_skipped_and_reported(tmp_path, caplog):
    image = textured(200, 100)
    jpeg, thumbnail = encode(image), encode(textured(48, 32))
    write(tmp_path / "good.jpg", jpeg)
    damaged = {
        "text.jpg": b"not an image",
        "empty.jpg": b"",
        "cut.jpg": jpeg[: len(jpeg) // 2],
        "cut-late.jpg": jpeg[:-2],
        "cut-early.jpg": jpeg[:100],
        "cut-after-thumbnail.jpg": with_exif(jpeg, 6, thumbnail)[: len(thumbnail) + len(jpeg) // 2],
        "zero-filled.jpg": jpeg[: len(jpeg) // 2].ljust(len(jpeg), b"\0"),
        "cut-progressive.jpg": encode(image, ".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1)[:-100],
    }
    for extension in (".png", ".bmp", ".tif"):
        whole = encode(image, extension)
        damaged["cut" + extension] = whole[: len(whole) // 2]
    damaged["cut-late.tif"] = grey_tiff(image, 1)[: image.size // 2]
    for name, data in damaged.items():
        write(tmp_path / name, data)
    (tmp_path / "dangling.png").symlink_to(tmp_path / "gone.png")
    write(tmp_path / "small.png", encode(textured(31, 500), ".png"))

    with caplog.at_level(logging.WARNING, logger="hm_sfm.photos.images"):
        listing = list_images(tmp_path)

    assert [ref.name for ref in listing.images] == ["good.jpg"]
    assert [name for name, _ in listing.skipped] == sorted([*damaged, "dangling.png", "small.png"])
    assert "31 x 500 px" in skipped_reason(listing, "small.png")
    assert "cut short" in skipped_reason(listing, "cut-after-thumbnail.jpg")
    assert "cannot be decoded" in skipped_reason(listing, "text.jpg")
    assert len(caplog.records) == len(listing.skipped)
    assert all(any(reason in record.getMessage() for record in caplog.records) for _, reason in listing.skipped)


def test_heic_photos_are_skipped_with_one_warning_that_says_what_to_do(tmp_path, caplog, monkeypatch):
    monkeypatch.setattr("hm_sfm.photos.images.can_read_heic", lambda: False)
    for name in ("IMG_2.HEIC", "sub/IMG_1.heic", "IMG_3.heif"):
        write(tmp_path / name, b"\0\0\0\x18ftypheic")
    with pytest.raises(InputError, match="holds 3 images but none can be used.*IMG_2.HEIC is HEIC.*convert it to JPEG"):
        list_images(tmp_path)
    write(tmp_path / "IMG_2.jpg", encode(textured(64, 48)))
    caplog.clear()
    listing = list_images(tmp_path)
    assert [ref.name for ref in listing.images] == ["IMG_2.jpg"]
    assert [name for name, _ in listing.skipped] == ["IMG_2.HEIC", "IMG_3.heif", "sub/IMG_1.heic"]
    assert "convert it to JPEG" in skipped_reason(listing, "sub/IMG_1.heic")
    (message,) = caplog.messages
    reason = 'is HEIC, which needs the package pillow-heif: pip install "hm_sfm[heif]", or convert it to JPEG'
    assert message == f"skipped: {tmp_path / 'IMG_2.HEIC'} {reason} (3 such files)"


def test_bytes_after_the_end_of_an_image_are_accepted(tmp_path):
    image = textured(64, 48)
    write(tmp_path / "motion.jpg", with_exif(encode(image), 1, encode(image)) + b"\0" * 999 + b"a video")
    write(tmp_path / "progressive.jpg", encode(image, ".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1) + b"junk")
    write(tmp_path / "padded.jpg", (jpeg := encode(image))[:2] + b"\xff\xff\xff" + jpeg[2:])
    write(tmp_path / "more.png", encode(image, ".png") + b"more")
    write(tmp_path / "really-a-png.jpg", encode(image, ".png"))
    listing = list_images(tmp_path)
    assert listing.skipped == () and len(listing.images) == 5


def test_photos_of_kinds_that_nothing_reads_are_named(tmp_path, caplog):
    for name in ("a.jxl", "b.CR2", "sub/c.dng"):
        write(tmp_path / name, encode(textured(64, 48), ".tif"))  # raw photos hold small TIFFs
    with pytest.raises(InputError, match="holds 3 images but none can be used.*convert it to JPEG"):
        list_images(tmp_path)
    write(tmp_path / "d.png", encode(textured(64, 48), ".png"))
    caplog.clear()
    listing = list_images(tmp_path)
    assert [ref.name for ref in listing.images] == ["d.png"]
    assert [name for name, _ in listing.skipped] == ["a.jxl", "b.CR2", "sub/c.dng"]
    assert caplog.messages == [f"skipped: {reason}" for _, reason in listing.skipped]


def test_raw_photos_beside_their_jpegs_are_told_in_one_line(tmp_path, caplog):
    for name in ("IMG_1.jpg", "IMG_1.CR2", "IMG_2.jpg", "IMG_2.CR2", "sub/IMG_1.CR2"):
        write(tmp_path / name, encode(textured(64, 48)))
    listing = list_images(tmp_path)
    assert [ref.name for ref in listing.images] == ["IMG_1.jpg", "IMG_2.jpg"]
    assert [name for name, _ in listing.skipped] == ["sub/IMG_1.CR2"]
    assert caplog.messages == [
        "left out: 2 raw photos beside photos of the same name, such as IMG_1.CR2",
        f"skipped: {tmp_path / 'sub/IMG_1.CR2'} is of a kind that cannot be read: convert it to JPEG, PNG or TIFF",
    ]


def damage(jpeg: bytes, kind: str) -> bytes:
    """As a failing card does it, or as a motion photo whose scan ends early, before its video."""
    half = len(jpeg) // 2
    if kind == "zeros":
        return jpeg[:half] + bytes(400) + jpeg[half + 400 :]
    if kind == "noise":
        return jpeg[:half] + np.random.default_rng(0).bytes(400).replace(b"\xff", b"\0") + jpeg[half + 400 :]
    return jpeg[:half] + b"\0\0\0\x18ftypmp42" + bytes(range(256)) * 4 + b"\xff\xd9" + b"x" * 100


@pytest.mark.parametrize("kind", ["zeros", "noise", "video"])
def test_jpegs_that_are_damaged_inside_are_used_with_a_warning(tmp_path, caplog, capfd, kind):
    jpeg = encode(textured(320, 240))
    write(tmp_path / "a.jpg", damage(jpeg, kind))
    write(tmp_path / "b.jpg", jpeg + b"a video")
    listing = list_images(tmp_path)
    assert [ref.name for ref in listing.images] == ["a.jpg", "b.jpg"]
    (message,) = caplog.messages
    assert message.startswith(f"{tmp_path / 'a.jpg'} is damaged, parts of it show nothing or something wrong: Corrupt")
    assert prepare_image(listing.images[0], 320).grey.shape == (240, 320)
    assert capfd.readouterr().err == ""  # no word of libjpeg, which names no file


@pytest.mark.parametrize("name", ["line\nbreak.png", b"latin-\xe9.png".decode("utf-8", "surrogateescape")])
def test_names_that_no_database_can_hold_are_skipped(tmp_path, name):
    write(tmp_path / "a.png", encode(textured(64, 48), ".png"))
    write(tmp_path / name, encode(textured(64, 48), ".png"))
    listing = list_images(tmp_path)
    assert [ref.name for ref in listing.images] == ["a.png"]
    (reason,) = [reason for _, reason in listing.skipped]
    assert "line break or bytes that are not UTF-8" in reason
    assert "\n" not in reason and reason.encode()


def test_a_folder_without_usable_images_is_an_error_that_says_what_was_found(tmp_path):
    with pytest.raises(InputError, match="nowhere does not exist"):
        list_images(tmp_path / "nowhere")
    with pytest.raises(InputError, match="holds 0 files but no image"):
        list_images(tmp_path)
    write(tmp_path / "a.txt", b"a")
    write(tmp_path / "sub/b.raw", b"b")
    with pytest.raises(InputError, match=r"holds 2 files but no image \(jpg, "):
        list_images(tmp_path)
    with pytest.raises(InputError, match="a.txt is not a folder"):
        list_images(tmp_path / "a.txt")
    write(tmp_path / "c.jpg", b"c")
    with pytest.raises(InputError, match="holds 1 images but none can be used, for example: .*c.jpg"):
        list_images(tmp_path)


def test_read_ref_names_an_image_after_its_file(tmp_path):
    path = write(tmp_path / "a.png", encode(textured(64, 48), ".png"))
    assert read_ref(path).name == "a.png"
    with pytest.raises(InputError, match="gone.png.*No such file"):
        read_ref(tmp_path / "gone.png")


# Where a point (x, y) of a stored photo of W x H px is shown, by EXIF's definition.
SHOWN_AT = {
    1: lambda x, y, w, h: (x, y),
    2: lambda x, y, w, h: (w - x, y),
    3: lambda x, y, w, h: (w - x, h - y),
    4: lambda x, y, w, h: (x, h - y),
    5: lambda x, y, w, h: (y, x),
    6: lambda x, y, w, h: (h - y, x),
    7: lambda x, y, w, h: (h - y, w - x),
    8: lambda x, y, w, h: (y, w - x),
}


@pytest.mark.parametrize("orientation", range(10))
@pytest.mark.parametrize("kind", ["jpg", "tif"])
def test_turned_and_mirrored_photos_come_upright_and_their_points_go_back(tmp_path, orientation, kind):
    xy = (190.0, 40.0)
    stored = spotted(300, 200, xy, sigma=8)
    data = with_exif(encode(stored, ".jpg", cv2.IMWRITE_JPEG_QUALITY, 98), orientation)
    path = write(tmp_path / f"a.{kind}", data if kind == "jpg" else grey_tiff(stored, orientation))
    ref = read_ref(path)
    assert ref.size_wh == (300, 200) and not ref.flipped
    assert ref.rotation_deg == {3: 180, 4: 180, 5: 90, 6: 90, 7: 270, 8: 270}.get(orientation, 0)
    assert ref.mirrored == (orientation in (2, 4, 5, 7))

    prepared = prepare_image(ref, 150)

    shown_at = SHOWN_AT.get(orientation, SHOWN_AT[1])  # 0 and 9 are no orientations
    assert prepared.scaled_wh == ((150, 100) if orientation < 5 or orientation == 9 else (100, 150))
    assert prepared.grey.shape == prepared.scaled_wh[::-1]
    spot = spot_of(np.where(prepared.grey > 0.1, prepared.grey, 0))
    np.testing.assert_allclose(spot, shown_at(95, 20, 150, 100), atol=0.05)
    np.testing.assert_allclose(prepared.stored_from_scaled @ [*spot, 1], [*xy, 1], atol=0.1)
    colours = np.rint(prepared.grey * 255)[..., None]
    np.testing.assert_allclose(read_rgb(prepared) - colours, 0, atol=1)
    # In a run, points are those of the photo flipped left to right: its camera is then one of COLMAP's.
    (listed,) = list_images(tmp_path).images
    assert listed.flipped == ref.mirrored
    in_run = prepare_image(listed, 150)
    assert np.array_equal(in_run.grey, prepared.grey)
    expected = (300 - xy[0], xy[1], 1) if ref.mirrored else (*xy, 1)
    np.testing.assert_allclose(in_run.stored_from_scaled @ [*spot, 1], expected, atol=0.1)
    assert np.linalg.det(in_run.stored_from_scaled) > 0


@pytest.mark.parametrize("orientation", range(1, 9))
def test_turning_agrees_with_opencv(tmp_path, orientation):
    path = write(tmp_path / "a.jpg", with_exif(encode(textured(120, 80)), orientation))
    prepared = prepare_image(read_ref(path), 1024)
    upright = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert np.array_equal(np.round(prepared.grey * 255), upright)


@pytest.mark.parametrize("rotation", [1, 6, 3, 8])
@pytest.mark.parametrize("size_wh", [(301, 199), (199, 301), (1000, 337)])
def test_corners_map_to_corners_whatever_the_rounding(tmp_path, size_wh, rotation):
    path = write(tmp_path / "a.jpg", with_exif(encode(textured(*size_wh)), rotation))
    prepared = prepare_image(read_ref(path), 100)
    width, height = prepared.scaled_wh
    assert max(width, height) == 100
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]])
    stored = corners @ prepared.stored_from_scaled.T
    assert {tuple(corner) for corner in np.round(stored[:, :2], 9)} == {
        (x, y) for x in (0, size_wh[0]) for y in (0, size_wh[1])
    }


def test_never_enlarged(tmp_path):
    image = textured(64, 48)
    prepared = prepare_image(read_ref(write(tmp_path / "a.png", encode(image, ".png"))), 1024)
    assert prepared.scaled_wh == (64, 48)
    assert np.array_equal(prepared.stored_from_scaled, np.eye(3))
    assert prepared.grey.dtype == np.float32 and not prepared.grey.flags.writeable
    assert np.array_equal(prepared.grey, image.astype(np.float32) / 255)


def test_reducing_averages_areas(tmp_path):
    image = textured(64, 48)
    prepared = prepare_image(read_ref(write(tmp_path / "a.png", encode(image, ".png"))), 32)
    means = image.reshape(24, 2, 32, 2).mean(axis=(1, 3)) / 255
    np.testing.assert_allclose(prepared.grey, means, atol=0.51 / 255)


def test_every_kind_of_pixel_becomes_the_same_grey(tmp_path):
    grey = textured(64, 48)
    rgb = np.dstack([grey] * 3)
    transparent = np.dstack([grey] * 3 + [np.zeros_like(grey)])
    deep = grey.astype(np.uint16) * 257
    files = {
        "grey.png": encode(grey, ".png"),
        "rgb.png": encode(rgb, ".png"),
        "rgba.png": encode(transparent, ".png"),
        "grey16.png": encode(deep, ".png"),
        "rgb16.png": encode(np.dstack([deep] * 3), ".png"),
        "rgba16.png": encode(np.dstack([deep] * 3 + [np.zeros_like(deep)]), ".png"),
        "grey.bmp": encode(grey, ".bmp"),
        "rgb.bmp": encode(rgb, ".bmp"),
        "grey.tif": encode(grey, ".tif"),
        "rgb.tif": encode(rgb, ".tif"),
        "grey16.tif": encode(deep, ".tif"),
        "float.tif": encode(grey.astype(np.float32) / 255, ".tif"),
    }
    for name, data in files.items():
        write(tmp_path / name, data)
    listing = list_images(tmp_path)
    assert len(listing.images) == len(files)
    for ref in listing.images:
        np.testing.assert_allclose(
            prepare_image(ref, 1024).grey, grey / np.float32(255), atol=1.01 / 255, err_msg=ref.name
        )


def test_sixteen_bits_are_kept(tmp_path):
    ramp = np.tile(np.arange(64, dtype=np.uint16), (48, 1))
    prepared = prepare_image(read_ref(write(tmp_path / "dark.png", encode(ramp, ".png"))), 1024)
    np.testing.assert_allclose(prepared.grey, ramp / 65535, rtol=1e-6)


def test_cmyk_is_not_inverted(tmp_path):
    grey = prepare_image(read_ref(write(tmp_path / "print.jpg", CMYK_JPEG)), 1024).grey * 255
    assert abs(grey[:14, :22].mean() - 220) < 4 and abs(grey[18:].mean() - 40) < 4


def test_an_image_of_108_megapixels(tmp_path):
    image = np.zeros((9000, 12000), np.uint8)
    image[4500:4512, 6000:6012] = 255
    ref = read_ref(write(tmp_path / "huge.jpg", encode(image)))
    del image
    prepared = prepare_image(ref, 1000)
    assert (ref.size_wh, prepared.scaled_wh) == ((12000, 9000), (1000, 750))
    assert np.unravel_index(prepared.grey.argmax(), prepared.grey.shape) == (375, 500)


def test_prepare_image_refuses_files_that_changed_since_they_were_listed(tmp_path):
    whole = encode(textured(64, 48), ".png")
    path = write(tmp_path / "a.png", whole)
    ref = read_ref(path)
    for data in (b"", b"text", whole[:-500]):
        write(path, data)
        with pytest.raises(InputError, match="a.png cannot be decoded"):
            prepare_image(ref, 1024)
    write(path, encode(textured(48, 64), ".png"))
    with pytest.raises(InputError, match="a.png is 48 x 64 px but was listed as 64 x 48 px"):
        prepare_image(ref, 1024)
    path.unlink()
    with pytest.raises(InputError, match="cannot read the image .*a.png: No such file"):
        prepare_image(ref, 1024)


def test_damage_inside_a_whole_looking_png_is_found_when_it_is_listed(tmp_path, capfd):
    data = bytearray(encode(textured(200, 100), ".png"))
    data[len(data) // 2] ^= 0xFF
    path = write(tmp_path / "a.png", bytes(data))
    with pytest.raises(InputError, match="a.png is cut short or cannot be decoded"):
        read_ref(path)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(
    ("dtype", "low", "high"), [("f4", 280, 320), ("f8", -20, 60), ("i4", 1000, 90_000), ("u2", 7000, 9000)]
)
def test_tiffs_of_thermal_cameras(tmp_path, dtype, low, high, orientation):
    grey = textured(64, 48).astype(float) / 255
    values = (low + (high - low) * grey).astype(dtype)
    kind = {"f": 3, "u": 1, "i": 2}[dtype[0]]
    path = write(tmp_path / "a.tif", grey_tiff(values, orientation, sample_format=kind))
    prepared = prepare_image(read_ref(path), 1024)
    back = np.rint(prepared.stored_from_scaled @ [0.5, 0.5, 1] - [0.5, 0.5, 0]).astype(int)
    if dtype == "u2":
        assert prepared.grey[0, 0] == pytest.approx(values[back[1], back[0]] / 65535, abs=1e-6)
        return
    black, white = np.percentile(values, (0.5, 99.5))
    expected = ((values - black) / (white - black)).clip(0, 1)
    assert prepared.grey[0, 0] == pytest.approx(expected[back[1], back[0]], abs=1e-4)
    np.testing.assert_allclose(np.sort(prepared.grey, axis=None), np.sort(expected, axis=None), atol=1e-4)
    assert np.abs(read_rgb(prepared)[..., 1] - prepared.grey * 255).max() <= 1


def test_values_that_are_no_numbers_are_black(tmp_path):
    values = np.full((48, 64), np.nan, np.float32)
    path = write(tmp_path / "a.tif", grey_tiff(values, 1, sample_format=3))
    assert not prepare_image(read_ref(path), 64).grey.any()
    values[10:30] = textured(64, 20)
    write(path, grey_tiff(values, 1, sample_format=3))
    grey = prepare_image(read_ref(path), 64).grey
    assert not grey[:10].any() and grey[10:30].min() == 0 and grey[10:30].max() == 1


@pytest.mark.parametrize("extension", [".jpg", ".png", ".tif", ".bmp", ".webp"])
def test_no_byte_of_a_photo_ends_a_run(tmp_path, extension):
    """Either it is used or skipped; whatever Pillow, OpenCV and COLMAP think of it, no other error comes through."""
    whole = np.frombuffer(encode(textured(64, 48), extension), np.uint8)
    rng = np.random.default_rng(0)
    for count in (1, 2, 8) * 20:
        data = whole.copy()
        data[rng.integers(0, rng.choice([40, 200, len(data)]), count)] = rng.integers(0, 256, count)
        path = write(tmp_path / f"a{extension}", data.tobytes())
        with contextlib.suppress(InputError):
            ref = read_ref(path)
            if np.prod(ref.size_wh) < 1e6:
                assert read_rgb(prepare_image(ref, 64)).shape[2] == 3


def test_an_impossible_matching_size_is_a_configuration_error():
    with pytest.raises(ConfigError, match="long_edge_px must be at least 32, found 0"):
        prepare_array(textured(64, 48), 0)


def test_arrays_are_prepared_as_files_are(tmp_path):
    rgb = np.dstack([textured(90, 60, seed) for seed in range(3)])
    path = write(tmp_path / "a.png", encode(np.ascontiguousarray(rgb[..., ::-1]), ".png"))
    from_file, from_array = prepare_image(read_ref(path), 45), prepare_array(rgb, 45, name="left")
    np.testing.assert_allclose(from_array.grey, from_file.grey, atol=1.01 / 255)
    assert np.array_equal(from_array.stored_from_scaled, from_file.stored_from_scaled)
    assert (from_array.ref.name, from_array.ref.size_wh, from_array.scaled_wh) == ("left", (90, 60), (45, 30))


def test_arrays_that_are_not_contiguous_are_as_good_as_their_copies():
    rgb = np.dstack([textured(90, 70, seed) for seed in range(3)])
    for view in (rgb[:, ::-1, ::-1], rgb[::2, ::-2], rgb[:, ::-1, 0], rgb[..., 1], rgb.transpose(1, 0, 2)):
        assert not view.flags.c_contiguous
        for long_edge_px in (40, 1024):
            expected = prepare_array(view.copy(order="C"), long_edge_px).grey
            assert np.array_equal(prepare_array(view, long_edge_px).grey, expected)


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((64, 64), np.float32),
        np.zeros((64, 64, 4), np.uint8),
        np.zeros((64, 64, 1), np.uint8),
        np.zeros((1, 64, 64, 3), np.uint8),
        np.zeros(64, np.uint8),
        np.zeros((0, 0), np.uint8),
        np.zeros((64, 31), np.uint8),
    ],
)
def test_other_arrays_are_refused(array):
    with pytest.raises(InputError, match="left"):
        prepare_array(array, 1024, name="left")
