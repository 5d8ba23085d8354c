"""The training loop: one stage of the network or both, resumable to the step, logged to CSV, checked on held-out pairs.

Several processes (torchrun) train one network: of each step's pairs, every process takes an equal share, and gradients
are averaged. Each loss is a mean over the process's share, so the mean over the processes is that of the whole step
up to pairs without a true match, and up to the number of correct patches for the fine stage. Batch norms see their own
process's share, and the patches that the fine stage draws depend on the number of processes; the pairs do not.
"""

import csv
import dataclasses
import logging
import math
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm

from hm_sfm.config import NetworkConfig, fingerprint
from hm_sfm.errors import ConfigError, HmSfmError, MissingPackageError, WeightsError
from hm_sfm.io.atomic import replace_file
from hm_sfm.network.backbone import load_xfeat
from hm_sfm.network.checkpoints import fit_state, load_loftr, load_parts, read_checkpoint, save_weights
from hm_sfm.network.homonet import HomoNet
from hm_sfm.training.curves import draw_curves
from hm_sfm.training.megadepth import MegaDepthPairs
from hm_sfm.training.mixture import MixedPairs, collate_pairs
from hm_sfm.training.multiview import VALIDATION_SCENES, PhotoPairs, read_photo_pairs
from hm_sfm.training.objectives import measure_objective, score_network
from hm_sfm.training.photos import WarpedPhotos, WarpRange, load_photos, split_photos
from hm_sfm.training.processes import Processes, find_processes, join_processes
from hm_sfm.training.scenes import RenderedScenes, ViewRange

logger = logging.getLogger(__name__)

HELD_OUT_PAIRS = 96
"""Pairs that a validation looks at."""
MOST_WORKERS = 8
"""Processes that prepare the batches of one training process."""
STAGES = ("fine", "coarse", "joint")
SUPERVISIONS = ("centre", "dense", "suppressed")


@dataclass(frozen=True)
class MultiviewSource:
    """Where the real pairs are; needed where real_share is not 0."""

    photos: str = ""
    """Folder of a folder of photos a scene."""
    tracks: str = ""
    """Folder of <scene>/tracks.h5, made by pipelines/training/make_teacher_tracks.py."""


@dataclass(frozen=True)
class MegaDepthSource:
    """Where MegaDepth is; needed where megadepth_share is not 0."""

    root: str = ""
    """Folder that the paths in the scene_info files start from."""
    scene_info: str = ""
    """Folder of the scene_info files (*.npz) of the scenes to train on."""
    validation_info: str = ""
    """Folder of those of the held-out scenes."""


@dataclass(frozen=True)
class TrainConfig:
    """Everything a training run depends on; read from YAML."""

    images: str
    """Folder of photos, searched with its subfolders."""
    out: str
    """Folder for checkpoint.pt, weights.pt, log.csv, validation.csv and curves.png."""
    start_from: str
    """Weights to start from: those of an earlier hm-sfm train (parts that fit; the others start new), XFeat's file for
    the backbone `light`, a LoFTR checkpoint for `loftr`."""
    stage: str = "fine"
    """fine (its features and the head) | coarse (the coarse stage alone) | joint (both)."""
    supervise: str = "suppressed"
    """Of the fine stage: centre (the patch's centre alone) | dense (81 points) | suppressed (them, and also patches one
    cell off, as mutual nearest neighbours suppress them)."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    warp: WarpRange = field(default_factory=WarpRange)
    views: ViewRange = field(default_factory=ViewRange)
    multiview: MultiviewSource = field(default_factory=MultiviewSource)
    megadepth: MegaDepthSource = field(default_factory=MegaDepthSource)
    rendered_share: float = 0.0
    """Of the pairs that are rendered scenes with parallax; what no share takes are warped photos."""
    real_share: float = 0.0
    """Of the pairs that are real photos of reconstructed scenes."""
    megadepth_share: float = 0.0
    """Of the pairs that are MegaDepth's."""
    steps: int = 8000
    pairs_per_step: int = 4
    """Of all processes together."""
    patches_per_pair: int = 256
    size_px: int = 256
    learning_rate: float = 1e-3
    warmup_steps: int = 200
    gradient_limit: float = 1.0
    average_decay: float = 0.998
    """Of the exponential moving average of the weights, which is what is validated and exported."""
    precision: str = "auto"
    """auto (bf16 for convolutions and matrix products) | fp32."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    validate_every: int = 500
    coarse_threshold: float = 0.2
    """Least confidence of a coarse match, where held-out pairs are matched."""
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

    Where torchrun's environment is set, this is one of several processes; the first one writes. Raises InputError on
    unusable photos, WeightsError on an unusable checkpoint, ConfigError where `out` belongs to another configuration,
    and HmSfmError on a loss or gradient that is not finite (the last checkpoint stays).
    """
    check_config(config)
    processes = find_processes()
    if config.pairs_per_step % processes.count:
        raise ConfigError(
            f"pairs_per_step must be a multiple of the {processes.count} processes, found {config.pairs_per_step}"
        )
    with join_processes(processes, config.device) as device:
        return run_training(config, resume, quiet, processes, device)


