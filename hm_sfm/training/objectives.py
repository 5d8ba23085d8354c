"""What a batch of training pairs says about the network: the losses of its stages, and scores on held-out pairs."""

# What measure_objective makes for a stage it uses for the same stage only.
# pyright: reportPossiblyUnboundVariable=false

import dataclasses
from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext

import torch
import torch.nn.functional as F
from torch import Tensor

from hm_sfm.matching.patches import fine_cell_of
from hm_sfm.network.aspan import Flow
from hm_sfm.network.backbone import FeatureMaps, require_fine
from hm_sfm.network.coarse import AspanCoarse, CosineCoarse
from hm_sfm.network.estimates import accuracy_from_scale
from hm_sfm.network.fine import FineEstimate, HomographyHead, make_fine_map
from hm_sfm.network.homography import is_regular
from hm_sfm.network.homonet import HomoNet
from hm_sfm.training.losses import (
    FLOW_WEIGHT,
    measure_coarse_loss,
    measure_errors,
    measure_flow_loss,
    measure_loss,
    measure_point_loss,
)
from hm_sfm.training.supervision import (
    JITTERED_SHARE,
    STARTED_SHARE,
    CoarseSupervision,
    PatchSupervision,
    PointSupervision,
    draw_patches,
    draw_point_patches,
    find_coarse_matches,
    map_points,
)

NEAR_CELLS = 1
"""A coarse match this far from the ground truth, along each axis, is one that the fine stage can correct."""
RIGHT_PX = 1.0
"""Of the network's input: a match with a smaller error is right. Scores are the probability of that."""
SCORE_BINS = 5
"""In which the scores of matches are compared with the share that is right."""


def run_backbone(net: HomoNet, images: Tensor, want_fine: bool) -> FeatureMaps:
    """Features of both views of a batch. images: (B, 2, H, W) uint8; the maps are (2 B, C, ...), A before B."""
    pixels = images.float() / 255
    if net.backbone.standardised:
        pixels = pixels - pixels.mean(dim=(2, 3), keepdim=True)
        pixels = pixels / pixels.std(dim=(2, 3), keepdim=True).clamp_min(1 / 255)
    return net.backbone(pixels.flatten(0, 1)[:, None], want_fine)


def run_coarse(net: HomoNet, maps: FeatureMaps) -> tuple[Tensor, Tensor, list[tuple[Flow, Flow]]]:
    """Cells as the coarse stage compares them, (B, N, C) float32 of both views, and its flows.

    The flows are those of each block, from A to B and back; a coarse stage without flows has none.
    """
    described = net.coarse.describe(maps.coarse).flatten(2).transpose(1, 2).unflatten(0, (-1, 2))
    flows = []
    if isinstance(net.coarse, AspanCoarse):
        coarse0, coarse1, flows = net.coarse.estimate(described[:, 0], described[:, 1])
    else:
        coarse0, coarse1 = net.coarse(described[:, 0], described[:, 1])
    return coarse0.float(), coarse1.float(), flows


def run_fine(net: HomoNet, maps: FeatureMaps, supervision: PatchSupervision | PointSupervision) -> list[FineEstimate]:
    """The head's estimates of the supervised patches, from where they start."""
    fine = require_fine(maps).unflatten(0, (-1, 2))
    fine0, fine1 = make_fine_map(fine[:, 0]), make_fine_map(fine[:, 1])
    where = supervision.image_index, supervision.cell0, supervision.cell1
    if isinstance(net.head, HomographyHead) and isinstance(supervision, PatchSupervision):
        return net.head(fine0, fine1, *where, supervision.start)
    return net.head(fine0, fine1, *where)


def describe_cells(maps: FeatureMaps) -> Tensor:
    """(B, 2, C, rows, columns) float32 on the CPU, without gradient: the coarse cells of both views, of unit length."""
    return F.normalize(maps.coarse.detach().float(), dim=1).unflatten(0, (-1, 2)).cpu()


def measure_objective(
    net: HomoNet,
    batch: dict[str, Tensor],
    stage: str,
    patches_per_pair: int,
    precision: str,
    device: torch.device,
    generator: torch.Generator,
    supervise: str = "suppressed",
) -> dict[str, Tensor]:
    """Scalars `loss` and its parts for a batch of training pairs.

    stage: coarse | fine | joint; supervise: what of the fine stage is supervised, as in TrainConfig.
    """
    jittered_share = JITTERED_SHARE if supervise == "suppressed" else 0.0
    with autocast(precision, device):
        maps = run_backbone(net, batch["images"].to(device), stage != "coarse")
        parts = {"loss": torch.zeros((), device=device)}
        if stage != "fine":
            supervision = to_device(supervise_coarse(net, batch), device)
            coarse0, coarse1, flows = run_coarse(net, maps)
        if stage != "coarse":
            drawn = describe_cells(maps), patches_per_pair, generator, jittered_share
            patches = to_device(supervise_fine(net, batch, *drawn), device)
            points = to_device(supervise_points(net, batch, *drawn), device)
            estimates = run_fine(net, maps, patches)
            point_estimates = run_fine(net, maps, points) if len(points.image_index) else []
    if stage != "fine":
        assert not isinstance(net.coarse, CosineCoarse)  # which has nothing to train
        parts["coarse"] = measure_coarse_loss(coarse0, coarse1, net.coarse.sharpness, supervision)
        parts["loss"] = parts["loss"] + parts["coarse"]
        if flows:
            parts["flow"] = measure_flow_loss(flows, supervision)
            parts["loss"] = parts["loss"] + FLOW_WEIGHT * parts["flow"]
    if stage != "coarse":
        fine = measure_loss(estimates, patches, net.head.half, dense=supervise != "centre")
        fine["point"] = measure_point_loss(point_estimates, points, net.head.half)
        parts["loss"] = parts["loss"] + fine.pop("loss") + fine["point"]
        parts |= fine
    return parts


