"""LoFTR itself, through kornia, with a checkpoint that the user has: a matcher to compare with."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hm_sfm.config import ImageConfig, MatchingConfig
from hm_sfm.errors import MissingPackageError
from hm_sfm.matching.encoder import pad_image
from hm_sfm.matching.interfaces import CellMatcher
from hm_sfm.matching.patches import is_inside
from hm_sfm.network.checkpoints import digest_weights, fit_state, read_checkpoint
from hm_sfm.network.device import pick_device
from hm_sfm.photos.images import PreparedImage
from hm_sfm.types import PatchMatches

STRIDE = 8
"""Of LoFTR's coarse cells, px."""


@dataclass(frozen=True)
class LoftrImage:
    """A photo as LoFTR takes it."""

    pixels: Tensor
    """(1, 1, H, W) float32 in [0, 1], padded to multiples of STRIDE."""
    stored_wh: tuple[int, int]
    stored_from_scaled: np.ndarray
    """(3, 3) float64: px of the network's input -> px of the stored image."""

    @property
    def size_bytes(self) -> int:
        """Memory that the pixels take."""
        return self.pixels.numel() * self.pixels.element_size()


class LoftrMatcher:
    """Matches with kornia's LoFTR as HomoMatcher does with ours; a match's homography is the mere shift.

    Raises MissingPackageError without kornia, WeightsError where the checkpoint is missing, damaged, or not LoFTR's.
    """

    def __init__(self, checkpoint: Path, config: MatchingConfig, images: ImageConfig) -> None:
        try:
            import kornia
            from kornia.feature import LoFTR
        except ImportError as error:
            raise MissingPackageError(
                "LoFTR's own matches need the package kornia, which is not installed: pip install kornia"
            ) from error
        self.config, self.images = config, images
        self.cell_matcher: CellMatcher | None = None  # LoFTR is compared as it is: no rotation or scale hypotheses
        self.made_by = {
            "weights": digest_weights(str(checkpoint)),
            "kornia": kornia.__version__,
            "images.long_edge_px": images.long_edge_px,
            "matching.max_matches": config.max_matches,
        }
        """What the matches depend on, by name."""
        self.device = pick_device(config.device)
        net = LoFTR(pretrained=None)
        content = read_checkpoint(checkpoint)
        state = {key.removeprefix("matcher."): value for key, value in content.get("state_dict", content).items()}
        fit_state(net, state, checkpoint)
        self.net = net.to(self.device).eval().requires_grad_(False)

    def encode(self, image: PreparedImage) -> LoftrImage:
        """A prepared image on the device."""
        pixels = pad_image(torch.tensor(image.grey, device=self.device), STRIDE, standardise=False)
        return LoftrImage(pixels, image.ref.size_wh, image.stored_from_scaled)

    @torch.inference_mode()
    def match_features(self, features0: LoftrImage, features1: LoftrImage) -> PatchMatches:
        """Match two images; coordinates are px of the stored images, the score is LoFTR's confidence.

        The public checkpoints were trained on COLMAP's cameras, so that their points are in its frame, as kornia
        says, too: nothing is added.
        """
        output = self.net({"image0": features0.pixels, "image1": features1.pixels})
        stored0, stored1 = features0.stored_from_scaled, features1.stored_from_scaled
        xy0 = output["keypoints0"].double().cpu().numpy() @ stored0[:2, :2].T + stored0[:2, 2]
        xy1 = output["keypoints1"].double().cpu().numpy() @ stored1[:2, :2].T + stored1[:2, 2]
        score = output["confidence"].float().cpu().numpy()
        inside0, inside1 = is_inside(xy0, features0.stored_wh), is_inside(xy1, features1.stored_wh)
        inside = np.flatnonzero(inside0 & inside1)
        best = inside[np.argsort(-score[inside], kind="stable")][: self.config.max_matches]
        shift = np.tile(np.eye(3), (len(best), 1, 1))
        shift[:, :2, 2] = xy1[best] - xy0[best]
        px_per_cell = np.sqrt(abs(np.linalg.det(stored0[:2, :2]))) * STRIDE
        return PatchMatches(
            xy0=xy0[best], xy1=xy1[best], score=score[best], homography=shift, patch_radius_px=float(px_per_cell / 2)
        )
