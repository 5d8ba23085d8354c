"""A wheel of this tree, and an environment that holds what the wheel requires and no more."""

import shutil
import subprocess
import sys
from importlib.metadata import Distribution, PathDistribution, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]


def build_wheel(folder: Path) -> Path:
    """Build the wheel in the empty `folder`, from a copy: what setuptools left in the tree itself could mask a gap."""
    source = folder / "source"
    shutil.copytree(ROOT / "hm_sfm", source / "hm_sfm", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE", "NOTICE"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--wheel-dir", str(folder), str(source)], check=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


def install_alone(wheel: Path, environment: Path) -> Path:
    """Make an environment of the wheel and, linked from that of the tests, its core dependencies; returns its bin/."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(environment)], check=True)
    pip = [sys.executable, "-m", "pip", "--python", str(environment / "bin" / "python"), "install", "--quiet"]
    subprocess.run([*pip, "--no-deps", "--no-index", str(wheel)], check=True)
    (packages,) = environment.glob("lib/python*/site-packages")
    (metadata,) = packages.glob("hm_sfm-*.dist-info")
    for dependency in list_dependencies(PathDistribution(metadata)):
        for name in {path.parts[0] for path in dependency.files or ()} - {"..", "__pycache__"}:
            target = packages / name
            if not target.exists():  # nvidia/ is shared by many
                target.symlink_to(Path(str(dependency.locate_file(name))))
    return environment / "bin"


def list_dependencies(project: Distribution) -> list[Distribution]:
    """What the project requires, directly or not; extras count where they are asked for by name."""
    required: dict[str, Distribution] = {}
    waiting = [(project, "")]
    while waiting:
        current, extra = waiting.pop()
        for requirement in map(Requirement, current.requires or ()):
            if requirement.marker and not requirement.marker.evaluate({"extra": extra}):
                continue
            name = canonicalize_name(requirement.name)
            if name not in required:
                required[name] = distribution(name)
                waiting += [(required[name], asked) for asked in ("", *requirement.extras)]
    return list(required.values())
