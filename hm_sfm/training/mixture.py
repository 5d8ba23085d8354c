"""Several kinds of training pairs in one data set, and batches of them."""

from collections.abc import Sequence

import numpy as np
from torch import Tensor
from torch.utils.data import Dataset, default_collate

from hm_sfm.types import TrainingPairs


class MixedPairs(Dataset):
    """Items of several data sets of the same length, drawn by their shares; deterministic per seed and index."""

    def __init__(self, kinds: Sequence[tuple[TrainingPairs, float]], seed: int) -> None:
        self.kinds = [pairs for pairs, share in kinds if share > 0]
        self.shares = np.array([share for _, share in kinds if share > 0])
        self.seed = seed

    def __len__(self) -> int:
        return len(self.kinds[0])

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        draw = np.random.default_rng([self.seed, index, 2]).random() * self.shares.sum()
        kind = int(np.searchsorted(self.shares.cumsum(), draw, side="right"))
        return self.kinds[kind][index]


def collate_pairs(items: Sequence[dict[str, np.ndarray]]) -> dict[str, Tensor]:
    """One batch of items.

    Kinds of pairs differ in their number of surfaces: b_from_a (P, 3, 3) of each item is padded to the longest with
    zeros, which no pixel refers to.
    """
    longest = max(len(item["b_from_a"]) for item in items)
    return default_collate(
        [
            item | {"b_from_a": np.pad(item["b_from_a"], ((0, longest - len(item["b_from_a"])), (0, 0), (0, 0)))}
            for item in items
        ]
    )
