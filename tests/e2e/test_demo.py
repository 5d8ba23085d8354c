"""The whole chain on rendered photos: how good it is, what it leaves behind, and that nothing is computed twice."""

import json
import re
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pycolmap
import pytest

from hm_sfm.evaluation.poses import ModelScore, score_model
from hm_sfm.formats.pairs_files import read_pairs
from hm_sfm.formats.strecha import read_strecha_cameras
from hm_sfm.synthetic.demo import write_demo

# A process that stores each pair at once instead of every 20 s, and that minds Ctrl-C even where the tests were
# started in the background.
STORING_EACH_PAIR = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
import hm_sfm.io.batches
hm_sfm.io.batches.BATCH_SECONDS = 0.0
from hm_sfm.cli import main
sys.exit(main(sys.argv[1:]))
"""


def test_demo_registers_all_images_precisely(demo):
    out, finished = demo
    assert finished.code == 0, finished.err
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["registered"], summary["num_images"], summary["models"]) == (12, 12, 1)
    assert summary["points"] >= 6000
    assert summary["mean_track_length"] >= 4.5
    assert 0.1 < summary["mean_reprojection_px"] <= 0.85

    score = score_demo(out)
    assert score.registered == 12
    assert score.auc_percent[1] >= 90


def test_demo_prints_what_came_out(demo):
    out, finished = demo
    first, second, third = finished.out.splitlines()
    assert first.startswith("12 of 12 images registered")
    assert str(out / "sparse" / "0") in second
    printed = re.search(r"AUC@1 deg ([0-9.]+)", third).group(1)
    assert float(printed) == pytest.approx(score_demo(out).auc_percent[1], abs=0.06)
    for stage in ("features", "matches", "verify", "seeds", "keypoints", "mapping"):
        assert f"{stage}: 100%" in finished.err
    assert "Traceback" not in finished.err


def test_demo_leaves_the_files_that_other_programs_rely_on(demo, read_matches):
    out, _ = demo
    names = [f"view_{index:02d}.jpg" for index in range(12)]
    pairs = [(pair.name0, pair.name1) for pair in read_pairs(out / "pairs.txt", names)]
    assert len(pairs) == 66

    matches = read_matches(out / "matches.h5")
    assert matches.keys() == set(pairs)
    neighbours = matches["view_00.jpg", "view_01.jpg"]
    count = len(neighbours["score"])
    assert count > 500
    assert neighbours["xy0"].shape == neighbours["xy1"].shape == (count, 2)
    assert neighbours["homography"].shape == (count, 3, 3)
    assert all(np.isfinite(data).all() for data in neighbours.values())

    with pycolmap.Database.open(out / "database.db") as database:
        assert sorted(image.name for image in database.read_all_images()) == names
        assert (database.num_cameras(), database.num_rigs(), database.num_frames()) == (1, 1, 12)
        assert database.num_verified_image_pairs() > 30
        assert database.num_keypoints() > 12 * 500

    model = pycolmap.Reconstruction(out / "sparse" / "0")
    summary = json.loads((out / "summary.json").read_text())
    assert model.num_points3D() == summary["points"]
    assert model.compute_num_observations() == summary["observations"]
    assert summary.keys() == {
        "image_folder",
        "num_images",
        "skipped_images",
        "registered",
        "unregistered",
        "models",
        "masks",
        "pairs_given_up",
        "matches_denied",
        "points",
        "observations",
        "mean_track_length",
        "mean_reprojection_px",
        "seconds",
        "version",
        "config_fingerprint",
    }
    stages = {"features", "match", "keypoints", "verify", "judge", "map", "total"}
    assert summary["seconds"].keys() == stages
    assert all(summary["seconds"][stage] > 0 for stage in stages)


def test_demo_matches_are_found_again(demo, run, matched_pairs):
    out, _ = demo
    before = (out / "matches.h5").stat().st_mtime_ns
    finished = run("match", out / "images", out)
    assert finished.code == 0
    assert matched_pairs == []
    assert (out / "matches.h5").stat().st_mtime_ns == before


def test_photos_are_rendered_the_same_again(scene, tmp_path, digest_files):
    """Otherwise a demo that is started again would not find its matches."""
    write_demo(tmp_path, count=5, size_wh=(320, 240))
    assert digest_files(tmp_path) == digest_files(scene.folder)


def test_the_same_command_again_gives_the_same_model(scene, out, run, matched_pairs):
    before = json.loads((out / "summary.json").read_text())
    assert run("reconstruct", scene.images, out).code == 0
    assert matched_pairs == []
    after = json.loads((out / "summary.json").read_text())
    assert after["config_fingerprint"] == before["config_fingerprint"]
    assert after["registered"] == before["registered"] == 5
    # The mapper's threads add up in any order.
    assert after["points"] == pytest.approx(before["points"], rel=0.02)


def test_a_deleted_database_and_model_come_back_from_the_matches(scene, out, run, matched_pairs):
    (out / "database.db").unlink()
    shutil.rmtree(out / "sparse")
    (out / "summary.json").unlink()
    assert run("reconstruct", scene.images, out).code == 0
    assert matched_pairs == []
    assert pycolmap.Reconstruction(out / "sparse" / "0").num_reg_images() == 5
    assert json.loads((out / "summary.json").read_text())["registered"] == 5


def test_a_killed_matching_goes_on_with_the_pairs_that_are_missing(
    scene, reconstructed, tmp_path, run, matched_pairs, read_matches
):
    out = tmp_path / "out"
    process = start_matching(scene, out)
    wait_for_pairs(process, out, 3)
    process.kill()
    process.wait()
    stored = len(list((out / "matches.h5.parts").glob("*.h5")))
    assert 3 <= stored < 10
    assert not (out / "matches.h5").exists()
    # What a kill in the middle of writing leaves.
    (out / "matches.h5.parts" / f"{stored:06d}.h5.tmp").write_bytes(b"half a file")

    assert run("match", scene.images, out).code == 0
    assert len(matched_pairs) == 10 - stored
    assert not (out / "matches.h5.parts").exists()
    assert_same_matches(read_matches(out / "matches.h5"), read_matches(reconstructed / "matches.h5"))


def test_ctrl_c_exits_130_and_keeps_what_is_done(scene, reconstructed, tmp_path, run, matched_pairs, read_matches):
    out = tmp_path / "out"
    process = start_matching(scene, out)
    wait_for_pairs(process, out, 2)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in err
    assert err.splitlines()[-1] == "hm-sfm: interrupted; run the same command again to continue"
    assert run("match", scene.images, out).code == 0
    assert 0 < len(matched_pairs) <= 8
    assert_same_matches(read_matches(out / "matches.h5"), read_matches(reconstructed / "matches.h5"))


def score_demo(out) -> ModelScore:
    return score_model(pycolmap.Reconstruction(out / "sparse" / "0"), read_strecha_cameras(out / "ground_truth"))


def start_matching(scene, out) -> subprocess.Popen:
    command = [sys.executable, "-c", STORING_EACH_PAIR, "match", str(scene.images), str(out)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def wait_for_pairs(process, out, count) -> None:
    """Until the process has stored so many of the ten pairs."""
    deadline = time.monotonic() + 120
    while len(list((out / "matches.h5.parts").glob("*.h5"))) < count:
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < deadline
        time.sleep(0.005)


def assert_same_matches(actual, expected) -> None:
    assert actual.keys() == expected.keys()
    for pair, fields in expected.items():
        for field, data in fields.items():
            np.testing.assert_array_equal(actual[pair][field], data, err_msg=f"{pair} {field}")
