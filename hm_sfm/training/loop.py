"""The training loop of the fine stage: resumable to the step, logged to CSV, checked on held-out pairs."""

import csv
import dataclasses
import logging
import math
import time
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm

from hm_sfm.atomic import replace_file
from hm_sfm.config import NetworkConfig, fingerprint
from hm_sfm.errors import ConfigError, HmSfmError, WeightsError
from hm_sfm.network.backbone import load_xfeat
from hm_sfm.network.fine import make_fine_map
from hm_sfm.network.model import HomoNet, load_loftr, pick_device, save_weights
from hm_sfm.training.losses import measure_errors, measure_loss
from hm_sfm.training.photos import WarpedPhotos, WarpRange, load_photos, split_photos
from hm_sfm.training.scenes import MixedPairs, RenderedScenes, ViewRange
from hm_sfm.training.supervision import PatchSupervision, draw_patches

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrainConfig:
    """Everything a training run depends on; read from YAML."""

    images: str
    """Folder of photos, searched with its subfolders."""
    out: str
    """Folder for checkpoint.pt, weights.pt, log.csv and validation.csv."""
    start_from: str
    """Public weights of the frozen parts: XFeat's file for the backbone `light`, a LoFTR checkpoint for `loftr`."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    warp: WarpRange = field(default_factory=WarpRange)
    views: ViewRange = field(default_factory=ViewRange)
    rendered_share: float = 0.0
    """Of the pairs that are rendered scenes with parallax; the others are warped photos."""
    steps: int = 8000
    pairs_per_step: int = 4
    patches_per_pair: int = 256
    size_px: int = 256
    learning_rate: float = 1e-3
    warmup_steps: int = 200
    gradient_limit: float = 1.0
    average_decay: float = 0.998
    """Of the exponential moving average of the weights, which is what is validated and exported."""
    precision: str = "auto"
    """auto (bf16 for convolutions and matrix products) | fp32."""
    device: str = "auto"
    validate_every: int = 500
    checkpoint_seconds: float = 120.0
    seed: int = 0


@dataclass
class TrainState:
    """What a checkpoint holds besides the configuration."""

    net: HomoNet
    average: HomoNet
    optimizer: torch.optim.Optimizer
    step: int = 0


def train(config: TrainConfig, resume: bool = False, quiet: bool = False) -> Path:
    """Train, or go on with a training, and return the path of the exported weights.

    Raises InputError on unusable photos, WeightsError on an unusable checkpoint, ConfigError where `out` belongs to
    another configuration, and HmSfmError on a loss that is not finite (the last checkpoint stays).
    """
    out = Path(config.out)
    checkpoint = out / "checkpoint.pt"
    if config.precision not in ("auto", "fp32"):
        raise ConfigError(f"precision must be auto or fp32, found {config.precision!r}")
    if checkpoint.exists() and not resume:
        raise ConfigError(f"{out} already holds a training: go on with --resume, or name another folder")
    training, validation = split_photos(load_photos(Path(config.images)))
    device = pick_device(config.device)
    state = make_state(config, device)
    out.mkdir(parents=True, exist_ok=True)
    if checkpoint.exists():
        load_checkpoint(checkpoint, config, state)
    for name in ("log.csv", "validation.csv"):
        drop_rows_after(out / name, state.step)
    pairs = make_pairs(training, config, config.seed, config.steps * config.pairs_per_step)
    held_out = make_pairs(validation, config, config.seed + 1, len(validation))
    saved_at = time.monotonic()
    progress = tqdm(total=config.steps, initial=state.step, desc="training", unit="step", disable=quiet)
    with progress:
        for batch in iterate_batches(pairs, config.pairs_per_step, state.step):
            row = train_step(state, batch, config, device)
            append_row(out / "log.csv", row)
            progress.update()
            progress.set_postfix(loss=f"{row['loss']:.3f}")
            done = state.step == config.steps
            if state.step % config.validate_every == 0 or done:
                scores = validate(state.average, held_out, config, device)
                append_row(out / "validation.csv", {"step": state.step} | scores)
                if not quiet:
                    progress.write(f"step {state.step}: " + ", ".join(f"{k} {v:.3f}" for k, v in scores.items()))
            if time.monotonic() - saved_at > config.checkpoint_seconds or done:
                save_checkpoint(checkpoint, config, state)
                save_weights(out / "weights.pt", state.average)
                saved_at = time.monotonic()
    return out / "weights.pt"


def make_pairs(photos: list[np.ndarray], config: TrainConfig, seed: int, count: int) -> MixedPairs:
    """`count` pairs of both kinds, in the configured mixture."""
    warped = WarpedPhotos(photos, config.size_px, seed, count, config.warp)
    rendered = RenderedScenes(photos, config.size_px, seed, count, config.views)
    return MixedPairs(warped, rendered, config.rendered_share, seed)


def make_state(config: TrainConfig, device: torch.device) -> TrainState:
    """Network, its average and the optimizer at step 0; the parts that come from public weights are frozen."""
    torch.manual_seed(config.seed)
    net = HomoNet(config.network).to(device)
    if config.network.backbone == "light":
        load_xfeat(net.backbone.trunk, Path(config.start_from))
    else:
        load_loftr(net, Path(config.start_from))
    for part in net.frozen:
        part.requires_grad_(False)
    average = HomoNet(config.network).to(device)
    average.load_state_dict(net.state_dict())
    average.eval().requires_grad_(False)
    trained = [p for p in net.parameters() if p.requires_grad]
    return TrainState(net, average, torch.optim.AdamW(trained, lr=config.learning_rate, weight_decay=1e-4))


def iterate_batches(pairs: Dataset, batch_size: int, first_step: int) -> Iterator[dict[str, Tensor]]:
    """Batches from step `first_step` on, prepared in a process of their own."""
    sampler = range(first_step * batch_size, len(pairs))
    yield from DataLoader(pairs, batch_size, sampler=sampler, num_workers=1, prefetch_factor=8)


def train_step(state: TrainState, batch: dict[str, Tensor], config: TrainConfig, device: torch.device) -> dict:
    """One update of weights and average; returns the row for log.csv. Raises HmSfmError on a non-finite loss."""
    started = time.monotonic()
    rate = learning_rate_at(state.step, config)
    for group in state.optimizer.param_groups:
        group["lr"] = rate
    generator = torch.Generator().manual_seed(config.seed * 1_000_003 + state.step)
    state.net.train()
    for part in state.net.frozen:
        part.eval()
    estimates, truth = run_pairs(state.net, batch, config, device, generator)
    parts = measure_loss(estimates, truth, state.net.head.half)
    loss = parts["loss"]
    if not math.isfinite(loss.item()):
        raise HmSfmError(f"the loss is {loss.item()} at step {state.step}; the last checkpoint in {config.out} is kept")
    state.optimizer.zero_grad(set_to_none=True)
    loss.backward()
    trained = state.optimizer.param_groups[0]["params"]
    norm = nn.utils.clip_grad_norm_(trained, config.gradient_limit)
    state.optimizer.step()
    state.step += 1
    update_average(state, config.average_decay)
    row = {"step": state.step} | {name: value.item() for name, value in parts.items()}
    return row | {"gradient": norm.item(), "rate": rate, "seconds": time.monotonic() - started}


def run_pairs(
    net: HomoNet, batch: dict[str, Tensor], config: TrainConfig, device: torch.device, generator: torch.Generator
) -> tuple[list, PatchSupervision]:
    """Network output and truth of a batch of MixedPairs."""
    backbone = net.backbone
    truth = draw_patches(
        batch["b_from_a"],
        batch["surface"],
        config.patches_per_pair,
        backbone.coarse_grid,
        backbone.fine_grid,
        net.head.half,
        generator,
    )
    truth = PatchSupervision(*(getattr(truth, f.name).to(device) for f in dataclasses.fields(truth)))
    images = batch["images"].to(device).float() / 255
    if backbone.standardised:
        images = images - images.mean(dim=(2, 3), keepdim=True)
        images = images / images.std(dim=(2, 3), keepdim=True).clamp_min(1 / 255)
    with autocast(config.precision, device):
        fine = backbone(images.flatten(0, 1)[:, None]).fine.unflatten(0, (-1, 2))
        maps0, maps1 = make_fine_map(fine[:, 0]), make_fine_map(fine[:, 1])
        estimates = net.head(maps0, maps1, truth.image_index, truth.cell0, truth.cell1)
    return estimates, truth


def autocast(precision: str, device: torch.device):
    """The context that runs convolutions and matrix products in half precision."""
    if precision == "fp32":
        return nullcontext()
    return torch.autocast(device.type, dtype=torch.bfloat16)


def learning_rate_at(step: int, config: TrainConfig) -> float:
    """Linear warm-up, then a cosine down to 2 % of the peak."""
    if step < config.warmup_steps:
        return config.learning_rate * (step + 1) / config.warmup_steps
    share = (step - config.warmup_steps) / max(config.steps - config.warmup_steps, 1)
    return config.learning_rate * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(share, 1.0))))


@torch.no_grad()
def update_average(state: TrainState, decay: float) -> None:
    """Move the averaged weights towards the present ones; faster at the start."""
    decay = min(decay, (1 + state.step) / (10 + state.step))
    present = state.net.state_dict()
    for name, value in state.average.state_dict().items():
        if value.dtype.is_floating_point:
            value.lerp_(present[name], 1 - decay)
        else:
            value.copy_(present[name])


@torch.no_grad()
def validate(net: HomoNet, pairs: Dataset, config: TrainConfig, device: torch.device) -> dict[str, float]:
    """Errors of the dense points of correct matches on held-out pairs, in px of the network's input."""
    generator = torch.Generator().manual_seed(config.seed)
    errors = []
    for batch in DataLoader(pairs, batch_size=8):
        estimates, truth = run_pairs(net, batch, config, device, generator)
        errors.append(measure_errors(estimates[-1], truth)[truth.correct].flatten())
    epe = torch.cat(errors) * net.backbone.fine_grid.stride
    scores = {f"pck_{limit}px": (epe < limit).float().mean().item() for limit in (0.5, 1, 3, 5)}
    return {"median_px": epe.median().item()} | scores


