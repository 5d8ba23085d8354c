"""The coarse stage of a network alone: which 1/8 cells of two images belong together."""

import numpy as np
import torch
from torch import Tensor

from hm_sfm.config import MatchingConfig
from hm_sfm.matching.encoder import Encoder
from hm_sfm.network.device import autocast
from hm_sfm.network.homonet import HomoNet
from hm_sfm.photos.images import PreparedImage


class CoarseCells:
    """Encodes and matches the coarse cells of a network: a CellMatcher."""

    def __init__(self, encoder: Encoder, config: MatchingConfig) -> None:
        self.encoder, self.threshold = encoder, choose_threshold(encoder.net, config)

    def encode(self, image: PreparedImage) -> Tensor:
        """(H, W, C) float32: the cells of an image on their grid."""
        return self.encoder.encode_coarse(image)

    @torch.inference_mode()
    def match(self, cells0: Tensor, cells1: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Indices of the matched cells of both images, (M,) int64 each, counted row by row, and scores (M,) float32.

        cells0, cells1: (N, C), or (H, W, C) as encode makes them. The score is the coarse stage's: a cosine of plain
        features, otherwise the confidence of a dual softmax.
        """
        flat0, flat1 = (cells.flatten(0, -2) for cells in (cells0, cells1))
        with autocast(self.encoder.device):
            index0, index1, score = self.encoder.net.coarse.match(flat0, flat1, self.threshold)
        return index0.cpu().numpy(), index1.cpu().numpy(), score.float().cpu().numpy()


def choose_threshold(net: HomoNet, config: MatchingConfig) -> float:
    """The least score of a coarse match: a cosine or a confidence, whichever the network's coarse stage gives."""
    return config.min_cosine if net.config.coarse in ("cosine", "context") else config.min_confidence
