"""Points of one image, placed in another by the homographies of the verified patches around them."""

from dataclasses import dataclass, replace

import numpy as np

from hm_sfm.config import KeypointConfig
from hm_sfm.geometry.homographies import apply_homographies, differentiate
from hm_sfm.geometry.nearest import find_nearest, find_pairs_within
from hm_sfm.keypoints.adjustment import weigh_scores
from hm_sfm.keypoints.graph import Photo, PropagatedPoints
from hm_sfm.keypoints.seeds import thin_points
from hm_sfm.types import PairMatches

AGREEMENT_PX = 0.5
"""Distance from the mean at which what a patch says of a point counts half."""
AGREEMENT_ROUNDS = 3
MIN_AGREEMENT = 0.8
"""Share of the patches, by weight, that must agree: at the edges of things, where depth jumps, they don't."""


@dataclass(frozen=True)
class PatchTransfer:
    """The verified patches of a pair in one direction, in px at the matching resolution."""

    centre: np.ndarray
    """(P, 2) in the image that points are propagated from."""
    homography: np.ndarray
    """(P, 3, 3)."""
    score: np.ndarray
    """(P,) in [0, 1], as in PairMatches."""


def make_transfers(matches: PairMatches, px_scale0: float, px_scale1: float) -> tuple[PatchTransfer, PatchTransfer]:
    """The transfers of verified matches, from image 0 to image 1 and back. px_scale0, px_scale1: see Photo."""
    scale0, scale1 = np.diag([px_scale0, px_scale0, 1.0]), np.diag([px_scale1, px_scale1, 1.0])
    forward = np.linalg.inv(scale1) @ matches.homography.astype(np.float64) @ scale0
    centre0, centre1 = matches.xy0 / px_scale0, matches.xy1 / px_scale1
    return PatchTransfer(centre0, forward, matches.score), PatchTransfer(centre1, np.linalg.inv(forward), matches.score)


def propagate_points(
    xy: np.ndarray,
    transfer: PatchTransfer,
    target_xy: np.ndarray,
    free: np.ndarray,
    target: Photo,
    config: KeypointConfig,
) -> PropagatedPoints:
    """Place points of one image in another, the target, one to one with the keypoints there.

    xy: (N, 2) points, target_xy: (K, 2) keypoints of the target, px of the graph; free: (K,) bool, the keypoints that
    no point of this pair has joined yet. A point is placed by the patches within propagation_radius_px. It joins the
    free keypoint within join_radius_px where each is the other's nearest. It starts a new keypoint where none lies
    within separation_px, free or not, and no other new one with a better score. All others are dropped, and so are
    points that end outside of the target or in its masked pixels.
    """
    placed = transfer_points(xy, transfer, config.propagation_radius_px)
    placed = placed.select(target.allows(placed.predicted))
    nearest, distance = find_nearest(placed.predicted, target_xy, config.separation_px)

    joins = (distance <= config.join_radius_px) & np.append(free, False)[nearest]  # no neighbour is -1, never free
    order = np.lexsort((distance, ~joins))
    _, first = np.unique(nearest[order], return_index=True)
    best = np.zeros(len(nearest), bool)
    best[order[first]] = True
    joins &= best

    starts = np.flatnonzero(nearest < 0)
    starts = starts[np.argsort(-placed.score[starts], kind="stable")]
    starts = starts[thin_points(placed.predicted[starts], config.separation_px)]

    kept = np.sort(np.concatenate([np.flatnonzero(joins), starts]))
    return replace(placed, target=np.where(joins, nearest, -1)).select(kept)


def transfer_points(xy: np.ndarray, transfer: PatchTransfer, radius: float) -> PropagatedPoints:
    """Where the patches within `radius` put points: the robust mean of what they say, near patches counting more.

    xy: (N, 2) px of the graph. Returns the points that any patch covers and whose patches agree, without targets; the
    score is the mean score of a point's patches times the share of them that agrees.
    """
    at, patch, distance = find_pairs_within(xy, transfer.centre, radius)
    point, slot = np.unique(at, return_inverse=True)
    homography = transfer.homography[patch]
    says = apply_homographies(homography, xy[at]).astype(np.float64)
    prior = weigh_scores(transfer.score[patch]) * (1.05 - distance / radius)
    trust, predicted = prior, np.zeros((len(point), 2))
    for _ in range(AGREEMENT_ROUNDS):
        predicted = mean_in_groups(says, slot, trust, len(point))
        apart = np.linalg.norm(says - predicted[slot], axis=1)
        trust = prior / (1 + (apart / AGREEMENT_PX) ** 2)
    jacobian = mean_in_groups(differentiate(homography, xy[at]).reshape(-1, 4), slot, trust, len(point))
    share = np.bincount(slot, trust, len(point)) / np.bincount(slot, prior, len(point))
    score = mean_in_groups(transfer.score[patch][:, None], slot, prior, len(point))[:, 0] * share
    placed = PropagatedPoints(point, np.full(len(point), -1), predicted, jacobian.reshape(-1, 2, 2), score)
    return placed.select(share >= MIN_AGREEMENT)


def mean_in_groups(values: np.ndarray, group: np.ndarray, weight: np.ndarray, count: int) -> np.ndarray:
    """Weighted means of values (N, D) by group (N,) int64: (count, D)."""
    total = np.bincount(group, weight, count)
    sums = [np.bincount(group, weight * column, count) for column in values.T]
    return np.stack(sums, axis=1) / np.maximum(total, 1e-12)[:, None]
