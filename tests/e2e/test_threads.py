"""What the number of threads changes: nothing where it is the same, and little where it is not."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch


@pytest.fixture
def threads() -> Iterator[None]:
    """The test may change the number of PyTorch's threads."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("count", [1, 2])
def test_equal_numbers_of_threads_match_byte_for_byte(count, threads, scene, tmp_path, run, read_matches):
    torch.set_num_threads(count)
    first, second = tmp_path / "first", tmp_path / "second"
    for out in (first, second):
        assert run("match", scene.images, out).code == 0
    expected, actual = (read_matches(out / "matches.h5") for out in (first, second))
    assert actual.keys() == expected.keys() and len(expected) == 10
    for pair, fields in expected.items():
        assert all(actual[pair][field].tobytes() == data.tobytes() for field, data in fields.items()), pair


def test_98_of_100_matches_stay_within_a_tenth_of_a_pixel_with_more_threads(
    threads, scene, tmp_path, run, read_matches
):
    matches = []
    for count in (1, 2):
        torch.set_num_threads(count)
        assert run("match", scene.images, tmp_path / str(count)).code == 0
        matches.append(read_matches(tmp_path / str(count) / "matches.h5"))
    one, two = matches
    assert one.keys() == two.keys()
    for pair in one:
        points, others = (np.column_stack([fields[pair]["xy0"], fields[pair]["xy1"]]) for fields in matches)
        distance = np.abs(points[:, None] - others).max(axis=2)
        assert len(points) > 100 and len(others) > 100
        assert np.mean(distance.min(axis=1) < 0.1) > 0.98, pair
        assert np.mean(distance.min(axis=0) < 0.1) > 0.98, pair
