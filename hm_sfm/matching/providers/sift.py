"""COLMAP's SIFT, as a provider of coarse matches."""

import numpy as np
import pycolmap
import torch
import torch.nn.functional as F

from hm_sfm.io.colmap_log import quiet_colmap
from hm_sfm.matching.interfaces import ImageFeatures, PointPairs
from hm_sfm.photos.images import PreparedImage

SIFT_RATIO = 0.8
"""COLMAP's limit of the angle to the nearest descriptor over that to the second nearest."""
BLOCK_ROWS = 1024
"""Of the matrix of similarities, held at a time."""


class SiftCoarse:
    """COLMAP's SIFT with its defaults, as photos are matched: mutual nearest neighbours that pass its ratio test."""

    def describe(self, image: PreparedImage) -> dict[str, np.ndarray]:
        """`xy` (N, 2) float32 px; `shape` (N, 2, 2) float32: scale and rotation; `descriptors` (N, 128) uint8."""
        with quiet_colmap():
            extractor = pycolmap.FeatureExtractor.create(device=pycolmap.Device.cpu)
            keypoints, descriptors = extractor.extract_from_float32_array(image.grey)
        return {
            "xy": np.array([(point.x, point.y) for point in keypoints], np.float32).reshape(-1, 2),
            "shape": np.array([(p.a11, p.a12, p.a21, p.a22) for p in keypoints], np.float32).reshape(-1, 2, 2),
            "descriptors": np.array(descriptors.data, np.uint8).reshape(-1, 128),
        }

    def match(self, features0: ImageFeatures, features1: ImageFeatures) -> PointPairs:
        """The score is 1 - ratio. Each match has its relative scale and rotation."""
        sift0, sift1 = features0.description, features1.description
        index0, index1, ratio = match_by_ratio(*(torch.tensor(sift["descriptors"]) for sift in (sift0, sift1)))
        shape0, shape1 = sift0["shape"][index0].astype(np.float64), sift1["shape"][index1].astype(np.float64)
        return PointPairs(sift0["xy"][index0], sift1["xy"][index1], 1 - ratio, shape1 @ np.linalg.inv(shape0))


def match_by_ratio(descriptor0: torch.Tensor, descriptor1: torch.Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mutual nearest neighbours among descriptors (N0, C) and (N1, C), by angle, below SIFT_RATIO.

    Returns indices into both, (M,) int64 each, and the ratios (M,) float32. COLMAP's own matcher gives the same, but
    takes many times as long without a GPU.
    """
    if min(len(descriptor0), len(descriptor1)) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.float32)
    unit0, unit1 = (F.normalize(descriptor.float(), dim=1) for descriptor in (descriptor0, descriptor1))
    nearest, partner = [], []
    best_of1, partner_of1 = torch.full((len(unit1),), -1.0), torch.zeros(len(unit1), dtype=torch.int64)
    for first in range(0, len(unit0), BLOCK_ROWS):
        similarity = unit0[first : first + BLOCK_ROWS] @ unit1.T
        values, indices = similarity.topk(2, dim=1)
        nearest.append(values)
        partner.append(indices[:, 0])
        values, indices = similarity.max(dim=0)
        better = values > best_of1
        best_of1[better], partner_of1[better] = values[better], indices[better] + first
    angle = torch.cat(nearest).clamp(-1, 1).acos()
    index1 = torch.cat(partner)
    ratio = angle[:, 0] / angle[:, 1].clamp_min(1e-6)
    index0 = ((ratio < SIFT_RATIO) & (partner_of1[index1] == torch.arange(len(unit0)))).nonzero().flatten()
    return index0.numpy(), index1[index0].numpy(), ratio[index0].numpy()
