"""Which photos look alike: descriptors from cells, the nearest ones, and the samples of cells on disk."""

from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import torch

from hm_sfm.config import Config, MatchingConfig, NetworkConfig, PairConfig
from hm_sfm.errors import InputError
from hm_sfm.io import batches
from hm_sfm.matching.encoder import Encoder
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.network.homonet import HomoNet
from hm_sfm.pairs import retrieval
from hm_sfm.pairs.retrieval import (
    CELLS_PER_IMAGE,
    CellStore,
    count_words,
    describe_images,
    find_similar,
    group_near_duplicates,
    learn_vocabulary,
    sample_cells,
    weigh_words,
)  # fmt: skip
from hm_sfm.pairs.selection import select_pairs
from hm_sfm.photos.images import prepare_array, read_ref
from hm_sfm.photos.orientation import CV_ROTATIONS
from hm_sfm.pipeline.collection import choose_pairs
from hm_sfm.synthetic.textures import make_texture
from hm_sfm.types import ImageRef

CHANNELS = 16


def normalise(values: np.ndarray) -> np.ndarray:
    return (values / np.linalg.norm(values, axis=-1, keepdims=True)).astype(np.float32)


class Ring:
    """Photos around an object: each sees an arc of its landmarks, and some noise. A matcher that encodes them."""

    def __init__(self, count: int, landmarks: int = 400, seen: int = 100) -> None:
        rng = np.random.default_rng(0)
        appearance = normalise(rng.normal(size=(landmarks, CHANNELS)))
        self.cells = {}
        for i in range(count):
            arc = (np.arange(seen) + i * landmarks // count) % landmarks
            noise = normalise(rng.normal(size=(seen // 4, CHANNELS)))
            self.cells[f"{i:03d}.jpg"] = normalise(
                np.concatenate([appearance[arc] + 0.05 * rng.normal(size=(seen, CHANNELS)), noise])
            )
        self.images = [ImageRef(name, Path(name), (640, 480)) for name in self.cells]
        self.digests = {name: f"{i:016x}" for i, name in enumerate(self.cells)}
        self.encoded: list[str] = []
        self.encoder = self

    def encode_plain(self, name: str) -> np.ndarray:
        self.encoded.append(name)
        return self.cells[name]

    def describe(self, folder, weights: str = "a", images=None, digests=None) -> np.ndarray:
        store = CellStore(folder, weights)
        return describe_images(images or self.images, digests or self.digests, self.encode_plain, store, quiet=True)


@pytest.fixture
def ring(monkeypatch) -> Ring:
    monkeypatch.setattr(retrieval, "prepare_image", lambda image, long_edge_px: image.name)
    return Ring(60)


def test_photos_of_the_same_part_are_similar(ring, tmp_path):
    similar = find_similar(ring.describe(tmp_path), 8)
    steps = (similar - np.arange(60)[:, None] + 30) % 60 - 30
    # 15 photos farther on, nothing is in common.
    assert (np.abs(steps) <= 6).mean() > 0.95
    assert set(steps[:, 0].tolist()) <= {-2, -1, 1, 2}


def test_descriptors_are_the_same_each_time(ring, tmp_path):
    first = ring.describe(tmp_path / "one")
    np.random.default_rng().normal(size=3)
    assert first.dtype == np.float32 and first.shape == (60, 60 * 125 // 20)
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), 1, atol=1e-5)
    assert first.tobytes() == ring.describe(tmp_path / "two").tobytes() == ring.describe(tmp_path / "one").tobytes()
    assert len(ring.encoded) == 120


def test_what_is_stored_is_not_encoded_again_when_photos_come_and_go(ring, tmp_path):
    ring.describe(tmp_path, images=ring.images[:40])
    ring.encoded.clear()
    full = ring.describe(tmp_path, images=ring.images[10:])
    assert ring.encoded == list(ring.cells)[40:]
    assert full.tobytes() == ring.describe(tmp_path / "new", images=ring.images[10:]).tobytes()


def test_a_changed_photo_is_encoded_again_and_other_weights_everything(ring, tmp_path):
    before = ring.describe(tmp_path)
    ring.encoded.clear()
    ring.cells["007.jpg"] = ring.cells["030.jpg"]
    changed = ring.describe(tmp_path, digests={**ring.digests, "007.jpg": "f" * 16})
    assert ring.encoded == ["007.jpg"]
    assert not np.array_equal(before[7], changed[7])
    assert find_similar(changed, 1)[7, 0] == 30
    ring.encoded.clear()
    ring.describe(tmp_path, weights="b")
    assert len(ring.encoded) == 60
    assert all(h5py.File(file).attrs["made_by"] == CellStore(tmp_path, "b").made_by for file in tmp_path.iterdir())


def test_two_names_of_one_photo_are_encoded_once(ring, tmp_path):
    descriptors = ring.describe(tmp_path, digests={**ring.digests, "001.jpg": ring.digests["000.jpg"]})
    assert len(ring.encoded) == 59
    assert find_similar(descriptors, 1)[:2].tolist() == [[1], [0]]


def test_an_interrupted_pass_goes_on(ring, tmp_path, monkeypatch):
    undisturbed = ring.describe(tmp_path / "undisturbed")
    ring.encoded.clear()
    encode = ring.encode_plain

    def stop_at_the_tenth(name):
        if len(ring.encoded) == 10:
            raise KeyboardInterrupt
        return encode(name)

    monkeypatch.setattr(ring, "encode_plain", stop_at_the_tenth)
    with pytest.raises(KeyboardInterrupt):
        ring.describe(tmp_path / "out")
    monkeypatch.setattr(ring, "encode_plain", encode)
    assert ring.describe(tmp_path / "out").tobytes() == undisturbed.tobytes()
    assert ring.encoded == list(ring.cells)


def test_a_killed_pass_keeps_its_batches(ring, tmp_path, monkeypatch):
    monkeypatch.setattr(batches, "BATCH_SECONDS", 0.0)
    write = CellStore.write

    def die_at_the_third(store, batch):
        if len(list(store.folder.glob("*.h5"))) == 2:
            raise SystemExit  # as after kill -9, nothing is written any more
        write(store, batch)

    monkeypatch.setattr(CellStore, "write", die_at_the_third)
    with pytest.raises(SystemExit):
        ring.describe(tmp_path)
    monkeypatch.setattr(CellStore, "write", write)
    (tmp_path / "0123456789abcdef.h5.tmp").write_bytes(b"half")
    ring.encoded.clear()
    ring.describe(tmp_path)
    assert ring.encoded == list(ring.cells)[2:]


def test_a_damaged_file_is_made_again(ring, tmp_path, caplog):
    expected = ring.describe(tmp_path)
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:1000])
    ring.encoded.clear()
    assert ring.describe(tmp_path).tobytes() == expected.tobytes()
    assert len(ring.encoded) == 60
    assert f"{file} is damaged, it is made again" in caplog.text


def test_what_was_never_stored_is_not_there(tmp_path):
    store = CellStore(tmp_path / "none", "a")
    store.write({})
    assert "0" not in store and not (tmp_path / "none").exists()
    with pytest.raises(KeyError):
        list(store.read(["0"]))


def test_samples_are_of_the_whole_photo():
    cells = np.arange(5000, dtype=np.float32)[:, None]
    sample = sample_cells(cells)
    assert sample.shape == (CELLS_PER_IMAGE, 1) and len(np.unique(sample)) == CELLS_PER_IMAGE
    assert abs(sample[:100].mean() - 2500) < 500
    np.testing.assert_array_equal(sample, sample_cells(cells))
    assert sorted(sample_cells(cells[:7]).ravel()) == [0, 1, 2, 3, 4, 5, 6]


def test_words_are_counted_and_weighed():
    vocabulary = np.array([[1, 0], [0, 1], [-0.6, -0.8]], np.float32)
    cells = np.array([[1, 0.25], [0.75, 0], [0, 1], [0.8, 0.6], [0.9, 0]], np.float32)
    counts = count_words(cells, vocabulary)
    assert counts.tolist() == [4, 1, 0]
    described = weigh_words(np.stack([counts, [9, 0, 0], [1, 0, 2]]))
    # Of three photos, three have the first word and one each of the others: log(4 / 3) and log(4).
    first = np.array([2 * np.log(4 / 3), np.log(4), 0])
    np.testing.assert_allclose(described[:2], [first / np.linalg.norm(first), [1, 0, 0]], rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(described, axis=1), 1, rtol=1e-6)


def test_a_word_that_no_photo_has_does_no_harm():
    assert weigh_words(np.array([[1, 0], [4, 0]])).tolist() == [[1, 0], [1, 0]]


def test_a_few_cells_make_a_small_vocabulary():
    cells = normalise(np.random.default_rng(0).normal(size=(60, CHANNELS)))
    assert learn_vocabulary([cells[:6], cells[6:]]).shape == (3, CHANNELS)
    assert learn_vocabulary([cells[:1], cells[1:2]]).shape == (1, CHANNELS)


def test_flat_photos_resemble_each_other_and_no_others(ring, tmp_path):
    flat = normalise(np.ones((50, CHANNELS)))
    for name in ("003.jpg", "030.jpg", "031.jpg"):
        ring.cells[name] = flat
    similar = find_similar(ring.describe(tmp_path), 2)
    assert [set(similar[i].tolist()) for i in (3, 30, 31)] == [{30, 31}, {3, 31}, {3, 30}]
    for name in ring.cells:
        ring.cells[name] = flat
    descriptors = ring.describe(tmp_path / "all")
    assert np.isfinite(descriptors).all()
    assert find_similar(descriptors, 2)[:3].tolist() == [[1, 2], [0, 2], [0, 1]]


def test_rotated_photos_are_similar(tmp_path):
    """Textures, each seen twice: as it is, and turned."""
    matcher = HomoMatcher.from_pretrained("light")
    rng = np.random.default_rng(0)
    for i, material in enumerate(("bricks", "stones", "planks", "mural")):
        texture = make_texture(rng, material, (1.6, 1.2), 100)
        turned = cv2.rotate(texture[4:, 7:], CV_ROTATIONS[(90, 180, 270, 90)[i]])
        for name, photo in ((f"{i}.png", texture), (f"{i + 4}.png", turned)):
            cv2.imwrite(str(tmp_path / name), photo)
    images = [read_ref(tmp_path / f"{i}.png") for i in range(8)]
    digests, store = {image.name: image.name for image in images}, CellStore(tmp_path / "cells", "a")
    upright = describe_images(images, digests, matcher.encoder.encode_plain, store, quiet=True)
    turned = describe_images(images, digests, matcher.encoder.encode_plain, store, quiet=True, rotated=True)
    assert turned.shape[:2] == (4, 8) and turned.dtype == np.float32
    expected = [4, 5, 6, 7, 0, 1, 2, 3]
    assert find_similar(turned, 1).ravel().tolist() == expected != find_similar(upright, 1).ravel().tolist()


def test_of_all_turns_the_most_similar_one_counts():
    one, other = np.eye(2, dtype=np.float32)
    descriptors = np.stack([one, one, other])
    turned = np.stack([descriptors, np.stack([other, 0.6 * one + 0.8 * other, one])])
    assert find_similar(turned, 2).tolist() == [[1, 2], [0, 2], [0, 1]]
    assert find_similar(descriptors, 2).tolist() == [[1, -1], [0, -1], [-1, -1]]
    assert find_similar(turned[:, :0], 2).shape == (0, 2)


def test_photos_with_nothing_in_common_are_in_no_pair():
    with pytest.raises(InputError, match="finds no pair among 3 images"):
        select_pairs(["a", "b", "c"], PairConfig(mode="retrieval"), lambda *ask: find_similar(np.eye(3), *ask[1:]))


def test_the_most_similar_come_first_whatever_the_block(monkeypatch):
    descriptors = normalise(np.random.default_rng(1).uniform(size=(41, 20)) ** 4)
    similarity = descriptors.astype(np.float64) @ descriptors.T
    np.fill_diagonal(similarity, -2)
    expected = np.argsort(-similarity, axis=1)[:, :5]
    for block in (512, 7):
        monkeypatch.setattr(retrieval, "BLOCK_ROWS", block)
        np.testing.assert_array_equal(find_similar(descriptors, 5), expected)


def test_more_than_there_are_two_photos_and_empty_ones():
    descriptors = np.array([[1, 0], [0, 0], [0.6, 0.8]], np.float32)
    assert find_similar(descriptors, 4).tolist() == [[2, -1, -1, -1], [-1, -1, -1, -1], [0, -1, -1, -1]]
    assert find_similar(descriptors[[0, 2]], 1).tolist() == [[1], [0]]
    assert find_similar(descriptors[:0], 2).shape == (0, 2)


def test_a_gap_leaves_the_neighbours_out():
    descriptors = np.tile(np.array([[1, 0]], np.float32), (6, 1))
    assert find_similar(descriptors, 6, 2).tolist()[0] == [3, 4, 5, -1, -1, -1]
    assert find_similar(descriptors, 2, 2).tolist()[3] == [0, -1]


def make_bursts(places: int, count: int, seed: int = 0) -> np.ndarray:
    """Descriptors (N, D) of unit length of `count` nearly equal photos of each place; neighbours have 0.3 in common."""
    rng = np.random.default_rng(seed)
    place = np.abs(rng.normal(size=(places, 400))) * (rng.random((places, 400)) < 0.15)
    photos = np.repeat(place, count, axis=0)
    return normalise(photos + 0.05 * np.abs(rng.normal(size=photos.shape)))


def test_bursts_are_paired_with_each_other(monkeypatch):
    monkeypatch.setattr(retrieval, "BLOCK_ROWS", 16)
    order = np.random.default_rng(1).permutation(66)
    descriptors, burst = make_bursts(3, 22)[order], np.repeat(np.arange(3), 22)[order]
    assert len(np.unique(group_near_duplicates(descriptors))) == 3
    similar = find_similar(descriptors, 20)
    assert all(np.bincount(burst[row], minlength=3).tolist() == [10 if k == burst[i] else 5 for k in range(3)]
               for i, row in enumerate(similar))  # fmt: skip
    assert (burst[similar[:, :5]] == burst[:, None]).all()
    names = [f"{i:02d}.jpg" for i in range(66)]
    pairs = select_pairs(names, PairConfig(), lambda names, top, gap: find_similar(descriptors, top, gap))
    joined = {(burst[names.index(pair.name0)], burst[names.index(pair.name1)]) for pair in pairs}
    assert {tuple(sorted(places)) for places in joined} == {(a, b) for a in range(3) for b in range(a, 3)}


def test_a_burst_alone_fills_the_list():
    descriptors = make_bursts(1, 12)
    similar = find_similar(descriptors, 8)
    similarity = descriptors @ descriptors.T
    np.fill_diagonal(similarity, 0)
    np.testing.assert_array_equal(similar, np.argsort(-similarity, axis=1, kind="stable")[:, :8])
    assert (find_similar(descriptors, 8, 9)[0] >= 0).sum() == 2


def test_a_thousand_photos_need_few_pairs(monkeypatch, tmp_path):
    monkeypatch.setattr(retrieval, "prepare_image", lambda image, long_edge_px: image.name)
    monkeypatch.setattr(retrieval, "WORDS", 256)
    ring = Ring(1000, landmarks=4000, seen=60)
    descriptors = ring.describe(tmp_path)
    pairs = select_pairs(list(ring.cells), PairConfig(), lambda names, top, gap: find_similar(descriptors, top, gap))
    assert len(pairs) < 0.03 * 1000 * 999 / 2


@pytest.mark.parametrize(("backbone", "coarse"), [("light", "attention"), ("light", "cosine"), ("loftr", "attention")])
def test_plain_features_are_those_that_the_coarse_stage_starts_from(backbone, coarse):
    torch.manual_seed(0)
    net = HomoNet(NetworkConfig(backbone=backbone, coarse=coarse))
    encoder = Encoder(net, torch.device("cpu"), max_keypoints=0)
    image = prepare_array(np.random.default_rng(0).integers(0, 255, (64, 100), np.uint8), 1024)
    plain, described = torch.tensor(encoder.encode_plain(image)), encoder.encode(image).coarse
    assert plain.dtype == torch.float32 and len(plain) == len(described) == 8 * (12 if backbone == "light" else 13)
    torch.testing.assert_close(plain.norm(dim=1), torch.ones(len(plain)), atol=1e-3, rtol=0)
    if backbone == "light":
        torch.testing.assert_close(plain, described[:, :64], atol=1e-2, rtol=0)


def test_choosing_pairs_encodes_only_where_appearance_matters(ring, tmp_path, monkeypatch):
    asked = []

    def get_matcher():
        asked.append(1)
        return ring

    monkeypatch.setattr("hm_sfm.pipeline.collection.digest_image", lambda image: ring.digests[image.name])
    exhaustive = choose_pairs(ring.images, tmp_path / "out", Config(), get_matcher, quiet=True)
    assert len(exhaustive) == 60 * 59 // 2 and not asked and not (tmp_path / "out").exists()
    pairing, matching = PairConfig(mode="retrieval", retrieval_top=4), MatchingConfig(try_hypotheses=False)
    config = Config(pairs=pairing, matching=matching)
    pairs = choose_pairs(ring.images, tmp_path / "out", config, get_matcher, quiet=True)
    assert 120 <= len(pairs) <= 240 and len(ring.encoded) == 60
    assert (tmp_path / "out" / ".hm_sfm").exists() and (tmp_path / "out" / "retrieval").is_dir()
    assert choose_pairs(ring.images, tmp_path / "out", config, get_matcher, quiet=True) == pairs
    assert len(ring.encoded) == 60


def test_choosing_pairs_by_position(tmp_path):
    def refuse_encoding():
        raise AssertionError("no photo is to be encoded")

    images = [
        ImageRef(f"{i}.jpg", tmp_path, (64, 64), 0, (48.0, 8.5 + i * 1e-5, 100.0) if i else None) for i in range(4)
    ]
    config = Config(pairs=PairConfig(mode="spatial"))
    pairs = choose_pairs(images, tmp_path / "out", config, refuse_encoding, quiet=True)
    assert {name for pair in pairs for name in (pair.name0, pair.name1)} == {"1.jpg", "2.jpg", "3.jpg"}