def run_training(config: TrainConfig, resume: bool, quiet: bool, processes: Processes, device: torch.device) -> Path:
    """What `train` does, in one of its processes."""
    out = Path(config.out)
    checkpoint = out / "checkpoint.pt"
    if checkpoint.exists() and not resume:
        raise ConfigError(f"{out} already holds a training: go on with --resume, or name another folder")
    training, validation = split_photos(load_photos(Path(config.images)))
    state = make_state(config, device)
    if checkpoint.exists():
        load_checkpoint(checkpoint, config, state)
    pairs = make_pairs(training, config, config.seed, config.steps * config.pairs_per_step, False)
    held_out = make_pairs(validation, config, config.seed + 1, HELD_OUT_PAIRS, True)
    if processes.is_first:
        out.mkdir(parents=True, exist_ok=True)
        for name in ("log.csv", "validation.csv"):
            drop_rows_after(out / name, state.step)
    undrawn = None
    saved_at = time.monotonic()
    progress = tqdm(
        total=config.steps, initial=state.step, desc="training", unit="step", disable=quiet or not processes.is_first
    )
    with progress:
        for batch in iterate_batches(pairs, config.pairs_per_step, state.step, processes):
            row = train_step(state, batch, config, device, processes)
            if not processes.is_first:
                continue
            append_row(out / "log.csv", row)
            progress.update()
            progress.set_postfix(loss=f"{row['loss']:.3f}")
            done = state.step == config.steps
            if state.step % config.validate_every == 0 or done:
                scores = validate(state.average, held_out, config, device)
                append_row(out / "validation.csv", {"step": state.step} | scores)
                if not quiet:
                    progress.write(f"step {state.step}: " + ", ".join(f"{k} {v:.3f}" for k, v in scores.items()))
                try:
                    draw_curves(out / "log.csv", out / "validation.csv", out / "curves.png")
                except MissingPackageError as error:
                    undrawn = error
            if time.monotonic() - saved_at > config.checkpoint_seconds or done:
                save_checkpoint(checkpoint, config, state)
                save_weights(out / "weights.pt", state.average)
                saved_at = time.monotonic()
    if undrawn:
        logger.warning("%s", undrawn)
    return out / "weights.pt"


def check_config(config: TrainConfig) -> None:
    """Raises ConfigError on a value that no training can use."""
    if config.precision not in ("auto", "fp32"):
        raise ConfigError(f"precision must be auto or fp32, found {config.precision!r}")
    if config.stage not in STAGES:
        raise ConfigError(f"stage must be {', '.join(STAGES[:-1])} or {STAGES[-1]}, found {config.stage!r}")
    if config.supervise not in SUPERVISIONS:
        raise ConfigError(f"supervise must be centre, dense or suppressed, found {config.supervise!r}")
    for name in ("steps", "pairs_per_step", "patches_per_pair", "size_px", "validate_every"):
        if getattr(config, name) < 1:
            raise ConfigError(f"{name} must be at least 1, found {getattr(config, name)}")
    if config.stage != "fine" and config.network.coarse == "cosine":
        raise ConfigError("network.coarse cosine has nothing to train: take attention or aspan, or stage fine")
    shares = (config.rendered_share, config.real_share, config.megadepth_share)
    if min(shares) < 0 or sum(shares) > 1 + 1e-9:
        raise ConfigError(
            "rendered_share, real_share and megadepth_share must be shares of one whole, "
            f"found {', '.join(map(str, shares))}"
        )
    for share, name in ((config.real_share, "multiview"), (config.megadepth_share, "megadepth")):
        places = dataclasses.asdict(getattr(config, name))
        if share and not all(places.values()):
            raise ConfigError(f"the share of {name} needs " + ", ".join(f"{name}.{key}" for key in places))


