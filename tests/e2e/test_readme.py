"""What the README says can be typed, can be typed."""

import argparse
import re
import shlex
import shutil
from pathlib import Path

import numpy as np

from hm_sfm.cli import make_parser

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()


def code_blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


def test_the_two_commands_are_those_of_makefile_and_ci():
    assert code_blocks("sh")[0].splitlines() == ["make demo", "make test"]
    makefile = (ROOT / "Makefile").read_text()
    assert re.search(r"^demo: setup\n\t\$\(VENV\)/bin/hm-sfm demo ", makefile, re.MULTILINE)
    assert re.search(r"^test: setup\n\t\$\(VENV\)/bin/python -m pytest$", makefile, re.MULTILINE)
    assert (ROOT / ".ci" / "run").read_text().splitlines()[-1] == "make test"


def test_the_cpu_build_of_pytorch_is_the_one_that_make_takes():
    (cpu_build,) = re.findall(r"^pip install (torch==.*)$", README, re.MULTILINE)
    assert f'"{cpu_build}"' in (ROOT / "Makefile").read_text()


def test_all_example_commands_parse():
    lines = [line for block in code_blocks("sh") for line in block.splitlines() if line.startswith("hm-sfm ")]
    assert len(lines) >= 4
    for line in lines:
        make_parser().parse_args(shlex.split(line)[1:])


def test_the_table_of_commands_is_complete():
    commands = next(a for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction))
    assert re.findall(r"^\| `hm-sfm ([a-z]+)", README, re.MULTILINE) == list(commands.choices)


def test_all_files_named_are_there():
    linked = re.findall(r"\]\((?!https?:)([^)#]+)\)", README)
    named = re.findall(r"`(hm_sfm/[\w/.]+|configs/[\w.]+)`", README)
    assert len(linked) >= 5 and len(named) >= 8
    for name in linked + named:
        assert (ROOT / name).exists(), name


def test_the_python_example_runs(scene, reconstructed, tmp_path, monkeypatch, matched_pairs):
    (example,) = code_blocks("python")
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
