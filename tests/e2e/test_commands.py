"""Every command once, as a user types it. `reconstruct` and `demo` run in the fixtures."""

import argparse
import ast
import json
import shutil
import subprocess
import sys
from importlib.metadata import entry_points, version
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

import numpy as np
import pycolmap
import pytest
import torch
import yaml

import hm_sfm
from hm_sfm.cli import main, make_parser
from hm_sfm.cli.parser import CONFIG_OPTIONS
from hm_sfm.config import Config
from hm_sfm.formats.strecha import write_strecha_cameras
from hm_sfm.network.backbone import XFeatTrunk

COMMANDS = (
    "reconstruct", "match", "export", "merge", "compare", "show", "refine", "convert", "frames", "demo", "evaluate",
    "train",
)  # fmt: skip


def test_the_installed_command_is_main():
    (command,) = entry_points(group="console_scripts", name="hm-sfm")
    assert command.load() is main


def test_help_names_all_commands_with_examples_and_exit_codes(run):
    finished = run("--help")
    assert finished.code == 0
    assert all(f"\n    {command}" in finished.out for command in COMMANDS)
    assert "examples:" in finished.out
    assert "exit codes: 0 done" in finished.out


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_explains_itself(command, run):
    finished = run(command, "--help")
    assert finished.code == 0
    assert finished.out.startswith(f"usage: hm-sfm {command} ")
    subparsers = next(a for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction))
    assert all(action.help for action in subparsers.choices[command]._actions)


def test_options_name_the_words_that_the_configuration_allows():
    options = [(key, metavar) for _, key, metavar, _ in CONFIG_OPTIONS] + [("matching.engine", "serial|ray")]
    for key, metavar in options:
        section, field = key.split(".")
        kind = get_type_hints(type(getattr(Config(), section)))[field]
        if get_origin(kind) is Literal:
            assert metavar == "|".join(get_args(kind)), key


def test_version(run):
    finished = run("--version")
    assert (finished.code, finished.out) == (0, f"hm-sfm {version('hm_sfm')}\n")


def test_help_does_not_wait_for_heavy_libraries():
    heavy = {"torch", "pycolmap", "cv2", "numpy", "h5py"}
    code = f"import sys, hm_sfm, hm_sfm.cli; print(sorted({heavy} & set(sys.modules)))"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert printed == "[]\n"


def test_every_public_name_is_importable():
    for name in hm_sfm.__all__:
        assert getattr(hm_sfm, name).__name__ == name
    with pytest.raises(AttributeError, match="nothing"):
        hm_sfm.nothing  # noqa: B018


def test_a_type_checker_sees_the_names_that_are_imported_at_run_time():
    tree = ast.parse(Path(hm_sfm.__file__).read_text())
    (checked,) = (node for node in tree.body if isinstance(node, ast.If))
    imports = {line.module: tuple(alias.name for alias in line.names) for line in checked.body}
    assert imports == hm_sfm._EXPORTS
    assert sorted(name for names in imports.values() for name in names) == sorted(hm_sfm.__all__)
    assert set(hm_sfm.__all__) <= set(dir(hm_sfm))
    assert (Path(hm_sfm.__file__).parent / "py.typed").exists()


def test_match_stops_after_the_matches(scene, tmp_path, run, read_matches):
    pairs = tmp_path / "two pairs.txt"
    pairs.write_text("view_00.jpg view_01.jpg\nview_02.jpg view_01.jpg\n")
    out = tmp_path / "new" / "out"
    finished = run("match", scene.images, out, "--pairs", pairs)
    assert finished.code == 0
    assert finished.out == f"2 pairs of 5 images matched: {out / 'matches.h5'}\n"
    assert "features: 100%" in finished.err and "matches: 100%" in finished.err
    assert {path.name for path in out.iterdir()} == {".hm_sfm", "pairs.txt", "matches.h5"}
    matches = read_matches(out / "matches.h5")
    assert matches.keys() == {("view_00.jpg", "view_01.jpg"), ("view_01.jpg", "view_02.jpg")}
    assert all(len(fields["score"]) > 100 for fields in matches.values())


@pytest.mark.slow
def test_match_pairs_by_their_appearance(scene, tmp_path, run, read_matches, matched_pairs):
    command = ("match", scene.images, tmp_path / "out", "--pairs", "retrieval", "--set", "pairs.retrieval_top=1")
    finished = run(*command)
    assert finished.code == 0 and "retrieval: 100%" in finished.err
    pairs = read_matches(tmp_path / "out" / "matches.h5").keys()
    assert 3 <= len(pairs) == len(matched_pairs) <= 5
    assert {path.name for path in (tmp_path / "out").iterdir()} == {".hm_sfm", "retrieval", "pairs.txt", "matches.h5"}
    again = run(*command)
    assert again.code == 0 and "retrieval:" not in again.err
    assert len(matched_pairs) == len(pairs)


