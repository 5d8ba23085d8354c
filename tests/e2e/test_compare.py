"""hm-sfm compare and hm-sfm export --format hloc, on the small scene."""

import json
import shutil
import sys
from pathlib import Path

import h5py
import numpy as np
import pycolmap
import pytest
import torch
from kornia.feature import LoFTR

from hm_sfm.cli import main
from hm_sfm.formats.hloc import read_features, read_matches
from hm_sfm.formats.pairs_files import read_pairs
from hm_sfm.photos.images import list_images

STYLES = ("raw", "1px", "2px", "4px", "8px")
METHODS = ("persistent", *(f"loftr_style_{style}" for style in STYLES))


def copy_run(reconstructed: Path, out: Path) -> Path:
    """OUT of a run that has come as far as its matches."""
    out.mkdir(parents=True)
    for name in (".hm_sfm", "matches.h5"):
        shutil.copy(reconstructed / name, out)
    return out


@pytest.fixture(scope="module")
def exported(scene, reconstructed, tmp_path_factory) -> Path:
    """OUT of `hm-sfm export --format hloc`."""
    out = copy_run(reconstructed, tmp_path_factory.mktemp("exported") / "out")
    assert main(["export", str(scene.images), str(out), "--format", "hloc", "--quiet"]) == 0
    return out


@pytest.fixture(scope="module")
def options(exported, expectation_weights, scene) -> list[str]:
    """Options that ask for every method but LoFTR's own matches, which take their time."""
    hloc = exported / "hloc"
    return [
        *("--expectation-model", str(expectation_weights), "--ground-truth", str(scene.folder / "ground_truth")),
        *("--hloc-features", str(hloc / "features.h5"), "--hloc-matches", str(hloc / "matches.h5")),
    ]


@pytest.fixture(scope="module")
def compared(scene, reconstructed, options, tmp_path_factory) -> Path:
    """OUT of `hm-sfm compare` with every method; not to be changed."""
    out = tmp_path_factory.mktemp("compared") / "out"
    copy_run(reconstructed, out / "persistent")
    (out / ".hm_sfm").touch()
    assert main(["compare", str(scene.images), str(out), *options, "--quiet"]) == 0
    return out


@pytest.fixture
def metrics(compared) -> dict:
    return json.loads((compared / "compare.json").read_text())


# Comparing


def test_every_method_is_in_the_json(metrics):
    assert metrics.keys() == {
        "num_images", "skipped_images", "num_pairs", "methods", "config_fingerprint", "version",
    }  # fmt: skip
    assert (metrics["num_images"], metrics["skipped_images"], metrics["num_pairs"]) == (5, 0, 10)
    assert tuple(metrics["methods"]) == (*METHODS, "hloc")
    for method in metrics["methods"].values():
        assert method["seconds"].keys() == {"match", "keypoints", "verify", "map"}
        assert method["auc_percent"].keys() == {"0.25", "0.5", "1", "3"}
        histogram = {int(length): count for length, count in method["track_length_histogram"].items()}
        assert sum(histogram.values()) == method["points"]
        assert sum(n * count for n, count in histogram.items()) == pytest.approx(
            method["mean_track_length"] * method["points"]
        )
        assert sum(count for n, count in histogram.items() if n >= 3) == method["points_in_3_images"]


def test_models_stand_side_by_side(compared, metrics):
    for name, method in metrics["methods"].items():
        assert (compared / name / "database.db").exists()
        assert (compared / name / "sparse").exists() == (method["models"] > 0)
        if method["models"]:
            model = pycolmap.Reconstruction(compared / name / "sparse" / "0")
            assert model.num_reg_images() == method["registered"] and model.num_points3D() == method["points"]


def test_persistent_is_what_reconstruct_makes(compared, metrics):
    summary = json.loads((compared / "persistent" / "summary.json").read_text())
    method = metrics["methods"]["persistent"]
    assert method["registered"] == summary["registered"] == 5
    assert method["points"] == summary["points"]
    assert method["mean_track_length"] == pytest.approx(summary["mean_track_length"], abs=1e-4)
    assert method["mean_reprojection_px"] == pytest.approx(summary["mean_reprojection_px"], abs=1e-4)
    assert method["auc_percent"]["3"] > 80


def test_loftr_style_matches_give_models_with_shorter_tracks(metrics):
    methods = metrics["methods"]
    for style in STYLES:
        assert methods[f"loftr_style_{style}"]["registered"] >= 2
    for name in ("mean_track_length", "mean_matched_track_length"):
        assert methods["loftr_style_raw"][name] < methods["persistent"][name]


