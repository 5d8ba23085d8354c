"""Stage 4: the verified pairs and matches that other photos agree with.

Two photos cannot tell a facade from its twin, nor refute a match that lies on the right epipolar line. A third one can.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pycolmap
from tqdm import tqdm

from hm_sfm.colmap.verification import VerifiedPair
from hm_sfm.config import VerificationConfig
from hm_sfm.judgement.beliefs import choose_believed, weigh_pairs
from hm_sfm.judgement.matches import PatchMap, map_patches, vote_on_matches
from hm_sfm.judgement.rotations import LOOP_DEG, estimate_rotation, measure_rotation_loops
from hm_sfm.judgement.triangles import Triangles, find_triangles
from hm_sfm.types import ImagePair, PairMatches

MOST_LOOPS = 10
"""Loops of matches per pair, the strongest ones: the time of all grows with the number of pairs alone."""
CONFIRMED = 0.6
"""Share of its matches that loops through believed pairs must confirm for a doubted pair to stay, with these alone."""
HELD_PAIRS = 1000
"""Pairs whose matches stay in memory."""
UNSEEN = 5
"""Matches that close, added to those of each loop: few say little."""


@dataclass(frozen=True)
class GivenUpPair:
    """A verified pair that loops through other photos contradict."""

    verified: VerifiedPair
    belief: float
    """In [0, 1], higher is better: how far the pair was believed."""


@dataclass(frozen=True)
class Judgement:
    """What is left of the verified pairs, and what isn't."""

    pairs: dict[ImagePair, VerifiedPair]
    """The pairs that are kept, with the matches that no majority of loops denies."""
    given_up: tuple[GivenUpPair, ...]
    """The least believed first."""
    denied_matches: int
    """Of the kept pairs."""


@dataclass(frozen=True)
class _Votes:
    """What L loops say of the M matches of a pair."""

    triangle: np.ndarray
    """(L,) int64."""
    votes: np.ndarray
    """(L, M) int8, see vote_on_matches."""


def judge_pairs(
    verified: Mapping[ImagePair, VerifiedPair],
    read: Callable[[ImagePair], PairMatches],
    cameras: Mapping[str, pycolmap.Camera],
    px_scale: Mapping[str, float],
    config: VerificationConfig,
    quiet: bool = False,
) -> Judgement:
    """Judge all verified pairs and their matches by the loops that they make with others.

    read: gives all matches of a pair. cameras, px_scale: by image name, as in verify_pairs. Pairs in no triangle are
    kept as they are.
    """
    pairs = sorted(verified)
    names = sorted({name for pair in pairs for name in (pair.name0, pair.name1)})
    number = {name: i for i, name in enumerate(names)}
    ends = np.array([(number[pair.name0], number[pair.name1]) for pair in pairs], np.int64).reshape(-1, 2)
    inliers = np.array([np.count_nonzero(verified[pair].inliers) for pair in pairs])
    triangles = find_triangles(ends)

    @lru_cache(HELD_PAIRS)
    def map_pair(i: int) -> tuple[PatchMap, PatchMap]:
        pair = pairs[i]
        matches = read(pair).select(verified[pair].inliers)
        return map_patches(matches, px_scale[pair.name0], px_scale[pair.name1])

    in_triangles = np.unique(triangles.pairs)
    rotations = np.full((len(pairs), 3, 3), np.nan)
    for i in tqdm(in_triangles.tolist(), desc="rotations", unit="pair", disable=quiet):
        pair = pairs[i]
        limit_px = config.max_error_px * max(px_scale[pair.name0], px_scale[pair.name1])
        matches = read(pair).select(verified[pair].inliers)
        rotations[i] = estimate_rotation(matches, cameras[pair.name0], cameras[pair.name1], limit_px)
    votes = _collect_votes(triangles, inliers, ends, map_pair, config.max_error_px, quiet)
    closed = _measure_closing(measure_rotation_loops(rotations, triangles), votes, len(triangles))
    belief, against = weigh_pairs(inliers, triangles, closed)
    believed = choose_believed(ends, belief, against)
    kept, judged, denied = believed.copy(), {}, 0
    for i, pair in enumerate(pairs):
        # Loops are heard if the two other pairs are believed.
        corners = triangles.pairs[votes[i].triangle]
        heard = votes[i].votes[(believed[corners] | (corners == i)).all(axis=1)].sum(axis=0, dtype=np.int64)
        agreed = heard >= 0 if believed[i] else heard > 0
        kept[i] |= np.count_nonzero(agreed) >= max(config.min_inliers, CONFIRMED * len(agreed))
        if kept[i]:
            judged[pair] = _keep_matches(verified[pair], agreed)
            denied += int(np.count_nonzero(~agreed))
    lost = np.flatnonzero(~kept)
    lost = lost[np.argsort(belief[lost], kind="stable")]
    given_up = tuple(GivenUpPair(verified[pairs[i]], float(belief[i])) for i in lost.tolist())
    return Judgement(judged, given_up, denied)


def _keep_matches(verified: VerifiedPair, agreed: np.ndarray) -> VerifiedPair:
    """The pair with those of its inliers alone that `agreed`, (inliers,) bool, names."""
    inliers = verified.inliers.copy()
    inliers[np.flatnonzero(inliers)[~agreed]] = False
    return VerifiedPair(verified.pair, inliers, verified.strength * float(np.mean(agreed)))


def _collect_votes(
    triangles: Triangles,
    inliers: np.ndarray,
    ends: np.ndarray,
    map_pair: Callable[[int], tuple[PatchMap, PatchMap]],
    max_error_px: float,
    quiet: bool,
) -> list[_Votes]:
    """Of each pair, what its strongest loops say of its matches."""
    corners = triangles.pairs
    loops: list[list[int]] = [[] for _ in inliers]
    for triangle in np.argsort(-inliers[corners].min(axis=1), kind="stable").tolist():
        for pair in corners[triangle].tolist():
            if len(loops[pair]) < MOST_LOOPS:
                loops[pair].append(triangle)
    collected = []
    for pair, own in enumerate(tqdm(loops, desc="loops", unit="pair", disable=quiet)):
        votes = np.zeros((len(own), inliers[pair]), np.int8)
        for row, triangle in enumerate(own):
            first, second = (int(other) for other in corners[triangle] if other != pair)
            a, b = ends[pair].tolist()
            from_a, from_b = (first, second) if a in ends[first] else (second, first)
            # Each pair maps from its lower photo; the third one may be on either side.
            ac = map_pair(from_a)[int(ends[from_a, 0] != a)]
            bc = map_pair(from_b)[int(ends[from_b, 0] != b)]
            votes[row] = vote_on_matches(map_pair(pair)[0], bc, ac, max_error_px)
        collected.append(_Votes(np.array(own, np.int64), votes))
    return collected


def _measure_closing(loop_deg: np.ndarray, votes: Sequence[_Votes], triangles: int) -> np.ndarray:
    """(T,) in [0, 1]: how far triangles close, by their rotations and by the share of the matches that come back."""
    which = np.concatenate([np.zeros(0, np.int64), *(own.triangle for own in votes)])
    closing = np.concatenate([np.zeros(0), *((own.votes > 0).sum(axis=1) for own in votes)])
    open_ = np.concatenate([np.zeros(0), *((own.votes < 0).sum(axis=1) for own in votes)])
    closing, open_ = (np.bincount(which, count, triangles) for count in (closing, open_))
    share = (closing + UNSEEN) / (closing + open_ + UNSEEN)
    return np.exp(-0.5 * np.nan_to_num(loop_deg / LOOP_DEG) ** 2) * share
