"""Stage 4: persistent keypoints. Verified patch matches carry each keypoint from image to image.

Pairs are walked strongest first. In a pair every keypoint of the first image that lies in a verified patch is propagated
by that patch's homography into the second; every keypoint of the second that is left over is propagated back by the
inverse; patches that hold no keypoint yet seed one at a well-localised pixel. A propagated point joins a keypoint that
is already there, or founds one. Afterwards tracks are formed, adjusted jointly and thinned to the budget.

Coordinates within this module are px of the matching resolution ("units"), or finer ones where a second fine pass
made the keypoints sharper, see hm_sfm.keypoints.refinement; results are px of the stored images.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
from tqdm import tqdm

from hm_sfm.config import KeypointConfig
from hm_sfm.geometry.frames import px_from_pixel_index
from hm_sfm.geometry.nearest import find_nearest, find_pairs_within
from hm_sfm.keypoints.adjustment import Anchors, adjust_keypoints, measure_residuals, weigh_scores
from hm_sfm.keypoints.selection import select_keypoints
from hm_sfm.keypoints.tracks import label_tracks, measure_lengths
from hm_sfm.photos.images import PreparedImage
from hm_sfm.types import ImagePair, IndexMatches, Keypoints, PairMatches, apply_homographies

SEED_CELL_PX = 8
MIN_PROPAGATING = 100
"""Matches of a pair that carry keypoints, however good they are."""
AGREEMENT_PX = 0.5
"""Distance from the mean at which a patch's say on a propagated point counts half."""
AGREEMENT_ROUNDS = 3
ANCHOR_PX = 1.0
"""How far from an exact seed a keypoint may be founded that is meant to be the same point."""
LEAST_AGREEMENT = 0.8
"""Share of the patches, by weight, that must agree: at the edges of things, where depth jumps, they don't."""


@dataclass(frozen=True)
class Photo:
    """What persistence needs to know of an image."""

    name: str
    size_wh: tuple[int, int]
    """Px of the stored image."""
    px_scale: float
    """Px of the stored image per unit."""
    seeds: np.ndarray
    """(N, 2) px of the stored image: well-localised points, best first."""
    hides: Callable[[np.ndarray], np.ndarray] | None = None
    """(N, 2) px of the stored image -> (N,) bool: where no keypoint may be, in masked pixels; None: nowhere."""
    finer: float = 1.0
    """Units per px of the matching resolution."""
    seeds_are_exact: bool = False
    """Whether a detector located the seeds to a fraction of a pixel, so that keypoints near them are held there."""

    def allows(self, xy: np.ndarray) -> np.ndarray:
        """(N,) bool: whether keypoints may lie at xy, (N, 2) units: within the image and not masked."""
        inside = np.all((xy >= 0) & (xy < np.array(self.size_wh) / self.px_scale), axis=1)
        if self.hides:
            # Rounded as Keypoints are: the edge of a mask must not lie between.
            inside[inside] = ~self.hides((xy[inside] * self.px_scale).astype(np.float32))
        return inside


@dataclass(frozen=True)
class PatchTransfer:
    """The verified patches of a pair in one direction, in units."""

    centre: np.ndarray
    """(P, 2) in the image that points are propagated from."""
    homography: np.ndarray
    """(P, 3, 3)."""
    score: np.ndarray
    """(P,)."""


@dataclass(frozen=True)
class PropagatedPoints:
    """Points that a PatchTransfer could place in the other image."""

    point: np.ndarray
    """(C,) int64: which of the given points."""
    target: np.ndarray
    """(C,) int64: the keypoint it joins, -1 where it founds a new one."""
    predicted: np.ndarray
    """(C, 2) units."""
    jacobian: np.ndarray
    """(C, 2, 2): how the prediction moves with the point."""
    score: np.ndarray
    """(C,)."""

    def select(self, chosen: np.ndarray) -> "PropagatedPoints":
        """Those that `chosen`, (C,) bool, names."""
        return PropagatedPoints(*(getattr(self, field.name)[chosen] for field in fields(self)))


