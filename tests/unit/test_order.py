"""The order in which pairs are matched: the same pairs, and photos that are seldom loaded twice."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hm_sfm.matching import feature_cache
from hm_sfm.matching.order import count_loads, order_pairs
from hm_sfm.matching.run import match_pairs
from hm_sfm.types import ImagePair, ImageRef, PatchMatches


def make_pairs(numbers) -> list[ImagePair]:
    return [ImagePair.of(f"{a:04d}.jpg", f"{b:04d}.jpg") for a, b in numbers]


def count_images(pairs) -> int:
    return len({name for pair in pairs for name in (pair.name0, pair.name1)})


different = st.tuples(st.integers(0, 12), st.integers(0, 12)).filter(lambda ends: ends[0] < ends[1])
lists = st.lists(different, max_size=40, unique=True).map(make_pairs)


@given(pairs=lists, capacity=st.integers(2, 15))
def test_the_order_holds_the_same_pairs_and_costs_no_more_loads(pairs, capacity):
    ordered = order_pairs(pairs, capacity)
    assert sorted(ordered) == sorted(pairs)
    loads = count_loads(ordered, capacity)
    # With capacity - 1 others in the cache, a load serves no more pairs than that.
    assert max(count_images(pairs), len(pairs) / (capacity - 1)) <= loads <= count_loads(pairs, capacity)


@given(pairs=lists)
def test_each_image_is_loaded_once_where_the_cache_holds_all(pairs):
    assert count_loads(order_pairs(pairs, 13), 13) == count_images(pairs)


@given(pairs=lists, capacity=st.integers(2, 15))
def test_the_order_is_always_the_same_one(pairs, capacity):
    assert order_pairs(pairs, capacity) == order_pairs(list(pairs), capacity)


def test_loads_are_those_of_a_cache_that_keeps_the_images_used_last():
    pairs = make_pairs([(0, 1), (0, 2), (1, 2), (0, 3)])
    # 0 and 1; 2 in the place of 1; 1 in that of 0; then 0 and 3.
    assert count_loads(pairs, 2) == 6
    # 3 in the place of 1: 0 is held, since its pair needs it, though 2 was used after it.
    assert count_loads(pairs, 3) == 4
    assert count_loads([*pairs, *make_pairs([(0, 2)])], 3) == 4
    assert count_loads([*pairs, *make_pairs([(0, 1)])], 3) == 5
    assert count_loads([], 2) == 0


def test_all_pairs_cost_little_more_than_they_must():
    pairs = make_pairs(itertools.combinations(range(120), 2))
    loads = count_loads(order_pairs(pairs, 10), 10)
    assert loads < 1.6 * len(pairs) / 9
    assert loads < count_loads(pairs, 10) / 5


def test_a_sequence_is_loaded_once_in_any_order_of_its_pairs():
    pairs = make_pairs((i, j) for i in range(500) for j in range(i + 1, min(i + 6, 500)))
    shuffled = [pairs[at] for at in np.random.default_rng(0).permutation(len(pairs))]
    assert count_loads(shuffled, 10) > 4500
    # It starts in the middle, so that half of the neighbours there are loaded again.
    assert count_loads(order_pairs(shuffled, 10), 10) < 550
    assert count_loads(order_pairs(pairs, 10), 10) == 500


@pytest.mark.slow
def test_neighbours_in_the_plane_are_loaded_a_few_times_in_a_cache_of_one_per_cent():
    xy = np.random.default_rng(0).uniform(size=(1000, 2))
    nearest = np.argsort(((xy[:, None] - xy) ** 2).sum(axis=2), axis=1)[:, 1:21]
    pairs = make_pairs({(min(i, j), max(i, j)) for i, row in enumerate(nearest.tolist()) for j in row})
    pairs.sort()
    loads = count_loads(order_pairs(pairs, 10), 10)
    assert loads < 2.2 * len(pairs) / 9 and loads < count_loads(pairs, 10) / 4


def test_a_star_keeps_its_centre():
    pairs = make_pairs((5, i) if i > 5 else (i, 5) for i in range(12) if i != 5)
    assert count_loads(order_pairs(pairs, 2), 2) == 12


def test_a_cache_for_one_image_is_none():
    with pytest.raises(ValueError, match="at least 2, got 1"):
        order_pairs(make_pairs([(0, 1)]), 1)
    assert order_pairs([], 2) == ()


class Store(dict):
    """A MatchStore in memory."""

    def write(self, batch) -> None:
        self.update({matches.pair: matches for matches in batch})

    def merge(self) -> None:
        pass


class CountingMatcher:
    """Encodes photos of 1 MB each and notes which."""

    def __init__(self, feature_cache_mb: int) -> None:
        self.config = SimpleNamespace(feature_cache_mb=feature_cache_mb, engine="serial")
        self.cell_matcher = None
        self.images = SimpleNamespace(long_edge_px=64)
        self.encoded: list[str] = []

    def encode(self, name: str) -> SimpleNamespace:
        self.encoded.append(name)
        return SimpleNamespace(name=name, size_bytes=1_000_000)

    def match_features(self, features0, features1) -> PatchMatches:
        xy = np.array([[int(features0.name[:4]), int(features1.name[:4])]])
        return PatchMatches(xy0=xy, xy1=xy, score=[1.0], homography=np.eye(3)[None], patch_radius_px=8.0)


@pytest.mark.parametrize("capacity", [2, 5, 100])
def test_matching_loads_as_planned_and_the_order_changes_no_match(capacity, monkeypatch, tmp_path):
    monkeypatch.setattr(feature_cache, "prepare_image", lambda image, long_edge_px: image.name)
    pairs = make_pairs(itertools.combinations(range(20), 2))
    images = [
        ImageRef(name, tmp_path / name, (64, 64)) for name in sorted({pair.name0 for pair in pairs} | {"0019.jpg"})
    ]
    matcher, store = CountingMatcher(capacity), Store()
    done = pairs[30:40]
    store.write([SimpleNamespace(pair=pair) for pair in done])
    missing = [pair for pair in pairs if pair not in store]
    match_pairs(images, pairs, matcher, store, quiet=True)
    assert len(matcher.encoded) == count_loads(order_pairs(missing, capacity), capacity)
    assert store.keys() == set(pairs)
    for pair in missing:
        assert store[pair].xy0.tolist() == [[int(pair.name0[:4]), int(pair.name1[:4])]]
