"""Keypoints placed a second time: a fine pass over what was propagated, each keypoint in the middle of a patch of its own.

Patches carry the keypoints around their centres. What was propagated is placed again by a patch around the keypoint itself,
starting from what the first homographies say, which is more exact; links that this does not confirm are given up. The
second pass looks at photos of keypoints.refine_long_edge_px, which may be larger than those that were matched: it is as exact as
matching at that size, without its cost.
"""

import dataclasses
import hashlib
import math
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from hm_sfm.errors import ConfigError, StaleResultError
from hm_sfm.io.batches import store_in_batches
from hm_sfm.keypoints.propagation import KeypointGraph, Photo, TrackEdges, choose_good, differentiate
from hm_sfm.matching.hypotheses import IDENTITY, Hypothesis, apply_hypothesis
from hm_sfm.matching.matcher import (
    HomoMatcher,
    autocast,
    cell_to_px,
    computes_in_half,
    make_start,
    pad_image,
    round_to_cells,
    score_from_scale,
)
from hm_sfm.matching.order import order_pairs
from hm_sfm.matching.store import MatchStore
from hm_sfm.network.fine import FineMap, HomographyHead, make_fine_map
from hm_sfm.network.homography import is_regular
from hm_sfm.photos.images import PreparedImage, prepare_image
from hm_sfm.types import ImagePair, ImageRef, PairMatches

STRIP_PX = 1024
"""Large photos are encoded in strips of so many rows, to bound the memory,"""
MARGIN_PX = 128
"""with so many more on each side as the network looks around. Both are multiples of any backbone's stride."""
ITERATIONS = 1
"""Updates of the homographies, which start near the truth: a second one changes nothing that can be measured."""
FARTHEST = 0.7
"""Px of the matching resolution by which the second pass may move a prediction: farther, one of the two is wrong."""
LEAST_SCORE = 0.1
"""Predictions of a lower score stay as the first pass made them."""
CONFIRMING_SCORE = 0.7
"""TrackEdges of a lower score, or moved too far, are given up"""
MIN_EDGES = 300
"""where their pair has so many better ones."""


@dataclass(frozen=True)
class RefinementFeatures:
    """Fine features of a photo at its native resolution."""

    fine: FineMap
    stored_from_scaled: np.ndarray
    """(3, 3) float64: px of the network's input -> px of the stored image."""
    downscale: float = 1
    """See Hypothesis."""


@dataclass(frozen=True)
class Placement:
    """A pair's propagated keypoints where the first pass put them, from the first photo of the pair to the second.

    Several TrackEdges of the pair one after another; px of the stored images.
    """

    xy0: np.ndarray
    """(N, 2)."""
    xy1: np.ndarray
    """(N, 2)."""
    linear: np.ndarray
    """(N, 2, 2): how xy1 moves with xy0."""

    def select(self, chosen: slice) -> "Placement":
        """Those that `chosen` names."""
        return Placement(self.xy0[chosen], self.xy1[chosen], self.linear[chosen])