def make_pairs(photos: list[np.ndarray], config: TrainConfig, seed: int, count: int, held_out: bool) -> MixedPairs:
    """`count` pairs of all kinds, in the configured mixture; held_out: of the scenes that validate."""
    size_wh = (config.size_px, config.size_px)
    rest = 1 - config.rendered_share - config.real_share - config.megadepth_share
    kinds: list[tuple[Dataset, float]] = [
        # What is left over by rounding is no share.
        (WarpedPhotos(photos, size_wh, seed, count, config.warp), rest if rest > 1e-9 else 0.0),
        (RenderedScenes(photos, size_wh, seed, count, config.views), config.rendered_share),
    ]
    if config.real_share:
        source = config.multiview
        names = VALIDATION_SCENES if held_out else None
        found = read_photo_pairs(Path(source.tracks), Path(source.photos), names)
        kinds.append((PhotoPairs(found, size_wh, seed, count), config.real_share))
    if config.megadepth_share:
        source = config.megadepth
        scene_info = Path(source.validation_info if held_out else source.scene_info)
        pairs = MegaDepthPairs(Path(source.root), scene_info, size_wh, seed, count)
        kinds.append((pairs, config.megadepth_share))
    return MixedPairs(kinds, seed)


def make_state(config: TrainConfig, device: torch.device) -> TrainState:
    """Network, its average and the optimizer at step 0; the parts that are not trained are frozen.

    Raises ConfigError on an impossible network or a size of the views that it cannot take, WeightsError where the
    weights to start from are unusable.
    """
    torch.manual_seed(config.seed)
    net = HomoNet(config.network).to(device)
    if config.size_px % net.backbone.stride:
        raise ConfigError(f"size_px must be a multiple of {net.backbone.stride}, found {config.size_px}")
    start_network(net, Path(config.start_from))
    net.requires_grad_(False)
    for part in find_trained(net, config.stage):
        part.requires_grad_(True)
    average = HomoNet(config.network).to(device)
    average.load_state_dict(net.state_dict())
    average.eval().requires_grad_(False)
    trained = [p for p in net.parameters() if p.requires_grad]
    return TrainState(net, average, torch.optim.AdamW(trained, lr=config.learning_rate, weight_decay=1e-4))


def start_network(net: HomoNet, path: Path) -> None:
    """Load the weights to start from: of hm-sfm train, or public ones of the network's backbone.

    Raises WeightsError where the file is damaged or holds nothing that fits.
    """
    content = read_checkpoint(path)
    if "network" in content:
        new = load_parts(net, content, path)
        if new:
            logger.warning("%s has no fitting weights for %s: they start new", path, ", ".join(new))
    elif net.config.backbone == "light":
        load_xfeat(net.backbone.trunk, path)
    else:
        load_loftr(net, path)


def find_trained(net: HomoNet, stage: str) -> list[nn.Module]:
    """The parts that a stage trains. The trunk of `light` always stays as it is; LoFTR's backbone learns in `joint`."""
    fine = [net.backbone.fine] if net.config.backbone == "light" else []
    backbone = fine if net.config.backbone == "light" else [net.backbone]
    return {"fine": [*fine, net.head], "coarse": [net.coarse], "joint": [*backbone, net.coarse, net.head]}[stage]


