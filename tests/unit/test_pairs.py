"""Which images are matched with which, and the pairs file."""

import itertools
from collections.abc import Iterable
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from hm_sfm.config import PairConfig
from hm_sfm.errors import ConfigError, InputError
from hm_sfm.pairs import pair_evenly, pair_exhaustively, pair_sequentially, read_pairs, select_pairs, write_pairs
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


def read_text(path: Path, text: str | bytes, names: list[str]) -> tuple[ImagePair, ...]:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_pairs(path, names)


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


@given(count=counts, spread=st.integers(0, 70))
def test_even_partners_are_as_many_as_asked_for(count, spread):
    pairs = pair_evenly(numbered(count), spread)
    assert len(set(pairs)) == len(pairs)
    if spread >= count - 1:
        assert set(pairs) == all_pairs(numbered(count))
    partners = [sum(name in (pair.name0, pair.name1) for pair in pairs) for name in numbered(count)]
    wanted = min(spread + (spread % 2 and count % 2), count - 1)
    assert set(partners) == {wanted}


def test_even_partners_divide_the_sequence():
    of_first = [pair for pair in pair_evenly(numbered(110), 10) if "img0.jpg" in (pair.name0, pair.name1)]
    assert sorted(distances(of_first)) == list(range(10, 110, 10))


def test_auto_is_exhaustive_up_to_the_limit_and_a_mixture_beyond():
    config = PairConfig(exhaustive_limit=60, window=5, spread=10)
    assert select_pairs(numbered(60), config) == pair_exhaustively(numbered(60))
    pairs = select_pairs(numbered(200), config)
    assert len(set(pairs)) == len(pairs)
    assert set(pairs) == set(pair_sequentially(numbered(200), 5)) | set(pair_evenly(numbered(200), 10))
    assert max(distances(pairs)) > 128


def test_modes(tmp_path):
    names = numbered(100)
    assert len(select_pairs(names, PairConfig(mode="exhaustive"))) == 4950
    assert select_pairs(names, PairConfig(mode="sequential", window=3)) == pair_sequentially(names, 3)
    (tmp_path / "pairs.txt").write_text("img1.jpg img0.jpg\n")
    assert select_pairs(names, PairConfig(mode=str(tmp_path / "pairs.txt"))) == (ImagePair("img0.jpg", "img1.jpg"),)
    with pytest.raises(ConfigError, match="'retrieval' does not exist yet: use"):
        select_pairs(names, PairConfig(mode="retrieval"))
    with pytest.raises(InputError, match="'sequental' is neither auto, exhaustive or sequential nor a file"):
        select_pairs(names, PairConfig(mode="sequental"))


@pytest.mark.parametrize("names", [[], ["a.jpg"]])
@pytest.mark.parametrize("mode", ["auto", "exhaustive", "sequential", "pairs.txt"])
def test_a_pair_needs_two_images(names, mode):
    with pytest.raises(InputError, match=f"at least 2 images .* found {len(names)}"):
        select_pairs(names, PairConfig(mode=mode))


def test_impossible_settings():
    with pytest.raises(ConfigError, match="window must be at least 1, found 0"):
        pair_sequentially(numbered(5), 0)
    with pytest.raises(ConfigError, match="spread must not be negative, found -1"):
        pair_evenly(numbered(5), -1)


@pytest.mark.parametrize(
    "text",
    [
        'b.jpg a.jpg\na.jpg "my photo.jpg"',
        "a.jpg b.jpg\r\n\r\nmy photo.jpg\ta.jpg\r\n",
        "\ufeffa.jpg   b.jpg  \n  # a comment\n\n#another\n  a.jpg\tmy photo.jpg\t\n",
        '\ufeff"a.jpg" "b.jpg"\n"my photo.jpg"\t"a.jpg"\n',
    ],
)
def test_reads_what_hloc_and_people_write(tmp_path, text):
    pairs = read_text(tmp_path / "pairs.txt", text, ["a.jpg", "b.jpg", "my photo.jpg"])
    assert pairs == (ImagePair("a.jpg", "b.jpg"), ImagePair("a.jpg", "my photo.jpg"))