def supervise_coarse(net: HomoNet, batch: dict[str, Tensor]) -> CoarseSupervision:
    """The true coarse matches of a batch."""
    return find_coarse_matches(batch["b_from_a"], batch["surface"], batch["points"], net.backbone.coarse_grid)


def supervise_fine(
    net: HomoNet, batch: dict[str, Tensor], features: Tensor, patches_per_pair: int, generator: torch.Generator,
    jittered_share: float = JITTERED_SHARE,
) -> PatchSupervision:  # fmt: skip
    """Patches of a batch and their supervision. features: of describe_cells."""
    grids = net.backbone.coarse_grid, net.backbone.fine_grid
    started_share = STARTED_SHARE if isinstance(net.head, HomographyHead) else 0.0
    return draw_patches(
        batch["b_from_a"], batch["surface"], features, patches_per_pair, *grids, net.head.half, generator,
        jittered_share, started_share,
    )  # fmt: skip


def supervise_points(
    net: HomoNet, batch: dict[str, Tensor], features: Tensor, patches_per_pair: int, generator: torch.Generator,
    jittered_share: float = JITTERED_SHARE,
) -> PointSupervision:  # fmt: skip
    """Patches around the known points of a batch's real photos. features: of describe_cells."""
    grids = net.backbone.coarse_grid, net.backbone.fine_grid
    return draw_point_patches(
        batch["points"], features, patches_per_pair, *grids, net.head.half, generator, jittered_share
    )


@torch.no_grad()
def score_network(
    net: HomoNet,
    batches: Iterable[dict[str, Tensor]],
    stage: str,
    patches_per_pair: int,
    coarse_threshold: float,
    precision: str,
    device: torch.device,
    generator: torch.Generator,
) -> dict[str, float]:
    """Metrics of the network on held-out pairs.

    coarse: `recall` and `precision` in percent, mean over the pairs: the share of the true coarse matches that are
    matched right, to within a cell, and the share of right ones among those that are matched at all; for pairs with
    known surfaces (rendered) and for those of real photos.
    fine: errors of the dense points of correct patches, px of the network's input; `started_...` are those of patches
    that start near their true homography. And how far the scores of the coarse stage's matches can be trusted, of pairs
    with known surfaces, see measure_calibration.
    """
    errors, started, coarse_scores = (
        [torch.zeros(0, 81)],
        [torch.zeros(0, dtype=torch.bool)],
        {"rendered": [], "real": []},
    )
    match_scores, rights = [torch.zeros(0)], [torch.zeros(0, dtype=torch.bool)]
    for batch in batches:
        with autocast(precision, device):
            maps = run_backbone(net, batch["images"].to(device), stage != "coarse")
            if stage != "fine":
                score_coarse(net, maps, batch, coarse_threshold, coarse_scores)
            if stage != "coarse":
                drawn = supervise_fine(net, batch, describe_cells(maps), patches_per_pair, generator)
                patches = to_device(drawn, device)
                estimates = run_fine(net, maps, patches)
                errors.append(measure_errors(estimates[-1], patches)[patches.correct].cpu())
                started.append(drawn.start.any(dim=2).any(dim=1)[drawn.correct])
                log_scale, right = judge_matches(net, maps, batch, coarse_threshold)
                match_scores.append(accuracy_from_scale(log_scale))
                rights.append(right)
    scores = {}
    for kind, pairs in coarse_scores.items():
        if pairs:
            recall, precise = torch.tensor(pairs).mean(dim=0).tolist()
            scores |= {f"{kind}_recall": 100 * recall, f"{kind}_precision": 100 * precise}
    if stage != "coarse":
        error_px, near = torch.cat(errors) * net.backbone.fine_grid.stride, torch.cat(started)
        kinds = {"": error_px[~near]} | ({"started_": error_px[near]} if isinstance(net.head, HomographyHead) else {})
        for prefix, epe in kinds.items():
            scores[f"{prefix}median_px"] = epe.median().item()
            scores |= {f"{prefix}pck_{limit}px": (epe < limit).float().mean().item() for limit in (0.5, 1, 3, 5)}
        scores |= measure_calibration(torch.cat(match_scores), torch.cat(rights))
    return scores


