import cv2
import numpy as np
import pytest

from hm_sfm.errors import InputError
from hm_sfm.evaluation.relative_poses import (
    PointMatches,
    PosePair,
    estimate_pose_colmap,
    estimate_pose_opencv,
    measure_pose_error,
    read_strecha_pairs,
    read_superglue_pairs,
    score_pose_matches,
)
from hm_sfm.formats.strecha import write_strecha_cameras
from hm_sfm.types import PatchMatches, PinholeView

K0 = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])
K1 = np.array([[450.0, 0, 300], [0, 450, 250], [0, 0, 1]])


def make_pose(rotation_deg, translation):
    rotation, _ = cv2.Rodrigues(np.radians(rotation_deg) * np.array([0.2, 1.0, 0.1]))
    return np.column_stack([rotation, np.array(translation) / np.linalg.norm(translation)])


def make_matches(pose, count=400, outliers=60, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.uniform([-2, -1.5, 4], [2, 1.5, 9], (count, 3))
    xy0 = points @ K0.T
    xy1 = (points @ pose[:, :3].T + pose[:, 3]) @ K1.T
    xy0, xy1 = xy0[:, :2] / xy0[:, 2:], xy1[:, :2] / xy1[:, 2:]
    xy1[:outliers] += rng.uniform(20, 80, (outliers, 2))
    homography = np.repeat(np.eye(3)[None], count, axis=0)
    return PatchMatches(xy0=xy0, xy1=xy1, score=np.ones(count), homography=homography, patch_radius_px=8.0)


@pytest.mark.parametrize("estimate", [estimate_pose_opencv, estimate_pose_colmap])
def test_poses_are_recovered_among_planted_outliers(estimate):
    pose = make_pose(12, (1.0, 0.1, 0.2))
    assert measure_pose_error(estimate(make_matches(pose), K0, K1), pose) < 0.2


@pytest.mark.parametrize("estimate", [estimate_pose_opencv, estimate_pose_colmap])
def test_too_few_matches_give_no_pose(estimate):
    pose = make_pose(5, (1, 0, 0))
    assert estimate(make_matches(pose, count=4, outliers=0), K0, K1) is None
    assert measure_pose_error(None, pose) == np.inf


def test_any_matcher_can_be_scored():
    pose = make_pose(12, (1.0, 0.1, 0.2))
    asked = []

    def match(path0, path1):
        asked.append((path0, path1))
        matches = make_matches(pose)
        return (
            PointMatches(matches.xy0, matches.xy1) if path0 == "a" else PointMatches(matches.xy0[:4], matches.xy1[:4])
        )

    pairs = [PosePair("a", "b", K0, K1, pose), PosePair("b", "c", K0, K1, pose)]
    scores = score_pose_matches(match, pairs, quiet=True)
    assert asked == [("a", "b"), ("b", "c")]
    assert scores["mean_matches"] == 202
    for name in ("opencv", "colmap"):
        assert 45 < scores[f"{name}_auc_5deg"] < scores[f"{name}_auc_20deg"] < 75


def test_points_of_two_images_must_be_as_many():
    with pytest.raises(ValueError, match="xy1"):
        PointMatches(np.zeros((3, 2)), np.zeros((2, 2)))


def test_a_pose_error_is_the_larger_angle_and_ignores_the_sign_of_the_translation():
    pose = make_pose(0, (1, 0, 0))
    assert measure_pose_error(make_pose(10, (1, 0, 0)), pose) == pytest.approx(10 * np.linalg.norm([0.2, 1, 0.1]))
    assert measure_pose_error(make_pose(0, (-1, 0, 0)), pose) == pytest.approx(0, abs=1e-4)
    assert measure_pose_error(make_pose(0, (1, 1, 0)), pose) == pytest.approx(45)


def test_superglue_pairs_move_into_colmaps_frame(tmp_path):
    pose = np.eye(4)
    pose[0, 3] = 2
    numbers = [*K0.ravel(), *K1.ravel(), *pose.ravel()]
    (tmp_path / "pairs.txt").write_text("a/0.jpg b/1.jpg 0 0 " + " ".join(map(str, numbers)) + "\n\n")
    (pair,) = read_superglue_pairs(tmp_path / "pairs.txt", tmp_path)
    assert pair.path1 == tmp_path / "b" / "1.jpg"
    assert np.allclose(pair.k0[:2, 2], K0[:2, 2] + 0.5) and np.allclose(pair.k1[0, 0], K1[0, 0])
    assert np.allclose(pair.cam1_from_cam0, pose[:3])


@pytest.mark.parametrize("text", ["a.jpg b.jpg 0 0 1 2 3\n", "a.jpg b.jpg 0 0 " + "x " * 34 + "\n", "\n"])
def test_malformed_superglue_pairs_are_refused(tmp_path, text):
    (tmp_path / "pairs.txt").write_text(text)
    with pytest.raises(InputError, match="pairs.txt"):
        read_superglue_pairs(tmp_path / "pairs.txt", tmp_path)


def test_strecha_scenes_give_all_pairs(tmp_path):
    views = {
        f"{i}.jpg": PinholeView(K0, (640, 480), np.column_stack([np.eye(3), np.array([-float(i), 0, 0])]))
        for i in range(3)
    }
    write_strecha_cameras(tmp_path / "gt_dense_cameras", views)
    with pytest.raises(InputError, match="K.txt"):
        read_strecha_pairs(tmp_path)
    np.savetxt(tmp_path / "K.txt", K0)
    pairs = read_strecha_pairs(tmp_path)
    assert [(p.path0.name, p.path1.name) for p in pairs] == [("0.jpg", "1.jpg"), ("0.jpg", "2.jpg"), ("1.jpg", "2.jpg")]
    assert np.allclose(pairs[1].cam1_from_cam0, np.column_stack([np.eye(3), [-2, 0, 0]]))
