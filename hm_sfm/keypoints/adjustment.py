"""Joint keypoint adjustment: all predictions of a track's keypoints reconciled by robust least squares.

A keypoint that was propagated through several pairs has several predictions of its position, each off by the error of
one homography. Together they locate it better than any one of them.
"""

from dataclasses import dataclass

import numpy as np

from hm_sfm.keypoints.graph import FlatGraph

PRIOR_WEIGHT = 0.01
"""Of each keypoint's first position, relative to one prediction: holds a track where its predictions leave it free."""
STEP = 0.6
FULL_TRUST_PX = 0.25
"""Expected error of a prediction at which its weight is a half; 1 is the weight of an exact one."""
ROBUST_SCALE_PX = 0.5
"""Residual, px of the graph, beyond which a prediction loses weight (Cauchy)."""
ANCHOR_WEIGHT = 0.2
"""Of where a detector saw a keypoint: that of a prediction of score 0.86. Heavier ones made models no better."""


@dataclass(frozen=True)
class Anchors:
    """Keypoints that a detector located in their own image, at most once each."""

    keypoint: np.ndarray
    """(A,) int64."""
    xy: np.ndarray
    """(A, 2) px of the graph."""


NO_ANCHORS = Anchors(np.zeros(0, np.int64), np.zeros((0, 2)))


def weigh_scores(score: np.ndarray) -> np.ndarray:
    """Scores (N,) in [0, 1], probabilities of an error below 1 px, -> weights (N,) in (0, 1) for least squares.

    The inverse of the squared error scale b of the Laplace distribution with that probability, 1 - exp(-1 / b).
    """
    scale = -1 / np.log1p(-np.clip(score, 1e-3, 1 - 1e-6).astype(np.float64))
    return FULL_TRUST_PX**2 / (FULL_TRUST_PX**2 + scale**2)


def adjust_keypoints(graph: FlatGraph, rounds: int, anchors: Anchors = NO_ANCHORS) -> tuple[np.ndarray, np.ndarray]:
    """Move keypoints so that they agree with their edges and anchors, in `rounds` rounds.

    Returns the positions (K, 2) float64 and their standard deviations (K,) float64, px of the graph.

    Each round moves every keypoint towards the weighted mean of what its edges, in both directions, say given the
    present positions of the others. The weights follow the scores and the residuals (iteratively reweighted least
    squares).
    """
    inverse = np.linalg.inv(graph.jacobian)
    xy, source, target = graph.xy, graph.source, graph.target
    moved = xy.astype(np.float64).copy()
    count = len(xy)
    ends = np.concatenate([target, source, anchors.keypoint])
    weight = weigh_scores(graph.score)
    weight = np.concatenate([weight, weight, np.full(len(anchors.keypoint), ANCHOR_WEIGHT)])

    def measure(forward: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """How far off each end is, what that end is worth (both as `ends`), and the sum of the latter by keypoint."""
        residual = np.linalg.norm(forward - moved[target], axis=1)
        apart = np.linalg.norm(anchors.xy - moved[anchors.keypoint], axis=1)
        off = np.concatenate([residual, residual, apart])
        trust = weight / (1 + (off / ROBUST_SCALE_PX) ** 2)
        return off, trust, np.bincount(ends, trust, count) + PRIOR_WEIGHT

    for _ in range(rounds):
        forward = predict_targets(graph, moved)
        _, trust, total = measure(forward)
        backward = xy[source] + np.einsum("eij,ej->ei", inverse, moved[target] - graph.predicted)
        says = np.concatenate([forward, backward, anchors.xy])
        for axis in range(2):
            mean = (np.bincount(ends, trust * says[:, axis], count) + PRIOR_WEIGHT * xy[:, axis]) / total
            # Less than a full step: two keypoints that both move to where the other one wants them would swap for ever.
            moved[:, axis] += STEP * (mean - moved[:, axis])

    off, trust, total = measure(predict_targets(graph, moved))
    spread = np.bincount(ends, trust * off**2, count) + PRIOR_WEIGHT * ROBUST_SCALE_PX**2
    return moved, np.sqrt(spread / total / np.maximum(np.bincount(ends, minlength=count), 1))


def predict_targets(graph: FlatGraph, moved: np.ndarray) -> np.ndarray:
    """Where the edges put their targets, (E, 2), once the keypoints have moved from graph.xy to `moved`, (K, 2)."""
    return graph.predicted + np.einsum("eij,ej->ei", graph.jacobian, moved[graph.source] - graph.xy[graph.source])


def measure_residuals(graph: FlatGraph, moved: np.ndarray) -> np.ndarray:
    """(E,) distance from where each edge puts its target to where the target is in `moved`, (K, 2)."""
    return np.linalg.norm(predict_targets(graph, moved) - moved[graph.target], axis=1)
