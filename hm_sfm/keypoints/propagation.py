"""Keypoints propagated from image to image by verified patch matches.

Pairs are walked strongest first. In a pair, every keypoint of the first image that lies in a verified patch is
propagated into the second image by that patch's homography. Every keypoint of the second image that is left over is
propagated back by the inverse. Patches that hold no keypoint yet start one at a seed, of the first image and then of
the second. A propagated point joins a keypoint that is already there, or starts a new one.
"""

from collections.abc import Callable, Sequence

import numpy as np
from tqdm import tqdm

from hm_sfm.config import KeypointConfig
from hm_sfm.geometry.nearest import find_nearest
from hm_sfm.keypoints.graph import KeypointGraph, Photo, PropagatedPoints, TrackEdges
from hm_sfm.keypoints.seeds import thin_points
from hm_sfm.keypoints.transfer import PatchTransfer, make_transfers, propagate_points
from hm_sfm.types import ImagePair, PairMatches

MIN_PROPAGATING = 100
"""Matches of a pair that propagate keypoints, however low their scores are."""


class GrowingKeypoints:
    """The keypoints of one image while pairs are walked: xy (K, 2) float64 px at the matching resolution."""

    def __init__(self) -> None:
        self.xy = np.zeros((0, 2))

    def append(self, xy: np.ndarray) -> np.ndarray:
        """Add keypoints (N, 2); returns their indices (N,) int64."""
        first = len(self.xy)
        self.xy = np.concatenate([self.xy, xy])
        return np.arange(first, len(self.xy))

    def settle(self, propagated: PropagatedPoints) -> np.ndarray:
        """(C,) int64: the keypoints that propagated points join or, added here, start."""
        target = propagated.target.copy()
        target[target < 0] = self.append(propagated.predicted[target < 0])
        return target


def propagate_keypoints(
    photos: Sequence[Photo],
    ranked_pairs: Sequence[ImagePair],
    read_verified: Callable[[ImagePair], PairMatches],
    config: KeypointConfig,
    quiet: bool = False,
) -> KeypointGraph:
    """Start keypoints at seeds and propagate them through all pairs.

    photos: in the order of the result. ranked_pairs: strongest first. Of a pair, the image that is in more and
    stronger pairs starts keypoints first. read_verified: the matches of a pair that agree with its two-view geometry.
    """
    index_of = {photo.name: i for i, photo in enumerate(photos)}
    growing = [GrowingKeypoints() for _ in photos]
    seeds = [place_seeds(photo, config.separation_px) for photo in photos]
    strength = np.zeros(len(photos))
    for place, pair in enumerate(ranked_pairs):
        strength[[index_of[pair.name0], index_of[pair.name1]]] += len(ranked_pairs) - place
    edges: list[TrackEdges] = []
    for pair in tqdm(ranked_pairs, desc="keypoints", unit="pair", disable=quiet):
        ends = index_of[pair.name0], index_of[pair.name1]
        matches = read_verified(pair)
        # Matches of exact seeds are few and reliable.
        min_score = 0.0 if photos[ends[0]].seeds_are_exact else config.propagation_min_score
        matches = matches.select(choose_good(matches.score, min_score, MIN_PROPAGATING))
        transfers = make_transfers(matches, *(photos[i].px_scale for i in ends))
        if strength[ends[1]] > strength[ends[0]]:
            ends, transfers = (ends[1], ends[0]), (transfers[1], transfers[0])
        edges += propagate_pair(*ends, transfers, photos, growing, (seeds[ends[0]], seeds[ends[1]]), config)
    return KeypointGraph(tuple(photos), tuple(keypoints.xy for keypoints in growing), tuple(edges))


def place_seeds(photo: Photo, separation_px: float) -> np.ndarray:
    """(N, 2) px at the matching resolution: the seeds where a keypoint may be, none too near to a better one."""
    xy = photo.seeds / photo.px_scale
    xy = xy[photo.allows(xy)]
    return xy[thin_points(xy, separation_px)]


def choose_good(score: np.ndarray, min_score: float, at_least: int) -> np.ndarray:
    """Which matches or edges of a pair to use, by their scores (N,): (N,) bool.

    Those of min_score or more, since a track is only as exact as its worst observation. Where there are fewer than
    `at_least` of them, the best `at_least`.
    """
    good = score >= min_score
    good[np.argsort(-score, kind="stable")[:at_least]] = True
    return good


def propagate_pair(
    first: int, second: int, transfers: tuple[PatchTransfer, PatchTransfer], photos: Sequence[Photo],
    growing: list[GrowingKeypoints], seeds: tuple[np.ndarray, np.ndarray], config: KeypointConfig,
) -> list[TrackEdges]:  # fmt: skip
    """Propagate the keypoints of `first` into `second` and those left over in `second` back, then start new ones.

    Adds to the keypoints of both images in `growing`. seeds: of both images, (N, 2) each, as place_seeds gives them.
    """
    here, there = growing[first], growing[second]

    old_there = len(there.xy)
    onward = propagate_points(here.xy, transfers[0], there.xy, np.ones(old_there, bool), photos[second], config)
    onward_edges = TrackEdges(first, second, onward.point, there.settle(onward), onward)

    free_here = np.ones(len(here.xy), bool)
    free_here[onward_edges.source] = False
    left = np.setdiff1d(np.arange(old_there), onward_edges.target)
    back = propagate_points(there.xy[left], transfers[1], here.xy, free_here, photos[first], config)
    back_edges = TrackEdges(second, first, left[back.point], here.settle(back), back)

    seeded_edges = []
    for a, b, transfer, points in ((first, second, transfers[0], seeds[0]), (second, first, transfers[1], seeds[1])):
        covered, _ = find_nearest(points, growing[a].xy, config.seed_spacing_px)
        fresh = points[covered < 0]
        # A seed starts a keypoint in both images: one that it could join has a neighbour here, which came from there.
        no_partner = np.zeros(len(growing[b].xy), bool)
        seeded = propagate_points(fresh, transfer, growing[b].xy, no_partner, photos[b], config)
        source = growing[a].append(fresh[seeded.point])
        seeded_edges.append(TrackEdges(a, b, source, growing[b].settle(seeded), seeded))
    return [onward_edges, back_edges, *seeded_edges]
