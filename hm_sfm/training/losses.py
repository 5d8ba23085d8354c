"""The losses of both stages (section 3.3 of the paper), and the errors that they are made of."""

import torch
from torch import Tensor

from hm_sfm.network.aspan import Flow
from hm_sfm.network.fine import FineEstimate
from hm_sfm.network.homography import apply_homography, is_regular, make_patch_grid
from hm_sfm.training.supervision import CoarseSupervision, PatchSupervision, PointSupervision

DENSE_RADIUS = 2.0
"""r_e: half the side of the square of supervised points, cells."""
DENSE_STEP = 0.5
CORNER_WEIGHT = 0.25
SCALE_WEIGHT = 0.05
DISCOUNT = 0.8
"""Weight of an iteration relative to the next one."""
TEACHER_ERROR = 0.15
"""Cells: errors below this may be those of the known points themselves."""
COARSE_TRUNCATION = 0.25
"""q of the coarse loss."""
UNBOUNDED_SHARE = 0.1
"""Of -log P in the coarse loss."""
COARSE_MATCHES = 1000
"""Supervised per pair; more of them add little."""
FLOW_WEIGHT = 0.1
"""Of the flows' likelihood beside the coarse loss, as in ASpanFormer."""
LARGEST_ERROR = 8.0
"""Cells: the error that supervises the error scale of a wrong match."""


def measure_errors(estimate: FineEstimate, supervision: PatchSupervision, dense: bool = True) -> Tensor:
    """(P, 81) float32 cells: distance of the predicted from the true dense points of each patch.

    dense False: (P, 1), that of its centre alone.
    """
    points = make_patch_grid(DENSE_RADIUS if dense else 0.0, DENSE_STEP, supervision.homography.device)
    predicted = apply_homography(estimate.homography, points)
    return (predicted - apply_homography(supervision.homography, points)).norm(dim=-1)


def measure_loss(
    estimates: list[FineEstimate], supervision: PatchSupervision, half: float, dense: bool = True
) -> dict[str, Tensor]:
    """Scalars `loss` and its parts `dense`, `corner` (relative to the patch's half side) and `scale`.

    Dense L2 over the patch's points where patch and estimate are regular; the four corners keep supervising where
    the estimate is not; the error scale is a Laplace likelihood and learns from wrong matches too. All 0 without
    patches: pairs of real photos have none. dense False: the centre of the patch stands for its points, and the corners
    supervise nothing.
    """
    correct = supervision.correct
    count = correct.sum().clamp_min(1)
    zero = supervision.homography.new_zeros(())
    parts = {"dense": zero, "corner": zero, "scale": zero}
    for age, estimate in enumerate(reversed(estimates)):
        weight = DISCOUNT**age
        errors = measure_errors(estimate, supervision, dense).mean(dim=1)
        regular = correct & is_regular(estimate.homography.detach(), half)
        corner = (estimate.displacement - supervision.displacement).abs().mean(dim=(1, 2))
        known = torch.where(correct, errors.detach(), errors.new_tensor(LARGEST_ERROR)).clamp(0.02, LARGEST_ERROR)
        likelihood = estimate.log_scale + known * torch.exp(-estimate.log_scale)
        parts["dense"] = parts["dense"] + weight * torch.where(regular, errors, 0.0).sum() / count / half
        parts["corner"] = parts["corner"] + weight * torch.where(correct, corner, 0.0).sum() / count / half
        parts["scale"] = parts["scale"] + weight * likelihood.sum() / max(len(likelihood), 1)
    loss = parts["dense"] + CORNER_WEIGHT * dense * parts["corner"] + SCALE_WEIGHT * parts["scale"]
    return {"loss": loss} | parts


