"""Training pairs of real photos: tracks of reconstructed scenes, and the views made of them."""

from pathlib import Path

import cv2
import h5py
import numpy as np
import pycolmap
import pytest

from hm_sfm.errors import InputError
from hm_sfm.training import multiview
from hm_sfm.training.multiview import (
    FEWEST_SHARED,
    VALIDATION_SCENES,
    PhotoPairs,
    read_photo_pairs,
    write_tracks,
)
from hm_sfm.training.photos import POINTS, SURFACES

SIZE_WH = (192, 160)


# Tracks


@pytest.fixture
def model(tmp_path) -> pycolmap.Reconstruction:
    """Four photos, in subfolders, of 60 points; observations lie where the points project."""
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=4, num_points3D=60)
    with pycolmap.Database.open(tmp_path / "synthetic.db") as database:
        made = pycolmap.synthesize_dataset(options, database)
    for image in made.images.values():
        image.name = f"{'left' if image.image_id % 2 else 'right'}/{image.image_id}.jpg"
    return made


def read_tracks(path: Path, name: str) -> dict[int, np.ndarray]:
    with h5py.File(path) as file:
        assert file[name]["point"].dtype == np.int64 and file[name]["xy"].dtype == np.float32
        return dict(zip(file[name]["point"][:].tolist(), file[name]["xy"][:]))


def test_tracks_are_the_projections_of_the_points(tmp_path, model):
    write_tracks(tmp_path / "tracks.h5", [model])
    for image in model.images.values():
        tracks = read_tracks(tmp_path / "tracks.h5", image.name)
        assert set(tracks) == {p.point3D_id for p in image.get_observation_points2D()} and len(tracks) > 20
        for point, xy in tracks.items():
            np.testing.assert_allclose(xy, image.project_point(model.points3D[point].xyz), atol=1e-3)


def test_observations_far_from_their_projection_are_dropped(tmp_path, model):
    image = model.images[2]
    ids = [p.point3D_id for p in image.get_observation_points2D()]
    for point, shift in ((ids[0], 1.4), (ids[1], 1.6), (ids[2], 200.0)):
        next(p for p in image.points2D if p.point3D_id == point).xy += np.array([shift, 0])
    write_tracks(tmp_path / "tracks.h5", [model])
    tracks = read_tracks(tmp_path / "tracks.h5", image.name)
    assert set(tracks) == set(ids) - {ids[1], ids[2]}
    np.testing.assert_allclose(tracks[ids[0]], image.project_point(model.points3D[ids[0]].xyz), atol=1e-3)


def test_points_of_several_models_are_not_confused(tmp_path, model):
    """The second model shares a photo with the first one, where it counts."""
    second = pycolmap.Reconstruction(model)
    for image in second.images.values():
        image.name = image.name if image.image_id == 1 else f"second/{image.image_id}.jpg"
    write_tracks(tmp_path / "tracks.h5", [model, second])
    first_ids = {point for i in model.images.values() for point in read_tracks(tmp_path / "tracks.h5", i.name)}
    second_ids = {point for i in (2, 3, 4) for point in read_tracks(tmp_path / "tracks.h5", f"second/{i}.jpg")}
    assert first_ids == set(model.points3D)
    assert second_ids and not first_ids & second_ids
    alone = {p.point3D_id for p in model.images[1].get_observation_points2D()}
    assert set(read_tracks(tmp_path / "tracks.h5", model.images[1].name)) == alone


def test_models_without_images_have_no_tracks(tmp_path):
    write_tracks(tmp_path / "tracks.h5", [pycolmap.Reconstruction()])
    with h5py.File(tmp_path / "tracks.h5") as file:
        assert len(file) == 0
    assert [p.name for p in tmp_path.iterdir()] == ["tracks.h5"]


# Scenes

MIRROR = np.array([[-0.9, 0.1, 420.0], [0.12, 0.95, 10.0]])
"""Px of photo a -> px of photo b: affine, and mirrored, so that no two points stand in for each other."""


