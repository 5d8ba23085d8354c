"""The coarse stage of other weights, as a provider of coarse matches: a public LoFTR's, or one made by hm-sfm train."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from hm_sfm.config import MatchingConfig, NetworkConfig
from hm_sfm.matching.cells import CoarseCells
from hm_sfm.matching.encoder import Encoder
from hm_sfm.matching.interfaces import ImageFeatures, PointPairs
from hm_sfm.matching.providers.context import match_keypoints
from hm_sfm.network.checkpoints import load_weights, read_checkpoint
from hm_sfm.photos.images import PreparedImage

LOFTR = NetworkConfig(backbone="loftr", head="expectation", coarse="attention", iterations=1, margin=0)
"""What a public LoFTR checkpoint holds; its fine stage is left alone."""


def load_coarse(weights: Path, config: MatchingConfig, device: torch.device) -> "OtherCells | OtherContext":
    """The provider of a file of weights: its context stage, or its coarse cells where it has none.

    Raises WeightsError where the file is missing, damaged, or neither a weights file nor a LoFTR checkpoint.
    """
    net = load_weights(str(weights), None if "network" in read_checkpoint(weights) else LOFTR)
    encoder = Encoder(net, device, config.context_keypoints)
    return OtherContext(encoder) if net.config.coarse == "context" else OtherCells(encoder, config)


class OtherContext:
    """Matches the keypoints of another network in their context; its own fine stage is not used."""

    def __init__(self, encoder: Encoder) -> None:
        self.encoder = encoder

    def describe(self, image: PreparedImage) -> dict[str, Any]:
        """`keypoints`, ImageKeypoints."""
        return {"keypoints": self.encoder.encode_keypoints(image)}

    def match(self, features0: ImageFeatures, features1: ImageFeatures) -> PointPairs:
        """See match_keypoints."""
        keypoints0, keypoints1 = (features.description["keypoints"] for features in (features0, features1))
        return match_keypoints(self.encoder.net.context, keypoints0, keypoints1)


class OtherCells:
    """Matches the coarse cells of another network; its own fine stage is not used."""

    def __init__(self, encoder: Encoder, config: MatchingConfig) -> None:
        self.cells = CoarseCells(encoder, config)

    def describe(self, image: PreparedImage) -> dict[str, Any]:
        """`cells` (H, W, C) float32."""
        return {"cells": self.cells.encode(image)}

    def match(self, features0: ImageFeatures, features1: ImageFeatures) -> PointPairs:
        """The points are the centres of the cells, the score is that of the coarse stage."""
        cells0, cells1 = (features.description["cells"] for features in (features0, features1))
        index0, index1, score = self.cells.match(cells0, cells1)
        return PointPairs(self._locate(index0, cells0.shape[1]), self._locate(index1, cells1.shape[1]), score)

    def _locate(self, index: np.ndarray, columns: int) -> np.ndarray:
        """(M,) int64 cells, counted row by row -> (M, 2) float64 px of the network's input."""
        grid = self.cells.encoder.net.backbone.coarse_grid
        return grid.to_px(np.stack([index % columns, index // columns], axis=1).astype(np.float64))
