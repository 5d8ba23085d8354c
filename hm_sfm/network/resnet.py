"""LoFTR's backbone: ResNet-FPN with features at 1/8 and 1/2, under the parameter names of its public checkpoints."""

import torch.nn.functional as F
from torch import Tensor, nn

from hm_sfm.geometry.frames import Grid
from hm_sfm.network.backbone import FeatureMaps

WIDTHS = (128, 196, 256)
"""Channels at 1/2, 1/4 and 1/8."""


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions beside a shortcut."""

    def __init__(self, in_channels: int, out_channels: int, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, out_channels, 3, stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(out_channels)
        self.conv2 = nn.Conv2d(out_channels, out_channels, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(out_channels)
        self.downsample = None
        if stride != 1:
            self.downsample = nn.Sequential(
                nn.Conv2d(in_channels, out_channels, 1, stride, bias=False), nn.BatchNorm2d(out_channels)
            )

    def forward(self, x: Tensor) -> Tensor:
        y = self.bn2(self.conv2(F.relu(self.bn1(self.conv1(x)))))
        return F.relu(y + (x if self.downsample is None else self.downsample(x)))


class LoftrBackbone(nn.Module):
    """Grey image -> FeatureMaps of 256 and 128 channels.

    Its strided 7x7 and 3x3 convolutions are centred on a pixel, so cell i sits on a pixel's centre: 8 i + 0.5 px.
    """

    stride = 8
    standardised = False
    reach_px: int | None = None
    """Maps are enlarged with their corners aligned: where a cell looks depends on the size of the whole image."""
    coarse_grid = Grid(stride=8, offset=0.5)
    fine_grid = Grid(stride=2, offset=0.5)
    fine_channels = WIDTHS[0]

    def __init__(self) -> None:
        super().__init__()
        half, quarter, eighth = WIDTHS
        self.conv1 = nn.Conv2d(1, half, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(half)
        self.layer1 = nn.Sequential(ResidualBlock(half, half), ResidualBlock(half, half))
        self.layer2 = nn.Sequential(ResidualBlock(half, quarter, stride=2), ResidualBlock(quarter, quarter))
        self.layer3 = nn.Sequential(ResidualBlock(quarter, eighth, stride=2), ResidualBlock(eighth, eighth))
        self.layer3_outconv = nn.Conv2d(eighth, eighth, 1, bias=False)
        self.layer2_outconv = nn.Conv2d(quarter, eighth, 1, bias=False)
        self.layer2_outconv2 = _smooth(eighth, quarter)
        self.layer1_outconv = nn.Conv2d(half, quarter, 1, bias=False)
        self.layer1_outconv2 = _smooth(quarter, half)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, image: Tensor, want_fine: bool = True) -> FeatureMaps:
        """image: (B, 1, H, W) float32 in [0, 1], H and W multiples of `stride`."""
        half = self.layer1(F.relu(self.bn1(self.conv1(image))))
        quarter = self.layer2(half)
        eighth = self.layer3_outconv(self.layer3(quarter))
        if not want_fine:
            return FeatureMaps(coarse=eighth, fine=None)
        quarter = self.layer2_outconv2(self.layer2_outconv(quarter) + _double(eighth))
        return FeatureMaps(coarse=eighth, fine=self.layer1_outconv2(self.layer1_outconv(half) + _double(quarter)))


def _smooth(channels: int, out_channels: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels, channels, 3, padding=1, bias=False),
        nn.BatchNorm2d(channels),
        nn.LeakyReLU(),
        nn.Conv2d(channels, out_channels, 3, padding=1, bias=False),
    )


def _double(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=True)
