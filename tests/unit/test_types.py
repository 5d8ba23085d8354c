"""What the domain types check and choose."""

import numpy as np
import pytest

from hm_sfm.types import ImagePair, IndexMatches

PAIR = ImagePair("a", "b")


@pytest.mark.parametrize(
    ("indices", "score", "kept"),
    [
        ([(0, 0), (0, 1), (1, 1)], [0.5, 0.9, 0.8], [1]),
        ([(0, 0), (1, 0)], [0.5, 0.5], [0]),
        ([(0, 1), (1, 0)], [0.1, 0.9], [0, 1]),
        (np.zeros((0, 2), int), [], []),
    ],
)
def test_the_best_matches_are_one_to_one(indices, score, kept):
    indices, score = np.array(indices), np.array(score)
    matches = IndexMatches.of_best(PAIR, indices, score)
    np.testing.assert_array_equal(matches.indices, indices[kept])
    np.testing.assert_array_equal(matches.score, score[kept].astype(np.float32))


def test_index_matches_that_repeat_a_keypoint_are_refused():
    with pytest.raises(ValueError, match="not one to one on side 1"):
        IndexMatches(PAIR, [(0, 1), (1, 1)], [1, 1])