@dataclass(frozen=True)
class TrackEdges:
    """Predictions between the keypoints of two images: target[e] from source[e]."""

    source_image: int
    target_image: int
    source: np.ndarray
    target: np.ndarray
    """(E,) int64, indices into the two images' keypoints."""
    propagated: PropagatedPoints

    def select(self, chosen: np.ndarray) -> "TrackEdges":
        """Those that `chosen`, (E,) bool, names."""
        ends = {"source": self.source[chosen], "target": self.target[chosen]}
        return replace(self, **ends, propagated=self.propagated.select(chosen))


@dataclass(frozen=True)
class KeypointGraph:
    """All keypoints, and what was predicted of them: tracks in the making."""

    photos: tuple[Photo, ...]
    xy: tuple[np.ndarray, ...]
    """By photo, (K, 2) units."""
    links: tuple[TrackEdges, ...]


@dataclass(frozen=True)
class SettledTracks:
    """All keypoints, those of one image after those of the other, and all links between them, one after another."""

    image: np.ndarray
    """(K,) int64: index of the photo."""
    label: np.ndarray
    """(K,) int64: the track."""
    xy: np.ndarray
    """(K, 2) units, adjusted."""
    sigma: np.ndarray
    """(K,) units."""
    kept: np.ndarray
    """(K,) bool: in a track of two images or more, and within the budget."""
    source: np.ndarray
    target: np.ndarray
    """(E,) int64, indices into all keypoints."""
    score: np.ndarray
    """(E,)."""
    used: np.ndarray
    """(E,) bool: links between kept keypoints that agree with them."""


class GrowingKeypoints:
    """The keypoints of one image while pairs are walked: xy (K, 2) units."""

    def __init__(self) -> None:
        self.xy = np.zeros((0, 2))

    def append(self, xy: np.ndarray) -> np.ndarray:
        """Add keypoints (N, 2); returns their indices (N,) int64."""
        first = len(self.xy)
        self.xy = np.concatenate([self.xy, xy])
        return np.arange(first, len(self.xy))

    def settle(self, propagated: PropagatedPoints) -> np.ndarray:
        """The keypoints that propagated points end at (C,) int64: joined ones, or new ones that they found."""
        target = propagated.target.copy()
        target[target < 0] = self.append(propagated.predicted[target < 0])
        return target


def find_seeds(image: PreparedImage) -> np.ndarray:
    """The best-localised pixel (Shi-Tomasi) of each 8 x 8 px cell.

    Returns (N, 2) float64 px of the stored image, best first.
    """
    height, width = image.grey.shape
    rows, columns = height // SEED_CELL_PX, width // SEED_CELL_PX
    response = cv2.cornerMinEigenVal(image.grey, blockSize=3, ksize=3)
    cells = response[: rows * SEED_CELL_PX, : columns * SEED_CELL_PX]
    cells = cells.reshape(rows, SEED_CELL_PX, columns, SEED_CELL_PX).transpose(0, 2, 1, 3).reshape(rows, columns, -1)
    best = cells.argmax(axis=2)
    y = np.arange(rows)[:, None] * SEED_CELL_PX + best // SEED_CELL_PX
    x = np.arange(columns)[None, :] * SEED_CELL_PX + best % SEED_CELL_PX
    xy = px_from_pixel_index(np.stack([x, y], axis=-1).reshape(-1, 2))
    order = np.argsort(-cells.max(axis=2).ravel(), kind="stable")
    stored = image.stored_from_scaled
    return xy[order] @ stored[:2, :2].T + stored[:2, 2]


def thin_points(xy: np.ndarray, spacing: float) -> np.ndarray:
    """(N,) bool: keep points that have no earlier point within `spacing`; xy: (N, 2), best first."""
    later, earlier, _ = find_pairs_within(xy, xy, spacing)
    keep = np.ones(len(xy), bool)
    keep[later[earlier < later]] = False
    return keep


