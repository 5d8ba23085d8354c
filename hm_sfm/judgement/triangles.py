"""Triangles of a graph of pairs: three photos of which all three pairs are verified."""

from dataclasses import dataclass

import numpy as np

from hm_sfm.types import freeze_array


@dataclass(frozen=True)
class Triangles:
    """T triangles of photos a < b < c; pairs are counted as they were given."""

    ab: np.ndarray
    bc: np.ndarray
    ac: np.ndarray
    """(T,) int64: the pairs of photos a and b, b and c, a and c."""

    def __post_init__(self) -> None:
        for name in ("ab", "bc", "ac"):
            object.__setattr__(self, name, freeze_array(getattr(self, name), np.int64, (len(self.ab),), name))

    def __len__(self) -> int:
        return len(self.ab)

    @property
    def pairs(self) -> np.ndarray:
        """(T, 3) int64: the three pairs of each triangle."""
        return np.stack([self.ab, self.bc, self.ac], axis=1)


def find_triangles(ends: np.ndarray) -> Triangles:
    """All triangles of a graph. ends: (P, 2) int64, the photos of each pair, the lower number first."""
    pair_of = {(a, b): i for i, (a, b) in enumerate(ends.tolist())}
    followers: dict[int, set[int]] = {}
    for a, b in pair_of:
        followers.setdefault(a, set()).add(b)
    corners = [
        (i, pair_of[b, c], pair_of[a, c])
        for (a, b), i in pair_of.items()
        for c in sorted(followers[a] & followers.get(b, set()))
    ]
    return Triangles(*np.array(corners, np.int64).reshape(-1, 3).T)
