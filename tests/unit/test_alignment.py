"""Models in the frame of earlier ones."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from hm_sfm.colmap.alignment import find_similarity, keep_frame, list_poses

TURN = pycolmap.Sim3d(2.5, pycolmap.Rotation3d(np.array([0.3, -1.0, 0.7])), [40.0, -7.0, 3.0])


def make_model(num_images: int = 8, seed: int = 1) -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(seed)
    return pycolmap.synthesize_dataset(
        pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=num_images, num_points3D=50)
    )


def write_earlier(folder: Path, model: pycolmap.Reconstruction, number: int = 0) -> Path:
    (folder / "sparse" / str(number)).mkdir(parents=True)
    model.write_binary(folder / "sparse" / str(number))
    return folder / "sparse"


def assert_same_poses(model: pycolmap.Reconstruction, expected: pycolmap.Reconstruction, atol: float = 1e-6) -> None:
    poses, others = list_poses(model), list_poses(expected)
    assert poses.keys() & others.keys()
    for name in poses.keys() & others.keys():
        np.testing.assert_allclose(poses[name].matrix(), others[name].matrix(), atol=atol)


def test_a_larger_model_comes_to_the_frame_of_the_earlier_one(tmp_path):
    model = make_model()
    earlier = make_model()
    for image_id in (2, 5):
        earlier.deregister_frame(earlier.image(image_id).frame_id)
    sparse = write_earlier(tmp_path, earlier)
    model.transform(TURN)
    keep_frame([model], sparse)
    assert_same_poses(model, make_model())
    xyz = [np.array([model.points3D[key].xyz for key in sorted(model.points3D)]) for model in (model, make_model())]
    np.testing.assert_allclose(*xyz, atol=1e-6)


def test_cameras_that_moved_do_not_count(tmp_path):
    earlier = make_model()
    for image_id in (1, 4):
        frame = earlier.frame(earlier.image(image_id).frame_id)
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([1.0, 2, 0])), [5, 5, 5])
    sparse = write_earlier(tmp_path, earlier)
    model = make_model()
    model.transform(TURN)
    keep_frame([model], sparse)
    assert_same_poses(model, make_model())


@pytest.mark.parametrize("count", [2, 3, 9])
def test_cameras_in_a_row_are_not_rolled_around_it(count):
    poses = {
        f"{n}.jpg": pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1 * n, 0.05, 0])), [float(n), 0, 0])
        for n in range(count)
    }
    moved = {
        name: pycolmap.Rigid3d(TURN.rotation * pose.rotation, TURN * pose.translation) for name, pose in poses.items()
    }
    similarity = find_similarity(poses, moved)
    np.testing.assert_allclose(similarity.matrix(), TURN.matrix(), atol=1e-6)


def test_utm_coordinates_are_kept(tmp_path):
    utm = pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), [500000.0, 4649776.0, 120.0])
    earlier = make_model()
    earlier.transform(utm)
    model = make_model()
    model.transform(TURN)
    keep_frame([model], write_earlier(tmp_path, earlier))
    assert_same_poses(model, earlier, atol=1e-5)


def test_each_model_goes_to_the_earlier_one_that_shares_most_images(tmp_path):
    first, second = make_model(8, 1), make_model(5, 2)
    for image in second.images.values():
        image.name = f"other_{image.name}"
    write_earlier(tmp_path, first, 0)
    sparse = write_earlier(tmp_path, second, 1)
    moved = [make_model(8, 1), make_model(5, 2)]
    for image in moved[1].images.values():
        image.name = f"other_{image.name}"
    for model in moved:
        model.transform(TURN)
    keep_frame(moved, sparse)
    assert_same_poses(moved[0], first)
    assert_same_poses(moved[1], second)


def test_a_model_that_is_there_already_stays_as_it_is(tmp_path):
    model = make_model()
    keep_frame([model], write_earlier(tmp_path, model))
    for image_id, image in model.images.items():
        np.testing.assert_array_equal(
            image.cam_from_world().matrix(), make_model().images[image_id].cam_from_world().matrix()
        )


@pytest.mark.parametrize("earlier", ["none", "damaged", "of other photos"])
def test_without_an_earlier_model_nothing_is_moved(tmp_path, earlier):
    model, sparse = make_model(), tmp_path / "sparse"
    if earlier == "damaged":
        (sparse / "0").mkdir(parents=True)
        for part in ("cameras", "images", "points3D"):
            (sparse / "0" / f"{part}.bin").write_bytes(b"damaged")
    elif earlier == "of other photos":
        other = make_model(8, 3)
        for image in other.images.values():
            image.name = f"other_{image.name}"
        write_earlier(tmp_path, other)
    keep_frame([model], sparse)
    assert_same_poses(model, make_model(), atol=0)
