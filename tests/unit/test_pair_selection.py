"""Which images are matched with which."""

import itertools
from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hm_sfm.config import PairConfig
from hm_sfm.errors import ConfigError, InputError
from hm_sfm.pairs.selection import pair_exhaustively, pair_sequentially, select_pairs
from hm_sfm.types import ImagePair

counts = st.integers(2, 60)


def numbered(count: int) -> list[str]:
    """Sorted as strings, which is not the order of the numbers."""
    return sorted(f"img{i}.jpg" for i in range(count))


def distances(pairs: Iterable[ImagePair]) -> list[int]:
    """How far apart the two images of each pair are in the sequence."""
    number = [[int(name[3:-4]) for name in (pair.name0, pair.name1)] for pair in pairs]
    return [abs(a - b) for a, b in number]


def all_pairs(names: list[str]) -> set[ImagePair]:
    return {ImagePair.of(a, b) for a, b in itertools.combinations(names, 2)}


@given(count=counts)
def test_exhaustive_is_every_pair_once(count):
    pairs = pair_exhaustively(numbered(count))
    assert len(pairs) == count * (count - 1) // 2
    assert set(pairs) == all_pairs(numbered(count))


@given(count=counts, window=st.integers(1, 70))
def test_sequential_is_the_window_and_powers_of_two(count, window):
    pairs = pair_sequentially(numbered(count), window)
    assert len(set(pairs)) == len(pairs)
    powers = {2**k for k in range(20)}
    expected = {
        ImagePair.of(f"img{i}.jpg", f"img{j}.jpg")
        for i, j in itertools.combinations(range(count), 2)
        if j - i <= window or j - i in powers
    }
    assert set(pairs) == expected


def test_sequences_compare_numbers_as_numbers():
    names = ["a10/2.jpg", "a10/10.jpg", "a2/3.jpg", "a2/03.jpg", "a2/x.jpg", "b.jpg"]
    neighbours = [ImagePair.of(a, b) for a, b in itertools.pairwise(["a2/03.jpg", "a2/3.jpg", "a2/x.jpg"])]
    neighbours += [ImagePair.of("a2/x.jpg", "a10/2.jpg"), ImagePair.of("a10/2.jpg", "a10/10.jpg")]
    assert set(neighbours) < set(pair_sequentially(names, 1))
    assert pair_sequentially(names, 2) == pair_sequentially(names[::-1], 2)


