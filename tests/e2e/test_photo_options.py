"""Masks, known cameras, known poses, the global mapper and convert, as a user types them."""

import json
import shutil

import cv2
import numpy as np
import pycolmap
import pytest


def assert_refused(finished, *parts: object) -> None:
    """Exit code 2 and one line on stderr that holds all `parts`."""
    assert finished.code == 2
    assert finished.err.startswith("hm-sfm: ") and finished.err.count("\n") == 1, finished.err
    assert all(str(part) in finished.err for part in parts), finished.err


@pytest.fixture
def masks(tmp_path):
    """A folder with a mask of view_01.jpg that hides its left half."""
    mask = np.full((240, 320), 255, np.uint8)
    mask[:, :160] = 0
    (tmp_path / "masks").mkdir()
    cv2.imwrite(str(tmp_path / "masks" / "view_01.jpg.png"), mask)
    return tmp_path / "masks"


def read_keypoints(database_path) -> dict[str, np.ndarray]:
    with pycolmap.Database.open(database_path) as database:
        return {row.name: database.read_keypoints(row.image_id)[:, :2] for row in database.read_all_images()}


def test_nothing_masked_is_matched_and_stored_matches_stay(scene, out, masks, run, matched_pairs, caplog):
    before = read_keypoints(out / "database.db")
    finished = run("export", scene.images, out, "--masks", masks)
    assert finished.code == 0, finished.err
    assert matched_pairs == []
    assert caplog.messages == [f"4 of 5 images have no mask in {masks}, such as view_00.jpg"]
    after = read_keypoints(out / "database.db")
    assert (before["view_01.jpg"][:, 0] < 160).sum() > 20
    assert (after["view_01.jpg"][:, 0] >= 160).all() and len(after["view_01.jpg"]) > 20
    assert (after["view_00.jpg"][:, 0] < 160).any()

    camera = masks / "view_01.jpg.png"
    assert run("export", scene.images, out, "--camera-mask", camera, "--quiet").code == 0
    assert all((xy[:, 0] >= 160).all() for xy in read_keypoints(out / "database.db").values())


def test_bad_masks_are_refused_before_anything_is_done(scene, masks, tmp_path, run):
    cv2.imwrite(str(masks / "view_02.jpg.png"), np.zeros((320, 240), np.uint8))
    finished = run("match", scene.images, tmp_path / "out", "--masks", masks)
    assert_refused(finished, masks / "view_02.jpg.png", "240 x 320 px", "320 x 240 px")
    finished = run("match", scene.images, tmp_path / "out", "--masks", tmp_path / "none")
    assert_refused(finished, tmp_path / "none", "does not exist")
    assert not (tmp_path / "out").exists()


def test_known_poses_are_triangulated(scene, reconstructed, out, run):
    model = reconstructed / "sparse" / "0"
    finished = run("reconstruct", scene.images, out, "--poses", model, "--quiet")
    assert finished.code == 0, finished.err
    assert finished.out.startswith("5 of 5 images registered")
    given, rebuilt = pycolmap.Reconstruction(model), pycolmap.Reconstruction(out / "sparse" / "0")
    for image in given.images.values():
        pose = rebuilt.find_image_with_name(image.name).cam_from_world().matrix()
        np.testing.assert_allclose(pose, image.cam_from_world().matrix(), atol=1e-12)
    np.testing.assert_array_equal(rebuilt.cameras[1].params, given.cameras[1].params)
    assert rebuilt.num_points3D() > 0.8 * given.num_points3D()
    assert rebuilt.compute_mean_reprojection_error() < 1.5


def test_known_cameras_are_kept(scene, reconstructed, out, run, tmp_path):
    (tmp_path / "known").mkdir()
    model = pycolmap.Reconstruction(reconstructed / "sparse" / "0")
    model.cameras[1].focal_length *= 1.01
    model.write_text(tmp_path / "known")
    finished = run("reconstruct", scene.images, out, "--cameras", tmp_path / "known" / "cameras.txt", "--quiet")
    assert finished.code == 0, finished.err
    rebuilt = pycolmap.Reconstruction(out / "sparse" / "0")
    assert rebuilt.num_reg_images() == 5
    np.testing.assert_allclose(rebuilt.cameras[1].params, model.cameras[1].params, rtol=1e-12)