def iterate_batches(
    pairs: Dataset, pairs_per_step: int, first_step: int, processes: Processes
) -> Iterator[dict[str, Tensor]]:
    """This process's share of each step's pairs, from step `first_step` on, prepared in processes of their own."""
    share = pairs_per_step // processes.count
    first_pair = first_step * pairs_per_step + processes.rank * share
    batches = [range(pair, pair + share) for pair in range(first_pair, len(pairs), pairs_per_step)]
    workers = min(max((os.cpu_count() or 1) // (2 * processes.count), 1), MOST_WORKERS)
    loader = DataLoader(
        pairs,
        batch_sampler=batches,
        num_workers=workers,
        prefetch_factor=max(8 // workers, 2),
        collate_fn=collate_pairs,
    )
    yield from read_batches(loader)


def read_batches(loader: DataLoader) -> Iterator[dict[str, Tensor]]:
    """The batches of a loader. The errors of its processes come as these raised them, without traces in their text."""
    try:
        yield from loader
    except HmSfmError as error:
        last_line = str(error).strip().splitlines()[-1]
        raise type(error)(last_line.partition(": ")[2]) from None


def train_step(
    state: TrainState, batch: dict[str, Tensor], config: TrainConfig, device: torch.device, processes: Processes
) -> dict:
    """One update of weights and average, by this process's share of the pairs; returns the row for log.csv, which is
    the same in all processes but for the seconds.

    Raises HmSfmError, in all processes, on a loss or gradient that is not finite.
    """
    started = time.monotonic()
    rate = learning_rate_at(state.step, config)
    for group in state.optimizer.param_groups:
        group["lr"] = rate
    generator = torch.Generator().manual_seed(config.seed * 1_000_003 + state.step + (processes.rank << 40))
    state.net.eval()
    trained = find_trained(state.net, config.stage)
    for part in trained:
        part.train()
    parts = measure_objective(
        state.net, batch, config.stage, config.patches_per_pair, config.precision, device, generator, config.supervise
    )
    means = {name: value.detach().clone() for name, value in parts.items()}
    processes.average(list(means.values()))
    check_finite("loss", means["loss"], state.step, config)
    state.optimizer.zero_grad(set_to_none=True)
    parts["loss"].backward()
    average_gradients(state.optimizer.param_groups[0]["params"], processes)
    norm = nn.utils.clip_grad_norm_(state.optimizer.param_groups[0]["params"], config.gradient_limit)
    check_finite("gradient", norm, state.step, config)
    state.optimizer.step()
    # Running statistics of batch norms: each process has seen its share of the pairs.
    processes.average([x for part in trained for x in part.buffers() if x.is_floating_point()])
    state.step += 1
    update_average(state, config.average_decay)
    row = {"step": state.step} | {name: value.item() for name, value in means.items()}
    return row | {"gradient": norm.item(), "rate": rate, "seconds": time.monotonic() - started}


def check_finite(name: str, value: Tensor, step: int, config: TrainConfig) -> None:
    """Raises HmSfmError, before any weight is changed, where a scalar is not finite."""
    if not math.isfinite(value.item()):
        raise HmSfmError(f"the {name} is {value.item()} at step {step}; the last checkpoint in {config.out} is kept")


def average_gradients(parameters: list[nn.Parameter], processes: Processes) -> None:
    """Replace each gradient by its mean over the processes; one that a process does not have counts as zero."""
    if processes.count == 1:
        return
    for parameter in parameters:
        if parameter.grad is None:
            parameter.grad = torch.zeros_like(parameter)
    processes.average([parameter.grad for parameter in parameters])


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


def validate(net: HomoNet, pairs: Dataset, config: TrainConfig, device: torch.device) -> dict[str, float]:
    """score_network on the held-out pairs."""
    generator = torch.Generator().manual_seed(config.seed)
    batches = read_batches(DataLoader(pairs, batch_size=4, num_workers=1, collate_fn=collate_pairs))
    return score_network(
        net,
        batches,
        config.stage,
        config.patches_per_pair,
        config.coarse_threshold,
        config.precision,
        device,
        generator,
    )


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
    content = read_checkpoint(path)
    missing = [key for key in ("fingerprint", "step", "net", "average", "optimizer") if key not in content]
    if missing:
        raise WeightsError(f"{path} is no checkpoint of hm-sfm train: it lacks {', '.join(missing)}")
    if content["fingerprint"] != run_fingerprint(config):
        raise ConfigError(f"{path} was made with another configuration: name another folder with `out`")
    fit_state(state.net, content["net"], path)
    fit_state(state.average, content["average"], path)
    state.optimizer.load_state_dict(content["optimizer"])
    state.step = content["step"]


def run_fingerprint(config: TrainConfig) -> str:
    """Fingerprint of what shapes the run; where things lie and how often they are saved does not."""
    return fingerprint(
        dataclasses.replace(
            config,
            images="",
            out="",
            start_from="",
            multiview=MultiviewSource(),
            megadepth=MegaDepthSource(),
            checkpoint_seconds=0.0,
            device="",
        )
    )


def drop_rows_after(path: Path, step: int) -> None:
    """Remove the rows of a CSV file that an interrupted run logged after its last checkpoint; atomic."""
    if not path.exists():
        return
    header, *rows = path.read_text().splitlines(keepends=True) or [""]
    # The last row may be cut short where the machine went down.
    whole = [row for row in rows if row.endswith("\n") and row.count(",") == header.count(",")]
    kept = [header] + [row for row in whole if int(row.split(",")[0]) <= step]
    with replace_file(path) as temporary:
        temporary.write_text("".join(kept))


def append_row(path: Path, row: dict) -> None:
    """Append a row to a CSV file, with the header where the file is new or empty."""
    new = not path.exists() or not path.stat().st_size
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, row)
        if new:
            writer.writeheader()
        writer.writerow({key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()})
