"""hm-sfm refine: a COLMAP database of SIFT in, one of refined keypoints out."""

import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from hm_sfm.colmap.database import read_verified_matches
from hm_sfm.io.colmap_log import quiet_colmap


def assert_refused(finished, *parts: object) -> None:
    """Exit code 2 and one line on stderr that holds all `parts`."""
    assert finished.code == 2
    assert finished.err.startswith("hm-sfm: ") and finished.err.count("\n") == 1, finished.err
    assert all(str(part) in finished.err for part in parts), finished.err


@pytest.fixture(scope="module")
def sift(scene, tmp_path_factory) -> Path:
    """COLMAP's own database of three of the scene's photos, each with a camera of its own."""
    path = tmp_path_factory.mktemp("sift") / "sift.db"
    with quiet_colmap():
        pycolmap.extract_features(path, scene.images, ["view_00.jpg", "view_01.jpg", "view_02.jpg"])
        pycolmap.match_exhaustive(path)
    return path


def read_xy(path: Path) -> dict[str, np.ndarray]:
    with pycolmap.Database.open(path) as database:
        return {row.name: database.read_keypoints(row.image_id)[:, :2] for row in database.read_all_images()}


def measure_error(scene, path: Path) -> float:
    """Median distance of verified matches from the true epipolar lines, px."""
    xy, errors = read_xy(path), []
    for pair, indices in read_verified_matches(path).items():
        view0, view1 = scene.views[pair.name0], scene.views[pair.name1]
        rotation = view1.cam_from_world[:, :3] @ view0.cam_from_world[:, :3].T
        x, y, z = view1.cam_from_world[:, 3] - rotation @ view0.cam_from_world[:, 3]
        essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
        matrix = np.linalg.inv(view1.K).T @ essential @ np.linalg.inv(view0.K)
        points0, points1 = (np.c_[xy[n][k], np.ones(len(k))] for n, k in zip((pair.name0, pair.name1), indices.T))
        lines = points0 @ matrix.T
        errors.append(np.abs((lines * points1).sum(axis=1)) / np.linalg.norm(lines[:, :2], axis=1))
    return float(np.median(np.concatenate(errors)))


def test_keypoints_of_sift_become_exact_and_persistent(scene, sift, tmp_path, run, matched_pairs):
    before = sift.read_bytes()
    command = ("refine", sift, scene.images, tmp_path / "out", "--quiet")
    finished = run(*command)
    assert (finished.code, finished.err) == (0, "")
    assert "3 images, 3 pairs" in finished.out and str(tmp_path / "out" / "database.db") in finished.out
    assert sift.read_bytes() == before and [path.name for path in sift.parent.iterdir()] == ["sift.db"]

    new = tmp_path / "out" / "database.db"
    assert read_verified_matches(new).keys() == read_verified_matches(sift).keys()
    assert measure_error(scene, new) < measure_error(scene, sift)
    # The first keypoints of tracks are SIFT's, which the joint adjustment then moves a little.
    old_xy, new_xy = read_xy(sift), read_xy(new)
    for name in old_xy:
        distance = np.linalg.norm(new_xy[name][:, None] - old_xy[name], axis=2).min(axis=1)
        assert len(new_xy[name]) > 30 and np.median(distance) < 1.0
    with pycolmap.Database.open(sift) as old, pycolmap.Database.open(new) as refined:
        assert [camera.params.tolist() for camera in refined.read_all_cameras()] == [
            camera.params.tolist() for camera in old.read_all_cameras()
        ]

    matched_pairs.clear()
    assert run(*command).code == 0 and matched_pairs == []  # goes on from what is there


def test_what_cannot_be_refined(scene, sift, tmp_path, run):
    out = tmp_path / "out"
    assert_refused(run("refine", tmp_path / "none.db", scene.images, out), "no database", "none.db")
    (tmp_path / "text.db").write_text("no database at all" * 100)
    assert_refused(run("refine", tmp_path / "text.db", scene.images, out), "text.db is damaged or no COLMAP database")
    assert_refused(run("refine", sift, tmp_path, out), "view_00.jpg")
    assert_refused(run("refine", sift, scene.images, out, "--coarse", "sift"), "--coarse")

    unmatched = shutil.copy(sift, tmp_path / "unmatched.db")
    with pycolmap.Database.open(unmatched) as database:
        database.clear_two_view_geometries()
    assert_refused(run("refine", unmatched, scene.images, out), "unmatched.db has no verified matches of its 3 images")
    resized = shutil.copy(sift, tmp_path / "resized.db")
    with pycolmap.Database.open(resized) as database:
        for camera in database.read_all_cameras():
            camera.rescale(2.0)
            database.update_camera(camera)
    assert_refused(run("refine", resized, scene.images, out), "640 x 480 px, the photo is 320 x 240 px")
    outside = shutil.copy(sift, tmp_path / "outside.db")
    with pycolmap.Database.open(outside) as database:
        database.update_keypoints(1, np.full((5, 2), 1000, np.float32))
    assert_refused(run("refine", outside, scene.images, out), "keypoints outside of 'view_0")
    assert not out.exists()

    out.mkdir()
    shutil.copy(sift, out / "database.db")
    assert_refused(run("refine", out / "database.db", scene.images, out), "its own refinement")
