"""Each recipe of pipelines/ once, as a script, on matches that are there already."""

import dataclasses
import importlib
import re
import runpy
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

import hm_sfm.matching.matcher as model
from hm_sfm.training import loop

PIPELINES = Path(__file__).parents[2] / "pipelines"
OTHERS = {
    "benchmark_poses.py", "benchmark_scenes.py", "make_teacher_tracks.py", "peers.py", "scene_scores.py", "tables.py",
    "benchmark.py", "matching_costs.py",
    "ablation_scores.py", "make_api_reference.py",
}  # fmt: skip
"""They compare with, or learn from, packages that hm_sfm does not need; test_benchmarks.py runs what it can of them.
ablation_scores.py measures what ablate.py tells, and test_docs.py runs make_api_reference.py."""


@pytest.fixture
def run_recipe(monkeypatch, capfd):
    """Run a recipe with its arguments and return what it printed."""

    def run_here(name: str, *arguments: Path) -> str:
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(PIPELINES / name), run_name="__main__")
        return capfd.readouterr().out

    return run_here


def test_recipes_are_short_and_all_are_run_here():
    recipes = sorted(path for path in PIPELINES.glob("*.py") if path.name not in OTHERS)
    assert [path.name for path in recipes] == [
        "ablate.py",
        "benchmark_retrieval.py",
        "compare_tracks.py",
        "export_to_colmap.py",
        "hloc_style_steps.py",
        "reconstruct_folder.py",
        "score_against_ground_truth.py",
    ]
    assert all(len(path.read_text().splitlines()) < 100 for path in recipes)


def test_reconstruct_folder(scene, out, run_recipe, matched_pairs):
    shutil.rmtree(out / "sparse")
    printed = run_recipe("reconstruct_folder.py", scene.images, out)
    assert matched_pairs == []
    assert printed.startswith("5 of 5 images registered")
    assert pycolmap.Reconstruction(out / "sparse" / "0").num_reg_images() == 5


def test_export_to_colmap(scene, out, run_recipe, matched_pairs):
    printed = run_recipe("export_to_colmap.py", scene.images, out)
    assert matched_pairs == []
    assert re.search(r"^5 images, [0-9]{4,} keypoints$", printed, re.MULTILINE)
    assert "of 10 image pairs verified" in printed
    assert f"{out / 'colmap' / '0'}: 5 images" in printed
    assert pycolmap.Reconstruction(out / "colmap" / "0").num_reg_images() == 5


def test_benchmark_retrieval(scene, reconstructed, tmp_path, run_recipe, monkeypatch):
    monkeypatch.syspath_prepend(PIPELINES)
    models = tmp_path / "models"
    shutil.copytree(reconstructed / "sparse", models / scene.images.name / "sparse")
    more = ("--models", models, "--out", tmp_path / "out", "--top", "1", "4")
    header, row = run_recipe("benchmark_retrieval.py", scene.images, *more).splitlines()
    assert header.split() == ["scene", "among", "images", "true", "recall@1", "pairs@1", "recall@4", "pairs@4"]
    values = row.split()
    assert values[:3] == ["images", "itself", "5"] and 4 <= int(values[3]) <= 10
    # Four of four others are all pairs; the best one of each makes three to five.
    assert values[-2:] == ["100.00", "100.00"]
    assert 30 <= float(values[5]) <= 50 and 0 < float(values[4]) < 100


def test_hloc_style_steps(scene, out, run_recipe, matched_pairs):
    printed = run_recipe("hloc_style_steps.py", scene.images, out)
    assert matched_pairs == []
    assert re.search(r"^[0-9]{4,} keypoints, [0-9]{4,} matches in 10 pairs\n5 of 5 images", printed, re.MULTILINE)
    assert pycolmap.Reconstruction(out / "hloc" / "sparse" / "0").num_reg_images() == 5


def test_compare_tracks(scene, out, expectation_weights, tmp_path, run_recipe, monkeypatch):
    weights = Path(shutil.copytree(model.WEIGHTS_FOLDER, tmp_path / "weights"))
    shutil.copy(expectation_weights, weights / "light_expectation.pt")
    digest = model.digest_weights(str(expectation_weights))
    (weights / "light_expectation.sha256").write_text(f"{digest}  light_expectation.pt\n")
    monkeypatch.setattr(model, "WEIGHTS_FOLDER", weights)
    (out / "matches.h5").rename(out / "homographies.h5")
    printed = run_recipe("compare_tracks.py", scene.images, out, scene.folder / "ground_truth")
    rows = re.findall(r"^(\w+): (\d) of 5 images, \d+ points, tracks of (.*) images, .* px$", printed, re.MULTILINE)
    assert [row[0] for row in rows] == ["persistent", "raw", "snapped"]
    assert int(rows[0][1]) == 5 and float(rows[0][2]) > float(rows[1][2])
    assert printed.count("AUC@0.5 deg") == 3


