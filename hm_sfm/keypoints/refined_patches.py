"""Patches around propagated keypoints, estimated by the network: what keypoint refinement asks of it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from hm_sfm.matching.encoder import Encoder
from hm_sfm.matching.patches import locate_patches, make_start, round_to_cells
from hm_sfm.network.device import computes_in_half
from hm_sfm.network.estimates import estimate_patches
from hm_sfm.network.fine import FineMap
from hm_sfm.photos.hypotheses import IDENTITY, Hypothesis, apply_hypothesis
from hm_sfm.photos.images import prepare_image
from hm_sfm.photos.sizes import find_scale
from hm_sfm.types import ImagePair, ImageRef, PairMatches

ITERATIONS = 1
"""Updates of the homographies, which start close to the result: a second one changes nothing that can be measured."""


@dataclass(frozen=True)
class RefinementFeatures:
    """Fine features of a photo at the size that keypoints are refined at."""

    fine: FineMap
    stored_from_scaled: np.ndarray
    """(3, 3) float64: px of the network's input -> px of the stored image."""
    downscale: float = 1
    """See Hypothesis."""


@dataclass(frozen=True)
class Placement:
    """Where propagation put the keypoints of a pair, from the first photo of the pair to the second.

    Several TrackEdges of the pair one after another; px of the stored images.
    """

    xy0: np.ndarray
    """(N, 2)."""
    xy1: np.ndarray
    """(N, 2)."""
    linear: np.ndarray
    """(N, 2, 2): how xy1 moves with xy0."""

    def select(self, chosen: np.ndarray) -> "Placement":
        """Those that `chosen`, indices, names."""
        return Placement(self.xy0[chosen], self.xy1[chosen], self.linear[chosen])


class PatchRefiner:
    """Estimates patches around keypoints, on photos whose longer sides are reduced to `long_edge_px`.

    The features of the photos used last are kept: as many as fit into cache_mb, but of two photos at least.
    """

    def __init__(self, encoder: Encoder, images: Sequence[ImageRef], long_edge_px: int, cache_mb: int) -> None:
        self.encoder, self.long_edge_px = encoder, long_edge_px
        self.images = {image.name: image for image in images}
        largest_px = max((math.prod(size_at(image, long_edge_px)) for image in images), default=1)
        backbone = encoder.net.backbone
        bytes_per_number = 2 if computes_in_half(encoder.device) else 4
        bytes_per_px = bytes_per_number * backbone.fine_channels / backbone.fine_grid.stride**2
        self.cached_photos = max(2, int(cache_mb * 1e6 / (largest_px * bytes_per_px)))
        self.encode = lru_cache(self.cached_photos)(self._encode)

    def _encode(self, name: str, hypothesis: Hypothesis) -> RefinementFeatures:
        image = apply_hypothesis(prepare_image(self.images[name], self.long_edge_px), hypothesis)
        return RefinementFeatures(self.encoder.encode_fine(image), image.stored_from_scaled, hypothesis.downscale)

    def refine_pair(self, pair: ImagePair, placement: Placement) -> PairMatches:
        """Matches in the order of `placement`, from where its keypoints lie in the first photo.

        The score is the probability that a match is off by less than 1 px of the photo at `long_edge_px`; it is 0 where
        the patch is of no use. Raises InputError on an undecodable photo.
        """
        features0, features1 = self.encode(pair.name0, IDENTITY), self.encode(pair.name1, IDENTITY)
        hypothesis0, hypothesis1 = fit_hypotheses(relate_inputs(features0, features1, placement))
        features0, features1 = self.encode(pair.name0, hypothesis0), self.encode(pair.name1, hypothesis1)
        return self._estimate(features0, features1, pair, placement)

    @torch.inference_mode()
    def _estimate(
        self, features0: RefinementFeatures, features1: RefinementFeatures, pair: ImagePair, placement: Placement
    ) -> PairMatches:
        grid, head, device = self.encoder.net.backbone.fine_grid, self.encoder.net.head, self.encoder.device
        scaled0, scaled1 = (np.linalg.inv(features.stored_from_scaled) for features in (features0, features1))
        xy0, xy1 = (
            xy @ scaled[:2, :2].T + scaled[:2, 2] for xy, scaled in ((placement.xy0, scaled0), (placement.xy1, scaled1))
        )
        cell0, offset0 = round_to_cells(xy0, grid)
        cell1, offset1 = round_to_cells(xy1, grid)
        start = make_start(offset0, offset1, relate_inputs(features0, features1, placement), head.half).to(device)
        estimates = estimate_patches(
            head, features0.fine, features1.fine, cell0.to(device), cell1.to(device), start, iterations=ITERATIONS
        )
        patches = locate_patches(
            estimates, offset0, features0.stored_from_scaled, features1.stored_from_scaled, grid, head.half
        )
        score = patches.score
        if features1.downscale > 1:  # a px of the photo at `long_edge_px` is less than one of the reduced input
            score = 1 - (1 - score) ** (1 / features1.downscale)
        return PairMatches(
            pair=pair,
            xy0=placement.xy0,
            xy1=patches.xy1,
            score=np.where(patches.regular, score, 0.0),
            homography=patches.homography,
            patch_radius_px=patches.patch_radius_px,
        )


def size_at(image: ImageRef, long_edge_px: int) -> tuple[float, float]:
    """(w, h) of a photo that is reduced to long_edge_px, see find_scale."""
    scale = find_scale(image.size_wh, long_edge_px)
    return image.size_wh[0] * scale, image.size_wh[1] * scale


def relate_inputs(features0: RefinementFeatures, features1: RefinementFeatures, placement: Placement) -> np.ndarray:
    """(N, 2, 2): how points of the network's second input move with those of the first."""
    scaled_from_stored1 = np.linalg.inv(features1.stored_from_scaled)
    return scaled_from_stored1[:2, :2] @ placement.linear @ features0.stored_from_scaled[:2, :2]


def fit_hypotheses(linear: np.ndarray) -> tuple[Hypothesis, Hypothesis]:
    """The rotation and scale at which patches of one photo are upright, and about as large, in the other.

    linear: (N, 2, 2), see relate_inputs. The second photo is rotated by quarter turns, the closer one reduced by powers
    of 2.
    """
    along, across = np.median(linear[:, 0, 0] + linear[:, 1, 1]), np.median(linear[:, 1, 0] - linear[:, 0, 1])
    rotation_deg = -90 * round(np.rad2deg(np.arctan2(across, along)) / 90) % 360
    octaves = round(np.log2(np.sqrt(np.median(np.abs(np.linalg.det(linear))))))
    return Hypothesis(downscale=2 ** max(0, -octaves)), Hypothesis(rotation_deg, 2 ** max(0, octaves))
