"""Each recipe of pipelines/examples/ once, as a script, on matches that are there already."""

import re
import runpy
import shutil
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from hm_sfm.network import checkpoints

EXAMPLES = Path(__file__).parents[2] / "pipelines" / "examples"


@pytest.fixture
def run_recipe(monkeypatch, capfd):
    """Run a recipe with its arguments and return what it printed."""

    def run_here(name: str, *arguments: Path) -> str:
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capfd.readouterr().out

    return run_here


@pytest.mark.parametrize("recipe", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_a_recipe_is_short_and_run_here(recipe):
    assert len(recipe.read_text().splitlines()) < 100
    assert f"test_{recipe.stem}" in globals()


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


def test_hloc_style_steps(scene, out, run_recipe, matched_pairs):
    printed = run_recipe("hloc_style_steps.py", scene.images, out)
    assert matched_pairs == []
    assert re.search(r"^[0-9]{4,} keypoints, [0-9]{4,} matches in 10 pairs\n5 of 5 images", printed, re.MULTILINE)
    assert pycolmap.Reconstruction(out / "hloc" / "sparse" / "0").num_reg_images() == 5


def test_compare_tracks(scene, out, expectation_weights, tmp_path, run_recipe, monkeypatch):
    weights = Path(shutil.copytree(checkpoints.WEIGHTS_FOLDER, tmp_path / "weights"))
    shutil.copy(expectation_weights, weights / "light_expectation.pt")
    digest = checkpoints.digest_weights(str(expectation_weights))
    (weights / "light_expectation.sha256").write_text(f"{digest}  light_expectation.pt\n")
    monkeypatch.setattr(checkpoints, "WEIGHTS_FOLDER", weights)
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
