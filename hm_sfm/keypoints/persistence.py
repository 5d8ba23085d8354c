"""Stage 5: persistent keypoints. The whole chain from verified patch matches to the keypoints of all images.

Keypoints are propagated through the pairs, and the edges pruned to those that tracks will use. A refiner, where there
is one, predicts these anew. Then the tracks are settled, and what is left of the edges are the matches.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from hm_sfm.config import KeypointConfig
from hm_sfm.keypoints.graph import FlatGraph, KeypointGraph, Photo
from hm_sfm.keypoints.propagation import propagate_keypoints
from hm_sfm.keypoints.settled_tracks import prune_edges, settle_tracks
from hm_sfm.keypoints.tracks import measure_lengths
from hm_sfm.types import ImagePair, IndexMatches, Keypoints, PairMatches


class Refiner(Protocol):
    """What predicts the edges of a graph more exactly, see hm_sfm.keypoints.refinement."""

    def refine(self, graph: KeypointGraph, quiet: bool = False) -> KeypointGraph:
        """The same keypoints with better edges, or fewer, in px of a resolution of the refiner's own."""
        ...


def persist_keypoints(
    photos: Sequence[Photo],
    ranked_pairs: Sequence[ImagePair],
    read_verified: Callable[[ImagePair], PairMatches],
    config: KeypointConfig,
    refiner: Refiner | None = None,
    quiet: bool = False,
) -> tuple[tuple[Keypoints, ...], tuple[IndexMatches, ...]]:
    """Persistent keypoints of `photos` and their matches, from the verified matches of the pairs, strongest first.

    photos, ranked_pairs, read_verified: as in propagate_keypoints. Returns what collect_keypoints does, and raises what
    the refiner raises.
    """
    graph = propagate_keypoints(photos, ranked_pairs, read_verified, config, quiet)
    if refiner:
        graph = refiner.refine(prune_edges(graph, config), quiet)  # only what will be used is worth the time
    return collect_keypoints(graph, config)


def collect_keypoints(
    graph: KeypointGraph, config: KeypointConfig
) -> tuple[tuple[Keypoints, ...], tuple[IndexMatches, ...]]:
    """Settle the tracks of a graph.

    Returns the Keypoints of every photo, scored by the share of all photos that their track is seen in, and the
    IndexMatches of every pair that shares tracks.
    """
    photos, tracks = graph.photos, settle_tracks(graph, config)
    image, kept = tracks.graph.image, tracks.kept
    length = measure_lengths(tracks.label)
    keypoints = []
    for i, photo in enumerate(photos):
        mine = kept & (image == i)
        share = (length[mine] / len(photos)).clip(0, 1)
        xy, sigma = tracks.xy[mine] * photo.px_scale, tracks.sigma[mine] * photo.px_scale
        keypoints.append(Keypoints(photo.name, xy, sigma, share))
    kept_start = np.concatenate([[0], np.cumsum(np.bincount(image[kept], minlength=len(photos)))])
    index = np.cumsum(kept) - 1 - kept_start[image]
    matches = group_matches([photo.name for photo in photos], tracks.graph.select_edges(tracks.used), index)
    return tuple(keypoints), matches


def group_matches(names: Sequence[str], graph: FlatGraph, index: np.ndarray) -> tuple[IndexMatches, ...]:
    """The edges of a graph as IndexMatches per pair of images, each match once with its best score.

    names: of the photos; index: (K,) int64, the index of each keypoint within its image.
    """
    image = graph.image
    rank = np.argsort(np.argsort(np.array(names, dtype=object), kind="stable"))
    swap = rank[image[graph.source]] > rank[image[graph.target]]
    low, high = np.where(swap, graph.target, graph.source), np.where(swap, graph.source, graph.target)
    order = np.lexsort((-graph.score, high, low, image[high], image[low]))
    low, high, score = low[order], high[order], graph.score[order]
    once = np.ones(len(low), bool)
    once[1:] = (np.diff(low) != 0) | (np.diff(high) != 0)
    low, high, score = low[once], high[once], score[once]
    pair_key = image[low] * len(names) + image[high]
    matches = []
    for rows in np.split(np.arange(len(low)), np.flatnonzero(np.diff(pair_key)) + 1):
        if len(rows):
            pair = ImagePair(*(names[int(image[side[rows[0]]])] for side in (low, high)))
            matches.append(IndexMatches(pair, np.stack([index[low[rows]], index[high[rows]]], axis=1), score[rows]))
    return tuple(matches)
