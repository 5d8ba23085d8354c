"""Scenes that are rendered and reconstructed once for all end-to-end tests, and ways to run the command."""

import ctypes
import dataclasses
import hashlib
import importlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
from installation import build_wheel, install_alone

from hm_sfm.cli import main
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.network.checkpoints import load_weights, save_weights
from hm_sfm.network.homonet import HomoNet
from hm_sfm.synthetic.demo import write_demo
from hm_sfm.synthetic.textures import make_texture
from hm_sfm.types import PinholeView


@dataclass(frozen=True)
class Finished:
    """What a command left behind."""

    code: int
    out: str
    err: str


@dataclass(frozen=True)
class Scene:
    """A rendered scene: `folder`/images, `folder`/ground_truth, and the cameras by image name."""

    folder: Path
    views: dict[str, PinholeView]

    @property
    def images(self) -> Path:
        return self.folder / "images"


def finish(command: list[Any], **settings: Any) -> Finished:
    """Run a command to its end, with subprocess.run's settings."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, **settings)
    return Finished(done.returncode, done.stdout, done.stderr)


@pytest.fixture(scope="session")
def spawn() -> Callable[..., Finished]:
    """Run hm-sfm in a process of its own, as a user does."""

    def run_there(*arguments: object) -> Finished:
        return finish([sys.executable, "-m", "hm_sfm.cli", *map(str, arguments)])

    return run_there


@pytest.fixture
def run(capfd) -> Callable[..., Finished]:
    """Run hm-sfm in this process, which saves loading PyTorch again; capfd also sees what C++ libraries print."""

    def run_here(*arguments: object) -> Finished:
        # What C++ libraries printed in earlier tests may still wait in C's own buffer.
        ctypes.CDLL(None).fflush(None)
        capfd.readouterr()
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as stop:  # argparse, after --help and --version
            code = stop.code
        out, err = capfd.readouterr()
        return Finished(code, out, err)

    return run_here


@pytest.fixture(scope="session")
def wheel(tmp_path_factory) -> Path:
    """The wheel of this tree."""
    return build_wheel(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="session")
def installed(wheel, tmp_path_factory) -> Path:
    """bin/ of an environment that holds the wheel and its core dependencies."""
    return install_alone(wheel, tmp_path_factory.mktemp("installed"))


@pytest.fixture(scope="session")
def demo(tmp_path_factory, installed) -> tuple[Path, Finished]:
    """`hm-sfm demo OUT` as installed from a wheel, outside of the repository: OUT and what was printed."""
    folder = tmp_path_factory.mktemp("demo")
    outside = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return folder / "out", finish([installed / "hm-sfm", "demo", folder / "out"], cwd=folder, env=outside)


@pytest.fixture(scope="session")
def scene(tmp_path_factory) -> Scene:
    """Five small photos of the demo's scene: enough for a model, matched in seconds."""
    folder = tmp_path_factory.mktemp("scene")
    return Scene(folder, write_demo(folder, count=5, size_wh=(320, 240)))


@pytest.fixture(scope="session")
def reconstructed(scene, tmp_path_factory) -> Path:
    """OUT of `hm-sfm reconstruct` on the small scene; not to be changed."""
    out = tmp_path_factory.mktemp("reconstructed") / "out"
    assert main(["reconstruct", str(scene.images), str(out), "--quiet"]) == 0
    return out


@pytest.fixture(scope="session")
def expectation_weights(tmp_path_factory) -> Path:
    """Weights of the expectation head on the features of the bundled `light` network; the head itself has none."""
    light = load_weights("light")
    net = HomoNet(dataclasses.replace(light.config, head="expectation"))
    net.load_state_dict({key: value for key, value in light.state_dict().items() if not key.startswith("head.")})
    path = tmp_path_factory.mktemp("expectation") / "expectation.pt"
    save_weights(path, net)
    return path


@pytest.fixture
def out(reconstructed, tmp_path) -> Path:
    """A copy of `reconstructed`."""
    return Path(shutil.copytree(reconstructed, tmp_path / "out"))


@pytest.fixture
def matched_pairs(monkeypatch) -> list[HomoMatcher]:
    """Grows by one with each pair that the network really matches."""
    calls: list[HomoMatcher] = []
    match_features = HomoMatcher.match_features

    def count_call(matcher, *features):
        calls.append(matcher)
        return match_features(matcher, *features)

    monkeypatch.setattr(HomoMatcher, "match_features", count_call)
    return calls


@pytest.fixture
def read_matches() -> Callable[[Path], dict[tuple[str, str], dict[str, np.ndarray]]]:
    """Read a matches.h5 as anybody would: pair of names -> field -> array."""

    def read(path: Path) -> dict[tuple[str, str], dict[str, np.ndarray]]:
        with h5py.File(path) as h5:
            return {
                (group.attrs["name0"], group.attrs["name1"]): {field: data[()] for field, data in group.items()}
                for group in h5.values()
            }

    return read


@pytest.fixture
def digest_files() -> Callable[[Path], dict[str, str]]:
    """Names and digests of all files below a folder."""

    def digest(folder: Path) -> dict[str, str]:
        files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
        return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}

    return digest


@pytest.fixture(scope="session")
def tiny_photos(tmp_path_factory) -> Path:
    """Six photos of 96 x 64 px that overlap: 15 pairs, matched in a moment."""
    folder = tmp_path_factory.mktemp("tiny")
    texture = make_texture(np.random.default_rng(4), "mural", (2.0, 1.0), 100)
    for number in range(6):
        crop = texture[4 + number : 68 + number, 6 * number : 6 * number + 96]
        cv2.imwrite(str(folder / f"{number}.png"), crop)
    return folder


@pytest.fixture
def load_benchmark(monkeypatch) -> Callable[[str], Any]:
    """Import a module of pipelines/benchmarks/, which is no package: its scripts find each other by their folder."""
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "pipelines" / "benchmarks")
    return importlib.import_module
