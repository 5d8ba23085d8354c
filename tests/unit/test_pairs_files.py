from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from hm_sfm.errors import InputError
from hm_sfm.formats.pairs_files import read_pairs, write_pairs
from hm_sfm.pairs.selection import pair_exhaustively
from hm_sfm.types import ImagePair


def read_text(path: Path, text: str | bytes, names: list[str]) -> tuple[ImagePair, ...]:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_pairs(path, names)


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


def test_pairs_that_are_there_twice_count_once(tmp_path):
    # As hloc's pairs_from_retrieval writes them: each photo with those most like it.
    text = "b a\nb c\na b\na c\nc b\nc a\nb a\n"
    pairs = read_text(tmp_path / "pairs.txt", text, ["a", "b", "c"])
    assert pairs == (ImagePair("a", "b"), ImagePair("b", "c"), ImagePair("a", "c"))


def test_spaces_that_are_not_ascii_separate_nothing(tmp_path):
    # macOS puts a narrow no-break space into the names of screenshots.
    names = ["9.41\u202fAM.png", "b\u2028.png"]
    assert read_text(tmp_path / "pairs.txt", " ".join(names), names) == (ImagePair(*names),)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a b\na a\n", "pairs.txt, line 2: 'a' is paired with itself"),
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
