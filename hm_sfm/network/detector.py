"""XFeat's keypoints (Potje et al., CVPR 2024): where they are, how reliable, and their descriptors."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hm_sfm.network.backbone import ConvBlock

CELL_PX = 8
MIN_DETECTION = 0.05
"""XFeat's limit of a pixel's probability of being a keypoint."""
SUPPRESSION_PX = 5
"""Side of the window in which a keypoint must be the most likely one."""


class KeypointDetector(nn.Module):
    """XFeat's keypoint and reliability heads."""

    def __init__(self, channels: int = 64) -> None:
        super().__init__()
        self.heatmap_head = nn.Sequential(
            ConvBlock(channels, channels, size=1),
            ConvBlock(channels, channels, size=1),
            nn.Conv2d(channels, 1, 1),
            nn.Sigmoid(),
        )
        self.keypoint_head = nn.Sequential(
            *(ConvBlock(CELL_PX**2, channels, size=1) for _ in range(3)), nn.Conv2d(channels, CELL_PX**2 + 1, 1)
        )

    def forward(self, image: Tensor, coarse: Tensor) -> tuple[Tensor, Tensor]:
        """Where the keypoints of an image are, and how reliable its cells.

        image: (1, 1, H, W) of zero mean and unit variance; coarse: (1, C, H/8, W/8), the trunk's map. Returns the
        probabilities that pixels are keypoints, (H, W), and reliabilities, (H/8, W/8). Of a cell's pixels at most one
        is a keypoint: their probabilities add up to 1 with that of none.
        """
        probability = self.keypoint_head(F.pixel_unshuffle(image, CELL_PX)).float().softmax(dim=1)[:, :-1]
        return F.pixel_shuffle(probability, CELL_PX)[0, 0], self.heatmap_head(coarse)[0, 0].float()


def detect_keypoints(
    probability: Tensor, reliability: Tensor, size_wh: tuple[int, int], most: int
) -> tuple[Tensor, Tensor]:
    """The best local maxima: (K, 2) float32 px of the network's input, COLMAP's frame, best first, and scores (K,).

    size_wh: what of the padded image is the photo. The score is the product of probability and reliability.
    """
    peak = (probability == find_largest_around(probability)) & (probability > MIN_DETECTION)
    y, x = peak[: size_wh[1], : size_wh[0]].nonzero(as_tuple=True)
    xy = torch.stack([x, y], dim=1) + 0.5
    score = probability[y, x] * sample_map(reliability[None], xy)[:, 0]
    order = score.argsort(descending=True, stable=True)[:most]
    return xy[order], score[order]


def find_largest_around(values: Tensor) -> Tensor:
    """The largest value of the window of SUPPRESSION_PX around each pixel, (H, W).

    What max_pool2d gives, but along one axis after the other, which is faster.
    """
    reach = SUPPRESSION_PX // 2
    for axis, padding in enumerate(((0, 0, reach, reach), (reach, reach, 0, 0))):
        padded, size = F.pad(values, padding, value=-torch.inf), values.shape[axis]
        for shift in range(SUPPRESSION_PX):
            shifted = padded.narrow(axis, shift, size)
            values = torch.maximum(values, shifted) if shift else shifted
    return values


def sample_map(maps: Tensor, xy: Tensor, mode: str = "bilinear") -> Tensor:
    """Values of maps (C, H/8, W/8) at points (K, 2) px of the network's input: (K, C)."""
    size = torch.tensor([maps.shape[2], maps.shape[1]], device=xy.device) * CELL_PX
    grid = 2 * xy / size - 1
    return F.grid_sample(maps[None], grid[None, None], mode=mode, padding_mode="border", align_corners=False)[0, :, 0].T


def describe_keypoints(coarse: Tensor, xy: Tensor) -> Tensor:
    """Descriptors (K, C) float32 of unit length at points (K, 2) px, from the trunk's map (C, H/8, W/8)."""
    return F.normalize(sample_map(F.normalize(coarse.float(), dim=0), xy, "bicubic"), dim=1)
