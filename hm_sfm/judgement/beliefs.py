"""How far each pair is believed to show one place, decided for all pairs of the collection together."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from hm_sfm.judgement.triangles import Triangles

SURE_INLIERS = 100
"""With so many inliers a pair is believed to the half before other pairs are asked."""
ROUNDS = 20
GIVEN_UP = 0.4
"""A pair that is believed less than this, and that loops contradict, is given up."""
CONTRADICTION = 0.1
"""Weight of the open loops that a pair must have to be given up: without them nothing speaks against it."""


def weigh_pairs(inliers: np.ndarray, triangles: Triangles, closed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Belief in each pair, (P,) in [0, 1], and the weight (P,) of the loops that speak against it.

    inliers: (P,) verified matches of each pair; closed: (T,) in [0, 1], how far each triangle closes.

    A triangle speaks for or against a pair as far as its other two pairs are believed: beliefs are iterated, from what
    the inliers alone say.
    """
    alone = inliers / (inliers + SURE_INLIERS)
    corners = triangles.pairs
    others = corners[:, [[1, 2], [0, 2], [0, 1]]]
    belief, against = alone, np.zeros(len(inliers))
    for _ in range(ROUNDS):
        weight = belief[others].prod(axis=2)
        total = np.bincount(corners.ravel(), weight.ravel(), len(inliers))
        support = np.bincount(corners.ravel(), (weight * closed[:, None]).ravel(), len(inliers))
        belief, against = (alone + support) / (1 + total), total - support
    return belief, against


def choose_believed(ends: np.ndarray, belief: np.ndarray, against: np.ndarray) -> np.ndarray:
    """(P,) bool: the pairs to keep.

    ends: (P, 2) int64, the photos of each pair. Pairs without which photos would fall apart that all pairs hold
    together are kept, the most believed first. Mapping may still leave out a photo that too few pairs are left of.
    """
    kept = (belief >= GIVEN_UP) | (against < CONTRADICTION)
    photos = ends.max(initial=-1) + 1
    for pair in np.flatnonzero(~kept)[np.argsort(-belief[~kept], kind="stable")]:
        graph = coo_array((np.ones(kept.sum()), tuple(ends[kept].T)), shape=(photos, photos))
        part = connected_components(graph, directed=False)[1]
        kept[pair] = part[ends[pair, 0]] != part[ends[pair, 1]]
    return kept
