"""The keypoints of all photos and the predictions between them: tracks in the making.

Coordinates are px at the matching resolution until the keypoints are refined, and px at the resolution of refinement
from then on: "px of the graph". Photo.px_scale converts either to px of the stored photo.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np


@dataclass(frozen=True)
class Photo:
    """What persistent keypoints need to know of an image."""

    name: str
    size_wh: tuple[int, int]
    """Px of the stored image."""
    px_scale: float
    """Px of the stored image per px of the graph."""
    seeds: np.ndarray
    """(N, 2) px of the stored image: well-localised points, best first."""
    hides: Callable[[np.ndarray], np.ndarray] | None = None
    """(N, 2) px of the stored image -> (N,) bool: where no keypoint may be, in masked pixels; None: nowhere."""
    matching_scale: float = 1.0
    """Px of the graph per px at the matching resolution: above 1 where the keypoints were refined at a larger size."""
    seeds_are_exact: bool = False
    """Whether a detector located the seeds to a fraction of a pixel, so that keypoints near them are held there."""

    def allows(self, xy: np.ndarray) -> np.ndarray:
        """(N,) bool: whether keypoints may lie at xy, (N, 2) px of the graph: within the image and not masked."""
        inside = np.all((xy >= 0) & (xy < np.array(self.size_wh) / self.px_scale), axis=1)
        if self.hides:
            # Rounded as Keypoints are: the edge of a mask must not lie between.
            inside[inside] = ~self.hides((xy[inside] * self.px_scale).astype(np.float32))
        return inside


@dataclass(frozen=True)
class PropagatedPoints:
    """Points of one image that patches placed in another."""

    point: np.ndarray
    """(C,) int64: which of the given points."""
    target: np.ndarray
    """(C,) int64: the keypoint of the other image that it joins, -1 where it starts a new one."""
    predicted: np.ndarray
    """(C, 2) float64 px of the graph."""
    jacobian: np.ndarray
    """(C, 2, 2) float64: how the prediction moves with the point."""
    score: np.ndarray
    """(C,) in [0, 1], higher is better: the probability that the prediction is off by less than 1 px of the graph."""

    def select(self, chosen: np.ndarray) -> "PropagatedPoints":
        """The chosen ones: (C,) bool, or indices."""
        return PropagatedPoints(*(getattr(self, field.name)[chosen] for field in fields(self)))


@dataclass(frozen=True)
class TrackEdges:
    """Predictions between the keypoints of two images: target[e] is predicted from source[e]."""

    source_image: int
    target_image: int
    source: np.ndarray
    target: np.ndarray
    """(E,) int64, indices into the keypoints of the two images."""
    propagated: PropagatedPoints

    def select(self, chosen: np.ndarray) -> "TrackEdges":
        """The edges that `chosen`, (E,) bool, names."""
        ends = {"source": self.source[chosen], "target": self.target[chosen]}
        return replace(self, **ends, propagated=self.propagated.select(chosen))


@dataclass(frozen=True)
class KeypointGraph:
    """All keypoints, image by image, and the predictions between them."""

    photos: tuple[Photo, ...]
    xy: tuple[np.ndarray, ...]
    """By photo, (K, 2) float64 px of the graph."""
    edges: tuple[TrackEdges, ...]


@dataclass(frozen=True)
class FlatGraph:
    """A KeypointGraph in flat arrays: the K keypoints of all images one after another, and all E edges between them.

    Edge e says that keypoint target[e] lies at predicted[e] + jacobian[e] (x - xy[source[e]]) if its source lies at x.
    """

    image: np.ndarray
    """(K,) int64: index of the photo."""
    xy: np.ndarray
    """(K, 2) float64 px of the graph."""
    source: np.ndarray
    target: np.ndarray
    """(E,) int64 keypoints."""
    predicted: np.ndarray
    """(E, 2) float64 px of the graph."""
    jacobian: np.ndarray
    """(E, 2, 2) float64."""
    score: np.ndarray
    """(E,) float64 in [0, 1], as in PropagatedPoints."""

    def select_edges(self, chosen: np.ndarray) -> "FlatGraph":
        """All keypoints, and the edges that `chosen`, (E,) bool, names."""
        names = ("source", "target", "predicted", "jacobian", "score")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})


def flatten_graph(graph: KeypointGraph) -> FlatGraph:
    """The graph in flat arrays, in the order of its photos and of its edges."""
    counts = [len(xy) for xy in graph.xy]
    first = np.concatenate([[0], np.cumsum(counts)])
    none, edges = np.zeros(0, np.int64), graph.edges
    return FlatGraph(
        image=np.repeat(np.arange(len(graph.photos)), counts),
        xy=np.concatenate([np.zeros((0, 2)), *graph.xy]),
        source=np.concatenate([none] + [first[part.source_image] + part.source for part in edges]),
        target=np.concatenate([none] + [first[part.target_image] + part.target for part in edges]),
        predicted=np.concatenate([np.zeros((0, 2))] + [part.propagated.predicted for part in edges]),
        jacobian=np.concatenate([np.zeros((0, 2, 2))] + [part.propagated.jacobian for part in edges]),
        score=np.concatenate([np.zeros(0)] + [part.propagated.score for part in edges]).astype(np.float64),
    )
