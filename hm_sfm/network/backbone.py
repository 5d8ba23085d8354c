"""The `light` backbone: coarse features at 1/8 and fine features at 1/2 of a grey image.

The trunk has the topology of XFeat (Potje et al., CVPR 2024), whose public weights (Apache-2.0, see NOTICE) start
it. The fine branch at 1/2 is ours.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hm_sfm.errors import WeightsError
from hm_sfm.geometry.frames import Grid


@dataclass(frozen=True)
class FeatureMaps:
    """Features of a batch of images, with the grids that say where their cells sit."""

    coarse: Tensor
    """(B, Cc, H/8, W/8)."""
    fine: Tensor | None
    """(B, Cf, H/2, W/2); None where it was not asked for."""


class ConvBlock(nn.Sequential):
    """3x3 or 1x1 convolution, batch norm without scale and shift, ReLU (XFeat's BasicLayer)."""

    def __init__(self, in_channels: int, out_channels: int, size: int = 3, stride: int = 1) -> None:
        super().__init__(
            nn.Conv2d(in_channels, out_channels, size, stride, padding=size // 2, bias=False),
            nn.BatchNorm2d(out_channels, affine=False),
            nn.ReLU(inplace=True),
        )


class XFeatTrunk(nn.Module):
    """XFeat's convolutions up to its descriptors: (B, 1, H, W) -> (B, 24, H/4, W/4) and (B, 64, H/8, W/8)."""

    def __init__(self) -> None:
        super().__init__()
        self.skip1 = nn.Sequential(nn.AvgPool2d(4, 4), nn.Conv2d(1, 24, 1))
        self.block1 = nn.Sequential(
            ConvBlock(1, 4), ConvBlock(4, 8, stride=2), ConvBlock(8, 8), ConvBlock(8, 24, stride=2)
        )
        self.block2 = nn.Sequential(ConvBlock(24, 24), ConvBlock(24, 24))
        self.block3 = nn.Sequential(ConvBlock(24, 64, stride=2), ConvBlock(64, 64), ConvBlock(64, 64, size=1))
        self.block4 = nn.Sequential(ConvBlock(64, 64, stride=2), ConvBlock(64, 64), ConvBlock(64, 64))
        self.block5 = nn.Sequential(
            ConvBlock(64, 128, stride=2), ConvBlock(128, 128), ConvBlock(128, 128), ConvBlock(128, 64, size=1)
        )
        self.block_fusion = nn.Sequential(ConvBlock(64, 64), ConvBlock(64, 64), nn.Conv2d(64, 64, 1))

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        quarter = self.block2(self.block1(image) + self.skip1(image))
        eighth = self.block3(quarter)
        sixteenth = self.block4(eighth)
        thirtysecond = self.block5(sixteenth)
        size = eighth.shape[-2:]
        fused = eighth + _resize(sixteenth, size) + _resize(thirtysecond, size)
        return quarter, self.block_fusion(fused)


class FineBranch(nn.Module):
    """Features at 1/2 for sub-pixel matching, from the pixels and the trunk's context.

    The stem is an even 4x4 convolution of stride 2, so that its cells sit symmetrically in their 2x2 pixels.
    """

    def __init__(self, channels: int = 48, width: int = 32) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            nn.Conv2d(1, width, 4, stride=2, padding=1, bias=False), nn.BatchNorm2d(width), nn.ReLU(inplace=True)
        )
        self.local = ConvBlock(width, width)
        self.from_quarter = nn.Conv2d(24, width, 1)
        self.from_eighth = nn.Conv2d(64, width, 1)
        self.context = ConvBlock(width, width)
        self.merge = nn.Sequential(ConvBlock(width, channels), nn.Conv2d(channels, channels, 3, padding=1))

    def forward(self, image: Tensor, quarter: Tensor, eighth: Tensor) -> Tensor:
        local = self.local(self.stem(image))
        context = self.from_quarter(quarter) + _resize(self.from_eighth(eighth), quarter.shape[-2:])
        return self.merge(local + _resize(self.context(context), local.shape[-2:]))


class LightBackbone(nn.Module):
    """Grey image -> FeatureMaps."""

    stride = 32
    """Images are padded right and bottom to a multiple of this."""
    standardised = True
    """Images come with zero mean and unit variance; otherwise in [0, 1]."""
    reach_px: int | None = 224
    """No feature depends on pixels farther away than this, along either axis; a multiple of `stride`."""
    coarse_grid = Grid(stride=8, offset=4.0)
    fine_grid = Grid(stride=2, offset=1.0)
    fine_channels = 48

    def __init__(self) -> None:
        super().__init__()
        self.trunk = XFeatTrunk()
        self.fine = FineBranch(self.fine_channels)

    def forward(self, image: Tensor, want_fine: bool = True) -> FeatureMaps:
        """image: (B, 1, H, W) float32 of zero mean and unit variance, H and W multiples of `stride`."""
        quarter, eighth = self.trunk(image)
        return FeatureMaps(coarse=eighth, fine=self.fine(image, quarter, eighth) if want_fine else None)


def require_fine(maps: FeatureMaps) -> Tensor:
    """(B, Cf, H/2, W/2): the fine features of maps that were asked for them."""
    assert maps.fine is not None
    return maps.fine


def load_xfeat(trunk: XFeatTrunk, path: Path) -> None:
    """Start the trunk from XFeat's weights file (its keypoint and matching heads are left out).

    Raises WeightsError where the file cannot be read or lacks one of the trunk's tensors.
    """
    try:
        source = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise WeightsError(f"cannot read the XFeat weights {path}: {' '.join(str(error).split())[:200]}") from error
    renamed = {key.replace(".layer.", "."): value for key, value in source.items()}
    wanted = trunk.state_dict()
    missing = [key for key in wanted if key not in renamed and not key.endswith("num_batches_tracked")]
    if missing:
        raise WeightsError(f"{path} is no XFeat weights file: {missing[0]} and {len(missing) - 1} more are missing")
    misshapen = [key for key, value in wanted.items() if getattr(renamed.get(key, value), "shape", None) != value.shape]
    if misshapen:
        raise WeightsError(f"{path} is no XFeat weights file: {misshapen[0]} is of another shape")
    trunk.load_state_dict({key: renamed.get(key, value) for key, value in wanted.items()})


def _resize(x: Tensor, size: Sequence[int]) -> Tensor:
    return F.interpolate(x, list(size), mode="bilinear", align_corners=False)