def refine_keypoints(
    graph: KeypointGraph,
    images: Sequence[ImageRef],
    matcher: HomoMatcher,
    refine_long_edge_px: int,
    store_path: Path,
    made_by: Mapping[str, Any],
    digests: Mapping[str, str],
    quiet: bool = False,
) -> KeypointGraph:
    """All links as a second fine pass predicts them, in px of photos of `refine_long_edge_px` along their longer sides.

    images: the photos of `graph`, in its order. store_path: keeps what is done, pair by pair; an interrupted run goes
    on from there. made_by, digests: the settings and the photos that the links depend on, see MatchStore.

    TrackEdges that the second pass does not confirm are given up, but for the best ones of pairs that have few; these stay as
    they are, and count less. Raises ConfigError where the network has no homography head, and what MatchStore.write and
    prepare_image raise.
    """
    if not isinstance(matcher.net.head, HomographyHead):
        raise ConfigError("keypoints.refine_long_edge_px needs network.head homography, found expectation")
    members: dict[ImagePair, list[int]] = {}
    for at, links in enumerate(graph.links):
        names = sorted(graph.photos[i].name for i in (links.source_image, links.target_image))
        members.setdefault(ImagePair(*names), []).append(at)

    def place(pair: ImagePair) -> Placement:
        return locate_edges(graph, pair, members[pair])

    store = open_refinement_store(store_path, map(place, members), made_by, digests)
    refine_pairs(tuple(members), place, images, matcher, store, refine_long_edge_px, quiet)

    native = tuple(
        refine_px_scale(photo, image, refine_long_edge_px) for photo, image in zip(graph.photos, images, strict=True)
    )
    sharpened = list(graph.links)
    for pair, numbers in members.items():
        placement, found, first, updated = place(pair), store.read(pair), 0, []
        for at in numbers:
            links = graph.links[at]
            these = slice(first, first + len(links.source))
            onward = graph.photos[links.source_image].name == pair.name0
            updated.append(update_edges(links, native, onward, placement.select(these), found.select(these)))
            first = these.stop
        kept = choose_good(np.concatenate([sure for _, sure in updated]), CONFIRMING_SCORE, MIN_EDGES)
        ends = np.cumsum([len(sure) for _, sure in updated])[:-1]
        for at, (links, _), of_links in zip(numbers, updated, np.split(kept, ends)):
            sharpened[at] = links.select(of_links)
    xy = tuple(xy * photo.finer for xy, photo in zip(graph.xy, native))
    return KeypointGraph(native, xy, tuple(sharpened))


def refine_px_scale(photo: Photo, image: ImageRef, refine_long_edge_px: int) -> Photo:
    """The same photo in px of the native resolution, or of the matching resolution where that is no coarser."""
    px_scale = min(photo.px_scale, max(1.0, max(image.size_wh) / refine_long_edge_px))
    return dataclasses.replace(photo, px_scale=px_scale, finer=photo.px_scale / px_scale)


def locate_edges(graph: KeypointGraph, pair: ImagePair, members: Sequence[int]) -> Placement:
    """Where the pair's links lie, whichever way they lead."""
    xy0, xy1, linear = [], [], []
    for at in members:
        links = graph.links[at]
        source, target = graph.photos[links.source_image], graph.photos[links.target_image]
        here = graph.xy[links.source_image][links.source] * source.px_scale
        there = links.propagated.predicted * target.px_scale
        jacobian = links.propagated.jacobian * (target.px_scale / source.px_scale)
        onward = source.name == pair.name0
        xy0.append(here if onward else there)
        xy1.append(there if onward else here)
        linear.append(jacobian if onward else np.linalg.inv(jacobian))
    return Placement(np.concatenate(xy0), np.concatenate(xy1), np.concatenate(linear))


def open_refinement_store(
    path: Path, placed: Iterable[Placement], made_by: Mapping[str, Any], digests: Mapping[str, str]
) -> MatchStore:
    """What an earlier run has done of exactly these links; where it did others, they are removed."""
    digest = hashlib.sha256()
    for placement in placed:
        for array in (placement.xy0, placement.xy1, placement.linear):
            digest.update(np.ascontiguousarray(array).tobytes())
    made_by = {**made_by, "links": digest.hexdigest()[:16]}
    try:
        return MatchStore(path, made_by, digests)
    except StaleResultError:
        path.unlink(missing_ok=True)
        shutil.rmtree(path.with_name(path.name + ".parts"), ignore_errors=True)
        return MatchStore(path, made_by, digests)


