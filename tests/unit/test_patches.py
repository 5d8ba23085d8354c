"""Scores of patches."""

import numpy as np
import pytest

from hm_sfm.matching.patches import scale_from_score, score_from_scale
from hm_sfm.network.backbone import LightBackbone


def test_scores_are_probabilities_of_less_than_a_pixel():
    score = score_from_scale(np.log([1e-3, 0.5, 50.0]), LightBackbone.fine_grid)
    np.testing.assert_allclose(score, [1.0, 1 - np.exp(-1), 0.01], atol=1e-3)


def test_the_scale_of_a_score_gives_the_score():
    grid = LightBackbone.fine_grid
    for score in (0.1, 0.5, 0.9):
        assert score_from_scale(np.array([scale_from_score(score, grid)]), grid)[0] == pytest.approx(score)