def choose_good(score: np.ndarray, least_score: float, at_least: int) -> np.ndarray:
    """Which of a pair's matches or links to use, by their scores (N,): (N,) bool.

    Those of least_score or more: a track is as exact as its worst observation. Where fewer are, the best at_least.
    """
    good = score >= least_score
    good[np.argsort(-score, kind="stable")[:at_least]] = True
    return good


def make_transfers(matches: PairMatches, px_scale0: float, px_scale1: float) -> tuple[PatchTransfer, PatchTransfer]:
    """The transfers of verified matches, from image 0 to image 1 and back."""
    scale0, scale1 = np.diag([px_scale0, px_scale0, 1.0]), np.diag([px_scale1, px_scale1, 1.0])
    forward = np.linalg.inv(scale1) @ matches.homography.astype(np.float64) @ scale0
    centre0, centre1 = matches.xy0 / px_scale0, matches.xy1 / px_scale1
    return PatchTransfer(centre0, forward, matches.score), PatchTransfer(centre1, np.linalg.inv(forward), matches.score)


def propagate_points(
    xy: np.ndarray, transfer: PatchTransfer, there_xy: np.ndarray, free: np.ndarray, there: Photo, config: KeypointConfig,
) -> PropagatedPoints:  # fmt: skip
    """Place points of one image in the other, one to one with what is there.

    xy: (N, 2) units; there_xy: (K, 2) keypoints of the other image, free (K,) bool: not yet graph in this pair;
    there: the other image. A point is propagated by the patches within propagation_radius_px. It joins the free keypoint
    within join_radius_px where each is the other's nearest; it founds a keypoint where none lies within
    separation_px, free or not, nor a better-scored founder; otherwise, and outside of the image and in its masked
    pixels, it is dropped.
    """
    point, predicted, jacobian, score = transfer_points(xy, transfer, config.propagation_radius_px)
    inside = there.allows(predicted)
    point, predicted, jacobian, score = point[inside], predicted[inside], jacobian[inside], score[inside]

    nearest, distance = find_nearest(predicted, there_xy, config.separation_px)
    # Index -1, no neighbour, meets the appended False.
    joins = (distance <= config.join_radius_px) & np.append(free, False)[nearest]
    order = np.lexsort((distance, ~joins))
    _, first = np.unique(nearest[order], return_index=True)
    best = np.zeros(len(point), bool)
    best[order[first]] = True
    joins &= best
    founds = np.flatnonzero(nearest < 0)
    founds = founds[np.argsort(-score[founds], kind="stable")]
    founds = founds[thin_points(predicted[founds], config.separation_px)]
    kept = np.sort(np.concatenate([np.flatnonzero(joins), founds]))
    target = np.where(joins[kept], nearest[kept], -1)
    return PropagatedPoints(point[kept], target, predicted[kept], jacobian[kept], score[kept])


