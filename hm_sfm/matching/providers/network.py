"""The network's own coarse stage, as a provider of coarse matches."""

from typing import Any

import numpy as np
import torch

from hm_sfm.matching.cells import CoarseCells
from hm_sfm.matching.interfaces import ImageFeatures, PointPairs
from hm_sfm.matching.patches import fine_cell_of
from hm_sfm.photos.images import PreparedImage


class NetworkCoarse:
    """Matches the coarse cells of the network whose fine stage follows, so that the matches can grow on their grid."""

    def __init__(self, cells: CoarseCells) -> None:
        self.cells = cells

    def describe(self, image: PreparedImage) -> dict[str, Any]:
        """Nothing: the coarse cells are encoded together with the fine ones."""
        return {}

    def match(self, features0: ImageFeatures, features1: ImageFeatures) -> PointPairs:
        """The score is that of the coarse stage. A point is the fine cell nearest to its coarse cell's centre."""
        index0, index1, score = self.cells.match(features0.coarse, features1.coarse)
        xy0, xy1 = self._locate(features0, index0), self._locate(features1, index1)
        return PointPairs(xy0, xy1, score, grow="if few")

    def _locate(self, features: ImageFeatures, index: np.ndarray) -> np.ndarray:
        """(M,) int64 coarse cells -> (M, 2) float64 px of the network's input."""
        backbone = self.cells.encoder.net.backbone
        cell = features.cell[torch.tensor(index, device=features.cell.device)]
        return backbone.fine_grid.to_px(fine_cell_of(cell, backbone.coarse_grid, backbone.fine_grid).cpu().numpy())