@pytest.mark.slow
def test_quiet_prints_no_progress_and_no_warnings(scene, tmp_path, spawn):
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("view_00.jpg", "view_01.jpg"):
        shutil.copy(scene.images / name, photos)
    (photos / "broken.jpg").write_bytes(b"")
    quiet = spawn("export", photos, tmp_path / "quiet", "--quiet")
    assert (quiet.code, quiet.err) == (0, "")
    loud = spawn("export", photos, tmp_path / "loud")
    assert loud.code == 0
    assert loud.err.startswith(f"WARNING: skipped: {photos / 'broken.jpg'} cannot be decoded as an image\n")
    assert all(f"{stage}: 100%" in loud.err for stage in ("features", "matches", "verify", "seeds", "keypoints"))


def test_export_stops_after_the_database(scene, reconstructed, tmp_path, run, matched_pairs):
    out = tmp_path / "out"
    out.mkdir()
    for name in (".hm_sfm", "matches.h5"):
        (out / name).write_bytes((reconstructed / name).read_bytes())
    finished = run("export", scene.images, out)
    assert finished.code == 0
    assert matched_pairs == []
    assert finished.out == f"5 images and their keypoints: {out / 'database.db'}\n"
    assert {path.name for path in out.iterdir()} == {".hm_sfm", "pairs.txt", "matches.h5", "refined.h5", "database.db"}
    with pycolmap.Database.open(out / "database.db") as database:
        assert database.num_images() == 5
        assert database.num_verified_image_pairs() >= 7
        assert database.num_inlier_matches() > 1000


def test_known_intrinsics_are_kept(scene, out, run):
    k = scene.views["view_00.jpg"].K
    params = [float(value) for value in (k[0, 0], k[1, 1], k[0, 2], k[1, 2])]
    given = ",".join(map(str, params))
    finished = run("reconstruct", scene.images, out, "--camera-model", "PINHOLE", "--camera-params", given)
    assert finished.code == 0
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    (camera,) = model.cameras.values()
    assert camera.model == pycolmap.CameraModelId.PINHOLE
    assert list(camera.params) == params
    assert model.num_reg_images() == 5


def test_settings_come_from_the_file_then_set_then_options(scene, out, tmp_path, run):
    config = tmp_path / "config.yaml"
    config.write_text("cameras: {mode: single, model: RADIAL}\npairs: {mode: sequential}\n")
    settings = ("--config", config, "--set", "cameras.mode=per-folder", "--set", "cameras.model=OPENCV")
    assert run("export", scene.images, out, *settings, "--camera-mode", "per-image").code == 0
    with pycolmap.Database.open(out / "database.db") as database:
        cameras = database.read_all_cameras()
    assert [camera.model for camera in cameras] == [pycolmap.CameraModelId.OPENCV] * 5


@pytest.mark.slow
def test_evaluate_scores_the_poses_of_a_scene(scene, tmp_path, run):
    shutil.copytree(scene.images, tmp_path / "images")
    write_strecha_cameras(tmp_path / "gt_dense_cameras", scene.views)
    np.savetxt(tmp_path / "K.txt", next(iter(scene.views.values())).K)
    finished = run("evaluate", "poses", tmp_path, "--json", tmp_path / "scores.json", "--quiet")
    assert finished.code == 0, finished.err
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert scores["mean_matches"] > 100
    assert scores["opencv_auc_5deg"] > 50 and scores["colmap_auc_5deg"] > 50
    assert all(name in finished.out for name in scores)


def test_evaluate_refuses_a_folder_without_truth(scene, run):
    for task in ("poses", "homographies"):
        finished = run("evaluate", task, scene.images)
        assert finished.code == 2
        assert finished.err.startswith("hm-sfm: ") and str(scene.images) in finished.err


@pytest.mark.slow
def test_train_makes_weights_that_match_uses(scene, tmp_path, run, read_matches):
    torch.manual_seed(0)
    torch.save(XFeatTrunk().state_dict(), tmp_path / "xfeat.pt")
    config = tmp_path / "train.yaml"
    settings = {
        "images": str(scene.images),
        "out": str(tmp_path / "training"),
        "start_from": str(tmp_path / "xfeat.pt"),
        "steps": 1,
        "pairs_per_step": 1,
        "patches_per_pair": 16,
        "size_px": 128,
        "precision": "fp32",
    }
    config.write_text(yaml.safe_dump(settings))
    finished = run("train", "--config", config, "--set", "steps=2")
    weights = tmp_path / "training" / "weights.pt"
    assert finished.code == 0, finished.err
    assert finished.out.endswith(f"\ntrained: {weights}\n")
    assert len((tmp_path / "training" / "log.csv").read_text().splitlines()) == 3
    assert len((tmp_path / "training" / "validation.csv").read_text().splitlines()) == 2

    again = run("train", "--config", config, "--set", "steps=2")
    assert again.code == 2
    assert "already holds a training" in again.err

    pairs = tmp_path / "pairs.txt"
    pairs.write_text("view_00.jpg view_01.jpg\n")
    matching = ("--pairs", pairs, "--model", weights, "--set", "matching.min_cosine=0.0")
    assert run("match", scene.images, tmp_path / "out", *matching).code == 0
    assert list(read_matches(tmp_path / "out" / "matches.h5")) == [("view_00.jpg", "view_01.jpg")]


def test_summary_counts_what_was_registered(reconstructed):
    summary = json.loads((reconstructed / "summary.json").read_text())
    assert (summary["num_images"], summary["registered"], summary["skipped_images"]) == (5, 5, 0)
    assert summary["version"] == version("hm_sfm")
