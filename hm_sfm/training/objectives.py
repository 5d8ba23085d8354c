"""What a batch of training pairs says about the network: the losses of its stages, and how it does on kept pairs."""

import dataclasses
from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor

from hm_sfm.network.aspan import Flow
from hm_sfm.network.backbone import FeatureMaps
from hm_sfm.network.coarse import AspanCoarse
from hm_sfm.network.fine import FineEstimate, make_fine_map
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
    CoarseSupervision,
    PatchSupervision,
    PointSupervision,
    draw_patches,
    draw_point_patches,
    find_coarse_matches,
)

NEAR_CELLS = 1
"""A coarse match this far from the truth, along each axis, is one that the fine stage can mend."""


def run_backbone(net: HomoNet, images: Tensor, want_fine: bool) -> FeatureMaps:
    """Features of both views of a batch. images: (B, 2, H, W) uint8; the maps are (2 B, C, ...), A before B."""
    pixels = images.float() / 255
    if net.backbone.standardised:
        pixels = pixels - pixels.mean(dim=(2, 3), keepdim=True)
        pixels = pixels / pixels.std(dim=(2, 3), keepdim=True).clamp_min(1 / 255)
    return net.backbone(pixels.flatten(0, 1)[:, None], want_fine)


def run_coarse(net: HomoNet, maps: FeatureMaps) -> tuple[Tensor, Tensor, list[tuple[Flow, Flow]]]:
    """(B, N, C) float32 of both views: cells as the coarse stage compares them; and the flows, from A to B and back, by
    which it found them, none where it works without.
    """
    described = net.coarse.describe(maps.coarse).flatten(2).transpose(1, 2).unflatten(0, (-1, 2))
    flows = []
    if isinstance(net.coarse, AspanCoarse):
        coarse0, coarse1, flows = net.coarse.estimate(described[:, 0], described[:, 1])
    else:
        coarse0, coarse1 = net.coarse(described[:, 0], described[:, 1])
    return coarse0.float(), coarse1.float(), flows


def run_fine(net: HomoNet, maps: FeatureMaps, truth: PatchSupervision | PointSupervision) -> list[FineEstimate]:
    """The head's estimates of the supervised patches."""
    fine = maps.fine.unflatten(0, (-1, 2))
    fine0, fine1 = make_fine_map(fine[:, 0]), make_fine_map(fine[:, 1])
    return net.head(fine0, fine1, truth.image_index, truth.cell0, truth.cell1)


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
    """Scalars `loss` and its parts for a batch of training pairs; stage: coarse | fine | joint; supervise: what of the
    fine stage, as in TrainConfig.
    """
    jittered_share = JITTERED_SHARE if supervise == "suppressed" else 0.0
    with autocast(precision, device):
        maps = run_backbone(net, batch["images"].to(device), stage != "coarse")
        parts = {"loss": torch.zeros((), device=device)}
        if stage != "fine":
            truth = to_device(supervise_coarse(net, batch), device)
            coarse0, coarse1, flows = run_coarse(net, maps)
        if stage != "coarse":
            patches = to_device(supervise_fine(net, batch, patches_per_pair, generator, jittered_share), device)
            points = to_device(supervise_points(net, batch, patches_per_pair, generator, jittered_share), device)
            estimates = run_fine(net, maps, patches)
            point_estimates = run_fine(net, maps, points) if len(points.image_index) else []
    if stage != "fine":
        parts["coarse"] = measure_coarse_loss(coarse0, coarse1, net.coarse.sharpness, truth)
        parts["loss"] = parts["loss"] + parts["coarse"]
        if flows:
            parts["flow"] = measure_flow_loss(flows, truth)
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
    net: HomoNet,
    batch: dict[str, Tensor],
    patches_per_pair: int,
    generator: torch.Generator,
    jittered_share: float = JITTERED_SHARE,
) -> PatchSupervision:
    """Patches of a batch and their truth."""
    grids = net.backbone.coarse_grid, net.backbone.fine_grid
    return draw_patches(
        batch["b_from_a"], batch["surface"], patches_per_pair, *grids, net.head.half, generator, jittered_share
    )


