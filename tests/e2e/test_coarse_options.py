"""--coarse and --coarse-matches, as a user types them."""

import h5py
import pycolmap

from hm_sfm.geometry.frames import pixel_index_from_px


def assert_refused(finished, *parts: object) -> None:
    """Exit code 2 and one line on stderr that holds all `parts`."""
    assert finished.code == 2
    assert finished.err.startswith("hm-sfm: ") and finished.err.count("\n") == 1, finished.err
    assert all(str(part) in finished.err for part in parts), finished.err


def test_a_run_starts_from_sift(scene, tmp_path, run):
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("view_00.jpg view_01.jpg\n")
    command = ("match", scene.images, tmp_path / "out", "--pairs", pairs)
    finished = run(*command, "--coarse", "sift", "--quiet")
    assert (finished.code, finished.err) == (0, "")
    with h5py.File(tmp_path / "out" / "matches.h5") as h5:
        group = h5["000000"]
        xy0, xy1, score = (group[name][()] for name in ("xy0", "xy1", "score"))
        assert (score > 0.5).sum() > 50
        assert ((xy0 * 2) % 1).any()  # no centres of cells
    assert_refused(run(*command), "matches.h5 was made with matching.coarse 'sift (pycolmap")

    with h5py.File(tmp_path / "points.h5", "w") as h5:
        h5["view_00.jpg/view_01.jpg/keypoints0"] = pixel_index_from_px(xy0)
        h5["view_00.jpg/view_01.jpg/keypoints1"] = pixel_index_from_px(xy1)
    command = ("match", scene.images, tmp_path / "other")
    options = ("--coarse-matches", tmp_path / "points.h5")
    assert_refused(run(*command, *options), tmp_path / "points.h5", "lacks 9 of 10 pairs")
    assert not (tmp_path / "other").exists()
    assert run(*command, "--pairs", pairs, *options).code == 0
    with h5py.File(tmp_path / "other" / "matches.h5") as h5:
        assert abs(len(h5["000000/score"]) - len(score)) < 10


def test_keypoints_are_placed_again_whoever_made_the_matches(scene, reconstructed, tmp_path, run):
    for name in (".hm_sfm", "matches.h5"):
        (tmp_path / name).write_bytes((reconstructed / name).read_bytes())
    assert run("export", scene.images, tmp_path, "--format", "hloc", "--quiet").code == 0
    hloc = tmp_path / "hloc"
    options = ("--coarse-matches", hloc / "matches.h5", "--coarse-features", hloc / "features.h5", "--quiet")
    finished = run("export", scene.images, tmp_path / "out", *options)
    assert (finished.code, finished.err) == (0, "")
    with pycolmap.Database.open(tmp_path / "out" / "database.db") as database:
        assert database.num_inlier_matches() > 1000


def test_an_unknown_name_is_refused_before_anything_is_done(scene, tmp_path, run):
    finished = run("match", scene.images, tmp_path / "out", "--coarse", "superglue")
    assert_refused(finished, "matching.coarse", "'superglue'", "--coarse-matches")
    assert not (tmp_path / "out").exists()
