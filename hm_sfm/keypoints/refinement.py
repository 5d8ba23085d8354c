"""Keypoint refinement: the edges between propagated keypoints are predicted anew, each by a patch of its own.

Propagation places keypoints by patches around other points. A patch around the keypoint itself, which starts from what
propagation says, is more exact. Edges that this does not confirm are given up. Refinement looks at photos reduced to
keypoints.refine_long_edge_px, which may be larger than those that were matched: it is as exact as matching at that
size, at a fraction of the cost.
"""

import hashlib
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np
from tqdm import tqdm

from hm_sfm.errors import ConfigError, StaleResultError
from hm_sfm.geometry.homographies import differentiate
from hm_sfm.io.batches import store_in_batches
from hm_sfm.keypoints.graph import KeypointGraph, Photo, TrackEdges
from hm_sfm.keypoints.propagation import choose_good
from hm_sfm.keypoints.refined_patches import PatchRefiner, Placement
from hm_sfm.matching.encoder import Encoder
from hm_sfm.matching.order import order_pairs
from hm_sfm.matching.store import MatchStore
from hm_sfm.network.fine import HomographyHead
from hm_sfm.photos.sizes import measure_px_scale
from hm_sfm.types import ImagePair, ImageRef, PairMatches

REFINED_FILE = "refined.h5"
"""Beside the matches."""
MAX_MOVE_PX = 0.7
"""Px at the matching resolution by which refinement may move a prediction: beyond that, one of the two is wrong."""
MIN_SCORE = 0.1
"""Predictions that refinement gives a lower score stay as propagation made them."""
CONFIRMING_SCORE = 0.7
"""Edges that are confirmed with a lower score, or moved too far, are given up"""
MIN_CONFIRMED = 300
"""where their pair has so many better ones."""


class KeypointRefiner:
    """Predicts the edges of a keypoint graph anew, on photos whose longer sides are reduced to `long_edge_px`.

    encoder: the matcher's. images: the photos of the graph, in its order. matches: the store of the matches that the
    graph was made from; what is refined is kept in REFINED_FILE beside it, pair by pair, and an interrupted run goes on
    from there. cache_mb: memory for the features of photos.

    Raises ConfigError where the network has no homography head.
    """

    def __init__(
        self, encoder: Encoder, images: Sequence[ImageRef], long_edge_px: int, matches: MatchStore, cache_mb: int
    ) -> None:
        if not isinstance(encoder.net.head, HomographyHead):
            raise ConfigError("keypoints.refine_long_edge_px needs network.head homography, found expectation")
        self.patches = PatchRefiner(encoder, images, long_edge_px, cache_mb)
        self.images, self.long_edge_px = tuple(images), long_edge_px
        self.path, self.digests = matches.path.with_name(REFINED_FILE), matches.digests
        self.made_by = {**matches.made_by, "keypoints.refine_long_edge_px": long_edge_px}

    def refine(self, graph: KeypointGraph, quiet: bool = False) -> KeypointGraph:
        """The graph with new predictions, in px of the photos at `long_edge_px`.

        Edges that are not confirmed are given up, but for the best ones of pairs that have few; these stay as they are,
        and count less. Raises what MatchStore.write and prepare_image raise.
        """
        edges_of: dict[ImagePair, list[int]] = {}
        for number, edges in enumerate(graph.edges):
            names = (graph.photos[i].name for i in (edges.source_image, edges.target_image))
            edges_of.setdefault(ImagePair.of(*names), []).append(number)

        def place(pair: ImagePair) -> Placement:
            return locate_edges(graph, pair, edges_of[pair])

        store = self._open_store(map(place, edges_of))
        self._refine_pairs(tuple(edges_of), place, store, quiet)

        photos = tuple(
            rescale_photo(photo, image, self.long_edge_px)
            for photo, image in zip(graph.photos, self.images, strict=True)
        )
        refined = list(graph.edges)
        for pair, numbers in edges_of.items():
            updated = update_pair(graph, photos, pair, numbers, place(pair), store.read(pair))
            for number, edges in zip(numbers, updated):
                refined[number] = edges
        xy = tuple(xy * photo.matching_scale for xy, photo in zip(graph.xy, photos))
        return KeypointGraph(photos, xy, tuple(refined))

    def _open_store(self, placements: Iterable[Placement]) -> MatchStore:
        """What an earlier run refined of exactly these edges; where the file is about others, it is removed."""
        digest = hashlib.sha256()
        for placement in placements:
            for array in (placement.xy0, placement.xy1, placement.linear):
                digest.update(np.ascontiguousarray(array).tobytes())
        made_by = {**self.made_by, "edges": digest.hexdigest()[:16]}
        try:
            return MatchStore(self.path, made_by, self.digests)
        except StaleResultError:
            self.path.unlink(missing_ok=True)
            shutil.rmtree(self.path.with_name(self.path.name + ".parts"), ignore_errors=True)
            return MatchStore(self.path, made_by, self.digests)

    def _refine_pairs(
        self, pairs: Sequence[ImagePair], place: Callable[[ImagePair], Placement], store: MatchStore, quiet: bool
    ) -> None:
        """Refine the pairs that the store lacks, and store them. place: where propagation put their keypoints."""
        missing = order_pairs([pair for pair in pairs if pair not in store], self.patches.cached_photos)
        with store_in_batches(store.write) as keep:
            for pair in tqdm(missing, desc="refinement", unit="pair", disable=quiet or not missing):
                keep([self.patches.refine_pair(pair, place(pair))])
        store.merge()


