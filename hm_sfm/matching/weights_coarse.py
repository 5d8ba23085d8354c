"""The coarse stage of other weights, as a provider of coarse matches: a public LoFTR's, or one made by hm-sfm train."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hm_sfm.config import ImageConfig, MatchingConfig, NetworkConfig
from hm_sfm.matching.coarse_matches import PointPairs
from hm_sfm.matching.matcher import HomoMatcher, ImageFeatures, load_weights, read_checkpoint
from hm_sfm.photos.images import PreparedImage

LOFTR = NetworkConfig(backbone="loftr", head="expectation", coarse="attention", iterations=1, margin=0)
"""What a public LoFTR checkpoint holds; its fine stage is left alone."""
LEAST_CONFIDENCE = 0.2
"""theta_c of a dual softmax, LoFTR's section 3.3; plain features are matched by matching.coarse_threshold instead."""


class WeightsCoarse:
    """Matches the coarse cells of another network, whose own fine stage is not used.

    Raises WeightsError where the file is missing, damaged, or neither a weights file nor a LoFTR checkpoint.
    """

    def __init__(self, weights: Path, config: MatchingConfig, device: torch.device) -> None:
        net = load_weights(str(weights), None if "network" in read_checkpoint(weights) else LOFTR)
        threshold = config.coarse_threshold if net.config.coarse == "cosine" else LEAST_CONFIDENCE
        own = replace(config, coarse="light", coarse_threshold=threshold, device=str(device))
        self.matcher = HomoMatcher(net, own, ImageConfig())

    def describe(self, image: PreparedImage) -> dict[str, Any]:
        """`cells` (H, W, C) float32."""
        return {"cells": self.matcher.encode_coarse(image)}

    def match(self, features0: ImageFeatures, features1: ImageFeatures) -> PointPairs:
        """The centres of the cells. The score is the coarse stage's confidence."""
        cells = [features.found["cells"] for features in (features0, features1)]
        *indices, score = self.matcher.match_coarse(*cells)
        grid = self.matcher.net.backbone.coarse_grid
        xy0, xy1 = (
            grid.to_px(np.stack([index % of.shape[1], index // of.shape[1]], axis=1).astype(np.float64))
            for index, of in zip(indices, cells)
        )
        return PointPairs(xy0, xy1, score)
