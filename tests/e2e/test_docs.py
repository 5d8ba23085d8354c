"""What the pages of docs/ say can be typed, can be typed, and what they say of the code is so."""

import argparse
import re
import runpy
import shlex
import shutil
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import yaml

import hm_sfm
from hm_sfm.cli import make_parser
from hm_sfm.colmap.rigs import assign_cameras, read_rigs
from hm_sfm.config import parse_config
from hm_sfm.errors import InputError
from hm_sfm.report.diagnosis import ADVICE, Cause
from hm_sfm.training.config import TrainConfig, check_config
from hm_sfm.training.multiview import VALIDATION_SCENES

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = {path.name: path.read_text() for path in sorted(DOCS.glob("*.md")) if path.name != "api.md"}  # api.md is built
WRITTEN = sorted(PAGES.keys() - {"README.md", "ablations.md"})
OTHER_PROGRAMS = {"--nproc-per-node", "--editable", "--scaling"}
"""Options of torchrun, pip and pipelines/benchmarks/benchmark_costs.py."""
CHEAP = ("show", "convert", "frames", "export")
"""Commands that are run here; of the others, only the arguments are checked."""


def code_blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGES[page], re.MULTILINE | re.DOTALL)


def list_commands(page: str) -> list[list[str]]:
    """The arguments of each hm-sfm command of a page's blocks."""
    lines = [line for block in code_blocks(page, "sh") for line in block.splitlines()]
    assert all(re.match(r"hm-sfm |torchrun [^|]* -m hm_sfm\.cli ", line) for line in lines), lines
    return [shlex.split(re.sub(r"^(hm-sfm|torchrun .*? -m hm_sfm\.cli) ", "", line)) for line in lines]


def test_the_index_has_a_line_for_each_page():
    linked = re.findall(r"^- \[[^]]+\]\(([\w.-]+\.md)\)", PAGES["README.md"], re.MULTILINE)
    assert sorted(linked) == sorted(PAGES.keys() - {"README.md"})


def list_subparsers() -> dict[str, argparse.ArgumentParser]:
    return next(a for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction)).choices


@pytest.mark.parametrize("page", WRITTEN)
def test_all_commands_parse(page):
    for command in list_commands(page):
        make_parser().parse_args(command)


def test_commands_within_a_sentence_parse_as_far_as_they_go():
    lines = [line for page in WRITTEN for line in re.findall(r"(?<!\| )`hm-sfm ([a-z][^`]*--[^`]*)`", PAGES[page])]
    assert len(lines) > 5
    for line in lines:
        try:
            make_parser().parse_args(shlex.split(line))
        except InputError as error:
            assert "the following arguments are required" in str(error), line


def test_the_table_of_commands_is_complete():
    rows = re.findall(r"^\| `hm-sfm ([a-z]+)", PAGES["commands.md"], re.MULTILINE)
    assert rows == list(list_subparsers())


@pytest.mark.parametrize("page", WRITTEN)
def test_all_options_settings_and_files_are_there(page):
    text = PAGES[page]
    known = {flag for command in list_subparsers().values() for flag in command._option_string_actions}
    assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", text)) - OTHER_PROGRAMS <= known
    for setting in re.findall(r"--set ([\w.]+)=", text):
        section, _, key = setting.partition(".")
        assert key in yaml.safe_load((ROOT / "configs" / "light.yaml").read_text())[section], setting
    for name in re.findall(r"\]\((?!https?:)([^)#]+)", text):
        assert (DOCS / name).exists(), name
    for name in re.findall(r"\b((?:hm_sfm|configs|pipelines)/[\w/]+\.\w+)", text):
        assert (ROOT / name).exists(), name


def test_the_cheap_commands_run(scene, out, tmp_path, monkeypatch, run, matched_pairs):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(scene.images, "photos")
    out = out.rename(tmp_path / "castle")
    Path("out").mkdir()
    out.rename("out/castle")
    video = cv2.VideoWriter("walk.avi", cv2.VideoWriter_fourcc(*"MJPG"), 10, (320, 240))
    for name in sorted(path.name for path in scene.images.iterdir()):
        video.write(cv2.imread(f"photos/{name}"))
    video.release()

    commands = [command for page in WRITTEN for command in list_commands(page) if command[0] in CHEAP]
    assert {command[0] for command in commands} == set(CHEAP)
    for command in commands:
        finished = run(*command)
        assert finished.code == 0, (command, finished.err)
    assert len(matched_pairs) == 1  # by show; everything else was there
    (frame,) = Path("photos/walk").glob("*.jpg")
    assert re.fullmatch(r"walk_\d{8}\.jpg", frame.name)