def judge_matches(net: HomoNet, maps: FeatureMaps, batch: dict[str, Tensor], threshold: float) -> tuple[Tensor, Tensor]:
    """Error scales, (M,) float32, log of fine cells, of a batch's matches, and which of these are right, (M,) bool.

    They are what the coarse stage matches in pairs with known surfaces and the head then refines, without patches of no
    use. Right is what is off by less than RIGHT_PX; a match of what B does not show is wrong.
    """
    coarse_grid, fine_grid, half = net.backbone.coarse_grid, net.backbone.fine_grid, net.head.half
    described = net.coarse.describe(maps.coarse)
    columns, cells = described.shape[3], described.flatten(2).transpose(1, 2).unflatten(0, (-1, 2))
    fine = require_fine(maps).unflatten(0, (-1, 2))
    fine0, fine1 = make_fine_map(fine[:, 0]), make_fine_map(fine[:, 1])
    log_scales, rights = [torch.zeros(0)], [torch.zeros(0, dtype=torch.bool)]
    for item, (cells0, cells1) in enumerate(cells):
        if not (batch["surface"][item] >= 0).any():
            continue
        matched = net.coarse.match(cells0, cells1, threshold)[:2]
        cell0, cell1 = (
            fine_cell_of(torch.stack([index % columns, index // columns], dim=1), coarse_grid, fine_grid)
            for index in matched
        )
        estimate = net.head(fine0, fine1, torch.full_like(cell0[:, 0], item), cell0, cell1)[-1]
        regular = is_regular(estimate.homography, half).cpu()
        shift = estimate.homography[:, :2, 2] / estimate.homography[:, 2:, 2]
        actual_px = fine_grid.to_px((cell1 + shift).cpu())
        true_px, _ = map_points(
            batch["b_from_a"][item, None], batch["surface"][item, None], fine_grid.to_px(cell0.float()).cpu()[None]
        )
        log_scales.append(estimate.log_scale.cpu()[regular])
        rights.append(((actual_px - true_px[0]).norm(dim=1) < RIGHT_PX)[regular])
    return torch.cat(log_scales), torch.cat(rights)


def measure_calibration(score: Tensor, right: Tensor) -> dict[str, float]:
    """How far the scores (M,) of matches, of which `right` (M,) are right, can be trusted, in percent.

    `matches_right`: the share right of all; `calibration_error`: the mean difference between score and share right in
    SCORE_BINS bins, by their matches (the expected calibration error); `score@0.2` and `right@0.2`: the mean score and
    the share right in the bin that begins at 0.2, and so on, NaN where it has no match.
    """
    of_bin = (score * SCORE_BINS).long().clamp_max(SCORE_BINS - 1)
    values, difference = {"matches_right": 100 * right.float().mean().item()}, 0.0
    for number in range(SCORE_BINS):
        own = of_bin == number
        mean_score, share = (100 * x[own].float().mean().item() for x in (score, right))
        values |= {f"score@{number / SCORE_BINS:g}": mean_score, f"right@{number / SCORE_BINS:g}": share}
        if own.any():
            difference += abs(mean_score - share) * own.float().mean().item()
    return values | {"calibration_error": difference}


def score_coarse(
    net: HomoNet, maps: FeatureMaps, batch: dict[str, Tensor], threshold: float, scores: dict[str, list]
) -> None:
    """Append (recall, precision) of each pair of a batch to `scores`, by kind of pair."""
    supervision = supervise_coarse(net, batch)
    described = net.coarse.describe(maps.coarse)
    columns = described.shape[3]
    cells = described.flatten(2).transpose(1, 2).unflatten(0, (-1, 2))
    for item, (cells0, cells1) in enumerate(cells):
        own = supervision.image_index == item
        if not own.any():
            continue
        index0, index1, _ = (x.cpu() for x in net.coarse.match(cells0, cells1, threshold))
        answer = torch.full((len(cells0),), -1)
        answer[index0] = index1
        given, true = answer[supervision.index0[own]], supervision.index1[own]
        apart = torch.maximum((given % columns - true % columns).abs(), (given // columns - true // columns).abs())
        answered = given >= 0
        right = (answered & (apart <= NEAR_CELLS)).sum().item()
        kind = "rendered" if (batch["surface"][item] >= 0).any() else "real"
        scores[kind].append((right / len(true), right / max(answered.sum().item(), 1)))


def to_device(supervision, device: torch.device):
    """The same supervision with its tensors on `device`."""
    return type(supervision)(
        *(getattr(supervision, field.name).to(device) for field in dataclasses.fields(supervision))
    )


def autocast(precision: str, device: torch.device) -> AbstractContextManager:
    """The context that runs convolutions and matrix products in half precision."""
    if precision == "fp32":
        return nullcontext()
    # bf16 has the exponents of float32: gradients do not underflow, so no GradScaler is needed.
    return torch.autocast(device.type, dtype=torch.bfloat16)