def test_cameras_that_name_other_images(scene, reconstructed, tmp_path, run, digest_files):
    (tmp_path / "known").mkdir()
    model = pycolmap.Reconstruction(reconstructed / "sparse" / "0")
    for image in model.images.values():
        image.name = f"other/{image.name}"
    model.write_text(tmp_path / "known")
    for flag in ("--cameras", "--poses"):
        finished = run("match", scene.images, tmp_path / "out", flag, tmp_path / "known")
        assert_refused(
            finished, tmp_path / "known", "lacks 5 of 5 photos, for example 'view_00.jpg'", "'other/view_00.jpg'"
        )
    finished = run("match", scene.images, tmp_path / "out", "--cameras", tmp_path / "none")
    assert_refused(finished, tmp_path / "none", "does not exist")
    assert not (tmp_path / "out").exists()


def test_a_rig_that_does_not_match(scene, tmp_path, run):
    rig = tmp_path / "rig.json"
    command = ("match", scene.images, tmp_path / "out", "--rig", rig)
    assert_refused(run(*command), rig, "No such file")
    rig.write_text("[{")
    assert_refused(run(*command), rig, "not valid JSON")
    rig.write_text('[{"cameras": [{"image_prefix": "left/"}]}]')
    assert_refused(run(*command), rig, "needs one camera with ref_sensor true")
    rig.write_text('[{"cameras": [{"image_prefix": "left/", "ref_sensor": true}]}]')
    assert_refused(run(*command), rig, "no photo has a name that begins with 'left/'")
    assert_refused(run(*command, "--camera-mode", "per-image"), "cameras.rig", "'per-image'")
    assert not (tmp_path / "out").exists()


def test_the_global_mapper(scene, out, run, tmp_path):
    finished = run("reconstruct", scene.images, out, "--mapper", "global", "--quiet")
    assert finished.code == 0, finished.err
    assert finished.out.startswith("5 of 5 images registered")
    assert_refused(run("match", scene.images, tmp_path / "new", "--mapper", "best"), "incremental or global", "'best'")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("to", ["hloc", "nerfstudio", "3dgs", "ply", "txt"])
def test_a_run_is_converted(reconstructed, tmp_path, run, to):
    target = tmp_path / "target"
    finished = run("convert", reconstructed, "--to", to, target)
    assert (finished.code, finished.out, finished.err) == (0, f"{to}: {target}\n", "")
    expected = {
        "hloc": ["features.h5", "matches.h5", "pairs.txt"],
        "nerfstudio": [".made_by_hm_sfm", "images", "points3D.ply", "transforms.json"],
        "3dgs": [".made_by_hm_sfm", "images", "sparse"],
        "ply": ["target"],
        "txt": ["cameras.txt", "frames.txt", "images.txt", "points3D.txt", "rigs.txt"],
    }
    assert expected[to] == (["target"] if to == "ply" else sorted(path.name for path in target.iterdir()))
    if to == "nerfstudio":
        assert len(json.loads((target / "transforms.json").read_text())["frames"]) == 5
    assert_refused(run("convert", reconstructed, "--to", to, target), target, "is there already")


def test_convert_needs_a_model_and_its_photos(scene, out, tmp_path, run):
    moved = shutil.copytree(scene.images, tmp_path / "moved")
    (out / "summary.json").write_text("{}")
    assert_refused(run("convert", out, "--to", "3dgs", tmp_path / "new"), out / "summary.json", "--images")
    assert run("convert", out, "--to", "3dgs", tmp_path / "new", "--images", moved).code == 0
    shutil.rmtree(out / "sparse")
    assert_refused(run("convert", out, "--to", "ply", tmp_path / "p.ply"), out, "hm-sfm reconstruct first")
    assert_refused(run("convert", out, "--to", "obj", tmp_path / "p.obj"), "'obj'", "--help")
