"""Which snapshots of a growing model are kept."""

from pathlib import Path

from hm_sfm.colmap.snapshots import Snapshots, discard_snapshots


def write_snapshot(growing: Path, content: str) -> None:
    (growing / "0001").mkdir()
    (growing / "0001" / "images.bin").write_text(content)


def start(folder: Path, made_from: str, run: int) -> Snapshots:
    return Snapshots(folder / "snapshots", folder / f"growing{run}", made_from)


def test_the_newest_of_the_largest_model_is_kept(tmp_path):
    snapshots = start(tmp_path, "aa", 1)
    assert snapshots.newest is None and snapshots.begin_model() == 2
    snapshots.add_image()
    assert not (tmp_path / "snapshots").exists()
    for number in (4, 5):
        write_snapshot(snapshots.growing, f"{number} images")
        snapshots.add_image()
        assert [path.name for path in (tmp_path / "snapshots").iterdir()] == [f"aa.{number}"]
    assert snapshots.begin_model() == 2  # another model, which is smaller
    write_snapshot(snapshots.growing, "3 images")
    snapshots.add_image()
    assert (snapshots.newest / "images.bin").read_text() == "5 images"
    assert not list(snapshots.growing.iterdir())


def test_a_later_run_goes_on_from_it(tmp_path):
    for name in ("aa.9", "aa.20", "bb.30"):  # killed between moving one there and removing the others
        (tmp_path / "snapshots" / name).mkdir(parents=True)
    snapshots = start(tmp_path, "aa", 1)
    assert snapshots.newest == tmp_path / "snapshots" / "aa.20"
    assert [snapshots.begin_model(), snapshots.begin_model()] == [20, 2]  # once: the next model is a new one

    snapshots = start(tmp_path, "aa", 2)
    snapshots.begin_model()
    write_snapshot(snapshots.growing, "more")
    snapshots.add_image()
    assert [path.name for path in (tmp_path / "snapshots").iterdir()] == ["aa.21"]


def test_one_that_was_made_from_something_else_is_not_used(tmp_path):
    (tmp_path / "snapshots" / "aa.20").mkdir(parents=True)
    snapshots = start(tmp_path, "bb", 1)
    assert snapshots.newest is None and snapshots.begin_model() == 2
    write_snapshot(snapshots.growing, "first")
    snapshots.add_image()
    assert [path.name for path in (tmp_path / "snapshots").iterdir()] == ["bb.3"]


def test_what_others_put_there_stays(tmp_path):
    """COLMAP names its own snapshots after the time."""
    for name in ("00001732900000", "mine", "aa.9"):
        (tmp_path / "snapshots" / name).mkdir(parents=True)
    (tmp_path / "snapshots" / "notes.txt").write_text("mine")
    snapshots = start(tmp_path, "aa", 1)
    snapshots.begin_model()
    write_snapshot(snapshots.growing, "more")
    snapshots.add_image()
    left = {"00001732900000", "mine", "notes.txt"}
    assert {path.name for path in (tmp_path / "snapshots").iterdir()} == {*left, "aa.10"}
    discard_snapshots(tmp_path / "snapshots", tmp_path / "discarded")
    assert {path.name for path in (tmp_path / "snapshots").iterdir()} == left
    assert [path.name for path in (tmp_path / "discarded").iterdir()] == ["aa.10"]
    discard_snapshots(tmp_path / "none", tmp_path / "nothing")
