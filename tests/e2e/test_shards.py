"""One OUT and several processes: shards side by side, everything else one after the other."""

import fcntl
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from hm_sfm.matching.matcher import HomoMatcher

SHARDS = ("1/3", "2/3", "3/3")


@pytest.fixture(scope="module")
def read_groups():
    """Read a matches.h5 with the names of its groups: name -> attributes and bytes of the fields."""

    def read(path: Path) -> dict[str, tuple[dict, dict[str, bytes]]]:
        with h5py.File(path) as h5:
            return {
                name: (dict(group.attrs), {field: data[()].tobytes() for field, data in group.items()})
                for name, group in h5.items()
            }

    return read


@pytest.fixture
def serial(tiny_photos, tmp_path, run) -> Path:
    """matches.h5 of an ordinary run."""
    assert run("match", tiny_photos, tmp_path / "serial").code == 0
    return tmp_path / "serial" / "matches.h5"


def assert_refused(finished, *parts: object) -> None:
    assert finished.code == 2
    assert finished.err.startswith("hm-sfm: ") and finished.err.count("\n") == 1, finished.err
    assert all(str(part) in finished.err for part in parts), finished.err


def test_merged_shards_are_a_serial_run(tiny_photos, serial, tmp_path, run, read_groups, matched_pairs):
    out = tmp_path / "out"
    matched_pairs.clear()
    for shard in reversed(SHARDS):
        finished = run("match", tiny_photos, out, "--shard", shard)
        path = out / f"matches.shard-{shard[0]}-of-3.h5"
        assert (finished.code, finished.out) == (0, f"{len(read_groups(path))} pairs of 6 images matched: {path}\n")
    assert len(matched_pairs) == 15
    finished = run("merge", tiny_photos, out)
    assert (finished.code, finished.out) == (0, f"15 pairs: {out / 'matches.h5'}\n")
    assert {path.name for path in out.iterdir()} == {".hm_sfm", "pairs.txt", "matches.h5"}
    assert (out / "pairs.txt").read_bytes() == serial.with_name("pairs.txt").read_bytes()
    merged = read_groups(out / "matches.h5")
    assert merged == read_groups(serial)
    assert sum(len(fields["score"]) for _, fields in merged.values()) > 15 * 4

    assert run("merge", tiny_photos, out).code == 0
    assert run("match", tiny_photos, out).code == 0
    assert len(matched_pairs) == 15