def save_checkpoint(path: Path, config: TrainConfig, state: TrainState) -> None:
    """Write everything a resumed run needs; atomic."""
    content = {
        "fingerprint": run_fingerprint(config),
        "step": state.step,
        "net": state.net.state_dict(),
        "average": state.average.state_dict(),
        "optimizer": state.optimizer.state_dict(),
    }
    with replace_file(path) as temporary:
        torch.save(content, temporary)


def load_checkpoint(path: Path, config: TrainConfig, state: TrainState) -> None:
    """Put a checkpoint into `state`. Raises WeightsError where it is damaged, ConfigError where it is foreign."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        stored = content["fingerprint"]
    except Exception as error:
        raise WeightsError(f"cannot read the checkpoint {path}: {' '.join(str(error).split())[:200]}") from error
    if stored != run_fingerprint(config):
        raise ConfigError(f"{path} was made with another configuration: name another folder with `out`")
    state.net.load_state_dict(content["net"])
    state.average.load_state_dict(content["average"])
    state.optimizer.load_state_dict(content["optimizer"])
    state.step = content["step"]


def run_fingerprint(config: TrainConfig) -> str:
    """Fingerprint of what shapes the run; where things lie and how often they are saved does not."""
    return fingerprint(dataclasses.replace(config, images="", out="", start_from="", checkpoint_seconds=0.0, device=""))


def drop_rows_after(path: Path, step: int) -> None:
    """Remove the rows of a CSV file that an interrupted run logged after its last checkpoint; atomic."""
    if not path.exists():
        return
    lines = path.read_text().splitlines(keepends=True)
    kept = lines[:1] + [row for row in lines[1:] if int(row.split(",")[0]) <= step]
    with replace_file(path) as temporary:
        temporary.write_text("".join(kept))


def append_row(path: Path, row: dict) -> None:
    """Append a row to a CSV file, with the header where the file is new."""
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, row)
        if new:
            writer.writeheader()
        writer.writerow({key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()})
