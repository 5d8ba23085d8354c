"""The context stage of a network, as a provider of coarse matches: keypoints matched by LightGlue."""

from typing import Any

import numpy as np
import torch

from hm_sfm.matching.interfaces import ImageFeatures, ImageKeypoints, PointPairs
from hm_sfm.network.lightglue import LightGlue
from hm_sfm.photos.images import PreparedImage

MIN_CONFIDENCE = 0.1
"""LightGlue's own limit of the probability of an assignment."""
MIN_KEYPOINTS = 8
"""Images with fewer, such as a white wall, have no context to match by."""


class ContextCoarse:
    """Matches the keypoints of the network whose fine stage follows."""

    def __init__(self, context: LightGlue) -> None:
        self.context = context

    def describe(self, image: PreparedImage) -> dict[str, Any]:
        """Nothing: the keypoints are encoded together with the fine features."""
        return {}

    def match(self, features0: ImageFeatures, features1: ImageFeatures) -> PointPairs:
        """See match_keypoints."""
        assert features0.keypoints is not None and features1.keypoints is not None  # of a network with context
        return match_keypoints(self.context, features0.keypoints, features1.keypoints)


@torch.inference_mode()
def match_keypoints(context: LightGlue, keypoints0: ImageKeypoints, keypoints1: ImageKeypoints) -> PointPairs:
    """Match the keypoints of two images; no matches where one has fewer than MIN_KEYPOINTS.

    The score is the probability of the assignment. A match is at the right place about as often as the square root of
    it says: measured on fountain-P11, Herz-Jesus-P8 and castle-P19, by the distance from the true epipolar line.
    """
    if min(len(keypoints0.xy), len(keypoints1.xy)) < MIN_KEYPOINTS:
        return PointPairs(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    index0, index1, score = context.assign(keypoints0.states, keypoints1.states)
    confident = score > MIN_CONFIDENCE
    xy0, xy1 = keypoints0.xy[index0[confident]].cpu().numpy(), keypoints1.xy[index1[confident]].cpu().numpy()
    probability = score[confident].cpu().numpy()
    return PointPairs(xy0, xy1, probability, place=np.sqrt(probability), grow="always")