@pytest.mark.slow
def test_a_missing_or_unfinished_shard_is_named(
    tiny_photos, serial, tmp_path, run, read_groups, digest_files, monkeypatch
):
    out = tmp_path / "out"
    for shard in ("1/3", "3/3"):
        assert run("match", tiny_photos, out, "--shard", shard).code == 0
    before = digest_files(out)
    assert_refused(run("merge", tiny_photos, out), out, "of shard 2/3:", "--shard 2/3")
    assert_refused(run("reconstruct", tiny_photos, out), out, "matches.shard-1-of-3.h5", "hm-sfm merge")
    assert digest_files(out) == before

    match_features, calls = HomoMatcher.match_features, []

    def interrupt(*arguments):
        calls.append(arguments)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return match_features(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(HomoMatcher, "match_features", interrupt)
        assert run("match", tiny_photos, out, "--shard", "2/3").code == 130
    assert_refused(run("merge", tiny_photos, out), "lacks 3 of 15 pairs, of shard 2/3")
    (out / "matches.shard-3-of-3.h5").unlink()
    assert_refused(run("merge", tiny_photos, out), "of shards 2/3, 3/3")

    assert run("match", tiny_photos, out, "--shard", "2/3").code == 0
    assert run("match", tiny_photos, out, "--shard", "3/3").code == 0
    assert run("merge", tiny_photos, out).code == 0
    assert read_groups(out / "matches.h5") == read_groups(serial)


@pytest.mark.slow
def test_shards_of_other_settings_counts_and_photos_are_refused(tiny_photos, tmp_path, run, digest_files):
    photos = Path(shutil.copytree(tiny_photos, tmp_path / "photos"))
    out = tmp_path / "out"
    assert_refused(run("merge", photos, out), out / "pairs.txt", "No such file")
    for shard in ("1/2", "2/2"):
        assert run("match", photos, out, "--shard", shard).code == 0
    before = digest_files(out)
    setting = ("--set", "matching.min_cosine=0.7")
    assert_refused(run("merge", photos, out, *setting), "matches.shard-1-of-2.h5", "matching.min_cosine")
    assert digest_files(out) == before
    assert run("match", photos, out, "--shard", "4/4").code == 0
    assert_refused(run("merge", photos, out), out, "shards of 2 and of 4")
    for path in out.glob("matches.shard-4*"):
        path.unlink()
    shutil.copy(photos / "0.png", photos / "5.png")
    assert_refused(run("merge", photos, out), "lacks 5 of 15 pairs")


@pytest.mark.slow
def test_nothing_to_merge(tiny_photos, tmp_path, run):
    out = tmp_path / "out"
    assert run("match", tiny_photos, out).code == 0
    assert run("merge", tiny_photos, out).code == 0
    (out / "matches.h5").unlink()
    assert_refused(run("merge", tiny_photos, out), out, "holds no shard", "--shard")


@pytest.mark.parametrize("shard", ["0/3", "4/3", "3", "a/b", "-1/3", "1/0", "1/3/5", ""])
def test_a_shard_that_does_not_exist(shard, tiny_photos, tmp_path, run):
    finished = run("match", tiny_photos, tmp_path / "out", f"--shard={shard}")
    assert_refused(finished, "shard", repr(shard) if "/" not in shard or len(shard) != 3 or "a" in shard else shard)
    assert not (tmp_path / "out").exists()


def test_more_shards_than_pairs(tiny_photos, tmp_path, run):
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("0.png 1.png\n1.png 2.png\n")
    out = tmp_path / "out"
    for number in (1, 2, 3, 4):
        finished = run("match", tiny_photos, out, "--pairs", pairs, "--shard", f"{number}/4")
        assert finished.out.startswith(f"{1 - number % 2} pairs of 6 images matched")
    assert run("merge", tiny_photos, out).out == f"2 pairs: {out / 'matches.h5'}\n"


@pytest.mark.slow
def test_one_process_at_a_time(tiny_photos, tmp_path, run, digest_files):
    out = tmp_path / "out"
    assert run("match", tiny_photos, out).code == 0
    before = digest_files(out)
    # A lock of this very process: locks belong to open files, not to processes.
    with open(out / ".hm_sfm", "ab") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        for command in (["match"], ["reconstruct"], ["export"], ["merge"], ["compare"], ["match", "--shard", "1/2"]):
            finished = run(command[0], tiny_photos, out, *command[1:])
            assert_refused(finished, out, "in use by another hm-sfm process")
    assert digest_files(out) == before
    assert run("match", tiny_photos, out).code == 0


@pytest.mark.slow
def test_shards_run_side_by_side_but_none_twice(tiny_photos, tmp_path, run):
    out = tmp_path / "out"
    assert run("match", tiny_photos, out, "--shard", "1/2").code == 0
    with open(out / ".hm_sfm", "ab") as folder, open(out / ".matches.shard-1-of-2.h5.lock", "ab") as shard:
        fcntl.flock(folder, fcntl.LOCK_SH)
        fcntl.flock(shard, fcntl.LOCK_EX)
        assert_refused(run("match", tiny_photos, out, "--shard", "1/2"), "shard 1/2", out)
        assert run("match", tiny_photos, out, "--shard", "2/2").code == 0
        for command in ("merge", "match"):
            assert_refused(run(command, tiny_photos, out), out, "in use by another hm-sfm process")
    assert run("merge", tiny_photos, out).code == 0


@pytest.mark.slow
def test_shards_selected_by_appearance_encode_one_after_the_other(tiny_photos, tmp_path, run, monkeypatch):
    out = tmp_path / "out"
    (out / "retrieval").mkdir(parents=True)
    (out / ".hm_sfm").touch()
    held = []

    def encode(*_):
        with open(out / "retrieval" / ".lock", "ab") as other, pytest.raises(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        held.append(True)
        return np.full((6, 3), 3**-0.5, np.float32)  # all alike

    monkeypatch.setattr("hm_sfm.pipeline.collection.describe_images", encode)
    finished = run("match", tiny_photos, out, "--pairs", "retrieval", "--shard", "1/1")
    assert finished.code == 0, finished.err
    assert held == [True]


@pytest.mark.slow
def test_a_folder_without_locks_is_used_all_the_same(tiny_photos, tmp_path, run, monkeypatch):
    def refuse(*_):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr("hm_sfm.io.locks.fcntl.flock", refuse)
    assert run("match", tiny_photos, tmp_path / "out").code == 0


@pytest.mark.parametrize("limit_mb", [0, 1])
def test_a_cache_too_small_for_a_pair(limit_mb, scene, tmp_path, run):
    finished = run("match", scene.images, tmp_path / "out", "--set", f"matching.feature_cache_mb={limit_mb}", "--quiet")
    assert_refused(finished, f"matching.feature_cache_mb is {limit_mb}", "view_00.jpg and view_01.jpg alone take", "MB")


@pytest.mark.slow
def test_a_cache_of_one_pair_changes_no_match(tiny_photos, serial, tmp_path, run, read_groups):
    finished = run("match", tiny_photos, tmp_path / "out", "--set", "matching.feature_cache_mb=1")
    assert finished.code == 0, finished.err
    merged, expected = read_groups(tmp_path / "out" / "matches.h5"), read_groups(serial)
    assert merged == expected and np.all([len(attrs) == 5 for attrs, _ in merged.values()])
