"""What the fine head says of many patches, some at a time."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
import torch.nn.functional as F
from torch import Tensor

from hm_sfm.network.device import autocast
from hm_sfm.network.fine import ExpectationHead, FineMap, HomographyHead

FINE_CHUNK = 512
"""Patches per call of the fine head: bounds its memory to about 50 MB."""
FINE_CELL_PX = 2
"""Of the grid of fine features, px of the network's input."""
FINE_STEP = 64
"""Smaller calls are filled up to a multiple of this: PyTorch keeps memory for every size it was ever called with."""

Head = HomographyHead | ExpectationHead


@dataclass(frozen=True)
class PatchEstimates:
    """What is known of P patches around pairs of fine cells; tensors on one device."""

    cell0: Tensor
    """(P, 2) int64: the cells of image 0 that the patches are cut around."""
    cell1: Tensor
    """(P, 2) int64: those of image 1."""
    homography: Tensor
    """(P, 3, 3) float32: patch of image 0 -> patch of image 1."""
    accuracy: Tensor
    """(P,) float32 in [0, 1]: the head's probability that the match is off by less than 1 px of the network's input, if
    it is at the right place."""
    place: Tensor
    """(P,) float32 in [0, 1]: the coarse stage's probability that it is; 1 where the stage knows none."""

    @property
    def score(self) -> Tensor:
        """(P,) float32 in [0, 1]: the probability that the match is off by less than 1 px of the network's input."""
        return self.accuracy * self.place

    @staticmethod
    def concatenate(parts: "Sequence[PatchEstimates]") -> "PatchEstimates":
        """One after another."""
        return PatchEstimates(*(torch.cat([getattr(part, f.name) for part in parts]) for f in fields(PatchEstimates)))

    def select(self, chosen: Tensor) -> "PatchEstimates":
        """Those that `chosen`, (P,) bool or (N,) int64, names."""
        return PatchEstimates(*(getattr(self, field.name)[chosen] for field in fields(self)))


def estimate_patches(
    head: Head,
    fine0: FineMap,
    fine1: FineMap,
    cell0: Tensor,
    cell1: Tensor,
    start: Tensor | None = None,
    place: Tensor | None = None,
    iterations: int | None = None,
) -> PatchEstimates:
    """The head's last estimate of P patches, computed some at a time.

    cell0, cell1: (P, 2) int64 fine cells; start: (P, 4, 2) cells and iterations, as in HomographyHead.forward; place:
    (P,), see PatchEstimates.
    """
    device = cell0.device
    homography, log_scale = [torch.zeros(0, 3, 3, device=device)], [torch.zeros(0, device=device)]
    for first in range(0, len(cell0), FINE_CHUNK):
        chunk = slice(first, first + FINE_CHUNK)
        count = len(cell0[chunk])
        padding = (0, 0, 0, -count % FINE_STEP)
        image = torch.zeros(count + padding[-1], dtype=torch.int64, device=device)
        cells = (F.pad(cell[chunk], padding) for cell in (cell0, cell1))
        begin = {} if start is None else {"start": F.pad(start[chunk], (0, 0, *padding)), "iterations": iterations}
        with autocast(device):
            estimate = head(fine0, fine1, image, *cells, **begin)[-1]
        homography.append(estimate.homography[:count])
        log_scale.append(estimate.log_scale[:count])
    accuracy = accuracy_from_scale(torch.cat(log_scale))
    return PatchEstimates(
        cell0, cell1, torch.cat(homography), accuracy, torch.ones_like(accuracy) if place is None else place
    )


def accuracy_from_scale(log_scale: Tensor) -> Tensor:
    """Error scales (P,), log of fine cells -> (P,) in [0, 1]: the probability of an error below 1 px (Laplace)."""
    return -torch.expm1(-1 / (log_scale.exp() * FINE_CELL_PX))
