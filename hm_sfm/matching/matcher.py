"""HomoMatcher: two images in, PatchMatches out."""

import dataclasses
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hm_sfm.config import GOOD_SCORE, ImageConfig, MatchingConfig, NetworkConfig
from hm_sfm.matching.cells import CoarseCells
from hm_sfm.matching.encoder import Encoder
from hm_sfm.matching.epipolar import agree_with, fit_fundamental
from hm_sfm.matching.hypotheses import Sketch, retry_hypotheses
from hm_sfm.matching.interfaces import CellMatcher, CoarseProvider, ImageFeatures, PointPairs
from hm_sfm.matching.patches import (
    fine_cell_of,
    is_inside,
    locate_matches,
    locate_patches,
    make_start,
    round_to_cells,
)
from hm_sfm.matching.providers.choice import make_provider
from hm_sfm.network.checkpoints import load_weights
from hm_sfm.network.device import pick_device
from hm_sfm.network.estimates import PatchEstimates, estimate_patches
from hm_sfm.network.fine import HomographyHead
from hm_sfm.network.growth import PatchGrid, grow_matches
from hm_sfm.network.homography import is_regular
from hm_sfm.network.homonet import HomoNet
from hm_sfm.photos.hypotheses import apply_hypothesis
from hm_sfm.photos.images import PreparedImage, prepare_array, prepare_image, read_ref
from hm_sfm.types import PatchMatches

GROWING_ROUNDS = 12
"""How many cells far good matches spread."""


