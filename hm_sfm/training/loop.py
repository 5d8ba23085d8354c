"""The training loop: one stage of the network or both, resumable to the step, logged to CSV, checked on held-out pairs.

Several processes (torchrun) train one network: of each step's pairs, every process takes an equal share, and gradients
are averaged. Each loss is a mean over the process's share, so the mean over the processes is that of the whole step
up to pairs without a true match, and up to the number of correct patches for the fine stage. Batch norms see their own
process's share, and the patches that the fine stage draws depend on the number of processes; the pairs do not.
"""

import logging
import math
import time
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm

from hm_sfm.errors import ConfigError, HmSfmError, MissingPackageError
from hm_sfm.network.checkpoints import save_weights
from hm_sfm.network.homonet import HomoNet
from hm_sfm.training.batches import iterate_batches, make_pairs, read_batches
from hm_sfm.training.config import TrainConfig, check_config
from hm_sfm.training.curves import draw_curves
from hm_sfm.training.log import append_row, drop_rows_after
from hm_sfm.training.mixture import collate_pairs
from hm_sfm.training.objectives import measure_objective, score_network
from hm_sfm.training.photos import load_photos, split_photos
from hm_sfm.training.processes import Processes, find_processes, join_processes
from hm_sfm.training.state import (
    TrainState,
    find_trained,
    load_checkpoint,
    make_state,
    save_checkpoint,
    update_average,
)

logger = logging.getLogger(__name__)

HELD_OUT_PAIRS = 96
"""Number of pairs in the validation set."""


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


def train_step(
    state: TrainState, batch: dict[str, Tensor], config: TrainConfig, device: torch.device, processes: Processes
) -> dict:
    """One update of weights and average, by this process's share of the pairs.

    Returns the row for log.csv, which is the same in all processes but for the seconds. Raises HmSfmError, in all
    processes, on a loss or gradient that is not finite.
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
    processes.average([parameter.grad for parameter in parameters if parameter.grad is not None])


def learning_rate_at(step: int, config: TrainConfig) -> float:
    """Linear warm-up, then a cosine down to 2 % of the peak."""
    if step < config.warmup_steps:
        return config.learning_rate * (step + 1) / config.warmup_steps
    share = (step - config.warmup_steps) / max(config.steps - config.warmup_steps, 1)
    return config.learning_rate * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(share, 1.0))))


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
