"""Joint keypoint adjustment: all predictions of a track's keypoints reconciled by robust least squares.

A keypoint that was propagated through several pairs has several predictions of its position, each off by the error of
one homography. Together they pin it down better than any of them.
"""

from dataclasses import dataclass

import numpy as np

PRIOR_WEIGHT = 0.01
"""Of each keypoint's first position, relative to one prediction: holds a track where its predictions leave it free."""
STEP = 0.6
FULL_TRUST_PX = 0.25
"""Expected error of a prediction at which its weight is a half; 1 is the weight of an exact one."""
ROBUST_SCALE = 0.5
"""Residual, in the unit of the coordinates, beyond which a prediction loses weight (Cauchy)."""
ANCHOR_WEIGHT = 0.2
"""Of where a detector saw a keypoint: that of a prediction of score 0.86. Heavier ones made models no better."""


@dataclass(frozen=True)
class Anchors:
    """Keypoints that a detector located in their own image, at most once each."""

    keypoint: np.ndarray
    """(A,) int64."""
    xy: np.ndarray
    """(A, 2)."""


NO_ANCHORS = Anchors(np.zeros(0, np.int64), np.zeros((0, 2)))


def weigh_scores(score: np.ndarray) -> np.ndarray:
    """Scores (N,) in [0, 1], probabilities of an error below 1 px, -> weights (N,) in (0, 1) for least squares.

    The inverse of the squared error scale b of the Laplace distribution with that probability, 1 - exp(-1 / b).
    """
    scale = -1 / np.log1p(-np.clip(score, 1e-3, 1 - 1e-6).astype(np.float64))
    return FULL_TRUST_PX**2 / (FULL_TRUST_PX**2 + scale**2)


def adjust_keypoints(
    xy: np.ndarray, source: np.ndarray, target: np.ndarray, predicted: np.ndarray, jacobian: np.ndarray,
    weight: np.ndarray, rounds: int, anchors: Anchors = NO_ANCHORS,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Move keypoints to agree with their links and anchors, in so many rounds.

    xy: (K, 2) positions; link e says that keypoint target[e] lies at predicted[e] + jacobian[e] (x - xy[source[e]])
    when its source lies at x: source, target (E,) int64, predicted (E, 2), jacobian (E, 2, 2), weight (E,).
    Any unit, one for all. Returns the positions (K, 2) float64 and their standard deviations (K,) float64.

    Each round moves every keypoint to the weighted mean of what its links, in both directions, say given the
    present positions of the others; the weights follow the residuals (iteratively reweighted least squares).
    """
    inverse = np.linalg.inv(jacobian)
    moved = xy.astype(np.float64).copy()
    count = len(xy)
    ends = np.concatenate([target, source, anchors.keypoint])
    links_at = np.bincount(ends, minlength=count)
    for number in range(rounds + 1):
        forward = predict_targets(xy, moved, source, predicted, jacobian)
        residual = np.linalg.norm(forward - moved[target], axis=1)
        apart = np.linalg.norm(anchors.xy - moved[anchors.keypoint], axis=1)
        robust = weight / (1 + (residual / ROBUST_SCALE) ** 2)
        anchored = ANCHOR_WEIGHT / (1 + (apart / ROBUST_SCALE) ** 2)
        trust = np.concatenate([robust, robust, anchored])
        total = np.bincount(ends, trust, count) + PRIOR_WEIGHT
        if number == rounds:
            break
        backward = xy[source] + np.einsum("eij,ej->ei", inverse, moved[target] - predicted)
        says = np.concatenate([forward, backward, anchors.xy])
        for axis in range(2):
            mean = (np.bincount(ends, trust * says[:, axis], count) + PRIOR_WEIGHT * xy[:, axis]) / total
            # Less than a full step: two graph keypoints that both move to the other's wish would swap for ever.
            moved[:, axis] += STEP * (mean - moved[:, axis])
    squared = trust * np.concatenate([residual, residual, apart]) ** 2
    spread = np.bincount(ends, squared, count) + PRIOR_WEIGHT * ROBUST_SCALE**2
    return moved, np.sqrt(spread / total / np.maximum(links_at, 1))


def predict_targets(
    xy: np.ndarray, moved: np.ndarray, source: np.ndarray, predicted: np.ndarray, jacobian: np.ndarray
) -> np.ndarray:
    """Where links put their targets, (E, 2), when the sources have moved from xy to `moved`, (K, 2) each."""
    return predicted + np.einsum("eij,ej->ei", jacobian, moved[source] - xy[source])


def measure_residuals(
    xy: np.ndarray, moved: np.ndarray, source: np.ndarray, target: np.ndarray, predicted: np.ndarray,
    jacobian: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """(E,) distance between where a link puts its target and where the target is."""
    return np.linalg.norm(predict_targets(xy, moved, source, predicted, jacobian) - moved[target], axis=1)
