import numpy as np
import pycolmap
import pytest

from hm_sfm.errors import InputError
from hm_sfm.evaluation.poses import measure_position_error, measure_relative_errors, pose_auc, score_model
from hm_sfm.types import PinholeView

K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])


def make_rotation(axis, angle_deg):
    """Rodrigues' formula, on its own so that the tests don't share the code they check."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(angle_deg)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def make_view(center, rotation=None):
    rotation = np.eye(3) if rotation is None else rotation
    return PinholeView(K, (640, 480), np.column_stack([rotation, -rotation @ np.asarray(center, float)]))


def make_ground_truth(count=5):
    rng = np.random.default_rng(3)
    return {
        f"{index}.jpg": make_view(rng.uniform(-2, 2, 3), make_rotation(rng.normal(size=3), rng.uniform(0, 60)))
        for index in range(count)
    }


def make_model(views):
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[500, 500, 320, 240], camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    for image_id, (name, view) in enumerate(views.items(), start=1):
        image = pycolmap.Image(name=name, camera_id=1, image_id=image_id)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.cam_from_world))
    return model


def measure_pose_errors(model, ground_truth):
    """The larger one of the two errors of each pair, degrees."""
    return np.maximum(*measure_relative_errors(model, ground_truth))


def test_perfect_model_in_another_world_frame_scores_100():
    ground_truth = make_ground_truth()
    model = make_model(ground_truth)
    turn = pycolmap.Rotation3d(make_rotation([1, 2, 3], 77))
    model.transform(pycolmap.Sim3d(2.5, turn, np.array([4.0, -5.0, 6.0])))
    score = score_model(model, ground_truth)
    assert (score.registered, score.num_images) == (5, 5)
    assert list(score.auc_percent.values()) == pytest.approx([100] * 7, abs=1e-3)
    assert score.median_rotation_deg < 1e-6 and score.median_translation_deg < 1e-6
    assert measure_position_error(model, ground_truth) < 1e-9


@pytest.mark.parametrize("angle_deg", [0.001, 2.0, 170.0])
def test_turned_camera_gives_its_angle_in_its_own_pairs_only(angle_deg):
    ground_truth = make_ground_truth(3)
    turned = make_rotation([3, -1, 2], angle_deg) @ ground_truth["1.jpg"].cam_from_world
    model = make_model(ground_truth | {"1.jpg": PinholeView(K, (640, 480), turned)})
    pairs_01_02_12 = measure_pose_errors(model, ground_truth)
    assert pairs_01_02_12 == pytest.approx([angle_deg, 0, angle_deg], rel=1e-6, abs=1e-6)


def test_moved_camera_gives_the_angle_between_the_directions():
    ground_truth = {"a": make_view([0, 0, 0]), "b": make_view([1, 0, 0])}
    moved = make_model(ground_truth | {"b": make_view([1, np.tan(np.radians(10)), 0])})
    opposite = make_model(ground_truth | {"b": make_view([-1, 0, 0])})
    assert measure_pose_errors(moved, ground_truth) == pytest.approx([10])
    assert measure_pose_errors(opposite, ground_truth) == pytest.approx([180])
    score = score_model(moved, ground_truth)
    assert (score.median_rotation_deg, score.median_translation_deg) == (0, pytest.approx(10))


def test_cameras_at_one_place_are_compared_by_rotation_alone():
    ground_truth = {"a": make_view([1, 2, 3]), "b": make_view([1, 2, 3])}
    turned = make_model(ground_truth | {"b": make_view([1, 2, 3], make_rotation([0, 0, 1], 5))})
    assert measure_pose_errors(turned, ground_truth) == pytest.approx([5])


def test_coinciding_cameras_that_should_stand_apart_miss():
    ground_truth = {"a": make_view([0, 0, 0]), "b": make_view([1, 0, 0])}
    assert measure_pose_errors(make_model(ground_truth | {"b": make_view([0, 0, 0])}), ground_truth) == pytest.approx(
        [180]
    )


def test_unregistered_images_are_infinite_errors():
    ground_truth = make_ground_truth(4)
    model = make_model({name: ground_truth[name] for name in ("0.jpg", "1.jpg", "3.jpg")})
    model.deregister_frame(model.find_image_with_name("3.jpg").frame_id)
    errors = measure_pose_errors(model, ground_truth)
    assert errors[0] < 1e-6 and np.isinf(errors[1:]).all() and len(errors) == 6
    score = score_model(model, ground_truth)
    assert (score.registered, score.num_images) == (2, 4)
    assert score.auc_percent[5] == pytest.approx(100 / 6, abs=1e-3)
    assert score.median_rotation_deg < 1e-6


def test_images_without_truth_do_not_count():
    ground_truth = make_ground_truth(3)
    score = score_model(make_model(ground_truth | {"other.jpg": make_view([9, 9, 9])}), ground_truth)
    assert (score.registered, score.num_images) == (3, 3)


def test_empty_model_scores_zero():
    score = score_model(pycolmap.Reconstruction(), make_ground_truth(3))
    assert score.registered == 0 and set(score.auc_percent.values()) == {0.0}
    assert np.isinf(score.median_rotation_deg)


def test_ground_truth_of_other_images_or_of_one_image_is_refused():
    ground_truth = make_ground_truth(3)
    with pytest.raises(InputError, match="'0.jpg'.*'elsewhere/0.jpg'"):
        measure_pose_errors(
            make_model(ground_truth), {f"elsewhere/{name}": view for name, view in ground_truth.items()}
        )
    with pytest.raises(InputError, match="at least two"):
        measure_pose_errors(make_model(ground_truth), {"0.jpg": ground_truth["0.jpg"]})


def test_auc_by_hand():
    # Recall runs (0, 0), (1, 1/2), (3, 1) and stays: up to 2 it covers 0.25 + 0.5, up to 5 it covers 0.25 + 1.5 + 2.
    assert pose_auc(np.array([3.0, 1.0]), (2, 5)) == pytest.approx({2: 37.5, 5: 75.0})
    assert pose_auc(np.array([1.0, np.inf]), (5,)) == pytest.approx({5: 45.0})
    assert pose_auc(np.zeros(3), (1,)) == pytest.approx({1: 100.0})
    assert pose_auc(np.array([7.0, np.inf]), (5,)) == pytest.approx({5: 0.0})


@pytest.mark.parametrize("errors", [[], [1.0, np.nan], [-1.0]])
def test_auc_refuses_what_is_no_error(errors):
    with pytest.raises(ValueError, match="errors_deg"):
        pose_auc(np.array(errors))


def test_position_error_by_hand():
    corners = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    ground_truth = {str(index): make_view(center) for index, center in enumerate(corners)}
    h = 0.1
    bent = {str(index): make_view(center + [0, 0, h * (-1) ** index]) for index, center in enumerate(corners)}
    # By symmetry the best fit only shrinks, by 0.5 / (0.5 + h^2); the square's diagonal is the extent.
    expected = np.sqrt(0.5 * h**2 / (0.5 + h**2)) / np.sqrt(2)
    assert measure_position_error(make_model(bent), ground_truth) == pytest.approx(expected)


@pytest.mark.parametrize("axes", [(1, 1, 0), (1, 0, 0)])
def test_position_error_of_cameras_in_a_plane_or_on_a_line(axes):
    ground_truth = {name: make_view(view.center * axes) for name, view in make_ground_truth().items()}
    model = make_model(ground_truth)
    model.transform(pycolmap.Sim3d(0.3, pycolmap.Rotation3d(make_rotation([1, 2, 3], 77)), np.array([4.0, -5.0, 6.0])))
    assert measure_position_error(model, ground_truth) < 1e-9


def test_mirrored_model_does_not_fit():
    ground_truth = make_ground_truth()
    mirrored = {name: make_view(view.center * [1, 1, -1]) for name, view in ground_truth.items()}
    assert measure_position_error(make_model(mirrored), ground_truth) > 0.05


def test_position_error_needs_three_cameras():
    ground_truth = make_ground_truth(4)
    assert (
        measure_position_error(make_model({name: ground_truth[name] for name in ("0.jpg", "1.jpg")}), ground_truth)
        == np.inf
    )
