"""Matching by the workers of a local Ray cluster: the same matches, also where a worker is lost.

A worker computes with one thread, and so does the process that it is compared with: see test_threads.py for more.
"""

import sys
from pathlib import Path

import pytest
import ray

from hm_sfm.matching import ray_engine as cluster_matching
from hm_sfm.matching.ray_engine import PairWorker


@pytest.fixture(scope="module")
def cluster():
    """Two workers' worth of Ray in this machine."""
    ray.init(
        num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="error", object_store_memory=100_000_000
    )
    yield
    ray.shutdown()


@pytest.fixture
def mortal(monkeypatch, tmp_path) -> Path:
    """Each worker kills itself at its second chunk until this file is there, which the first one leaves."""
    flag = tmp_path / "somebody died"

    class MortalWorker(PairWorker):
        chunks = 0

        def match(self, chunk):
            import os
            import signal

            self.chunks += 1
            if self.chunks == 2 and not flag.exists():
                flag.touch()
                os.kill(os.getpid(), signal.SIGKILL)
            return super().match(chunk)

    monkeypatch.setattr(cluster_matching, "PairWorker", MortalWorker)
    monkeypatch.setattr(cluster_matching, "CHUNK_PAIRS", 3)
    return flag


def test_a_cluster_that_loses_a_worker_matches_as_one_process_does(
    cluster, mortal, one_thread, tiny_photos, tmp_path, run, read_matches, matched_pairs
):
    assert run("match", tiny_photos, tmp_path / "serial").code == 0
    assert len(matched_pairs) == 15
    finished = run("match", tiny_photos, tmp_path / "out", "--engine", "ray")
    assert finished.code == 0, finished.err
    assert mortal.exists() and len(matched_pairs) == 15
    actual, expected = (read_matches(tmp_path / name / "matches.h5") for name in ("out", "serial"))
    assert actual.keys() == expected.keys()
    assert sum(len(fields["score"]) for fields in expected.values()) > 100
    for pair, fields in expected.items():
        assert all(actual[pair][field].tobytes() == data.tobytes() for field, data in fields.items()), pair

    # The engine is no part of the settings that matches are made with.
    assert run("match", tiny_photos, tmp_path / "serial", "--engine", "ray").code == 0
    assert run("match", tiny_photos, tmp_path / "out").code == 0
    assert len(matched_pairs) == 15


def test_workers_that_die_again_and_again_are_given_up(
    cluster, mortal, tiny_photos, tmp_path, run, monkeypatch, matched_pairs
):
    monkeypatch.setattr(cluster_matching, "MAX_LOSSES", 0)
    out = tmp_path / "out"
    finished = run("match", tiny_photos, out, "--engine", "ray", "--quiet")
    assert finished.code == 2
    (line,) = [line for line in finished.err.splitlines() if line.startswith("hm-sfm: ")]
    assert "workers of the Ray cluster died" in line and ".png and " in line and "Traceback" not in finished.err
    assert list(out.glob("matches.h5.parts/*.h5"))
    assert run("match", tiny_photos, out).code == 0
    assert 0 < len(matched_pairs) < 15


def test_what_a_worker_cannot_use_is_told_as_in_one_process(cluster, tiny_photos, tmp_path, run):
    finished = run(
        "match", tiny_photos, tmp_path / "out", "--engine", "ray", "--set", "images.long_edge_px=16", "--quiet"
    )
    assert (finished.code, finished.err) == (2, "hm-sfm: images.long_edge_px must be at least 32, found 16\n")


def test_without_ray_it_says_how_to_install_it(tiny_photos, tmp_path, run, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    finished = run("match", tiny_photos, tmp_path / "out", "--engine", "ray")
    assert finished.code == 2 and finished.err.count("\n") == 1
    assert 'pip install "hm_sfm[ray]"' in finished.err
    assert not (tmp_path / "out").exists()


def test_an_engine_that_does_not_exist(tiny_photos, tmp_path, run):
    finished = run("match", tiny_photos, tmp_path / "out", "--engine", "spark")
    assert (finished.code, finished.err) == (2, "hm-sfm: matching.engine must be serial or ray, found 'spark'\n")
    assert not (tmp_path / "out").exists()