def refine_pairs(
    pairs: Sequence[ImagePair],
    place: Callable[[ImagePair], Placement],
    images: Sequence[ImageRef],
    matcher: HomoMatcher,
    store: MatchStore,
    refine_long_edge_px: int,
    quiet: bool,
) -> None:
    """Store what the second pass says of the pairs that the store lacks. place: where the first one put their links."""
    missing = [pair for pair in pairs if pair not in store]
    image_of = {image.name: image for image in images}
    largest = max((math.prod(size_at(image, refine_long_edge_px)) for image in images), default=1)
    bytes_per_number = 2 if computes_in_half(matcher.device) else 4
    bytes_per_px = bytes_per_number * matcher.net.backbone.fine_channels / matcher.net.backbone.fine_grid.stride**2
    capacity = max(2, int(matcher.config.feature_cache_mb * 1e6 / (largest * bytes_per_px)))

    @lru_cache(maxsize=capacity)
    def encode(name: str, hypothesis: Hypothesis) -> RefinementFeatures:
        return encode_for_refinement(matcher, prepare_image(image_of[name], refine_long_edge_px), hypothesis)

    with store_in_batches(store.write) as keep:
        for pair in tqdm(order_pairs(missing, capacity), desc="second pass", unit="pair", disable=quiet or not missing):
            names, placement = (pair.name0, pair.name1), place(pair)
            hypotheses = fit_hypotheses(relate_inputs(*(encode(name, IDENTITY) for name in names), placement))
            keep([refine_pair(matcher, *map(encode, names, hypotheses), pair, placement)])
    store.merge()


def relate_inputs(features0: RefinementFeatures, features1: RefinementFeatures, placement: Placement) -> np.ndarray:
    """(N, 2, 2): how points of the network's second input move with those of the first."""
    scaled_from_stored1 = np.linalg.inv(features1.stored_from_scaled)
    return scaled_from_stored1[:2, :2] @ placement.linear @ features0.stored_from_scaled[:2, :2]


def fit_hypotheses(linear: np.ndarray) -> tuple[Hypothesis, Hypothesis]:
    """How to show two photos so that patches of one lie upright, and in about the same scale, in the other.

    linear: (N, 2, 2), see relate_inputs. The second photo is turned by quarters, the closer one reduced by powers of 2.
    """
    along, across = np.median(linear[:, 0, 0] + linear[:, 1, 1]), np.median(linear[:, 1, 0] - linear[:, 0, 1])
    rotation_deg = -90 * round(np.rad2deg(np.arctan2(across, along)) / 90) % 360
    octaves = round(np.log2(np.sqrt(np.median(np.abs(np.linalg.det(linear))))))
    return Hypothesis(downscale=2 ** max(0, -octaves)), Hypothesis(rotation_deg, 2 ** max(0, octaves))


def size_at(image: ImageRef, refine_long_edge_px: int) -> tuple[float, float]:
    """(w, h) of a photo whose longer side is reduced to refine_long_edge_px."""
    scale = min(1.0, refine_long_edge_px / max(image.size_wh))
    return image.size_wh[0] * scale, image.size_wh[1] * scale


