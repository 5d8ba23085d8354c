"""hloc's files: what hloc finds in ours, what we find in hloc's, and everything that does not fit."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from hm_sfm.errors import InputError
from hm_sfm.formats.hloc import read_features, read_matches, write_features, write_matches
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints

NAMES = ("a.jpg", "left/with space.jpg", "right/Köln — 教会.png")
IMAGES = [ImageRef(name, Path(name), (600, 400)) for name in NAMES]
PAIRS = [ImagePair(NAMES[0], NAMES[1]), ImagePair(NAMES[0], NAMES[2]), ImagePair(NAMES[1], NAMES[2])]
PX_SCALE = {NAMES[0]: 1.0, NAMES[1]: 2.5, NAMES[2]: 1.0}


@pytest.fixture
def keypoints() -> list[Keypoints]:
    rng = np.random.default_rng(0)
    counts = (5, 4, 0)
    return [Keypoints(n, rng.uniform(0, 400, (k, 2)), rng.random(k), rng.random(k)) for n, k in zip(NAMES, counts)]


@pytest.fixture
def matches() -> list[IndexMatches]:
    return [IndexMatches(PAIRS[0], [(4, 0), (1, 3), (2, 2)], np.float32([0.9, 0.5, 0.25]))]


@pytest.fixture
def files(tmp_path, keypoints, matches) -> tuple[Path, Path]:
    features_file, matches_file = tmp_path / "new" / "features.h5", tmp_path / "new" / "matches.h5"
    write_features(features_file, IMAGES, keypoints, PX_SCALE)
    write_matches(matches_file, PAIRS, keypoints, matches)
    assert sorted(path.name for path in features_file.parent.iterdir()) == ["features.h5", "matches.h5"]
    return features_file, matches_file


def test_a_round_trip(files, keypoints, matches):
    actual = read_features(files[0], IMAGES)
    for one, other in zip(actual, keypoints, strict=True):
        assert one.name == other.name
        np.testing.assert_allclose(one.xy, other.xy, atol=1e-7)
        np.testing.assert_array_equal(one.sigma_px, other.sigma_px)
        np.testing.assert_array_equal(one.score, other.score)
    read = read_matches(files[1], PAIRS, actual)
    assert [some.pair for some in read] == PAIRS
    assert [len(some) for some in read] == [3, 0, 0]
    expected = dict(zip(map(tuple, matches[0].indices.tolist()), matches[0].score.tolist()))
    assert dict(zip(map(tuple, read[0].indices.tolist()), read[0].score.tolist())) == expected


def test_hloc_finds_what_it_looks_for(files, keypoints):
    """Names, shapes and conventions of hloc's extract_features, match_features and utils/io."""
    with h5py.File(files[0]) as h5:
        group = h5["left/with space.jpg"]
        np.testing.assert_allclose(group["keypoints"][()] + 0.5, keypoints[1].xy, atol=1e-7)
        assert group["keypoints"].attrs["uncertainty"] == 2.5
        assert group["scores"].shape == (4,)
        np.testing.assert_array_equal(group["image_size"][()], (600, 400))
    with h5py.File(files[1]) as h5:
        group = h5["a.jpg/left-with space.jpg"]
        np.testing.assert_array_equal(group["matches0"][()], [-1, 3, 2, -1, 0])
        np.testing.assert_array_equal(group["matching_scores0"][()], np.float32([0, 0.5, 0.25, 0, 0.9]))
        assert group["matches0"].dtype.kind == "i"
        np.testing.assert_array_equal(h5["a.jpg/right-Köln — 教会.png"]["matches0"][()], [-1] * 5)


def test_only_the_asked_images_and_pairs_are_read(files):
    (second,) = read_features(files[0], IMAGES[1:2])
    assert second.name == NAMES[1] and len(second) == 4
    assert read_matches(files[1], [], [second]) == ()


def write_plain(path: Path, groups: dict[str, dict[str, np.ndarray]]) -> Path:
    with h5py.File(path, "w") as h5:
        for name, fields in groups.items():
            group = h5.create_group(name)
            for field, value in fields.items():
                group[field] = value
    return path


def test_features_as_hloc_writes_them(tmp_path):
    """In half precision, without image size or scores, or with match_dense's `score`."""
    xy = np.array([(599.5, 10.25), (0, 0)])
    path = write_plain(
        tmp_path / "f.h5",
        {NAMES[0]: {"keypoints": xy.astype(np.float16)}, NAMES[1]: {"keypoints": xy, "score": [3.0, 1.0]}},
    )
    with h5py.File(path, "a") as h5:
        h5[NAMES[0]]["keypoints"].attrs["uncertainty"] = 2.0
    first, second = read_features(path, IMAGES[:2])
    np.testing.assert_array_equal(first.xy, [(600, 10.75), (0.5, 0.5)])
    assert first.xy.dtype == np.float32
    np.testing.assert_array_equal(first.sigma_px, [2, 2])
    np.testing.assert_array_equal(first.score, [1, 1])
    np.testing.assert_array_equal(second.sigma_px, [1, 1])
    np.testing.assert_array_equal(second.score, [3, 1])


@pytest.mark.parametrize(
    "group", ["left-with space.jpg/a.jpg", "left-with space.jpg_a.jpg", "a.jpg_left-with space.jpg"]
)
def test_pairs_in_the_other_order_and_of_early_versions(tmp_path, keypoints, group):
    swapped = group.startswith("left")
    partner = np.int16([-1, 4, 0, -1]) if swapped else np.int16([2, -1, -1, -1, 1])
    path = write_plain(tmp_path / "m.h5", {group: {"matches0": partner}})
    (actual,) = read_matches(path, PAIRS[:1], keypoints)
    assert sorted(actual.indices.tolist()) == [[0, 2], [4, 1]]
    np.testing.assert_array_equal(actual.score, [1, 1])