def test_the_python_example_runs(scene, reconstructed, tmp_path, monkeypatch, matched_pairs):
    (example,) = code_blocks("python.md", "python")
    monkeypatch.chdir(tmp_path)
    shutil.copytree(scene.images, "photos")
    shutil.copy("photos/view_00.jpg", "a.jpg")
    shutil.copy("photos/view_01.jpg", "b.jpg")
    shutil.copytree(reconstructed, "out/castle")

    names: dict = {}
    exec(example, names)

    assert len(matched_pairs) == 1
    matches = names["matches"]
    assert len(matches) > 100
    assert names["valid"].any()
    assert np.isfinite(names["xy_b"][names["valid"]]).all()
    assert len(names["dense_a"]) == len(names["dense_b"]) > len(matches)
    assert names["model"].num_reg_images() == names["result"].registered == 5


def test_the_python_example_of_hloc_runs(scene, out, tmp_path, monkeypatch, run):
    assert run("export", scene.images, out, "--format", "hloc", "--quiet").code == 0
    (tmp_path / "work" / "out").mkdir(parents=True)
    out.rename(tmp_path / "work" / "out" / "castle")
    monkeypatch.chdir(tmp_path / "work")
    shutil.copytree(scene.images, "photos")
    (example,) = code_blocks("from-hloc.md", "python")
    names: dict = {}
    exec(example, names)
    assert names["database"].exists() and sum(map(len, names["matches"])) > 1000


def test_the_python_example_of_a_matcher_runs(scene, tmp_path, monkeypatch, run, matched_pairs):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(scene.images, "photos")
    Path("pairs.txt").write_text("view_00.jpg view_01.jpg\n")
    (example,) = code_blocks("use-my-own-matcher.md", "python")
    exec(example, {})
    command = next(command for command in list_commands("use-my-own-matcher.md") if command[0] == "match")
    finished = run(*command, "--quiet")
    assert (finished.code, finished.err) == (0, "")
    assert len(matched_pairs) == 1
    with h5py.File("out/mine/matches.h5") as h5:
        assert np.count_nonzero(h5["000000/score"][()] > 0.5) > 30


def test_the_example_of_a_rig(tmp_path):
    (example,) = code_blocks("photos-as-people-have-them.md", "json")
    (tmp_path / "rig.json").write_text(example)
    (rig,) = read_rigs(tmp_path / "rig.json")
    assert assign_cameras([rig], ["left/0001.jpg", "right/0001.jpg"], tmp_path) == [(0, 0), (0, 1)]


def test_the_training_configurations_are_complete():
    blocks = code_blocks("train-on-megadepth.md", "yaml")
    assert len(blocks) == 2
    for block in blocks:
        config = parse_config(yaml.safe_load(block), TrainConfig)
        check_config(config)
        assert config.megadepth_share > 0
    for share in ("rendered_share", "real_share", "megadepth_share"):
        assert f"`{share}`" in PAGES["train-on-megadepth.md"]
    assert "`VALIDATION_SCENES`" in PAGES["train-on-megadepth.md"] and VALIDATION_SCENES


def test_every_cause_of_a_missing_photo_is_explained():
    page = PAGES["photos-that-do-not-register.md"]
    rows = re.findall(r"^\| ([a-z][^|]+?) \|", page, re.MULTILINE)
    assert rows == ["cause", *(cause.value for cause in Cause)]
    for advice in {advice for some in ADVICE.values() for advice in some}:
        for option in re.findall(r"--[a-z-]+ ?[\w.=-]*", advice):
            assert option.strip().removesuffix(" and") in page, option


def test_the_api_reference_describes_every_public_name():
    page = runpy.run_path(str(DOCS / "make_api_reference.py"))["make_reference"]()
    public = re.findall(r"^\| `(\w+)` \| ", page, re.MULTILINE)
    assert public == sorted(hm_sfm.__all__)
    for name in public:
        assert f"\n### {name}\n" in page, name


def test_the_picture_of_the_report():
    picture = cv2.imread(str(DOCS / "report.png"))
    assert picture.shape == (1000, 1180, 3) and np.std(picture) > 10
    assert (DOCS / "report.png").stat().st_size < 300_000