class PlantedAppearance:
    """Images on a circle resemble those next to them; counts how often it is asked."""

    def __init__(self, order: list[str] | None = None) -> None:
        self.order, self.asked = order, []

    def __call__(self, names: list[str], top: int, gap: int) -> np.ndarray:
        self.asked.append((top, gap))
        place = np.argsort([(self.order or names).index(name) for name in names])
        similar = np.full((len(names), top), -1, np.int64)
        steps = [step for k in range(1, len(names) // 2) for step in (k, -k) if k > gap][:top]
        for at, image in enumerate(place):
            for column, step in enumerate(steps):
                similar[image, column] = place[(at + step) % len(names)]
        return similar


def on_circle(names: list[str], reach: int) -> set[ImagePair]:
    return {
        ImagePair.of(name, names[(i + k) % len(names)]) for i, name in enumerate(names) for k in range(1, reach + 1)
    }


def in_order(count: int) -> list[str]:
    return [f"img{i}.jpg" for i in range(count)]


def test_auto_is_exhaustive_up_to_the_limit():
    appearance = PlantedAppearance()
    assert select_pairs(numbered(60), PairConfig(exhaustive_limit=60), appearance) == pair_exhaustively(numbered(60))
    assert appearance.asked == []


def test_auto_beyond_takes_what_looks_alike_and_the_window_of_a_sequence():
    appearance = PlantedAppearance()
    pairs = select_pairs(numbered(200), PairConfig(window=5, retrieval_top=4), appearance)
    assert appearance.asked == [(4, 0)] and len(set(pairs)) == len(pairs)
    within = {ImagePair.of(f"img{i}.jpg", f"img{j}.jpg") for i in range(200) for j in range(i + 1, min(i + 6, 200))}
    assert set(pairs) == on_circle(in_order(200), 2) | within


def test_numbers_that_say_nothing_about_the_appearance_make_no_sequence():
    shuffled = in_order(200)
    np.random.default_rng(0).shuffle(shuffled)
    pairs = select_pairs(numbered(200), PairConfig(window=5, retrieval_top=4), PlantedAppearance(shuffled))
    assert set(pairs) == on_circle(shuffled, 2)


def test_names_without_numbers_make_no_sequence():
    words = sorted("".join(letters) for letters in itertools.product("abcdef", repeat=3))
    assert set(select_pairs(words, PairConfig(retrieval_top=4), PlantedAppearance())) == on_circle(words, 2)


def test_frames_named_by_their_milliseconds_are_a_sequence():
    frames = [f"walk_{i * 500:08d}.jpg" for i in range(100)]
    pairs = select_pairs(frames, PairConfig(window=5, retrieval_top=4), PlantedAppearance())
    within = {ImagePair.of(one, other) for i, one in enumerate(frames) for other in frames[i + 1 : i + 6]}
    assert within <= set(pairs)


def test_retrieval_takes_no_more_than_there_are():
    appearance = PlantedAppearance()
    pairs = select_pairs(numbered(6), PairConfig(mode="retrieval", retrieval_top=20), appearance)
    assert appearance.asked == [(5, 0)] and set(pairs) == on_circle(in_order(6), 2)


def test_a_pair_that_one_of_the_two_proposes_is_taken_once():
    similar = np.array([[1, 2], [0, -1], [-1, -1]])
    pairs = select_pairs(["a", "b", "c"], PairConfig(mode="retrieval"), lambda names, top, gap: similar)
    assert pairs == (ImagePair("a", "b"), ImagePair("a", "c"))


def test_retrieval_that_finds_nothing_is_told():
    with pytest.raises(InputError, match="'retrieval' finds no pair among 3 images"):
        select_pairs(["a", "b", "c"], PairConfig(mode="retrieval"), lambda names, top, gap: np.full((3, 2), -1))


def test_a_sequence_closes_its_loops_by_appearance():
    appearance = PlantedAppearance()
    pairs = select_pairs(numbered(100), PairConfig(mode="sequential", window=3, loop_top=2), appearance)
    assert appearance.asked == [(2, 12)]
    assert set(pairs) == set(pair_sequentially(numbered(100), 3)) | {
        ImagePair.of(f"img{i}.jpg", f"img{(i + 13) % 100}.jpg") for i in range(100)
    }


def along_a_street(count: int, step_m: float) -> dict[str, tuple[float, float, float]]:
    return {f"img{i}.jpg": (48.0 + i * step_m / 111_200, 8.5, 100.0 * (i % 2)) for i in range(count)}


def test_spatial_takes_the_nearest_within_the_distance():
    names, positions = numbered(12), along_a_street(10, 30.0)
    config = PairConfig(mode="spatial", spatial_top=2)
    pairs = select_pairs(names, config, None, positions)
    assert {1} <= set(distances(pairs)) <= {1, 2}
    assert all({pair.name0, pair.name1} <= positions.keys() for pair in pairs)
    near = PairConfig(mode="spatial", spatial_top=9, spatial_distance_m=65.0)
    expected = {ImagePair.of(f"img{i}.jpg", f"img{j}.jpg") for i in range(10) for j in range(i + 1, min(i + 3, 10))}
    assert set(select_pairs(names, near, None, positions)) == expected


def test_spatial_says_what_it_lacks(caplog):
    with pytest.raises(InputError, match="needs photos with a GPS position in EXIF, found none in 5"):
        select_pairs(numbered(5), PairConfig(mode="spatial"), None, {})
    with pytest.raises(InputError, match="'spatial' finds no pair among 5 images"):
        select_pairs(numbered(5), PairConfig(mode="spatial"), None, along_a_street(5, 1000.0))
    select_pairs(numbered(5), PairConfig(mode="spatial"), None, along_a_street(3, 10.0))
    assert caplog.messages[-1] == "2 of 5 photos have no GPS position in EXIF: they are in no pair"


def test_auto_adds_neighbours_by_position():
    positions = {f"img{i}.jpg": (48.0, 8.5, 100.0) for i in (0, 50)}
    pairs = select_pairs(numbered(100), PairConfig(retrieval_top=2), PlantedAppearance(), positions)
    without = select_pairs(numbered(100), PairConfig(retrieval_top=2), PlantedAppearance())
    assert set(pairs) - set(without) == {ImagePair.of("img0.jpg", "img50.jpg")}


def test_modes(tmp_path):
    names = numbered(100)
    assert len(select_pairs(names, PairConfig(mode="exhaustive"))) == 4950
    assert select_pairs(names, PairConfig(mode="sequential", window=3)) == pair_sequentially(names, 3)
    (tmp_path / "pairs.txt").write_text("img1.jpg img0.jpg\n")
    assert select_pairs(names, PairConfig(mode=str(tmp_path / "pairs.txt"))) == (ImagePair("img0.jpg", "img1.jpg"),)
    with pytest.raises(InputError, match="'sequental' is neither auto, exhaustive, .* or spatial nor a file"):
        select_pairs(names, PairConfig(mode="sequental"))
    for mode in ("retrieval", "auto"):
        with pytest.raises(ValueError, match="pair 100 images by appearance, select_pairs needs find_similar"):
            select_pairs(names, PairConfig(mode=mode))


@pytest.mark.parametrize("names", [[], ["a.jpg"]])
@pytest.mark.parametrize("mode", ["auto", "exhaustive", "sequential", "pairs.txt"])
def test_a_pair_needs_two_images(names, mode):
    with pytest.raises(InputError, match=f"at least 2 images .* found {len(names)}"):
        select_pairs(names, PairConfig(mode=mode))


def test_impossible_settings():
    with pytest.raises(ConfigError, match="window must be at least 1, found 0"):
        pair_sequentially(numbered(5), 0)
    for key in ("window", "retrieval_top", "spatial_top"):
        with pytest.raises(ConfigError, match=f"pairs.{key} must be at least 1, found 0"):
            select_pairs(numbered(5), PairConfig(**{key: 0}))
