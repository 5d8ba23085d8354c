"""What the README says can be typed, can be typed."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest

from hm_sfm.cli import make_parser
from hm_sfm.config import RENAMED

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()


def code_blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


def test_the_two_commands_are_those_of_makefile_and_ci():
    assert code_blocks("sh")[0].splitlines() == ["make demo", "make test"]
    makefile = (ROOT / "Makefile").read_text()
    assert re.search(r"^demo: setup\n\t\$\(VENV\)/bin/hm-sfm demo ", makefile, re.MULTILINE)
    assert re.search(r"^test: test-fast\n\t\$\(VENV\)/bin/python -m pytest -m slow$", makefile, re.MULTILINE)
    assert re.search(r'^test-fast: setup\n\t.*pytest -m "not slow"', makefile, re.MULTILINE)
    assert (ROOT / ".ci" / "run").read_text().splitlines()[-1] == "make check test"


def test_the_cpu_build_of_pytorch_is_the_one_that_make_takes():
    (cpu_build,) = re.findall(r"^pip install (torch==.*)$", README, re.MULTILINE)
    assert f'"{cpu_build}"' in (ROOT / "Makefile").read_text()


def test_all_example_commands_parse():
    lines = [line for block in code_blocks("sh") for line in block.splitlines() if line.startswith("hm-sfm ")]
    assert len(lines) >= 4
    for line in lines:
        make_parser().parse_args(shlex.split(line)[1:])


def test_it_is_short():
    assert len(README.splitlines()) <= 200


def test_the_table_of_stages_names_all_folders():
    folders = {path.name for path in (ROOT / "hm_sfm").iterdir() if (path / "__init__.py").exists()}
    assert folders - set(re.findall(r"`hm_sfm/(\w+)/`", README)) == {"geometry", "io"}


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"])
def test_all_files_named_are_there(page):
    text = (ROOT / page).read_text()
    linked = re.findall(r"\]\((?!https?:)([^)#]+)\)", text)
    named = re.findall(r"`((?:hm_sfm|docs|pipelines|tests)/[\w/.]+|configs/[\w.]+|pyproject\.toml)`", text)
    assert len(linked + named) >= 3
    for name in linked + named:
        assert (ROOT / name).exists() or name == "docs/api.md", name


def test_the_changelog_lists_all_renamed_settings():
    text = (ROOT / "CHANGELOG.md").read_text()
    for renamed in RENAMED.values():
        for old, new in renamed.items():
            (row,) = re.findall(rf"^\| `\w+\.{old}` \| (.*) \|$", text, re.MULTILINE)
            assert set(re.findall(r"\w+\.\w+", new)) <= set(re.findall(r"\w+\.\w+", row)), old


def test_the_layers_are_those_that_are_checked():
    rows = re.findall(r"^\| (`\w+`(?:, `\w+`)*) \| [^|]+ \|$", (ROOT / "CONTRIBUTING.md").read_text(), re.MULTILINE)
    layers = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]["layers"]
    assert [set(re.findall(r"\w+", row)) for row in rows] == [set(re.findall(r"\w+", layer)) for layer in layers]


def test_the_make_targets_that_are_named_exist():
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for page in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"):
        assert set(re.findall(r"`make ([a-z-]+)`", (ROOT / page).read_text())) <= set(targets)