def test_keypoints_through_hlocs_files_map_as_well(metrics):
    ours, theirs = metrics["methods"]["persistent"], metrics["methods"]["hloc"]
    assert theirs["registered"] == 5
    assert theirs["points"] == pytest.approx(ours["points"], rel=0.02)
    assert theirs["mean_track_length"] == pytest.approx(ours["mean_track_length"], rel=0.02)
    assert theirs["seconds"]["match"] is None and theirs["seconds"]["map"] > 0


def test_a_second_run_keeps_everything(scene, compared, options, metrics, run, digest_files, matched_pairs):
    before = digest_files(compared)
    finished = run("compare", scene.images, compared, *options)
    assert finished.code == 0, finished.err
    assert matched_pairs == []
    assert "methods: 100%" in finished.err and "mapping" not in finished.err
    after = digest_files(compared)
    rewritten = {"compare.png", "compare.json", "pairs.txt"}
    assert {name: after[name] for name in after.keys() - rewritten} == {
        name: before[name] for name in before.keys() - rewritten
    }
    assert json.loads((compared / "compare.json").read_text()) == metrics

    heading, *rows = finished.out.splitlines()
    assert heading.startswith("method ") and "AUC@0.25" in heading
    assert [row.split()[0] for row in rows[:-1]] == [*METHODS, "hloc"]
    assert f"{compared / 'compare.json'}, {compared / 'compare.png'}" in rows[-1]


def test_the_plot_is_a_png(compared):
    data = (compared / "compare.png").read_bytes()
    assert data.startswith(b"\x89PNG") and len(data) > 10_000


def test_an_interrupted_comparison_goes_on(scene, reconstructed, expectation_weights, tmp_path, run, monkeypatch):
    out = tmp_path / "out"
    copy_run(reconstructed, out / "persistent")
    (out / ".hm_sfm").touch()
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("view_00.jpg view_01.jpg\nview_01.jpg view_02.jpg\nview_00.jpg view_02.jpg\n")
    command = ("compare", scene.images, out, "--pairs", pairs, "--expectation-model", expectation_weights, "--quiet")

    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("hm_sfm.evaluation.comparison.make_keypoints", interrupt)
        stopped = run(*command)
    assert stopped.code == 130 and "run the same command again" in stopped.err
    kept = (out / "persistent" / "result.json").stat().st_mtime_ns
    assert (out / "loftr_style" / "matches.h5").exists() and not (out / "compare.json").exists()

    with monkeypatch.context() as patch:
        patch.setattr("hm_sfm.pipeline.run.match_pairs", interrupt)
        patch.setattr("hm_sfm.evaluation.comparison.build_model", interrupt)
        assert run(*command).code == 0
    assert (out / "persistent" / "result.json").stat().st_mtime_ns == kept
    methods = json.loads((out / "compare.json").read_text())["methods"]
    assert list(methods) == list(METHODS)
    # Photos 3 and 4 are in no pair.
    assert methods["persistent"]["registered"] == 3 and methods["loftr_style_raw"]["auc_percent"] is None
    assert methods["loftr_style_raw"]["seconds"]["match"] > 0


def test_photos_without_a_model_end_with_code_3_and_a_report(scene, expectation_weights, tmp_path, run):
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("a.jpg", "b.jpg"):
        shutil.copy(scene.images / "view_00.jpg", photos / name)
    # LoFTR's weights are random, so that its pair has no match at all.
    torch.manual_seed(0)
    checkpoint = tmp_path / "loftr.ckpt"
    torch.save({"state_dict": LoFTR(pretrained=None).state_dict()}, checkpoint)
    out = tmp_path / "out"
    options = ("--expectation-model", expectation_weights, "--loftr", checkpoint, "--quiet")
    finished = run("compare", photos, out, *options)
    assert finished.code == 3
    assert finished.err.startswith("hm-sfm: no method could build a model from 2 images") and str(out) in finished.err
    assert (out / "compare.png").exists()
    methods = json.loads((out / "compare.json").read_text())["methods"]
    assert list(methods) == [*METHODS, *(f"loftr_{style}" for style in STYLES)]
    assert all(method["models"] == method["registered"] == method["points"] == 0 for method in methods.values())
    assert methods["loftr_raw"]["matched_tracks"] == 0 < methods["loftr_style_raw"]["matched_tracks"]
    with h5py.File(out / "loftr" / "matches.h5") as h5:
        assert [len(group["score"]) for group in h5.values()] == [0]


