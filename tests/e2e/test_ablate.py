"""pipelines/training/ablate.py, with trainings of two steps."""

import dataclasses
import importlib
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from hm_sfm.network import checkpoints
from hm_sfm.network.homonet import HomoNet
from hm_sfm.training import loop

TRAINING = Path(__file__).parents[2] / "pipelines" / "training"


@pytest.fixture
def ablate(scene, tmp_path, monkeypatch, capfd):
    """Run ablate.py for two steps per version, on pairs of noise and two photos of the small scene; what it printed."""
    monkeypatch.syspath_prepend(TRAINING)
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
        f"{{images: {photos}, out: {tmp_path / 'versions'}, start_from: {checkpoints.find_weights('light')}, "
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
    light = checkpoints.load_weights("light")
    attentive = HomoNet(dataclasses.replace(light.config, coarse="attention"))
    attentive.load_state_dict(light.state_dict(), strict=False)
    checkpoints.save_weights(tmp_path / "attention.pt", attentive)
    weights = ("--attention-weights", str(tmp_path / "attention.pt"))

    tables = ablate(*weights).partition("\n## ")[2].strip()
    report = (tmp_path / "docs" / "ablations.md").read_text()
    assert report.endswith(f"{tables}\n") and f"    python ablate.py {tmp_path / 'train.yaml'} --scene" in report
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in tables.splitlines() if line.startswith("|")]
    assert [line[0] for line in cells if not line[0].startswith("-")] == [
        "", "semi-dense", "+ dense", "+ suppressed", "", "expectation", "9/1/2, spacing 2", "", "with", "without",
    ]  # fmt: skip
    assert cells[0][1:] == ["PCK@1", "PCK@3", "centre@1", "centre@3", "AUC@5"]
    assert (
        cells[5][-1] == "fine ms"
        and cells[9][1:4] == ["threshold", "recall", "precision"]
        and cells[9][-1] == "coarse ms"
    )
    assert all(0 <= float(value) <= 100 for line in cells[2:5] for value in line[1:])
    # What the first table's last row tells is the same network.
    assert cells[4][1:] == cells[8][1:-1]
    trained = sorted(path.parent.name for path in (tmp_path / "versions").glob("*/weights.pt"))
    assert trained == ["expectation-9-1-2-2-centre"] + [
        f"homography-9-1-2-2-{supervise}" for supervise in ("centre", "dense", "suppressed")
    ]

    # All versions start from the same features, with new heads.
    features = checkpoints.read_checkpoint(tmp_path / "versions" / "features.pt")["state_dict"]
    assert features.keys() == {key for key in light.state_dict() if not key.startswith("head.")}

    # All is done: nothing is trained or matched, and without the weights there are two tables.
    matched_pairs.clear()
    monkeypatch.setattr(loop, "run_training", None)
    assert ablate(*weights).strip() == f"## {tables}"
    assert ablate().count("## ") == 2
    assert matched_pairs == []


def test_two_coarse_stages_are_compared_at_one_precision(monkeypatch):
    monkeypatch.syspath_prepend(TRAINING)
    scores = importlib.import_module("ablation_scores")
    measured = {0.01: 55.0, 0.02: 61.0, 0.05: 68.0, 0.1: 76.0}
    monkeypatch.setattr(scores, "score_cells", lambda net, trial, limit: {"precision": measured.get(limit, 95.0)})
    assert [scores.equalise_precision(None, None, precision) for precision in (70.0, 74.0, 40.0)] == [0.05, 0.1, 0.01]


def test_ablate_refuses_weights_without_a_transformer(ablate, tmp_path, capfd):
    with pytest.raises(SystemExit) as stop:
        ablate("--attention-weights", "light")
    assert stop.value.code == 2
    assert "light has no coarse transformer: network.coarse is 'context'" in capfd.readouterr().err
    assert not (tmp_path / "versions").exists()