def test_spaces_that_are_not_ascii_separate_nothing(tmp_path):
    # macOS puts a narrow no-break space into the names of screenshots.
    names = ["9.41\u202fAM.png", "b\u2028.png"]
    assert read_text(tmp_path / "pairs.txt", " ".join(names), names) == (ImagePair(*names),)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a b\na a\n", "pairs.txt, line 2: 'a' is paired with itself"),
        ("a b\n\n# c\nb a\n", "pairs.txt, line 4: repeats the pair of line 1, 'b' and 'a'"),
        ("a b\na\n", "pairs.txt, line 2: expected two names, found 'a'"),
        ("a b c\n", "pairs.txt, line 1: expected two names, found 'a b c'.*double quotes"),
        ("a\tb\tc\n", "pairs.txt, line 1: expected two names"),
        ('"a b\n', "pairs.txt, line 1: expected two names"),
        ("a x\nb y\nx a b.jpg\n", "line 3: expected two names"),
        ("a x\nb y\na b\nx b\n", r"pairs.txt names images that are not there: 'x' \(line 1\), 'y' \(line 2\)$"),
        ("", "pairs.txt holds no pair"),
        ("\ufeff# nothing\r\n\r\n", "pairs.txt holds no pair"),
        ("a b\n".encode("utf-16"), "pairs.txt is not UTF-8 text"),
    ],
)
def test_unusable_pairs_files_say_why(tmp_path, text, expected):
    with pytest.raises(InputError, match=expected) as caught:
        read_text(tmp_path / "pairs.txt", text, ["a", "b", "c"])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("count", "ending"), [(20, r"'x19' \(line 20\)$"), (25, r"'x19' \(line 20\) and 5 more$")])
def test_many_unknown_images_are_counted(tmp_path, count, ending):
    with pytest.raises(InputError, match=ending) as caught:
        read_text(tmp_path / "pairs.txt", "".join(f"a x{i}\n" for i in range(count)), ["a"])
    assert all(f"'x{i}'" in str(caught.value) for i in range(20))


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match="cannot read the pairs file .*gone.txt: No such file"):
        read_pairs(tmp_path / "gone.txt", ["a", "b"])
    with pytest.raises(InputError, match="cannot read the pairs file .*: Is a directory"):
        read_pairs(tmp_path, ["a", "b"])


odd_names = st.text(
    st.one_of(st.sampled_from(' \t"#\\/\ufeff\x0b\x85\u2028\u202f'), st.characters(exclude_categories=["Cs"])),
    min_size=1,
    max_size=8,
).filter(lambda name: "\n" not in name and "\r" not in name)


@example(names=["#a", "b"])
@example(names=["\ufeffa", "\ufeffb"])
@example(names=['a"" "b', '"c"'])
@given(names=st.lists(odd_names, min_size=2, max_size=6, unique=True))
def test_round_trip_of_odd_names(tmp_path_factory, names):
    path = tmp_path_factory.mktemp("pairs") / "pairs.txt"
    pairs = pair_exhaustively(names)
    write_pairs(path, pairs)
    assert read_pairs(path, names) == pairs
    assert [file.name for file in path.parent.iterdir()] == ["pairs.txt"]


def test_plain_names_are_written_as_hloc_reads_them(tmp_path):
    write_pairs(tmp_path / "pairs.txt", [ImagePair("a.jpg", "sub/ü.jpg"), ImagePair('1" pipe.jpg', "b.jpg")])
    assert (tmp_path / "pairs.txt").read_text("utf-8") == 'a.jpg sub/ü.jpg\n"1"" pipe.jpg" b.jpg\n'


def test_writing_replaces_the_file_or_leaves_it(tmp_path):
    path = tmp_path / "pairs.txt"
    path.write_text("old")
    with pytest.raises(InputError, match="line break"):
        write_pairs(path, [ImagePair("a", "b\nc")])
    assert path.read_text() == "old"
    write_pairs(path, [])
    assert path.read_text() == ""
    with pytest.raises(InputError, match="holds no pair"):
        read_pairs(path, ["a", "b"])
