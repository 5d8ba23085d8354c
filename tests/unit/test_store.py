"""Matches on disk: round trips, interruptions, and everything stale or damaged."""

import dataclasses
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from hm_sfm.errors import InputError, StaleResultError
from hm_sfm.matching.store import MatchStore, digest_image
from hm_sfm.types import ImagePair, ImageRef, PairMatches

MADE_BY = {"weights": "abc", "matching.max_matches": 8000, "images.long_edge_px": 1024}
NAMES = ("a.jpg", "b.jpg", "c.jpg", "left/with space.jpg", "right/Köln — 教会.png")
DIGESTS = {name: f"{i:016x}" for i, name in enumerate(NAMES)}


def make_matches(name0: str, name1: str, count: int = 5) -> PairMatches:
    rng = np.random.default_rng([ord(name0[0]), ord(name1[0]), count])
    return PairMatches(
        pair=ImagePair.of(name0, name1),
        xy0=rng.uniform(0, 4000, (count, 2)),
        xy1=rng.uniform(0, 4000, (count, 2)),
        score=rng.uniform(0, 1, count),
        homography=rng.normal(size=(count, 3, 3)),
        patch_radius_px=1 / 3,
    )


def assert_same(actual: PairMatches, expected: PairMatches) -> None:
    for field in dataclasses.fields(PairMatches):
        one, other = getattr(actual, field.name), getattr(expected, field.name)
        if isinstance(one, np.ndarray):
            assert one.dtype == other.dtype and one.tobytes() == other.tobytes(), field.name
        else:
            assert one == other, field.name


def open_store(folder: Path, made_by=MADE_BY, digests=DIGESTS) -> MatchStore:
    return MatchStore(folder / "matches.h5", made_by, digests)


@pytest.fixture
def batch() -> list[PairMatches]:
    return [make_matches("a.jpg", "b.jpg"), make_matches("a.jpg", "c.jpg", 0), make_matches(*NAMES[3:], 1)]


@pytest.mark.parametrize("merged", [False, True])
@pytest.mark.parametrize("reopened", [False, True])
def test_matches_come_back_bit_for_bit(tmp_path, batch, merged, reopened):
    store = open_store(tmp_path)
    store.write(batch[:2])
    store.write(batch[2:])
    if merged:
        store.merge()
        assert [path.name for path in tmp_path.iterdir()] == ["matches.h5"]
    if reopened:
        store = open_store(tmp_path)
    for matches in batch:
        assert matches.pair in store
        assert_same(store.read(matches.pair), matches)


def test_what_was_never_stored_is_not_there(tmp_path, batch):
    store = open_store(tmp_path)
    store.write(batch)
    absent = ImagePair("b.jpg", "c.jpg")
    assert absent not in store
    with pytest.raises(KeyError):
        store.read(absent)


def test_an_empty_store(tmp_path):
    store = open_store(tmp_path)
    store.write([])
    assert not store.parts.exists()
    store.merge()
    assert ImagePair("a.jpg", "b.jpg") not in open_store(tmp_path)


def test_more_pairs_can_be_added_to_a_merged_store(tmp_path, batch):
    for matches in batch:
        store = open_store(tmp_path)
        store.write([matches])
        store.merge()
    store = open_store(tmp_path)
    for matches in batch:
        assert_same(store.read(matches.pair), matches)


def test_merging_twice_changes_nothing(tmp_path, batch):
    store = open_store(tmp_path)
    store.write(batch)
    store.merge()
    before = store.path.read_bytes()
    store.merge()
    assert store.path.read_bytes() == before
    assert_same(store.read(batch[0].pair), batch[0])


def test_a_batch_that_was_cut_off_is_ignored(tmp_path, batch):
    store = open_store(tmp_path)
    store.write(batch[:1])
    (store.parts / "000001.h5.tmp").write_bytes(b"half a file")
    (tmp_path / "matches.h5.tmp").write_bytes(b"half a file")
    store = open_store(tmp_path)
    assert batch[0].pair in store and batch[1].pair not in store
    store.write(batch[1:])
    store.merge()
    assert [path.name for path in tmp_path.iterdir()] == ["matches.h5"]
    assert_same(open_store(tmp_path).read(batch[2].pair), batch[2])


def test_a_deleted_batch_does_not_let_the_next_one_overwrite_another(tmp_path, batch):
    store = open_store(tmp_path)
    for matches in batch:
        store.write([matches])
    (store.parts / "000000.h5").unlink()
    store = open_store(tmp_path)
    assert batch[0].pair not in store
    store.write(batch[:1])
    for matches in batch:
        assert_same(store.read(matches.pair), matches)