class HomoMatcher:
    """Matches two images: the homographies that a network estimates around the coarse matches of a provider."""

    def __init__(self, encoder: Encoder, config: MatchingConfig, images: ImageConfig, provider: CoarseProvider) -> None:
        self.encoder, self.config, self.images, self.provider = encoder, config, images, provider
        self.net, self.device = encoder.net, encoder.device
        self.cell_matcher: CellMatcher | None = None
        """Compares rotation and scale hypotheses; None where the configuration does without them."""
        if config.try_hypotheses:
            self.cell_matcher = CoarseCells(encoder, config)

    @classmethod
    def from_network(cls, net: HomoNet, config: MatchingConfig, images: ImageConfig) -> "HomoMatcher":
        """The matcher of a network, with the device and the provider of coarse matches that the configuration names.

        Raises ConfigError where the device is unknown or absent, and what make_provider raises.
        """
        encoder = Encoder(net, pick_device(config.device), config.context_keypoints)
        return cls(encoder, config, images, make_provider(config, encoder))

    @classmethod
    def from_pretrained(
        cls, name: str = "light", *, config: MatchingConfig | None = None, images: ImageConfig | None = None,
        network: NetworkConfig | None = None,
    ) -> "HomoMatcher":  # fmt: skip
        """The matcher with bundled weights (`light`) or those of a file.

        Raises WeightsError where the file is missing, damaged or does not fit `network`, and what from_network raises.
        """
        net = load_weights(name, network)
        return cls.from_network(net, config or MatchingConfig(), images or ImageConfig())

    def match(self, image0: str | Path | np.ndarray, image1: str | Path | np.ndarray) -> PatchMatches:
        """Match two images, each a path or an HxW or HxWx3 (RGB) uint8 array.

        Coordinates are px of the images as stored. Raises InputError on an unreadable image.
        """
        images = [self._prepare(image) for image in (image0, image1)]
        return retry_hypotheses(
            self,
            self.match_features(*(self.encode(image) for image in images)),
            lambda side, hypothesis: self.encode(apply_hypothesis(images[side], hypothesis)),
            lambda side: Sketch(images[side]),
        )

    def _prepare(self, image: str | Path | np.ndarray) -> PreparedImage:
        if isinstance(image, np.ndarray):
            return prepare_array(image, self.images.long_edge_px)
        return prepare_image(read_ref(Path(image)), self.images.long_edge_px)

    @torch.inference_mode()
    def encode(self, image: PreparedImage) -> ImageFeatures:
        """Features of a prepared image, described by the provider of coarse matches."""
        return dataclasses.replace(self.encoder.encode(image), description=self.provider.describe(image))

    @torch.inference_mode()
    def match_features(self, features0: ImageFeatures, features1: ImageFeatures) -> PatchMatches:
        """Match two images by their features; coordinates are px of the stored images.

        Patches whose homography is of no use, and points outside of an image, are left out.
        """
        grid, head = self.net.backbone.fine_grid, self.net.head
        points = self.provider.match(features0, features1).keep_best(self.config.max_matches)
        cell0, offset0 = round_to_cells(points.xy0, grid)
        cell1, offset1 = round_to_cells(points.xy1, grid)
        start = None
        if isinstance(head, HomographyHead) and (points.linear is not None or offset0.any() or offset1.any()):
            start = make_start(offset0, offset1, points.linear, head.half).to(self.device)
        place = None if points.place is None else torch.tensor(points.place, device=self.device)
        patches = estimate_patches(
            head, features0.fine, features1.fine, cell0.to(self.device), cell1.to(self.device), start, place
        )
        patches, offset0 = self._grow(features0, features1, points, patches, offset0)
        stored = locate_patches(
            patches, offset0, features0.stored_from_scaled, features1.stored_from_scaled, grid, head.half
        )
        inside0, inside1 = (
            is_inside(stored.xy0, features0.image.size_wh),
            is_inside(stored.xy1, features1.image.size_wh),
        )
        keep = (stored.regular & inside0 & inside1).nonzero()[0]
        keep = keep[np.argsort(-stored.score[keep], kind="stable")][: self.config.max_matches]
        return PatchMatches(
            xy0=stored.xy0[keep],
            xy1=stored.xy1[keep],
            score=stored.score[keep],
            homography=stored.homography[keep],
            patch_radius_px=stored.patch_radius_px,
            size0_wh=features0.image.size_wh,
            size1_wh=features1.image.size_wh,
        )

    def _lay_grid(self, size_wh: tuple[int, int], is_chessboard: bool) -> PatchGrid:
        """The patches of an image of size_wh px (the network's input) that matches grow into."""
        backbone = self.net.backbone
        columns, rows = (backbone.coarse_grid.count_cells(size) for size in size_wh)
        first, second = fine_cell_of(torch.tensor([[0, 0], [1, 1]]), backbone.coarse_grid, backbone.fine_grid)
        return PatchGrid(columns, rows, int(first[0]), int(second[0] - first[0]), self.net.head.half, is_chessboard)

    def _grow(
        self,
        features0: ImageFeatures,
        features1: ImageFeatures,
        points: PointPairs,
        patches: PatchEstimates,
        offset0: np.ndarray,
    ) -> tuple[PatchEstimates, np.ndarray]:
        """The patches, and those that grow beside the good ones, where the provider wants that.

        offset0: (P, 2) cells, the points of image 0 relative to the centres of their patches; also returned. Where the
        good matches have a two-view geometry, only matches that agree with it grow, and only into such.
        """
        head = self.net.head
        few = torch.count_nonzero(patches.score >= GOOD_SCORE) < self.config.grow_below
        wanted = (points.grow == "always" and self.config.grow_below > 0) or (points.grow == "if few" and few)
        if not wanted or not isinstance(head, HomographyHead) or not len(points):
            return patches, offset0
        grid = self._lay_grid(features0.scaled_wh, is_chessboard=points.grow == "always")
        fundamental = None
        if points.place is not None:
            good = (is_regular(patches.homography, head.half) & (patches.score >= GOOD_SCORE)).cpu().numpy()
            xy0, xy1 = locate_matches(patches, offset0, self.net.backbone.fine_grid)
            fundamental = fit_fundamental(xy0[good], xy1[good], points.place[good])

        def doubt(estimates: PatchEstimates, offset0: np.ndarray | float = 0.0) -> PatchEstimates:
            """Without accuracy where the pair's geometry denies them."""
            if fundamental is None:
                return estimates
            agreeing = agree_with(fundamental, *locate_matches(estimates, offset0, self.net.backbone.fine_grid))
            accuracy = estimates.accuracy * torch.tensor(agreeing, device=self.device)
            return dataclasses.replace(estimates, accuracy=accuracy)

        def refine(cell0: Tensor, cell1: Tensor, start: Tensor, place: Tensor) -> PatchEstimates:
            return doubt(estimate_patches(head, features0.fine, features1.fine, cell0, cell1, start, place))

        seeds = doubt(patches, offset0)
        grown = grow_matches(seeds, grid, refine, features1.fine.size_wh, GOOD_SCORE, GROWING_ROUNDS)
        beside = ~grid.holds(patches.cell0)
        patches = PatchEstimates.concatenate([patches.select(beside), grown])
        kept = offset0[beside.cpu().numpy()]
        return patches, np.concatenate([kept, np.zeros((len(patches.cell0) - len(kept), 2))])