# Bad input


def assert_refused(finished, out: Path, *parts: object) -> None:
    """One line that holds all `parts`, and no OUT."""
    assert finished.code == 2
    assert finished.err.startswith("hm-sfm: ") and finished.err.count("\n") == 1, finished.err
    assert all(str(part) in finished.err for part in parts), finished.err
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--hloc-features", "f.h5"], ["--hloc-matches"]),
        (["--hloc-matches", "m.h5"], ["--hloc-features"]),
        (["--hloc-features", "f.h5", "--hloc-matches", "m.h5"], ["there is no file f.h5"]),
        (["--ground-truth", "nowhere"], ["nowhere holds no ground truth"]),
        (["--loftr", "none.ckpt"], ["none.ckpt"]),
        (["--expectation-model", "light"], ["'light' has the head 'homography'"]),
        (["--set", "network.backbone=loftr"], ["network.backbone"]),
        (["--expectation-model", "none.pt"], ["'none.pt' is neither a file nor bundled"]),
    ],
    ids=lambda value: " ".join(value) if value[0].startswith("--") else "",
)
def test_bad_options(arguments, parts, scene, expectation_weights, tmp_path, run):
    out = tmp_path / "out"
    model = ("--expectation-model", expectation_weights)
    assert_refused(run("compare", scene.images, out, *model, *arguments), out, *parts)


def test_files_and_cameras_of_other_photos(scene, exported, expectation_weights, tmp_path, run):
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("view_00.jpg", "view_01.jpg"):
        shutil.copy(scene.images / name, photos / f"my_{name}")
    out = tmp_path / "out"
    command = ("compare", photos, out, "--expectation-model", expectation_weights)
    hloc = exported / "hloc"
    files = ("--hloc-features", hloc / "features.h5", "--hloc-matches", hloc / "matches.h5")
    assert_refused(run(*command, *files), out, hloc / "features.h5", "2 of 2 images, for example 'my_view_00.jpg'")
    truth = scene.folder / "ground_truth"
    assert_refused(run(*command, "--ground-truth", truth), out, truth, "of 0 of 2 photos", "'my_view_00.jpg'")


@pytest.mark.parametrize("missing", ["matplotlib", "kornia"])
def test_a_package_that_is_not_installed(missing, scene, expectation_weights, tmp_path, run, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == missing] or [missing]:
        monkeypatch.setitem(sys.modules, name, None)
    out = tmp_path / "out"
    options = ("--expectation-model", expectation_weights, "--loftr", "loftr.ckpt")
    assert_refused(run("compare", scene.images, out, *options), out, f"{missing}, which is not installed: pip install")


def test_out_of_another_comparison(scene, compared, options, run, digest_files):
    before = digest_files(compared)
    finished = run("compare", scene.images, compared, *options, "--set", "matching.max_matches=100")
    assert finished.code == 2
    assert "matches.h5 was made with matching.max_matches" in finished.err and finished.err.count("\n") == 1
    assert digest_files(compared) == before


# hloc's format


def test_export_in_hlocs_format(scene, exported, reconstructed):
    assert {path.name for path in exported.iterdir()} == {".hm_sfm", "pairs.txt", "matches.h5", "refined.h5", "hloc"}
    images = list_images(scene.images).images
    pairs = read_pairs(exported / "pairs.txt", [image.name for image in images])
    keypoints = read_features(exported / "hloc" / "features.h5", images)
    matches = read_matches(exported / "hloc" / "matches.h5", pairs, keypoints)
    with pycolmap.Database.open(reconstructed / "database.db") as database:
        for number, points in enumerate(keypoints, start=1):
            np.testing.assert_allclose(database.read_keypoints(number).reshape(-1, 2), points.xy, atol=1e-4)
        assert database.num_matches() == sum(map(len, matches)) > 1000


def test_export_says_what_it_wrote(scene, exported, tmp_path, run):
    out = copy_run(exported, tmp_path / "out")
    finished = run("export", scene.images, out, "--format", "hloc")
    hloc = out / "hloc"
    assert finished.out == f"5 images and their keypoints: {hloc / 'features.h5'}, {hloc / 'matches.h5'}\n"
    assert finished.code == 0
    refused = run("export", scene.images, out, "--format", "bundler")
    assert refused.code == 2 and "'bundler'" in refused.err