def test_a_crash_while_merging_loses_nothing(tmp_path, batch, monkeypatch):
    store = open_store(tmp_path)
    store.write(batch)

    def crash(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("hm_sfm.io.atomic.os.replace", crash)
    with pytest.raises(KeyboardInterrupt):
        store.merge()
    monkeypatch.undo()
    store = open_store(tmp_path)
    store.merge()
    for matches in batch:
        assert_same(store.read(matches.pair), matches)


@pytest.mark.parametrize("merged", [False, True])
@pytest.mark.parametrize(
    ("changed", "key", "stored", "wanted"),
    [
        ({"matching.max_matches": 100}, "matching.max_matches", "8000", "100"),
        ({"weights": "xyz"}, "weights", "'abc'", "'xyz'"),
        ({"network.new": 1}, "network.new", "None", "1"),
    ],
)
def test_matches_of_another_configuration_are_refused(tmp_path, batch, merged, changed, key, stored, wanted):
    store = open_store(tmp_path)
    store.write(batch)
    if merged:
        store.merge()
    with pytest.raises(StaleResultError) as error:
        open_store(tmp_path, MADE_BY | changed)
    assert all(part in str(error.value) for part in (str(tmp_path), key, stored, wanted))
    assert batch[0].pair in open_store(tmp_path)


@pytest.mark.parametrize("merged", [False, True])
def test_pairs_of_a_changed_photo_are_made_again(tmp_path, batch, merged):
    store = open_store(tmp_path)
    store.write(batch)
    if merged:
        store.merge()
    digests = DIGESTS | {"b.jpg": "f" * 16}
    store = open_store(tmp_path, digests=digests)
    stale, valid = batch[0].pair, batch[1].pair
    assert stale not in store and valid in store
    anew = make_matches("a.jpg", "b.jpg", 9)
    store.write([anew])
    store.merge()
    store = open_store(tmp_path, digests=digests)
    assert_same(store.read(stale), anew)
    assert_same(store.read(valid), batch[1])
    # What was made of the earlier photo is gone for good.
    assert stale not in open_store(tmp_path)


def test_a_removed_photo_takes_its_pairs_along(tmp_path, batch):
    store = open_store(tmp_path)
    store.write(batch)
    store.merge()
    left = {name: digest for name, digest in DIGESTS.items() if name != "c.jpg"}
    store = open_store(tmp_path, digests=left)
    assert batch[0].pair in store and batch[1].pair not in store


def test_matches_of_other_photos_are_refused(tmp_path, batch):
    store = open_store(tmp_path)
    store.write(batch)
    with pytest.raises(StaleResultError, match="other photos"):
        open_store(tmp_path, digests=dict.fromkeys(NAMES, "e" * 16))


@pytest.mark.parametrize("where", ["matches.h5", "matches.h5.parts/000000.h5"])
@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(lambda data: b"", id="empty"),
        pytest.param(lambda data: b"no matches" * 100, id="text"),
        pytest.param(lambda data: data[: len(data) // 2], id="cut short"),
        pytest.param(lambda data: data[:96] + bytes(2000) + data[2096:], id="a hole near the start"),
    ],
)
def test_damaged_files_are_refused_by_name(tmp_path, batch, where, spoil):
    store = open_store(tmp_path)
    store.write(batch)
    if where == "matches.h5":
        store.merge()
    path = tmp_path / where
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(StaleResultError) as error:
        open_store(tmp_path)
    assert str(path) in str(error.value) and "delete it" in str(error.value)


def test_foreign_and_older_files_are_refused(tmp_path, batch):
    with h5py.File(tmp_path / "matches.h5", "w") as h5:
        h5["x"] = np.zeros(3)
    with pytest.raises(StaleResultError, match="matches.h5"):
        open_store(tmp_path)
    (tmp_path / "matches.h5").unlink()
    store = open_store(tmp_path)
    store.write(batch)
    store.merge()
    with h5py.File(tmp_path / "matches.h5", "a") as h5:
        h5.attrs["version"] = 999
    with pytest.raises(StaleResultError, match="another version"):
        open_store(tmp_path)


def test_thousands_of_photos(tmp_path):
    digests = {f"{i:06d}.jpg": f"{i:016x}" for i in range(6000)}
    matches = make_matches("000000.jpg", "005999.jpg")
    store = open_store(tmp_path, digests=digests)
    store.write([matches])
    store.merge()
    assert_same(open_store(tmp_path, digests=digests).read(matches.pair), matches)


def test_the_store_can_move(tmp_path, batch):
    store = open_store(tmp_path)
    store.write(batch)
    store.merge()
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    shutil.move(store.path, elsewhere / "matches.h5")
    assert_same(open_store(elsewhere).read(batch[0].pair), batch[0])


def test_digests_follow_the_bytes_of_a_photo(tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(b"abc")
    image = ImageRef("a.jpg", path, (64, 64))
    assert digest_image(image) == "ba7816bf8f01cfea"
    path.write_bytes(b"abd")
    assert digest_image(image) != "ba7816bf8f01cfea"
    path.unlink()
    with pytest.raises(InputError, match="a.jpg"):
        digest_image(image)