def supervise_points(
    net: HomoNet,
    batch: dict[str, Tensor],
    patches_per_pair: int,
    generator: torch.Generator,
    jittered_share: float = JITTERED_SHARE,
) -> PointSupervision:
    """Patches around the known points of a batch's real photos."""
    grids = net.backbone.coarse_grid, net.backbone.fine_grid
    height, width = batch["images"].shape[2:]
    return draw_point_patches(
        batch["points"], (width, height), patches_per_pair, *grids, net.head.half, generator, jittered_share
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
    """How the network does on held-out pairs.

    coarse: `recall` and `precision` in percent, mean over the pairs, of the true coarse matches: found, and among the
    answers to them right, to within a cell; for pairs with known surfaces (rendered) and for those of real photos.
    fine: errors of the dense points of correct patches, px of the network's input.
    """
    errors, found = [torch.zeros(0)], {"rendered": [], "real": []}
    for batch in batches:
        with autocast(precision, device):
            maps = run_backbone(net, batch["images"].to(device), stage != "coarse")
            if stage != "fine":
                score_coarse(net, maps, batch, coarse_threshold, found)
            if stage != "coarse":
                patches = to_device(supervise_fine(net, batch, patches_per_pair, generator), device)
                estimates = run_fine(net, maps, patches)
                errors.append(measure_errors(estimates[-1], patches)[patches.correct].flatten().cpu())
    scores = {}
    for kind, pairs in found.items():
        if pairs:
            recall, precise = torch.tensor(pairs).mean(dim=0).tolist()
            scores |= {f"{kind}_recall": 100 * recall, f"{kind}_precision": 100 * precise}
    if stage != "coarse":
        epe = torch.cat(errors) * net.backbone.fine_grid.stride
        scores["median_px"] = epe.median().item()
        scores |= {f"pck_{limit}px": (epe < limit).float().mean().item() for limit in (0.5, 1, 3, 5)}
    return scores


def score_coarse(
    net: HomoNet, maps: FeatureMaps, batch: dict[str, Tensor], threshold: float, found: dict[str, list]
) -> None:
    """Append (recall, precision) of each pair of a batch to `found`, by kind of pair."""
    truth = supervise_coarse(net, batch)
    described = net.coarse.describe(maps.coarse)
    columns = described.shape[3]
    cells = described.flatten(2).transpose(1, 2).unflatten(0, (-1, 2))
    for item, (cells0, cells1) in enumerate(cells):
        own = truth.image_index == item
        if not own.any():
            continue
        index0, index1, _ = (x.cpu() for x in net.coarse.match(cells0, cells1, threshold))
        answer = torch.full((len(cells0),), -1)
        answer[index0] = index1
        given, true = answer[truth.index0[own]], truth.index1[own]
        apart = torch.maximum((given % columns - true % columns).abs(), (given // columns - true // columns).abs())
        answered = given >= 0
        right = (answered & (apart <= NEAR_CELLS)).sum().item()
        kind = "rendered" if (batch["surface"][item] >= 0).any() else "real"
        found[kind].append((right / len(true), right / max(answered.sum().item(), 1)))


def to_device(truth, device: torch.device):
    """The same supervision with its tensors on `device`."""
    return type(truth)(*(getattr(truth, field.name).to(device) for field in dataclasses.fields(truth)))


def autocast(precision: str, device: torch.device) -> AbstractContextManager:
    """The context that runs convolutions and matrix products in half precision."""
    if precision == "fp32":
        return nullcontext()
    # bf16 has the exponents of float32: gradients do not underflow, so no GradScaler is needed.
    return torch.autocast(device.type, dtype=torch.bfloat16)
