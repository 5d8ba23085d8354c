"""Models on disk: new ones take the places of our earlier ones, and of nothing else."""

import json
import os
import shutil
from contextlib import suppress
from pathlib import Path

import pycolmap
import pytest

import hm_sfm.colmap.model_folders
from hm_sfm.colmap.model_folders import RECORD, count_latest, replace_models, restore_models


def make_model(num_images: int) -> pycolmap.Reconstruction:
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=num_images, num_points3D=20)
    return pycolmap.synthesize_dataset(options)


@pytest.fixture
def write(tmp_path):
    """Write models of so many images each to tmp_path/sparse."""

    def write_there(*sizes: int) -> Path:
        work_folder = tmp_path / ".sparse.work"
        work_folder.mkdir()
        replace_models([make_model(size) for size in sizes], tmp_path / "sparse", work_folder)
        shutil.rmtree(work_folder)
        return tmp_path / "sparse"

    return write_there


def count_images(sparse: Path) -> dict[str, int]:
    return {path.parent.name: pycolmap.Reconstruction(path.parent).num_images() for path in sparse.glob("*/images.bin")}


def test_models_replace_those_of_the_run_before(write):
    assert count_images(write(6, 4, 3)) == {"0": 6, "1": 4, "2": 3}
    sparse = write(7)
    assert count_images(sparse) == {"0": 7} and sorted(path.name for path in sparse.iterdir()) == [RECORD, "0"]
    assert count_latest(sparse) == 1


def test_without_models_the_earlier_ones_stay(write):
    sparse = write(6, 4)
    before = (sparse / "0" / "images.bin").read_bytes()
    write()
    assert count_images(sparse) == {"0": 6, "1": 4} and (sparse / "0" / "images.bin").read_bytes() == before
    assert count_latest(sparse) == 0
    assert count_images(write(7)) == {"0": 7}  # they are still known as ours


def test_without_any_models_there_is_no_folder(write):
    assert not write().exists()


def test_what_others_wrote_beside_models_stays(write):
    sparse = write(6, 4)
    (sparse / "aligned").mkdir()
    make_model(2).write_binary(sparse / "aligned")
    for path in (sparse / "project.ini", sparse / "0" / "points.ply", sparse / "1" / "notes.txt"):
        path.write_text(path.name)
    write(6)
    assert count_images(sparse) == {"0": 6, "aligned": 2}
    for path in (sparse / "project.ini", sparse / "0" / "points.ply", sparse / "1" / "notes.txt"):
        assert path.read_text() == path.name
    assert [path.name for path in (sparse / "1").iterdir()] == ["notes.txt"]


def test_models_that_others_wrote_or_changed_are_kept(write, tmp_path, caplog):
    """As colmap mapper does, told to write to OUT/sparse, and colmap model_aligner."""
    sparse = tmp_path / "sparse"
    (sparse / "0").mkdir(parents=True)
    make_model(7).write_binary(sparse / "0")
    write(6, 4)
    assert count_images(sparse) == {"0": 6, "1": 4, "0_kept": 7}
    make_model(8).write_binary(sparse / "0")
    write(6)
    assert count_images(sparse) == {"0": 6, "0_kept": 7, "0_kept_2": 8}
    assert caplog.messages == [
        f"{sparse / '0'} was written or changed by something else: it is now {sparse / name}"
        for name in ("0_kept", "0_kept_2")
    ]
    (sparse / "1").mkdir()
    make_model(3).write_binary(sparse / "1")
    write(6)
    assert count_images(sparse)["1"] == 3  # no model takes its place


def test_a_model_of_more_images_is_kept_until_there_is_a_better_one(write, caplog):
    sparse = write(6, 4)
    assert count_images(write(5, 3)) == {"0": 5, "0_kept": 6, "1": 3}
    assert caplog.messages == [
        f"the new model has 5 images, that of an earlier run, which is now {sparse / '0_kept'}, has 6"
    ]
    assert count_images(write(5)) == {"0": 5, "0_kept": 6} and len(caplog.messages) == 1


@pytest.mark.parametrize("fail_at", range(8))
def test_killed_at_any_rename_there_is_a_whole_model(write, tmp_path, monkeypatch, fail_at):
    sparse = write(6, 4)
    (sparse / "0" / "points.ply").write_text("mine")
    renames = []

    def count_and_fail(source, target):
        if len(renames) == fail_at:
            raise KeyboardInterrupt
        renames.append(target)
        return os.rename(source, target)

    work_folder = tmp_path / ".sparse.work"
    work_folder.mkdir()
    with monkeypatch.context() as patch:
        patch.setattr(hm_sfm.colmap.model_folders.os, "replace", count_and_fail)
        with suppress(KeyboardInterrupt):  # as if killed: nobody cleans up
            replace_models([make_model(7), make_model(3)], sparse, work_folder)
    restore_models(sparse, work_folder)
    shutil.rmtree(work_folder)
    assert count_images(sparse)["0"] in (6, 7) and count_images(sparse)["1"] in (3, 4)
    assert (sparse / "0" / "points.ply").read_text() == "mine"
    write(8)
    assert count_images(sparse) == {"0": 8} and (sparse / "0" / "points.ply").read_text() == "mine"


def test_a_damaged_record_loses_nothing(write):
    sparse = write(6)
    (sparse / RECORD).write_text("{")
    assert count_latest(sparse) == 0
    assert count_images(write(6)) == {"0": 6, "0_kept": 6}
    assert json.loads((sparse / RECORD).read_text())["latest"] == 1