def rescale_photo(photo: Photo, image: ImageRef, long_edge_px: int) -> Photo:
    """The same photo in px of its size at `long_edge_px`, or at the matching resolution where that is larger."""
    px_scale = min(photo.px_scale, measure_px_scale(image.size_wh, long_edge_px))
    return replace(photo, px_scale=px_scale, matching_scale=photo.px_scale / px_scale)


def locate_edges(graph: KeypointGraph, pair: ImagePair, numbers: Sequence[int]) -> Placement:
    """Where the ends of a pair's edges lie, whichever way they lead. numbers: of its TrackEdges in `graph`."""
    xy0, xy1, linear = [], [], []
    for number in numbers:
        edges = graph.edges[number]
        source, target = graph.photos[edges.source_image], graph.photos[edges.target_image]
        source_xy = graph.xy[edges.source_image][edges.source] * source.px_scale
        target_xy = edges.propagated.predicted * target.px_scale
        jacobian = edges.propagated.jacobian * (target.px_scale / source.px_scale)
        onward = source.name == pair.name0
        xy0.append(source_xy if onward else target_xy)
        xy1.append(target_xy if onward else source_xy)
        linear.append(jacobian if onward else np.linalg.inv(jacobian))
    return Placement(np.concatenate(xy0), np.concatenate(xy1), np.concatenate(linear))


def update_pair(
    graph: KeypointGraph,
    photos: Sequence[Photo],
    pair: ImagePair,
    numbers: Sequence[int],
    placement: Placement,
    refined: PairMatches,
) -> list[TrackEdges]:
    """The edges of a pair as refined, without those that are given up.

    photos: as rescale_photo makes them. numbers: of the pair's TrackEdges in `graph`. placement, refined: of all their
    edges, one after another.
    """
    updated, first = [], 0
    for number in numbers:
        edges = graph.edges[number]
        these = np.arange(first, first + len(edges.source))
        onward = graph.photos[edges.source_image].name == pair.name0
        updated.append(update_edges(edges, photos, onward, placement.select(these), refined.select(these)))
        first += len(these)
    kept = choose_good(np.concatenate([confirmed for _, confirmed in updated]), CONFIRMING_SCORE, MIN_CONFIRMED)
    ends = np.cumsum([len(confirmed) for _, confirmed in updated])[:-1]
    return [edges.select(kept_here) for (edges, _), kept_here in zip(updated, np.split(kept, ends))]


def update_edges(
    edges: TrackEdges, photos: Sequence[Photo], onward: bool, placement: Placement, refined: PairMatches
) -> tuple[TrackEdges, np.ndarray]:
    """The edges as refined, where that is of use, in px of the graph after refinement.

    photos: as rescale_photo makes them. onward: whether the edges lead from the first photo of the pair to the second.
    placement, refined: of these edges. Also returns how well each edge is confirmed, (E,) float64 in [0, 1]: the
    probability that the new prediction is off by less than 1 px at the matching resolution, 0 where it moved too far.
    """
    source, target = photos[edges.source_image], photos[edges.target_image]
    inverse = np.linalg.inv(differentiate(refined.homography.astype(np.float64), placement.xy0))
    if onward:
        predicted, jacobian = refined.xy1, np.linalg.inv(inverse)
    else:
        predicted = placement.xy0 + np.einsum("nij,nj->ni", inverse, placement.xy1 - refined.xy1)
        jacobian = inverse
    predicted = predicted / target.px_scale
    jacobian = jacobian * (source.px_scale / target.px_scale)

    before, scale = edges.propagated, target.matching_scale
    before_predicted = before.predicted * scale
    before_jacobian = before.jacobian * (scale / source.matching_scale)
    # Scores of propagation are about errors of 1 px at the matching resolution. Of the same error scale in smaller px:
    before_score = 1 - (1 - before.score) ** (1 / scale)
    near = np.linalg.norm(predicted - before_predicted, axis=1) <= MAX_MOVE_PX * scale
    useful = near & (refined.score >= MIN_SCORE)
    propagated = replace(
        before,
        predicted=np.where(useful[:, None], predicted, before_predicted),
        jacobian=np.where(useful[:, None, None], jacobian, before_jacobian),
        score=np.where(useful, refined.score, before_score),
    )
    confirmed = np.where(near, 1 - (1 - refined.score.astype(np.float64)) ** scale, 0.0)
    return replace(edges, propagated=propagated), confirmed
