"""Consistent tracks from the keypoint graph: formed, adjusted jointly, freed of edges that disagree, and selected."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hm_sfm.config import KeypointConfig
from hm_sfm.geometry.nearest import find_nearest
from hm_sfm.keypoints.adjustment import Anchors, adjust_keypoints, measure_residuals
from hm_sfm.keypoints.graph import FlatGraph, KeypointGraph, Photo, flatten_graph
from hm_sfm.keypoints.selection import select_keypoints
from hm_sfm.keypoints.tracks import label_tracks, measure_lengths

ANCHOR_PX = 1.0
"""Px at the matching resolution: how far from an exact seed a keypoint may be that is meant to be the same point."""


@dataclass(frozen=True)
class SettledTracks:
    """The tracks of all keypoints, where these are after the joint adjustment, and which of them are kept."""

    graph: FlatGraph
    """The keypoints where they were first predicted, and all edges."""
    label: np.ndarray
    """(K,) int64: the track."""
    xy: np.ndarray
    """(K, 2) float64 px of the graph, adjusted."""
    sigma: np.ndarray
    """(K,) float64 px of the graph: standard deviation of the position along each axis."""
    kept: np.ndarray
    """(K,) bool: in a track of two images or more, and selected."""
    used: np.ndarray
    """(E,) bool: edges between kept keypoints of one track that agree with both."""


def settle_tracks(graph: KeypointGraph, config: KeypointConfig) -> SettledTracks:
    """Form tracks, adjust them jointly, give up the edges that disagree then, and select the keypoints to keep."""
    flat = flatten_graph(graph)
    label = label_tracks(len(flat.xy), flat.source, flat.target, flat.score, flat.image)
    same = label[flat.source] == label[flat.target]
    anchors = find_anchors(graph.photos, graph.xy)
    moved, sigma = adjust_keypoints(flat.select_edges(same), config.adjustment_rounds, anchors)

    matching_scale = np.array([photo.matching_scale for photo in graph.photos])[flat.image]
    agreed = same & (measure_residuals(flat, moved) <= config.join_radius_px * matching_scale[flat.target])
    edges = flat.select_edges(agreed)
    label = label_tracks(len(flat.xy), edges.source, edges.target, edges.score, flat.image)

    allowed = np.zeros(len(moved), bool)
    for i, photo in enumerate(graph.photos):
        mine = flat.image == i
        allowed[mine] = photo.allows(moved[mine])
    length = measure_lengths(label)
    kept = allowed & (length >= 2)
    matching_xy = moved[kept] / matching_scale[kept, None]
    kept[kept] = select_keypoints(
        label[kept], length[kept], sigma[kept], matching_xy, flat.image[kept], config.max_keypoints
    )
    used = agreed & (label[flat.source] == label[flat.target]) & kept[flat.source] & kept[flat.target]
    return SettledTracks(flat, label, moved, sigma, kept, used)


def prune_edges(graph: KeypointGraph, config: KeypointConfig) -> KeypointGraph:
    """The graph with those edges alone that settle_tracks uses; all keypoints stay, with or without edges."""
    used = settle_tracks(graph, config).used
    ends = np.cumsum([len(edges.source) for edges in graph.edges])
    pruned = [
        edges.select(used_here)
        for edges, used_here in zip(graph.edges, np.split(used, ends[:-1]) if graph.edges else ())
        if used_here.any()
    ]
    return replace(graph, edges=tuple(pruned))


def find_anchors(photos: Sequence[Photo], xy: Sequence[np.ndarray]) -> Anchors:
    """The exact seeds that lie within ANCHOR_PX of a keypoint, each the other's nearest.

    xy: by photo, (K, 2) px of the graph; the anchors' indices count the keypoints of all photos.
    """
    keypoint, places, first = [np.zeros(0, np.int64)], [np.zeros((0, 2))], 0
    for photo, points in zip(photos, xy):
        if photo.seeds_are_exact:
            seeds = photo.seeds / photo.px_scale
            nearest, _ = find_nearest(points, seeds, ANCHOR_PX * photo.matching_scale)
            back, _ = find_nearest(seeds, points, ANCHOR_PX * photo.matching_scale)
            held = np.flatnonzero(np.append(back, -1)[nearest] == np.arange(len(points)))
            keypoint.append(first + held)
            places.append(seeds[nearest[held]])
        first += len(points)
    return Anchors(np.concatenate(keypoint), np.concatenate(places))