def write_scene(
    folder: Path, name: str, points: int = 90, photos: tuple[str, ...] = ("a.png", "sub/b.png")
) -> np.ndarray:
    """Two photos with dots at the points that both show; returns those in photo a, (N, 2) px."""
    rng = np.random.default_rng(7)
    grid = np.stack(np.meshgrid(np.arange(10), np.arange(9)), axis=-1).reshape(-1, 2)
    xy = (grid * 38 + 30 + rng.uniform(-5, 5, (90, 2)))[:points]
    (folder / "tracks" / name).mkdir(parents=True)
    with h5py.File(folder / "tracks" / name / "tracks.h5", "w") as file:
        for number, (photo, dots) in enumerate(zip(photos, (xy, xy @ MIRROR[:, :2].T + MIRROR[:, 2]))):
            y, x = np.mgrid[:400, :440] + 0.5
            image = np.full((400, 440), 60.0)
            for dot_x, dot_y in dots:
                image += 150 * np.exp(-((x - dot_x) ** 2 + (y - dot_y) ** 2) / (2 * 4.0**2))
            path = folder / "photos" / name / photo
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), np.clip(np.round(image), 0, 255).astype(np.uint8))
            # Each photo has points of its own, too, and lists them in its own order.
            order = rng.permutation(len(dots) + 5)
            own = np.arange(5) + 1000 * (number + 1)
            file[f"{photo}/point"] = np.concatenate([np.arange(len(dots)), own])[order]
            file[f"{photo}/xy"] = np.concatenate([dots, rng.uniform(0, 400, (5, 2))])[order].astype(np.float32)
    return xy


def test_pairs_are_photos_that_share_points(tmp_path):
    xy = write_scene(tmp_path, "house")
    ((pair,),) = read_photo_pairs(tmp_path / "tracks", tmp_path / "photos")
    assert (pair.path0, pair.path1) == tuple(tmp_path / "photos" / "house" / name for name in ("a.png", "sub/b.png"))
    order = np.argsort(pair.xy0[:, 0])
    np.testing.assert_allclose(pair.xy0[order], xy[np.argsort(xy[:, 0])], atol=1e-3)
    np.testing.assert_allclose(pair.xy1, pair.xy0 @ MIRROR[:, :2].T + MIRROR[:, 2], atol=1e-3)


@pytest.mark.slow
def test_validation_scenes_are_taken_only_by_their_names(tmp_path):
    held_out = VALIDATION_SCENES[3]
    for name in ("house", "bridge", held_out):
        write_scene(tmp_path, name)

    def read_folders(*names):
        scenes = read_photo_pairs(tmp_path / "tracks", tmp_path / "photos", *names)
        return [scene[0].path0.parent.name for scene in scenes]

    assert read_folders() == ["bridge", "house"]
    assert read_folders(VALIDATION_SCENES) == [held_out]
    assert read_folders(("house", held_out)) == sorted(["house", held_out])
    with pytest.raises(InputError, match="no tracks of scenes"):
        read_folders(("absent",))


def test_ten_scenes_are_kept():
    assert len(set(VALIDATION_SCENES)) == 10


def test_photos_that_share_too_few_points_are_no_pair(tmp_path):
    write_scene(tmp_path, "house", points=FEWEST_SHARED)
    write_scene(tmp_path, "bridge", points=FEWEST_SHARED - 1)
    scenes = read_photo_pairs(tmp_path / "tracks", tmp_path / "photos")
    assert [scene[0].path0.parent.name for scene in scenes] == ["house"]


def test_unusable_scenes_are_named(tmp_path):
    with pytest.raises(InputError, match="tracks holds no tracks"):
        read_photo_pairs(tmp_path / "tracks", tmp_path / "photos")
    write_scene(tmp_path, "house")
    path = tmp_path / "tracks" / "house" / "tracks.h5"
    photo = tmp_path / "photos" / "house" / "sub" / "b.png"
    photo.rename(photo.with_name("c.png"))
    with pytest.raises(InputError, match=f"{path} names the photo 'sub/b.png', which is not in .*house"):
        read_photo_pairs(tmp_path / "tracks", tmp_path / "photos")
    with h5py.File(path, "a") as file:
        del file["a.png/xy"]
    with pytest.raises(InputError, match=f"{path} is damaged or no file of tracks"):
        read_photo_pairs(tmp_path / "tracks", tmp_path / "photos")
    path.write_bytes(b"no tracks")
    with pytest.raises(InputError, match=f"{path} is damaged or no file of tracks"):
        read_photo_pairs(tmp_path / "tracks", tmp_path / "photos")


# Views


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    write_scene(folder, "house")
    return read_photo_pairs(folder / "tracks", folder / "photos")


