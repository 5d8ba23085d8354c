"""Prepared images -> the network's features: coarse cells, fine cells, or both."""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from hm_sfm.matching.interfaces import ImageFeatures, ImageKeypoints
from hm_sfm.network.backbone import FeatureMaps, require_fine
from hm_sfm.network.detector import describe_keypoints, detect_keypoints
from hm_sfm.network.device import autocast
from hm_sfm.network.fine import FineMap, make_fine_map
from hm_sfm.network.homonet import HomoNet
from hm_sfm.photos.images import PreparedImage

STRIP_PX = 1024
"""encode_fine takes photos in strips of so many rows, to bound the memory; a multiple of any backbone's stride."""


class Encoder:
    """A network on a device, ready to encode images. The network is moved there and frozen."""

    def __init__(self, net: HomoNet, device: torch.device, max_keypoints: int) -> None:
        """max_keypoints: of an image, best first, that a network with context matches; others find none."""
        self.device, self.max_keypoints = device, max_keypoints
        self.net = net.to(device).eval().requires_grad_(False)
        # Half the time on a CPU. PyTorch's own type hints lack this argument of a module.
        self.net.backbone.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    @torch.inference_mode()
    def encode(self, image: PreparedImage) -> ImageFeatures:
        """All features of an image, described by no provider yet."""
        pixels = self._pad(image)
        maps = self._run_backbone(pixels)
        coarse = self._describe_cells(maps.coarse, image)
        rows, columns = coarse.shape[:2]
        y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
        return ImageFeatures(
            coarse=coarse.flatten(0, 1),
            cell=torch.stack([x, y], dim=-1).reshape(-1, 2).to(self.device),
            fine=make_fine_map(require_fine(maps)),
            scaled_wh=image.scaled_wh,
            stored_from_scaled=image.stored_from_scaled,
            image=image.ref,
            keypoints=self._find_keypoints(pixels, maps.coarse, image) if self.net.config.coarse == "context" else None,
        )

    @torch.inference_mode()
    def encode_coarse(self, image: PreparedImage) -> Tensor:
        """(H, W, C) float32: the cells of ImageFeatures.coarse on their grid, without the rest."""
        return self._describe_cells(self._run_backbone(self._pad(image), want_fine=False).coarse, image)

    @torch.inference_mode()
    def encode_plain(self, image: PreparedImage) -> np.ndarray:
        """(N, C) float32 of unit length: the 1/8 cells as the backbone sees them, without what only matching needs."""
        coarse = self._run_backbone(self._pad(image), want_fine=False).coarse
        columns, rows = self._count_coarse_cells(image)
        return F.normalize(coarse[0, :, :rows, :columns].flatten(1).T.float(), dim=1).cpu().numpy()

    @torch.inference_mode()
    def encode_fine(self, image: PreparedImage) -> FineMap:
        """The fine features alone: what the backbone makes of the whole, but for the last digits.

        Strip by strip, each with the rows around it that its features see, where the backbone looks only so far.
        """
        pixels = self._pad(image)
        backbone, height = self.net.backbone, pixels.shape[2]
        stride, reach_px = backbone.fine_grid.stride, backbone.reach_px
        strip_px = height if reach_px is None else STRIP_PX
        strips = []
        for top in range(0, height, strip_px):
            bottom = min(height, top + strip_px)
            first, last = max(0, top - (reach_px or 0)), min(height, bottom + (reach_px or 0))
            fine = require_fine(self._run_backbone(pixels[:, :, first:last]))
            strips.append(fine[:, :, (top - first) // stride : (bottom - first) // stride])
        return make_fine_map(torch.cat(strips, dim=2))

    @torch.inference_mode()
    def encode_keypoints(self, image: PreparedImage) -> ImageKeypoints:
        """The keypoints alone, of a network that matches them in context."""
        pixels = self._pad(image)
        return self._find_keypoints(pixels, self._run_backbone(pixels, want_fine=False).coarse, image)

    def _pad(self, image: PreparedImage) -> Tensor:
        backbone = self.net.backbone
        return pad_image(torch.tensor(image.grey, device=self.device), backbone.stride, backbone.standardised)

    def _run_backbone(self, pixels: Tensor, want_fine: bool = True) -> FeatureMaps:
        with autocast(self.device):
            return self.net.backbone(pixels, want_fine)

    def _find_keypoints(self, pixels: Tensor, coarse: Tensor, image: PreparedImage) -> ImageKeypoints:
        """pixels, coarse: what the backbone is given, and its map at 1/8."""
        probability, reliability = self.net.detector(pixels, coarse.float())
        xy, _ = detect_keypoints(probability, reliability, image.scaled_wh, self.max_keypoints)
        descriptors = describe_keypoints(coarse[0], xy)
        return ImageKeypoints(xy, self.net.context.describe(descriptors, xy, image.scaled_wh))

    def _describe_cells(self, coarse: Tensor, image: PreparedImage) -> Tensor:
        """The backbone's (1, C, H', W') -> (H, W, C) of the cells within the image, as the coarse stage sees them."""
        columns, rows = self._count_coarse_cells(image)
        with autocast(self.device):
            described = self.net.coarse.describe(coarse[:, :, :rows, :columns])
        return described[0].permute(1, 2, 0).contiguous()

    def _count_coarse_cells(self, image: PreparedImage) -> tuple[int, int]:
        """Columns and rows of the coarse cells whose centre lies within the image."""
        columns, rows = (self.net.backbone.coarse_grid.count_cells(size) for size in image.scaled_wh)
        return columns, rows


def pad_image(grey: Tensor, stride: int, standardise: bool) -> Tensor:
    """(H, W) float32 in [0, 1] -> (1, 1, H', W'), zero-padded right and bottom to multiples of `stride`.

    standardise: to zero mean and unit variance first.
    """
    if standardise:
        grey = (grey - grey.mean()) / grey.std().clamp_min(1e-3)
    height, width = grey.shape
    return F.pad(grey[None, None], (0, -width % stride, 0, -height % stride))