@torch.inference_mode()
def encode_for_refinement(
    matcher: HomoMatcher, image: PreparedImage, hypothesis: Hypothesis = IDENTITY
) -> RefinementFeatures:
    """The fine features of a photo, strip by strip: what the backbone makes of the whole, but for the last digits."""
    image = apply_hypothesis(image, hypothesis)
    backbone = matcher.net.backbone
    pixels = pad_image(torch.tensor(image.grey, device=matcher.device), backbone.stride, backbone.standardised)
    stride, height = backbone.fine_grid.stride, pixels.shape[2]
    strips = []
    for top in range(0, height, STRIP_PX):
        first, last = max(0, top - MARGIN_PX), min(height, top + STRIP_PX + MARGIN_PX)
        with autocast(matcher.device):
            fine = backbone(pixels[:, :, first:last]).fine
        bottom = min(height, top + STRIP_PX)
        strips.append(fine[:, :, (top - first) // stride : (bottom - first) // stride])
    return RefinementFeatures(make_fine_map(torch.cat(strips, dim=2)), image.stored_from_scaled, hypothesis.downscale)


@torch.inference_mode()
def refine_pair(
    matcher: HomoMatcher,
    features0: RefinementFeatures,
    features1: RefinementFeatures,
    pair: ImagePair,
    placement: Placement,
) -> PairMatches:
    """The second pass over a pair: in the order of `placement`; the score is 0 where a patch is of no use.

    The score is the probability that a match is off by less than 1 px of the native resolution.
    """
    grid, head = matcher.net.backbone.fine_grid, matcher.net.head
    scaled0, scaled1 = (np.linalg.inv(features.stored_from_scaled) for features in (features0, features1))
    xy0, xy1 = (
        xy @ scaled[:2, :2].T + scaled[:2, 2] for xy, scaled in ((placement.xy0, scaled0), (placement.xy1, scaled1))
    )
    linear = relate_inputs(features0, features1, placement)
    cell0, rest0 = round_to_cells(xy0, grid)
    cell1, rest1 = round_to_cells(xy1, grid)
    start = make_start(rest0, rest1, linear, head.half).to(matcher.device)
    cells = cell0.to(matcher.device), cell1.to(matcher.device)
    homography, log_scale = matcher.estimate_patches(features0.fine, features1.fine, *cells, start, ITERATIONS)
    regular = is_regular(homography, head.half).cpu().numpy()

    stored0 = features0.stored_from_scaled @ cell_to_px(cell0.numpy(), grid)
    stored1 = features1.stored_from_scaled @ cell_to_px(cell1.numpy(), grid)
    between = stored1 @ homography.cpu().numpy().astype(np.float64) @ np.linalg.inv(stored0)
    between[~regular] = np.eye(3)
    at = np.einsum("nij,nj->ni", between, np.concatenate([placement.xy0, np.ones((len(between), 1))], axis=1))
    score = score_from_scale(log_scale.cpu().numpy().astype(np.float64), grid)
    if features1.downscale > 1:  # a pixel of its native resolution is less than one of the input
        score = 1 - (1 - score) ** (1 / features1.downscale)
    px_per_cell = np.sqrt(abs(np.linalg.det(features0.stored_from_scaled[:2, :2]))) * grid.stride
    return PairMatches(
        pair=pair,
        xy0=placement.xy0,
        xy1=at[:, :2] / at[:, 2:],
        score=np.where(regular, score, 0.0),
        homography=between / at[:, 2, None, None],
        patch_radius_px=float(head.half * px_per_cell),
    )


def update_edges(
    links: TrackEdges, native: Sequence[Photo], onward: bool, placement: Placement, found: PairMatches
) -> tuple[TrackEdges, np.ndarray]:
    """TrackEdges in px of the native resolution, as the second pass predicts them where it is of use.

    onward: they lead from the first photo of the pair to the second; placement, found: of these links. Also returns how
    sure the second pass is of each, (E,): the probability that it is off by less than 1 px of the matching resolution, 0
    where it moved the link too far.
    """
    source, target = native[links.source_image], native[links.target_image]
    inverse = np.linalg.inv(differentiate(found.homography.astype(np.float64), placement.xy0))
    if onward:
        predicted, jacobian = found.xy1, np.linalg.inv(inverse)
    else:
        predicted = placement.xy0 + np.einsum("nij,nj->ni", inverse, placement.xy1 - found.xy1)
        jacobian = inverse
    predicted = predicted / target.px_scale
    jacobian = jacobian * (source.px_scale / target.px_scale)

    first = links.propagated
    kept = first.predicted * target.finer
    moved = np.linalg.norm(predicted - kept, axis=1)
    near = moved <= FARTHEST * target.finer
    useful = near & (found.score >= LEAST_SCORE)
    # The first pass speaks of 1 px of the matching resolution: the same error scale, in finer px.
    dulled = 1 - (1 - first.score) ** (1 / target.finer)
    propagated = dataclasses.replace(
        first,
        predicted=np.where(useful[:, None], predicted, kept),
        jacobian=np.where(useful[:, None, None], jacobian, first.jacobian * (target.finer / source.finer)),
        score=np.where(useful, found.score, dulled),
    )
    sure = np.where(near, 1 - (1 - found.score.astype(np.float64)) ** target.finer, 0.0)
    return dataclasses.replace(links, propagated=propagated), sure