def transfer_points(
    xy: np.ndarray, transfer: PatchTransfer, radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Where the patches within `radius` put points: the robust mean of what they say, near patches counting more.

    xy: (N, 2) units. Returns point (C,) int64, the points that any patch covers and whose patches agree, predicted
    (C, 2), jacobian (C, 2, 2) and score (C,): the patches' mean score times the share of them that agrees.
    """
    at, patch, distance = find_pairs_within(xy, transfer.centre, radius)
    point, slot = np.unique(at, return_inverse=True)
    homography = transfer.homography[patch]
    says = apply_homographies(homography, xy[at]).astype(np.float64)
    prior = weigh_scores(transfer.score[patch]) * (1.05 - distance / radius)
    trust = prior
    for _ in range(AGREEMENT_ROUNDS):
        predicted = mean_in_groups(says, slot, trust, len(point))
        apart = np.linalg.norm(says - predicted[slot], axis=1)
        trust = prior / (1 + (apart / AGREEMENT_PX) ** 2)
    jacobian = mean_in_groups(differentiate(homography, xy[at]).reshape(-1, 4), slot, trust, len(point))
    share = np.bincount(slot, trust, len(point)) / np.bincount(slot, prior, len(point))
    score = mean_in_groups(transfer.score[patch][:, None], slot, prior, len(point))[:, 0] * share
    agreed = share >= LEAST_AGREEMENT
    return point[agreed], predicted[agreed], jacobian.reshape(-1, 2, 2)[agreed], score[agreed]


def mean_in_groups(values: np.ndarray, group: np.ndarray, weight: np.ndarray, count: int) -> np.ndarray:
    """Weighted means of values (N, D) by group (N,) int64: (count, D)."""
    total = np.bincount(group, weight, count)
    sums = [np.bincount(group, weight * column, count) for column in values.T]
    return np.stack(sums, axis=1) / np.maximum(total, 1e-12)[:, None]


def differentiate(homography: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """(N, 2, 2): the derivative of homography i (N, 3, 3) at point i (N, 2)."""
    ones = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    x, y, w = np.einsum("nij,nj->in", homography, ones)
    top = homography[:, :2, :2] * w[:, None, None] - np.stack([x, y], 1)[:, :, None] * homography[:, 2:, :2]
    return top / w[:, None, None] ** 2


def persist_keypoints(
    photos: Sequence[Photo],
    ranked_pairs: Sequence[ImagePair],
    read_verified: Callable[[ImagePair], PairMatches],
    config: KeypointConfig,
    quiet: bool = False,
) -> tuple[tuple[Keypoints, ...], tuple[IndexMatches, ...]]:
    """Carry keypoints through all pairs, form tracks, adjust them and thin them out: propagate_keypoints, finish_keypoints.

    Returns the Keypoints of every image, and the IndexMatches of every pair that shares tracks.
    """
    return finish_keypoints(propagate_keypoints(photos, ranked_pairs, read_verified, config, quiet), config)


def propagate_keypoints(
    photos: Sequence[Photo],
    ranked_pairs: Sequence[ImagePair],
    read_verified: Callable[[ImagePair], PairMatches],
    config: KeypointConfig,
    quiet: bool = False,
) -> KeypointGraph:
    """Seed keypoints and carry them through all pairs.

    photos: in the order of the result; ranked_pairs: strongest first, the first image of a pair (the one that
    seeds) is the one in more and stronger pairs; read_verified: the matches of a pair that agree with its two-view
    geometry.
    """
    index_of = {photo.name: i for i, photo in enumerate(photos)}
    growing = [GrowingKeypoints() for _ in photos]
    seeds = []
    for photo in photos:
        units = photo.seeds / photo.px_scale
        units = units[photo.allows(units)]
        seeds.append(units[thin_points(units, config.separation_px)])
    strength = np.zeros(len(photos))
    for place, pair in enumerate(ranked_pairs):
        strength[[index_of[pair.name0], index_of[pair.name1]]] += len(ranked_pairs) - place
    links: list[TrackEdges] = []
    for pair in tqdm(ranked_pairs, desc="keypoints", unit="pair", disable=quiet):
        ends = index_of[pair.name0], index_of[pair.name1]
        matches = read_verified(pair)
        # Exact seeds are few, and matches of them sure.
        least_score = 0.0 if photos[ends[0]].seeds_are_exact else config.propagation_min_score
        matches = matches.select(choose_good(matches.score, least_score, MIN_PROPAGATING))
        transfers = make_transfers(matches, *(photos[i].px_scale for i in ends))
        turn = strength[ends[1]] > strength[ends[0]]
        first, second = ends[::-1] if turn else ends
        links += propagate_pair(
            first, second, transfers[::-1] if turn else transfers, photos, growing, seeds[first], config
        )
    return KeypointGraph(tuple(photos), tuple(keypoints.xy for keypoints in growing), tuple(links))


def propagate_pair(
    first: int, second: int, transfers: tuple[PatchTransfer, PatchTransfer], photos: Sequence[Photo],
    growing: list[GrowingKeypoints], seeds: np.ndarray, config: KeypointConfig,
) -> list[TrackEdges]:  # fmt: skip
    """Carry the keypoints of `first` into `second`, those left over in `second` back, then seed; grows both."""
    here, there = growing[first], growing[second]

    old_there = len(there.xy)
    onward = propagate_points(here.xy, transfers[0], there.xy, np.ones(old_there, bool), photos[second], config)
    onward_links = TrackEdges(first, second, onward.point, there.settle(onward), onward)

    free_here = np.ones(len(here.xy), bool)
    free_here[onward_links.source] = False
    left = np.setdiff1d(np.arange(old_there), onward_links.target)
    back = propagate_points(there.xy[left], transfers[1], here.xy, free_here, photos[first], config)
    back_links = TrackEdges(second, first, left[back.point], here.settle(back), back)

    covered, _ = find_nearest(seeds, here.xy, config.seed_spacing_px)
    fresh = seeds[covered < 0]
    # A seed in first founds its partner in second; one that would join has a neighbour that was propagated back.
    no_partner = np.zeros(len(there.xy), bool)
    seeded = propagate_points(fresh, transfers[0], there.xy, no_partner, photos[second], config)
    seed_links = TrackEdges(first, second, here.append(fresh[seeded.point]), there.settle(seeded), seeded)
    return [onward_links, back_links, seed_links]


def finish_keypoints(
    graph: KeypointGraph, config: KeypointConfig
) -> tuple[tuple[Keypoints, ...], tuple[IndexMatches, ...]]:
    """From links to consistent tracks, adjusted positions, and the keypoints that the budget keeps.

    Returns the Keypoints of every image, and the IndexMatches of every pair that shares tracks.
    """
    photos, tracks = graph.photos, settle_tracks(graph, config)
    image, kept = tracks.image, tracks.kept
    length = measure_lengths(tracks.label)
    keypoints = []
    for i, photo in enumerate(photos):
        mine = kept & (image == i)
        quality = (length[mine] / len(photos)).clip(0, 1)
        xy, sigma = tracks.xy[mine] * photo.px_scale, tracks.sigma[mine] * photo.px_scale
        keypoints.append(Keypoints(photo.name, xy, sigma, quality))
    kept_start = np.concatenate([[0], np.cumsum(np.bincount(image[kept], minlength=len(photos)))])
    index = np.cumsum(kept) - 1 - kept_start[image]
    used = tracks.used
    matches = group_matches(photos, image, index, tracks.source[used], tracks.target[used], tracks.score[used])
    return tuple(keypoints), matches


def prune_edges(graph: KeypointGraph, config: KeypointConfig) -> KeypointGraph:
    """The links alone that finish_keypoints would make matches of; all keypoints stay, with or without links."""
    used = settle_tracks(graph, config).used
    ends = np.cumsum([len(links.source) for links in graph.links])
    links = [
        links.select(of_links)
        for links, of_links in zip(graph.links, np.split(used, ends[:-1]) if graph.links else ())
        if of_links.any()
    ]
    return replace(graph, links=tuple(links))


def settle_tracks(graph: KeypointGraph, config: KeypointConfig) -> SettledTracks:
    """Form tracks, adjust them jointly, give up the links that disagree then, and choose the keypoints to keep."""
    photos, links = graph.photos, graph.links
    counts = [len(xy) for xy in graph.xy]
    start = np.concatenate([[0], np.cumsum(counts)])
    image = np.repeat(np.arange(len(photos)), counts)
    xy = np.concatenate([np.zeros((0, 2)), *graph.xy])
    source = np.concatenate([np.zeros(0, np.int64)] + [start[link.source_image] + link.source for link in links])
    target = np.concatenate([np.zeros(0, np.int64)] + [start[link.target_image] + link.target for link in links])
    predicted = np.concatenate([np.zeros((0, 2))] + [link.propagated.predicted for link in links])
    jacobian = np.concatenate([np.zeros((0, 2, 2))] + [link.propagated.jacobian for link in links])
    score = np.concatenate([np.zeros(0)] + [link.propagated.score for link in links]).astype(np.float64)

    label = label_tracks(len(xy), source, target, score, image)
    same = label[source] == label[target]
    moved, sigma = adjust_keypoints(
        xy,
        source[same],
        target[same],
        predicted[same],
        jacobian[same],
        weigh_scores(score[same]),
        config.adjustment_rounds,
        find_anchors(photos, graph.xy),
    )
    residual = measure_residuals(xy, moved, source, target, predicted, jacobian)
    finer = np.repeat([photo.finer for photo in photos], counts)
    agreed = same & (residual <= config.join_radius_px * finer[target])
    label = label_tracks(len(xy), source[agreed], target[agreed], score[agreed], image)

    inside = [photo.allows(moved[a:b]) for photo, a, b in zip(photos, start[:-1], start[1:])]
    inside = np.concatenate([np.zeros(0, bool), *inside])
    length = measure_lengths(label)
    kept = inside & (length >= 2)
    spread = moved[kept] / finer[kept, None]
    kept[kept] = select_keypoints(label[kept], length[kept], sigma[kept], spread, image[kept], config.max_keypoints)
    used = agreed & (label[source] == label[target]) & kept[source] & kept[target]
    return SettledTracks(image, label, moved, sigma, kept, source, target, score, used)


def find_anchors(photos: Sequence[Photo], xy: Sequence[np.ndarray]) -> Anchors:
    """The exact seeds that lie within ANCHOR_PX of a keypoint, each the other's nearest.

    xy: by photo, (K, 2) units; the anchors' indices count the keypoints of all photos.
    """
    keypoint, places, first = [np.zeros(0, np.int64)], [np.zeros((0, 2))], 0
    for photo, points in zip(photos, xy):
        if photo.seeds_are_exact:
            seeds = photo.seeds / photo.px_scale
            nearest, _ = find_nearest(points, seeds, ANCHOR_PX * photo.finer)
            back, _ = find_nearest(seeds, points, ANCHOR_PX * photo.finer)
            held = np.flatnonzero(np.append(back, -1)[nearest] == np.arange(len(points)))
            keypoint.append(first + held)
            places.append(seeds[nearest[held]])
        first += len(points)
    return Anchors(np.concatenate(keypoint), np.concatenate(places))


def group_matches(
    photos: Sequence[Photo], image: np.ndarray, index: np.ndarray, source: np.ndarray, target: np.ndarray,
    score: np.ndarray,
) -> tuple[IndexMatches, ...]:  # fmt: skip
    """TrackEdges between kept keypoints as IndexMatches per pair of images, each match once."""
    names = np.array([photo.name for photo in photos], dtype=object)
    swap = np.array([names[a] > names[b] for a, b in zip(image[source], image[target])], dtype=bool)
    low, high = np.where(swap, target, source), np.where(swap, source, target)
    order = np.lexsort((-score, high, low, image[high], image[low]))
    low, high, score = low[order], high[order], score[order]
    once = np.ones(len(low), bool)
    once[1:] = (np.diff(low) != 0) | (np.diff(high) != 0)
    low, high, score = low[once], high[once], score[once]
    pair_key = image[low] * len(photos) + image[high]
    matches = []
    for rows in np.split(np.arange(len(low)), np.flatnonzero(np.diff(pair_key)) + 1):
        if len(rows):
            pair = ImagePair(names[image[low[rows[0]]]], names[image[high[rows[0]]]])
            matches.append(IndexMatches(pair, np.stack([index[low[rows]], index[high[rows]]], axis=1), score[rows]))
    return tuple(matches)