def find_dot(image: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """(2,) px: the centre of what is bright around a point."""
    column, row = np.floor(xy).astype(int)
    window = image[row - 6 : row + 7, column - 6 : column + 7].astype(float)
    weight = np.clip(window - np.percentile(window, 70), 0, None)
    y, x = np.mgrid[row - 6 : row + 7, column - 6 : column + 7] + 0.5
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


def test_points_lie_on_what_both_views_show(scenes):
    """The dots of the photos, to a tenth of a pixel in the mean: half a pixel would show."""
    pairs = PhotoPairs(scenes, SIZE_WH, seed=1, count=12)
    offsets = []
    for index in range(12):
        item = pairs[index]
        points = item["points"][~np.isnan(item["points"][:, 0])].astype(float)
        assert len(points) >= 1
        for view in range(2):
            xy = points[:, 2 * view : 2 * view + 2]
            inner = np.all((xy > 8) & (xy < np.array(SIZE_WH) - 8), axis=1)
            offsets += [find_dot(item["images"][view], p) - p for p in xy[inner]]
    offsets = np.array(offsets)
    assert len(offsets) > 200
    assert np.abs(offsets.mean(axis=0)).max() < 0.1
    assert np.percentile(np.linalg.norm(offsets, axis=1), 90) < 0.8


def test_points_of_both_views_belong_together(scenes):
    """The photos are mirror images: an affine map fits the points of the two views, if they are not mixed up."""
    pairs = PhotoPairs(scenes, SIZE_WH, seed=2, count=8)
    for index in range(8):
        points = pairs[index]["points"]
        points = points[~np.isnan(points[:, 0])].astype(float)
        if len(points) < 6:
            continue
        design = np.column_stack([points[:, :2], np.ones(len(points))])
        fitted, *_ = np.linalg.lstsq(design, points[:, 2:], rcond=None)
        np.testing.assert_allclose(design @ fitted, points[:, 2:], atol=0.01)
        assert np.linalg.det(fitted[:2]) < 0


def test_items_have_the_common_form(scenes):
    item = PhotoPairs(scenes, SIZE_WH, seed=1, count=5)[3]
    width, height = SIZE_WH
    assert item["images"].shape == (2, height, width) and item["images"].dtype == np.uint8
    assert item["b_from_a"].shape == (SURFACES, 3, 3) and item["b_from_a"].dtype == np.float32
    assert item["surface"].shape == (height, width) and item["surface"].dtype == np.int64
    assert (item["surface"] == -1).all()
    assert item["points"].shape == (POINTS, 4) and item["points"].dtype == np.float32
    known = ~np.isnan(item["points"])
    count = known.all(axis=1).sum()
    assert known[:count].all() and not known[count:].any()
    assert ((item["points"][:count] >= 0) & (item["points"][:count] <= SIZE_WH * 2)).all()


def test_no_more_points_than_an_item_holds(scenes, monkeypatch):
    monkeypatch.setattr(multiview, "POINTS", 4)
    points = [PhotoPairs(scenes, SIZE_WH, seed=1, count=5)[i]["points"] for i in range(5)]
    assert all(p.shape == (4, 4) for p in points)
    assert not np.isnan(points).all(axis=(1, 2)).any()


def test_items_depend_on_seed_and_index_alone(scenes):
    first, again, other = (PhotoPairs(scenes, SIZE_WH, seed, 10) for seed in (1, 1, 2))
    assert len(first) == 10
    again[0], again[5]
    for key in ("images", "points"):
        assert np.array_equal(first[7][key], again[7][key], equal_nan=key == "points")
        assert not np.array_equal(first[7][key], first[6][key], equal_nan=key == "points")
        assert not np.array_equal(first[7][key], other[7][key], equal_nan=key == "points")


@pytest.mark.slow
def test_scenes_come_equally_often(tmp_path, monkeypatch):
    """Whatever their number of pairs."""
    write_scene(tmp_path, "house")
    write_scene(tmp_path, "bridge")
    bridge, house = read_photo_pairs(tmp_path / "tracks", tmp_path / "photos")
    taken = []
    monkeypatch.setattr(multiview, "read_grey", lambda path: taken.append(path) or np.zeros((400, 440), np.uint8))
    pairs = PhotoPairs([bridge * 9, house], (32, 32), seed=0, count=60)
    for index in range(60):
        pairs[index]
    assert 20 < sum("house" in path.parts for path in taken[::2]) < 40


def test_a_photo_that_is_no_image_is_named(tmp_path):
    write_scene(tmp_path, "house")
    scenes = read_photo_pairs(tmp_path / "tracks", tmp_path / "photos")
    scenes[0][0].path1.write_bytes(b"no photo")
    with pytest.raises(InputError, match="house/sub/b.png cannot be read as an image"):
        PhotoPairs(scenes, (32, 32), seed=0, count=1)[0]
