"""Processes that are killed while they match, and full disks: nothing stored is lost, and the end is the same."""

import multiprocessing
import os
import resource
import shutil
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import hm_sfm.io.batches
from hm_sfm.cli import main

pytestmark = pytest.mark.slow

KILLS = int(os.environ.get("KILLS", "5"))
"""How often to kill; `KILLS=20 pytest tests/e2e/test_interruptions.py` for more."""


def match_here(photos: Path, out: Path, errors: Path, file_limit: int | None) -> None:
    """hm-sfm match in a process forked for it; each pair is stored at once, no file grows beyond file_limit bytes."""
    os.dup2(os.open(errors, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
    hm_sfm.io.batches.BATCH_SECONDS = 0.0
    if file_limit:
        resource.setrlimit(resource.RLIMIT_FSIZE, (file_limit, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    sys.exit(main(["match", str(photos), str(out), "--quiet"]))


@pytest.fixture(scope="module")
def start_matching(tiny_photos, tmp_path_factory):
    """Start hm-sfm match on the tiny photos: OUT, limit of the file size -> process and the file of its stderr."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["hm_sfm.cli", "hm_sfm.pipeline.reconstruction", "pytest"])
    folder = tmp_path_factory.mktemp("errors")

    def start(out: Path, file_limit: int | None = None):
        errors = folder / f"{time.monotonic_ns()}.txt"
        process = context.Process(target=match_here, args=(tiny_photos, out, errors, file_limit))
        process.start()
        return process, errors

    return start


@pytest.fixture(scope="module")
def undisturbed(start_matching, tmp_path_factory) -> tuple[Path, float]:
    """matches.h5 of a run that nobody killed, and its seconds; the second run, since the first loads the libraries."""
    out = tmp_path_factory.mktemp("undisturbed")
    for name in ("first", "second"):
        started = time.monotonic()
        process, errors = start_matching(out / name)
        process.join()
        seconds = time.monotonic() - started
        assert process.exitcode == 0, errors.read_text()
    return out / "second" / "matches.h5", seconds


def assert_same_matches(actual: dict, expected: dict) -> None:
    assert actual.keys() == expected.keys()
    for pair, fields in expected.items():
        assert {field: data.tobytes() for field, data in actual[pair].items()} == {
            field: data.tobytes() for field, data in fields.items()
        }, pair


def test_killed_at_any_moment_it_goes_on_and_ends_the_same(start_matching, undisturbed, tmp_path, read_matches):
    path, seconds = undisturbed
    expected = read_matches(path)
    assert len(expected) == 15 and sum(len(fields["score"]) for fields in expected.values()) > 100
    rng = np.random.default_rng(0)
    stored = []
    for kill in range(KILLS):
        out = tmp_path / f"out_{kill}"
        process, _ = start_matching(out)
        time.sleep((kill + rng.uniform()) / KILLS * seconds)
        process.kill()
        process.join()
        assert process.exitcode in (-signal.SIGKILL, 0)
        stored.append(len(list(out.glob("matches.h5.parts/*.h5"))))
        process, errors = start_matching(out)
        process.join()
        assert (process.exitcode, errors.read_text()) == (0, "")
        assert_same_matches(read_matches(out / "matches.h5"), expected)
        assert {entry.name for entry in out.iterdir()} <= {".hm_sfm", "pairs.txt", "matches.h5"}
        shutil.rmtree(out)
    assert any(0 < count < 15 for count in stored), f"no kill came between two pairs: {stored}"


@pytest.mark.parametrize(
    ("file_limit", "refused", "kept"),
    [(4_000, "matches.h5.parts/000000.h5", 0), (64_000, "matches.h5", 15)],
    ids=["at the first pair", "at the end"],
)
def test_a_full_disk_keeps_what_is_stored(
    file_limit, refused, kept, start_matching, undisturbed, tmp_path, read_matches
):
    out = tmp_path / "out"
    process, errors = start_matching(out, file_limit)
    process.join()
    assert process.exitcode == 2
    assert errors.read_text() == f"hm-sfm: cannot write {out / refused}: File too large\n"
    assert len(list(out.glob("matches.h5.parts/*"))) == kept and not (out / "matches.h5").exists()

    process, errors = start_matching(out)
    process.join()
    assert (process.exitcode, errors.read_text()) == (0, "")
    assert_same_matches(read_matches(out / "matches.h5"), read_matches(undisturbed[0]))


def test_a_device_without_space(tiny_photos, tmp_path, run, monkeypatch):
    def refuse(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("hm_sfm.matching.store.replace_file", refuse)
    out = tmp_path / "out"
    finished = run("match", tiny_photos, out, "--quiet")
    part = out / "matches.h5.parts" / "000000.h5"
    assert (finished.code, finished.err) == (2, f"hm-sfm: cannot write {part}: No space left on device\n")
