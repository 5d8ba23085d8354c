"""Make a trained network's scores mean what they say: the share of its matches that is off by less than 1 px.

    python pipelines/training/calibrate_scores.py CONFIG WEIGHTS OUT

CONFIG is that of the training which made WEIGHTS. Its held-out pairs with known surfaces are matched, and the logarithm
of the head's error scale is replaced by the linear function of it under which the scores are most likely: the loss of
training fits the mean error, which says little of how often an error is small.
"""

import sys
from itertools import product
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.data import DataLoader

from hm_sfm.config import load_config
from hm_sfm.errors import ConfigError
from hm_sfm.network.checkpoints import load_weights, save_weights
from hm_sfm.network.device import pick_device
from hm_sfm.network.estimates import accuracy_from_scale
from hm_sfm.network.fine import HomographyHead
from hm_sfm.network.homonet import HomoNet
from hm_sfm.training.batches import make_pairs, read_batches
from hm_sfm.training.config import TrainConfig
from hm_sfm.training.loop import HELD_OUT_PAIRS
from hm_sfm.training.mixture import collate_pairs
from hm_sfm.training.objectives import autocast, judge_matches, measure_calibration, run_backbone
from hm_sfm.training.photos import load_photos, split_photos

FACTORS = torch.arange(0.5, 2.51, 0.05)
TERMS = torch.arange(-1.0, 1.01, 0.05)
"""Those that are tried."""


def calibrate_scores(config: TrainConfig, weights: str, out: Path) -> None:
    net = load_weights(weights, config.network).to(pick_device(config.device)).eval()
    if not isinstance(net.head, HomographyHead):
        raise ConfigError(
            f"{weights} must have network.head homography, whose error scale is learnt, found expectation"
        )
    log_scale, right = match_held_out(net, config)
    factor, term = fit_scale(log_scale, right)
    for name, value in (("before", log_scale), ("after", factor * log_scale + term)):
        scores = measure_calibration(accuracy_from_scale(value), right)
        print(name, ", ".join(f"{key} {number:.1f}" for key, number in scores.items()))
    print(f"log scale times {factor:.2f} plus {term:.2f}")
    scale = net.head.scale.state_dict()
    net.head.scale.load_state_dict({"weight": factor * scale["weight"], "bias": factor * scale["bias"] + term})
    save_weights(out, net)


@torch.no_grad()
def match_held_out(net: HomoNet, config: TrainConfig) -> tuple[Tensor, Tensor]:
    """Of the matches of the held-out pairs, the logarithm of the error scale, (M,) float32, and which are right."""
    _, photos = split_photos(load_photos(Path(config.images)))
    pairs = make_pairs(photos, config, config.seed + 1, HELD_OUT_PAIRS, True)
    judged = []
    for batch in read_batches(DataLoader(pairs, batch_size=4, num_workers=1, collate_fn=collate_pairs)):
        device = pick_device(config.device)
        with autocast(config.precision, device):
            maps = run_backbone(net, batch["images"].to(device), True)
            judged.append(judge_matches(net, maps, batch, config.coarse_threshold))
    log_scale, right = (torch.cat(parts) for parts in zip(*judged))
    return log_scale, right


def fit_scale(log_scale: Tensor, right: Tensor) -> tuple[float, float]:
    """The factor and the term of the linear function of `log_scale`, (M,), under which `right`, (M,), is likeliest."""

    def measure_surprise(factor: Tensor, term: Tensor) -> float:
        score = accuracy_from_scale(factor * log_scale + term).clamp(1e-4, 1 - 1e-4)
        return F.binary_cross_entropy(score, right.float()).item()

    factor, term = min(product(FACTORS, TERMS), key=lambda two: measure_surprise(*two))
    return factor.item(), term.item()


if __name__ == "__main__":
    calibrate_scores(load_config(Path(sys.argv[1]), (), TrainConfig), sys.argv[2], Path(sys.argv[3]))
