"""The state of a training: the network, its average and the optimizer, in memory and in checkpoint.pt."""

import logging
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import nn

from hm_sfm.errors import ConfigError, WeightsError
from hm_sfm.io.atomic import replace_file
from hm_sfm.network.backbone import LightBackbone, load_xfeat
from hm_sfm.network.checkpoints import fit_state, load_loftr, load_parts, read_checkpoint
from hm_sfm.network.homonet import HomoNet
from hm_sfm.training.config import TrainConfig, run_fingerprint

logger = logging.getLogger(__name__)


@dataclass
class TrainState:
    """What a checkpoint holds besides the configuration."""

    net: HomoNet
    average: HomoNet
    optimizer: torch.optim.Optimizer
    step: int = 0


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
    elif isinstance(net.backbone, LightBackbone):
        load_xfeat(net.backbone.trunk, path)
    else:
        load_loftr(net, path)


def find_trained(net: HomoNet, stage: str) -> list[nn.Module]:
    """The parts that a stage trains. The trunk of `light` always stays as it is; LoFTR's backbone learns in `joint`."""
    fine = [net.backbone.fine] if net.config.backbone == "light" else []
    backbone = fine if net.config.backbone == "light" else [net.backbone]
    return {"fine": [*fine, net.head], "coarse": [net.coarse], "joint": [*backbone, net.coarse, net.head]}[stage]


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