def test_score_against_ground_truth(scene, out, tmp_path, run_recipe, matched_pairs):
    strecha = tmp_path / "strecha"
    shutil.copytree(scene.images, strecha / "images")
    shutil.copytree(scene.folder / "ground_truth", strecha / "gt_dense_cameras")
    k = scene.views["view_00.jpg"].K
    np.savetxt(strecha / "K.txt", k)
    printed = run_recipe("score_against_ground_truth.py", strecha, out)
    assert matched_pairs == []
    assert "registered          5 of 5" in printed
    auc = re.search(r"of pose errors +(.*) %", printed).group(1).split("/")
    assert len(auc) == 5 and float(auc[3]) > 80
    (camera,) = pycolmap.Reconstruction(out / "sparse" / "0").cameras.values()
    np.testing.assert_allclose(camera.params, [k[0, 0], k[1, 1], k[0, 2], k[1, 2]])

    (strecha / "K.txt").unlink()
    run_recipe("score_against_ground_truth.py", strecha, out)
    (camera,) = pycolmap.Reconstruction(out / "sparse" / "0").cameras.values()
    assert camera.model == pycolmap.CameraModelId.SIMPLE_RADIAL


@pytest.fixture
def ablate(scene, tmp_path, monkeypatch, capfd):
    """Run ablate.py for two steps a variant, on pairs of noise and two photos of the small scene; what it printed."""
    monkeypatch.syspath_prepend(PIPELINES)
    scores, recipe = importlib.import_module("ablation_scores"), importlib.import_module("ablate")
    for name, value in {"PAIRS": 2, "SIZE_WH": (160, 128), "TIMED_PATCHES": 40, "TIMED_CALLS": 1}.items():
        monkeypatch.setattr(scores, name, value)
    monkeypatch.setattr(recipe, "SIZES", ((9, 1, 2, 2),))
    monkeypatch.setattr(loop, "HELD_OUT_PAIRS", 2)
    monkeypatch.setattr(loop, "draw_curves", lambda *paths: None)
    strecha, photos = tmp_path / "courtyard", tmp_path / "photos"
    shutil.copytree(scene.images, strecha / "images")
    (strecha / "gt_dense_cameras").mkdir()
    for name in ("view_00.jpg", "view_01.jpg"):
        shutil.copy(scene.folder / "ground_truth" / f"{name}.camera", strecha / "gt_dense_cameras")
    np.savetxt(strecha / "K.txt", scene.views["view_00.jpg"].K)
    photos.mkdir()
    for seed in range(2):
        noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(240, 320)), (0, 0), 2.5)
        cv2.imwrite(str(photos / f"{seed}.png"), np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8))
    config = tmp_path / "train.yaml"
    config.write_text(
        f"{{images: {photos}, out: {tmp_path / 'variants'}, start_from: {model.find_weights('light')}, "
        "size_px: 64, pairs_per_step: 1, patches_per_pair: 8, precision: fp32, device: cpu}"
    )

    def run_here(*more: str) -> str:
        arguments = [config, "--scene", strecha, "--steps", "2", "--report", tmp_path / "docs" / "ablations.md", *more]
        monkeypatch.setattr(sys, "argv", ["ablate.py", *map(str, arguments)])
        capfd.readouterr()
        recipe.main()
        return capfd.readouterr().out

    return run_here


def test_ablate(ablate, tmp_path, monkeypatch, matched_pairs):
    light = model.load_weights("light")
    attentive = model.HomoNet(dataclasses.replace(light.config, coarse="attention"))
    attentive.load_state_dict(light.state_dict(), strict=False)
    model.save_weights(tmp_path / "attention.pt", attentive)
    weights = ("--attention-weights", str(tmp_path / "attention.pt"))

    tables = ablate(*weights).partition("\n## ")[2].strip()
    report = (tmp_path / "docs" / "ablations.md").read_text()
    assert report.endswith(f"{tables}\n") and f"    python ablate.py {tmp_path / 'train.yaml'} --scene" in report
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in tables.splitlines() if line.startswith("|")]
    assert [line[0] for line in cells if not line[0].startswith("-")] == [
        "", "semi-dense", "+ dense", "+ suppressed", "", "expectation", "9/1/2, spacing 2", "", "with", "without",
    ]  # fmt: skip
    assert cells[0][1:] == ["PCK@1", "PCK@3", "centre@1", "centre@3", "AUC@5"]
    assert cells[5][-1] == "fine ms" and cells[9][1:3] == ["recall", "precision"] and cells[9][-1] == "coarse ms"
    assert all(0 <= float(value) <= 100 for line in cells[2:5] for value in line[1:])
    # What the first table's last row tells is the same network.
    assert cells[4][1:] == cells[8][1:-1]
    trained = sorted(path.parent.name for path in (tmp_path / "variants").glob("*/weights.pt"))
    assert trained == ["expectation-9-1-2-2-centre"] + [
        f"homography-9-1-2-2-{supervise}" for supervise in ("centre", "dense", "suppressed")
    ]

    # The variants have the features in common that they start from; all heads start new.
    features = model.read_checkpoint(tmp_path / "variants" / "features.pt")["state_dict"]
    assert features.keys() == {key for key in light.state_dict() if not key.startswith("head.")}

    # All is done: nothing is trained or matched, and without the weights there are two tables.
    matched_pairs.clear()
    monkeypatch.setattr(loop, "run_training", None)
    assert ablate(*weights).strip() == f"## {tables}"
    assert ablate().count("## ") == 2
    assert matched_pairs == []


def test_ablate_refuses_weights_without_a_transformer(ablate, tmp_path, capfd):
    with pytest.raises(SystemExit) as stop:
        ablate("--attention-weights", "light")
    assert stop.value.code == 2
    assert "light has no coarse transformer: network.coarse is 'cosine'" in capfd.readouterr().err
    assert not (tmp_path / "variants").exists()
