"""Masks: which pixels they hide, where they are looked for, and what does not fit."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from hm_sfm.config import KeypointConfig, MaskConfig
from hm_sfm.errors import InputError
from hm_sfm.keypoints.graph import Photo
from hm_sfm.keypoints.persistence import persist_keypoints
from hm_sfm.photos.masks import Masks, read_masks
from hm_sfm.types import ImagePair, ImageRef, PairMatches

NAMES = ("a/b.jpg", "a/b.png", "c.jpg")
WIDTH, HEIGHT = 13, 5


@pytest.fixture
def images(tmp_path) -> list[ImageRef]:
    """Photos whose names differ in case, folder or ending; only their paths matter here."""
    folder = tmp_path / "photos"
    (folder / "a").mkdir(parents=True)
    for name in NAMES:
        (folder / name).touch()
    return [ImageRef(name, folder / name, (WIDTH, HEIGHT)) for name in NAMES]


def write_mask(path: Path, mask: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), mask)
    return path


def make_mask(hidden: tuple[int, int], shape: tuple[int, int] = (HEIGHT, WIDTH), white: int = 255) -> np.ndarray:
    """White but for the pixel hidden = (column, row)."""
    mask = np.full(shape, white, np.uint8)
    mask[hidden[1], hidden[0]] = 0
    return mask


@pytest.mark.parametrize("hidden", [(0, 0), (7, 1), (8, 2), (12, 4)])
def test_exactly_the_black_pixels_are_hidden(tmp_path, images, hidden):
    write_mask(tmp_path / "masks" / "a/b.jpg.png", make_mask(hidden, white=1))
    masks = read_masks(images, MaskConfig(folder=str(tmp_path / "masks")))
    grid = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1).reshape(-1, 2)
    for inside_pixel in (0.0, 0.5, 0.999):
        masked = grid[masks.hides("a/b.jpg", grid + inside_pixel)]
        assert masked.tolist() == [list(hidden)]
    assert not masks.hides("a/b.png", grid).any()
    assert masks.hides("a/b.jpg", np.zeros((0, 2))).shape == (0,)


def test_the_mask_of_a_mirrored_photo_is_that_of_the_stored_pixels(tmp_path, images):
    mirrored = [replace(images[0], mirrored=True, flipped=True), *images[1:]]
    write_mask(tmp_path / "masks" / "a/b.jpg.png", make_mask((2, 1)))
    camera = write_mask(tmp_path / "camera.png", make_mask((0, 4)))
    masks = read_masks(mirrored, MaskConfig(folder=str(tmp_path / "masks"), camera=str(camera)))
    grid = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1).reshape(-1, 2)
    hidden = [grid[masks.hides(name, grid + 0.5)].tolist() for name in NAMES[:2]]
    assert hidden == [[[WIDTH - 3, 1], [WIDTH - 1, 4]], [[0, 4]]]


def test_points_outside_of_the_image_take_the_nearest_pixel(tmp_path, images):
    write_mask(tmp_path / "masks" / "c.jpg.png", make_mask((12, 4)))
    masks = read_masks(images, MaskConfig(folder=str(tmp_path / "masks")))
    xy = np.array([(13.0, 5.0), (40.0, 4.5), (12.5, 9.0), (-3.0, 4.5), (12.5, -1.0)])
    assert masks.hides("c.jpg", xy).tolist() == [True, True, True, False, False]


@pytest.mark.parametrize("kind", ["rgb", "rgba", "16 bits"])
def test_masks_of_other_kinds(tmp_path, images, kind):
    mask = make_mask((3, 2))
    channels = {"rgb": 3, "rgba": 4}.get(kind)
    stored = np.repeat(mask[:, :, None], channels, axis=2) if channels else mask.astype(np.uint16) * 257
    write_mask(tmp_path / "masks" / "c.jpg.png", stored)
    masks = read_masks(images, MaskConfig(folder=str(tmp_path / "masks")))
    assert masks.hides("c.jpg", np.array([(3.5, 2.5), (4.5, 2.5)])).tolist() == [True, False]


def test_images_without_a_mask_are_counted_and_not_masked(tmp_path, images, caplog):
    write_mask(tmp_path / "masks" / "a/b.png.png", make_mask((0, 0)))
    masks = read_masks(images, MaskConfig(folder=str(tmp_path / "masks")))
    assert set(masks.packed) == {"a/b.png"}
    assert caplog.messages == [f"2 of 3 images have no mask in {tmp_path / 'masks'}, such as a/b.jpg"]


def test_a_camera_mask_is_that_of_all_images_of_its_size(tmp_path, images, caplog):
    images.append(ImageRef("other.jpg", images[0].path, (20, 20)))
    write_mask(tmp_path / "masks" / "c.jpg.png", make_mask((0, 0)))
    camera = write_mask(tmp_path / "camera.png", make_mask((1, 1)))
    masks = read_masks(images, MaskConfig(folder=str(tmp_path / "masks"), camera=str(camera)))
    corners = np.array([(0.5, 0.5), (1.5, 1.5)])
    assert masks.hides("c.jpg", corners).tolist() == [True, True]
    assert masks.hides("a/b.jpg", corners).tolist() == [False, True]
    assert not masks.hides("other.jpg", corners).any()
    assert caplog.messages[1] == f"1 of 4 images are not of the size of the mask {camera}: it is not theirs"


def test_images_that_are_hidden_as_a_whole(tmp_path, images, caplog):
    """Masks are often the wrong way round: black where the object is."""
    for name in NAMES:
        write_mask(tmp_path / "masks" / f"{name}.png", make_mask((0, 0)))
    write_mask(tmp_path / "masks" / f"{NAMES[1]}.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    read_masks(images, MaskConfig(folder=str(tmp_path / "masks")))
    assert caplog.messages == ["1 of 3 images are hidden as a whole, such as a/b.png: what is black is masked out"]
    camera = write_mask(tmp_path / "black.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(InputError, match="hide all pixels of all 3 images: what is black is masked out"):
        read_masks(images, MaskConfig(camera=str(camera)))


def test_no_masks_hide_nothing(images):
    masks = read_masks(images, MaskConfig())
    assert masks == Masks() and not masks.hides("c.jpg", np.array([(1, 1)])).any()


def test_the_digest_follows_the_masks(tmp_path, images):
    digests = {Masks().digest()}
    for name in ("c.jpg", "a/b.jpg"):
        for hidden in ((0, 0), (1, 0)):
            folder = tmp_path / f"{len(digests)}"
            write_mask(folder / f"{name}.png", make_mask(hidden))
            masks = read_masks(images, MaskConfig(folder=str(folder)))
            digests |= {masks.digest(), masks.digest()}
    assert len(digests) == 5


# What does not fit


def test_a_mask_of_another_size(tmp_path, images):
    path = write_mask(tmp_path / "masks" / "a/b.jpg.png", make_mask((0, 0), (WIDTH, HEIGHT)))
    with pytest.raises(InputError, match=f"{path} is 5 x 13 px but its image a/b.jpg is 13 x 5 px"):
        read_masks(images, MaskConfig(folder=str(tmp_path / "masks")))
    with pytest.raises(InputError, match=f"{path} is 5 x 13 px, but no image is: a/b.jpg is 13 x 5 px"):
        read_masks(images, MaskConfig(camera=str(path)))


@pytest.mark.parametrize("content", [b"", b"no image"])
def test_a_mask_that_cannot_be_read(tmp_path, images, content):
    path = tmp_path / "masks" / "c.jpg.png"
    path.parent.mkdir()
    path.write_bytes(content)
    for config in (MaskConfig(folder=str(path.parent)), MaskConfig(camera=str(path))):
        with pytest.raises(InputError, match=f"cannot read the mask {path}: it is no image"):
            read_masks(images, config)


def test_masks_that_are_not_there(tmp_path, images):
    missing = str(tmp_path / "none")
    with pytest.raises(InputError, match=f"the mask folder {missing} does not exist"):
        read_masks(images, MaskConfig(folder=missing))
    with pytest.raises(InputError, match="is not a folder"):
        read_masks(images, MaskConfig(folder=str(images[0].path)))
    with pytest.raises(InputError, match=f"cannot read the mask {missing}: it does not exist"):
        read_masks(images, MaskConfig(camera=missing))


def test_a_folder_without_a_mask_of_any_image(tmp_path, images):
    write_mask(tmp_path / "masks" / "a/b.jpg", make_mask((0, 0)))
    with pytest.raises(InputError, match=r"no mask of any of the 3 images: that of a/b.jpg would be .*/a/b.jpg.png"):
        read_masks(images, MaskConfig(folder=str(tmp_path / "masks")))


def test_masks_among_the_photos(tmp_path, images):
    with pytest.raises(InputError, match="holds 'a/b.jpg', which is taken for a photo"):
        read_masks(images, MaskConfig(folder=str(tmp_path / "photos" / "a")))
    with pytest.raises(InputError, match="lies among the photos"):
        read_masks(images, MaskConfig(camera=str(images[1].path)))


# What is matched


def make_matches(shift: float) -> PairMatches:
    """A grid of patches in images of 200 x 120 px, moved to the right."""
    xy0 = np.stack(np.meshgrid(np.arange(10, 180, 8), np.arange(10, 110, 8)), axis=-1).reshape(-1, 2) + 0.5
    homography = np.tile(np.array([[1, 0, shift], [0, 1, 0], [0, 0, 1]]), (len(xy0), 1, 1))
    return PairMatches(
        pair=ImagePair("a.jpg", "b.jpg"),
        xy0=xy0,
        xy1=xy0 + [shift, 0],
        score=np.full(len(xy0), 0.9),
        homography=homography,
        patch_radius_px=8.0,
    )


def make_masks() -> Masks:
    """The left 80 columns of a.jpg and the lower half of b.jpg are hidden."""
    first, second = np.ones((2, 120, 200), bool)
    first[:, :80] = False
    second[60:] = False
    return Masks({"a.jpg": np.packbits(first, axis=1), "b.jpg": np.packbits(second, axis=1)})


def test_matches_with_an_end_in_a_masked_pixel_are_dropped():
    matches = make_matches(10.0)

    kept = make_masks().drop_hidden(matches)
    right = (matches.xy0[:, 0] >= 80) & (matches.xy1[:, 1] < 60)
    assert 0 < right.sum() < len(matches)
    np.testing.assert_array_equal(kept.xy0, matches.xy0[right])


def test_no_keypoint_is_in_a_masked_pixel():
    """Though patches next to a mask reach into it, and seeds lie there."""
    masks = make_masks()
    seeds = np.stack(np.meshgrid(np.arange(5, 195, 3), np.arange(5, 115, 3)), axis=-1).reshape(-1, 2) + 0.5
    matches = masks.drop_hidden(make_matches(0.3))

    def persist(hides: Masks | None):
        photos = [
            Photo(name, (200, 120), 1.0, seeds, (lambda xy, name=name: hides.hides(name, xy)) if hides else None)
            for name in ("a.jpg", "b.jpg")
        ]
        return persist_keypoints(photos, [matches.pair], lambda pair: matches, KeypointConfig(), quiet=True)[0]

    for keypoints in persist(None):
        assert masks.hides(keypoints.name, keypoints.xy).any()
    for keypoints in persist(masks):
        assert len(keypoints) > 50
        assert not masks.hides(keypoints.name, keypoints.xy).any()