def measure_point_loss(estimates: list[FineEstimate], supervision: PointSupervision, half: float) -> Tensor:
    """The loss of patches of which one pair of points is known, a scalar.

    It is the error beyond TEACHER_ERROR, where the estimate is regular, and that of the error scale, which is told the
    whole error, weighted as in measure_loss.
    """
    count = supervision.correct.sum().clamp_min(1)
    total = supervision.point0.new_zeros(())
    for age, estimate in enumerate(reversed(estimates)):
        moved = apply_homography(estimate.homography, supervision.point0[:, None])[:, 0]
        whole = (moved - supervision.point1).norm(dim=-1)
        error = (whole - TEACHER_ERROR).clamp_min(0)
        regular = supervision.correct & is_regular(estimate.homography.detach(), half)
        known = torch.where(supervision.correct, whole.detach(), LARGEST_ERROR).clamp(0.02, LARGEST_ERROR)
        likelihood = estimate.log_scale + known * torch.exp(-estimate.log_scale)
        dense = torch.where(regular, error, 0.0).sum() / count / half
        total = total + DISCOUNT**age * (dense + SCALE_WEIGHT * likelihood.sum() / max(len(known), 1))
    return total


def measure_coarse_loss(coarse0: Tensor, coarse1: Tensor, sharpness: Tensor, supervision: CoarseSupervision) -> Tensor:
    """L_c: how far the confidence P of the true matches (LoFTR's dual softmax) is from 1.

    A scalar: the mean over each pair's matches and then over the pairs; 0 without matches.

    LoFTR takes -log P. Ours is mostly (1 - P**q) / q, which becomes -log P as q goes to 0 (Zhang and Sabuncu, NeurIPS
    2018): matches that are hopeless, or were wrong in the first place, do not drown the others. A share of -log P
    remains, so that a network that knows nothing yet learns, too.
    coarse0: (B, N0, C), coarse1: (B, N1, C) float32, from the coarse stage; sharpness: factor of their inner products.
    Only the rows and columns of true matches are computed, and of at most COARSE_MATCHES a pair.
    """
    losses = []
    for item in range(len(coarse0)):
        own = (supervision.image_index == item).nonzero().flatten()
        own = own[:: len(own) // COARSE_MATCHES + 1]
        index0, index1 = supervision.index0[own, None], supervision.index1[own, None]
        rows = sharpness * coarse0[item, index0[:, 0]] @ coarse1[item].T
        columns = sharpness * coarse1[item, index1[:, 0]] @ coarse0[item].T
        confidence = rows.log_softmax(dim=1).gather(1, index1) + columns.log_softmax(dim=1).gather(1, index0)
        if len(own):
            bounded = (1 - torch.exp(COARSE_TRUNCATION * confidence)) / COARSE_TRUNCATION
            losses.append(torch.lerp(bounded, -confidence, UNBOUNDED_SHARE).mean())
    return torch.stack(losses).mean() if losses else coarse0.sum() * 0


def measure_flow_loss(flows: list[tuple[Flow, Flow]], supervision: CoarseSupervision) -> Tensor:
    """How unlikely the true matches are under the flows of ASpanFormer's blocks (L_flow, section 3 of its paper).

    A scalar: the negative log-likelihood, without its constant, summed over both axes; the mean over matches,
    directions and blocks; 0 without matches.

    flows: of each block, from image 0 to image 1 and back. The centre of the true match's cell stands for the true
    point: it is at most half a cell off.
    """
    losses = []
    for flow0, flow1 in flows:
        for flow, other, own_index, other_index in (
            (flow0, flow1, supervision.index0, supervision.index1),
            (flow1, flow0, supervision.index1, supervision.index0),
        ):
            columns = other.centre.shape[3]
            true = torch.stack([other_index % columns, other_index // columns], dim=1)
            own = supervision.image_index, slice(None), own_index
            centre, log_sigma = flow.centre.flatten(2)[own], flow.log_sigma.flatten(2)[own]
            surprise = log_sigma + 0.5 * ((true - centre) * torch.exp(-log_sigma)).square()
            losses.append(surprise.sum() / max(len(true), 1))
    return torch.stack(losses).mean()
