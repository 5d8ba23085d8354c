"""The loss of the fine stage (section 3.3 of the paper), and the error measures it is judged by."""

import torch
from torch import Tensor

from hm_sfm.network.fine import FineEstimate
from hm_sfm.network.homography import apply_homography, is_regular, make_patch_grid
from hm_sfm.training.supervision import PatchSupervision

DENSE_RADIUS = 2.0
"""r_e: half the side of the square of supervised points, cells."""
DENSE_STEP = 0.5
CORNER_WEIGHT = 0.25
SCALE_WEIGHT = 0.05
DISCOUNT = 0.8
"""Weight of an iteration relative to the next one."""
LARGEST_ERROR = 8.0
"""Cells: what the error scale of a wrong match is taught."""


def measure_errors(estimate: FineEstimate, truth: PatchSupervision) -> Tensor:
    """(P, 81) float32 cells: distance of the predicted from the true dense points of each patch."""
    points = make_patch_grid(DENSE_RADIUS, DENSE_STEP, truth.homography.device)
    predicted = apply_homography(estimate.homography, points)
    return (predicted - apply_homography(truth.homography, points)).norm(dim=-1)


def measure_loss(estimates: list[FineEstimate], truth: PatchSupervision, half: float) -> dict[str, Tensor]:
    """Scalars `loss` and its parts `dense`, `corner` (relative to the patch's half side) and `scale`.

    Dense L2 over the patch's points where patch and estimate are regular; the four corners keep supervising where
    the estimate is not; the error scale is a Laplace likelihood and learns from wrong matches too.
    """
    correct = truth.correct
    count = correct.sum().clamp_min(1)
    zero = truth.homography.new_zeros(())
    parts = {"dense": zero, "corner": zero, "scale": zero}
    for age, estimate in enumerate(reversed(estimates)):
        weight = DISCOUNT**age
        errors = measure_errors(estimate, truth).mean(dim=1)
        regular = correct & is_regular(estimate.homography.detach(), half)
        corner = (estimate.displacement - truth.displacement).abs().mean(dim=(1, 2))
        known = torch.where(correct, errors.detach(), errors.new_tensor(LARGEST_ERROR)).clamp(0.02, LARGEST_ERROR)
        likelihood = estimate.log_scale + known * torch.exp(-estimate.log_scale)
        parts["dense"] = parts["dense"] + weight * torch.where(regular, errors, 0.0).sum() / count / half
        parts["corner"] = parts["corner"] + weight * torch.where(correct, corner, 0.0).sum() / count / half
        parts["scale"] = parts["scale"] + weight * likelihood.mean()
    loss = parts["dense"] + CORNER_WEIGHT * parts["corner"] + SCALE_WEIGHT * parts["scale"]
    return {"loss": loss} | parts