def test_a_shorter_list_and_several_matches_of_a_keypoint(tmp_path, keypoints):
    """match_dense ends its list at the last match, and may match one keypoint of image 1 several times."""
    fields = {"matches0": np.int32([2, 2, 1]), "matching_scores0": np.float16([0.5, 0.75, 0.25])}
    path = write_plain(tmp_path / "m.h5", {"a.jpg/left-with space.jpg": fields})
    (actual,) = read_matches(path, PAIRS[:1], keypoints)
    assert actual.indices.tolist() == [[1, 2], [2, 1]]
    np.testing.assert_array_equal(actual.score, [0.75, 0.25])


@pytest.mark.parametrize("count", [0, 1])
def test_no_match_and_one(tmp_path, keypoints, count):
    fields = {"matches0": np.int32([3] * count), "matching_scores0": np.ones(count)}
    path = write_plain(tmp_path / "m.h5", {"a.jpg/left-with space.jpg": fields})
    (actual,) = read_matches(path, PAIRS[:1], keypoints)
    assert actual.indices.tolist() == [[0, 3]] * count


# What does not fit


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({}, "no keypoints in its group 'a.jpg'"),
        ({"keypoints": np.zeros((3, 4))}, r"must have shape \(K, 2\), found \(3, 4\)"),
        ({"keypoints": np.zeros((3, 2)), "image_size": np.array([400, 600])}, "400 x 600 px.*600 x 400 px"),
        ({"keypoints": np.array([(610.0, 10.0)])}, "outside of 'a.jpg'"),
        ({"keypoints": np.array([(np.nan, 10.0)])}, "outside of 'a.jpg'"),
        ({"keypoints": np.zeros((3, 2)), "scores": np.zeros(2)}, "3 keypoints of 'a.jpg' but scores of shape"),
    ],
)
def test_features_of_another_kind_or_run(tmp_path, fields, message):
    path = write_plain(tmp_path / "features.h5", {NAMES[0]: fields})
    with pytest.raises(InputError, match=f"features.h5.*{message}|{message}.*features.h5"):
        read_features(path, IMAGES[:1])


def test_features_of_other_photos(tmp_path):
    path = write_plain(tmp_path / "features.h5", {"other.jpg": {"keypoints": np.zeros((3, 2))}})
    with pytest.raises(InputError, match=r"features.h5 .* 3 of 3 images, for example 'a.jpg'.*'other.jpg'"):
        read_features(path, IMAGES)
    empty = write_plain(tmp_path / "empty.h5", {})
    with pytest.raises(InputError, match=r"empty.h5 .*'nothing'"):
        read_features(empty, IMAGES)


def test_matches_of_other_pairs(files, keypoints):
    other = [*keypoints, Keypoints("z.jpg", np.zeros((0, 2)), [], [])]
    with pytest.raises(InputError, match=r"matches.h5 lacks 1 of 4 pairs, for example 'a.jpg' and 'z.jpg'"):
        read_matches(files[1], [*PAIRS, ImagePair("a.jpg", "z.jpg")], other)


@pytest.mark.parametrize("side", [0, 1])
def test_matches_of_another_run(files, keypoints, side):
    fewer = list(keypoints)
    fewer[side] = Keypoints(NAMES[side], keypoints[side].xy[:2], [1, 1], [1, 1])
    with pytest.raises(InputError, match=rf"matches.h5 matches keypoint [34] of '{NAMES[side]}', which has 2"):
        read_matches(files[1], PAIRS, fewer)


def test_scores_that_do_not_fit_the_matches(tmp_path, keypoints):
    fields = {"matches0": np.int32([1, 2]), "matching_scores0": np.ones(3)}
    path = write_plain(tmp_path / "m.h5", {"a.jpg/left-with space.jpg": fields})
    with pytest.raises(InputError, match=r"m.h5 has \(2,\) matches but \(3,\) scores"):
        read_matches(path, PAIRS[:1], keypoints)


@pytest.mark.parametrize("content", [None, b"", b"no HDF5"])
def test_files_that_are_missing_or_damaged(tmp_path, keypoints, content):
    path = tmp_path / "file.h5"
    if content is not None:
        path.write_bytes(content)
    for read in (lambda: read_features(path, IMAGES), lambda: read_matches(path, PAIRS, keypoints)):
        with pytest.raises(InputError, match="file.h5"):
            read()


def test_names_that_hloc_cannot_tell_apart(tmp_path):
    names = ["a-b.jpg", "a/b.jpg", "c.jpg"]
    keypoints = [Keypoints(name, np.zeros((0, 2)), [], []) for name in names]
    pairs = [ImagePair("a-b.jpg", "c.jpg")]
    with pytest.raises(InputError, match="'a-b.jpg' and 'a/b.jpg'"):
        write_matches(tmp_path / "m.h5", pairs, keypoints, [])
    assert not list(tmp_path.iterdir())
    write_plain(tmp_path / "m.h5", {"a-b.jpg/c.jpg": {"matches0": np.int32([])}})
    with pytest.raises(InputError, match="'a-b.jpg' and 'a/b.jpg'"):
        read_matches(tmp_path / "m.h5", pairs, keypoints)
