"""What is known of patches."""

import numpy as np
import torch

from hm_sfm.network.estimates import PatchEstimates, accuracy_from_scale


def test_accuracies_are_probabilities_of_less_than_a_pixel():
    accuracy = accuracy_from_scale(torch.tensor([1e-3, 0.5, 50.0]).log())
    np.testing.assert_allclose(accuracy, [1.0, 1 - np.exp(-1), 0.01], atol=1e-3)


def test_the_score_is_that_of_an_accurate_match_at_the_right_place():
    def make(accuracy: list[float], place: list[float]) -> PatchEstimates:
        count = len(accuracy)
        cell = torch.zeros(count, 2, dtype=torch.int64)
        return PatchEstimates(cell, cell, torch.eye(3).expand(count, 3, 3), *map(torch.tensor, (accuracy, place)))

    both = PatchEstimates.concatenate([make([0.8, 0.5], [0.5, 1.0]), make([0.2], [0.1])])
    torch.testing.assert_close(both.score, torch.tensor([0.4, 0.5, 0.02]))
    torch.testing.assert_close(both.select(torch.tensor([2, 0])).accuracy, torch.tensor([0.2, 0.8]))
