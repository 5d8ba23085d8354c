"""Each recipe of pipelines/ once, as a script, on matches that are there already."""

import re
import runpy
import shutil
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest

PIPELINES = Path(__file__).parents[2] / "pipelines"


@pytest.fixture
def run_recipe(monkeypatch, capfd):
    """Run a recipe with its arguments and return what it printed."""

    def run_here(name: str, *arguments: Path) -> str:
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(PIPELINES / name), run_name="__main__")
        return capfd.readouterr().out

    return run_here


def test_recipes_are_short_and_all_are_run_here():
    recipes = sorted(PIPELINES.glob("*.py"))
    assert [path.name for path in recipes] == [
        "export_to_colmap.py",
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
