"""What the parts of matching hand to each other, and what they ask of each other."""

from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from hm_sfm.config import ImageConfig, MatchingConfig
from hm_sfm.network.fine import FineMap
from hm_sfm.network.lightglue import KeypointStates
from hm_sfm.photos.images import PreparedImage
from hm_sfm.types import ImageRef, PatchMatches, freeze_array


@dataclass(frozen=True)
class PointPairs:
    """Coarse matches of two images."""

    xy0: np.ndarray
    """(M, 2) float64 px of the network's input of image 0, COLMAP's frame."""
    xy1: np.ndarray
    """(M, 2) float64 px of the network's input of image 1."""
    score: np.ndarray
    """(M,) float32: higher is better. Scores of different providers cannot be compared."""
    linear: np.ndarray | None = None
    """(M, 2, 2) float64: px of image 1 per px of image 0 around each match, from its relative scale and rotation; None
    where the provider does not know them."""
    place: np.ndarray | None = None
    """(M,) float32 in [0, 1]: the probability that the two points are at the same place; None where the provider does
    not know it."""
    grow: Literal["never", "if few", "always"] = "never"
    """Whether matches grow beside these: "if few" are good, see MatchingConfig.grow_below."""

    def __post_init__(self) -> None:
        count = len(self.score)
        object.__setattr__(self, "xy0", freeze_array(self.xy0, np.float64, (count, 2), "xy0"))
        object.__setattr__(self, "xy1", freeze_array(self.xy1, np.float64, (count, 2), "xy1"))
        object.__setattr__(self, "score", freeze_array(self.score, np.float32, (count,), "score"))
        if self.linear is not None:
            object.__setattr__(self, "linear", freeze_array(self.linear, np.float64, (count, 2, 2), "linear"))
        if self.place is not None:
            object.__setattr__(self, "place", freeze_array(self.place, np.float32, (count,), "place"))

    def __len__(self) -> int:
        return len(self.score)

    def keep_best(self, most: int) -> "PointPairs":
        """The `most` matches of the highest score, best first; of equal ones the first."""
        best = np.argsort(-self.score, kind="stable")[:most]
        linear, place = (None if values is None else values[best] for values in (self.linear, self.place))
        return PointPairs(self.xy0[best], self.xy1[best], self.score[best], linear, place, self.grow)


@dataclass(frozen=True)
class ImageKeypoints:
    """What the context stage matches: the K keypoints of an image, best first, K = 0 in an image without texture."""

    xy: Tensor
    """(K, 2) float32 px of the network's input, COLMAP's frame."""
    states: KeypointStates

    @property
    def nbytes(self) -> int:
        """Memory that they take."""
        return sum(tensor.nbytes for tensor in (self.xy, self.states.state, self.states.cos, self.states.sin))


@dataclass(frozen=True)
class ImageFeatures:
    """Features of one image, ready to be matched with those of any other."""

    coarse: Tensor
    """(N, C) float32: the 1/8 cells whose centre lies in the image, as the network's coarse stage describes them."""
    cell: Tensor
    """(N, 2) int64: their grid positions (x, y)."""
    fine: FineMap
    scaled_wh: tuple[int, int]
    stored_from_scaled: np.ndarray
    """(3, 3) float64: px of the network's input -> px of the stored image."""
    image: ImageRef
    keypoints: ImageKeypoints | None = None
    """Where the network matches keypoints in context."""
    description: dict[str, Any] = field(default_factory=dict)
    """What the provider of coarse matches keeps of the image, see CoarseProvider.describe."""

    @property
    def size_bytes(self) -> int:
        """Memory that the features take."""
        described = [value for value in self.description.values() if hasattr(value, "nbytes")]
        keypoints = self.keypoints.nbytes if self.keypoints else 0
        return keypoints + sum(array.nbytes for array in (self.coarse, self.cell, self.fine.cells, *described))


class CoarseProvider(Protocol):
    """What makes coarse matches."""

    def describe(self, image: PreparedImage) -> dict[str, Any]:
        """What the provider keeps of an image, arrays or tensors by name. It becomes ImageFeatures.description."""
        ...

    def match(self, features0: ImageFeatures, features1: ImageFeatures) -> PointPairs:
        """Match two images."""
        ...


class CellMatcher(Protocol):
    """What rotation and scale hypotheses are compared by: coarse matches of small images."""

    def encode(self, image: PreparedImage) -> Tensor:
        """(H, W, C) float32: the cells of an image on their grid."""
        ...

    def match(self, cells0: Tensor, cells1: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Indices of the matched cells of both images, (M,) int64 each, counted row by row, and scores (M,) float32."""
        ...


class PairMatcher(Protocol):
    """What matches the pairs of a run: HomoMatcher, or a matcher to compare it with."""

    config: MatchingConfig
    images: ImageConfig
    device: torch.device
    cell_matcher: CellMatcher | None
    """Compares rotation and scale hypotheses; None where pairs are matched as they are only."""

    def encode(self, image: PreparedImage) -> Any:
        """Features of an image, with their size in memory as `size_bytes`."""
        ...

    def match_features(self, features0: Any, features1: Any) -> PatchMatches:
        """Match two images; coordinates are px of the stored images."""
        ...


@dataclass(frozen=True)
class MatchingTimes:
    """Seconds spent on reading and encoding photos, and on matching pairs."""

    features: float
    match: float
