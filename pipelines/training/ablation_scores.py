"""What ablate.py measures of a network: its matches of held-out pairs, relative poses, and the time its stages take."""

import json
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hm_sfm.config import ImageConfig, MatchingConfig, fingerprint
from hm_sfm.evaluation.relative_poses import PosePair, read_strecha_pairs, score_poses
from hm_sfm.geometry.homographies import apply_homographies
from hm_sfm.io.atomic import replace_file, write_json
from hm_sfm.matching.cells import choose_threshold
from hm_sfm.matching.encoder import pad_image
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.network.checkpoints import read_checkpoint
from hm_sfm.network.device import autocast
from hm_sfm.network.estimates import FINE_CHUNK
from hm_sfm.network.fine import make_fine_map
from hm_sfm.network.homonet import HomoNet
from hm_sfm.photos.images import prepare_image, read_ref
from hm_sfm.training.config import TrainConfig, run_fingerprint
from hm_sfm.training.losses import DENSE_RADIUS
from hm_sfm.training.mixture import MixedPairs, collate_pairs
from hm_sfm.training.multiview import VALIDATION_SCENES, PhotoPair, PhotoPairs, read_photo_pairs
from hm_sfm.training.objectives import score_network
from hm_sfm.training.photos import WarpedPhotos, load_photos, split_photos
from hm_sfm.training.scenes import RenderedScenes

SIZE_WH = (640, 480)
PAIRS = 48
"""Held-out pairs with known surfaces, and as many of real photos."""
LIMITS_PX = (1, 3)
TIMED_PATCHES = 2000
TIMED_CALLS = 9

POINTS = ("PCK@1", "PCK@3", "centre@1", "centre@3", "AUC@5")
CELLS = ("threshold", "recall", "precision", "real recall", "real precision")
CONFIDENCES = (0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.7)
"""What `equalise_precision` chooses from."""

Scores = dict[str, float]


@dataclass(frozen=True)
class Trial:
    """What all networks are judged by."""

    config: TrainConfig
    scene: Path
    photos: list[np.ndarray]
    """Held out from training."""
    real_scenes: list[list[PhotoPair]]
    """Pairs of each scene; empty where the configuration names no real photos."""
    pose_pairs: list[PosePair]

    @property
    def key(self) -> str:
        """Fingerprint of the trial and of what all trainings have in common."""
        return fingerprint(run_fingerprint(self.config), self.config.multiview, self.scene.name, SIZE_WH, PAIRS)

    @cached_property
    def known(self) -> list[dict[str, np.ndarray]]:
        """Pairs with known surfaces: as many warped photos as rendered scenes."""
        seed = self.config.seed + 1
        warped = WarpedPhotos(self.photos, SIZE_WH, seed, PAIRS, self.config.warp)
        rendered = RenderedScenes(self.photos, SIZE_WH, seed, PAIRS, self.config.views)
        pairs = MixedPairs([(warped, 0.5), (rendered, 0.5)], seed)
        return [pairs[index] for index in range(PAIRS)]

    @cached_property
    def real(self) -> list[dict[str, np.ndarray]]:
        """Pairs of real photos, known by single points."""
        pairs = PhotoPairs(self.real_scenes, SIZE_WH, self.config.seed + 1, PAIRS)
        return [pairs[index] for index in range(PAIRS)] if self.real_scenes else []


def prepare_trial(config: TrainConfig, scene: Path) -> Trial:
    """The trial of a configuration. Raises InputError on unusable photos, real scenes or pose scene."""
    _, photos = split_photos(load_photos(Path(config.images)))
    source = config.multiview
    names = VALIDATION_SCENES
    real_scenes = read_photo_pairs(Path(source.tracks), Path(source.photos), names) if source.tracks else []
    return Trial(config, scene, photos, real_scenes, read_strecha_pairs(scene))


def score_once(path: Path, score: Callable[[], Scores]) -> Scores:
    """The scores that an earlier run stored in `path`; otherwise those of now, which are stored there."""
    if not path.exists():
        scores = score()
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, scores)
    return json.loads(path.read_text())


def make_matcher(net: HomoNet, config: TrainConfig, min_confidence: float) -> HomoMatcher:
    matching = MatchingConfig(min_confidence=min_confidence, device=config.device)
    return HomoMatcher.from_network(net, matching, ImageConfig())


def score_cells(net: HomoNet, trial: Trial, min_confidence: float) -> Scores:
    """`recall` and `precision` of a network's coarse stage, and `real` ones on real photos, in percent.

    `threshold`, in percent: the least score of its matches; min_confidence, where they have confidences.
    """
    matcher = make_matcher(net, trial.config, min_confidence)
    batches = [collate_pairs([pair]) for pair in (*trial.known, *trial.real)]
    threshold, precision = choose_threshold(net, matcher.config), trial.config.precision
    scores = score_network(net, batches, "coarse", 0, threshold, precision, matcher.device, torch.Generator())
    named = {name.replace("rendered_", "").replace("_", " "): value for name, value in scores.items()}
    return {"threshold": 100 * threshold} | named


def equalise_precision(net: HomoNet, trial: Trial, precision: float) -> float:
    """Of CONFIDENCES the one at which the precision of a network's coarse matches is nearest to that of another.

    precision: percent. Two stages whose scores mean different things are comparable at one precision only.
    """

    def measure(min_confidence: float) -> float:
        return abs(score_cells(net, trial, min_confidence)["precision"] - precision)

    return min(CONFIDENCES, key=measure)


def score_net(net: HomoNet, trial: Trial, min_confidence: float) -> Scores:
    """All metrics of a network: CELLS, and what score_matches measures."""
    return score_cells(net, trial, min_confidence) | score_matches(net, trial, min_confidence)


def score_matches(net: HomoNet, trial: Trial, min_confidence: float) -> Scores:
    """Metrics of a network's matches.

    `PCK` of the points that its patches cover, `centre` of the patches' centres alone and `AUC@5` of poses, all in
    percent, and `ms` of its stages.
    """
    matcher, scores = make_matcher(net, trial.config, min_confidence), {}
    errors = [measure_matches(matcher, pair) for pair in trial.known]
    for name, parts in zip(("PCK", "centre"), zip(*errors)):
        pooled = np.concatenate(parts)
        scores |= {f"{name}@{limit}": 100 * float((pooled < limit).sum()) / max(len(pooled), 1) for limit in LIMITS_PX}
    scores["AUC@5"] = score_poses(matcher, trial.pose_pairs, quiet=True)["opencv_auc_5deg"]
    return scores | time_stages(matcher, trial.pose_pairs[0])


def measure_matches(matcher: HomoMatcher, pair: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Errors, px, of the matches of a pair with known surfaces.

    Returns those of the pixels within r_e of a patch's centre (N,), and those of the centres (M,). Points that view B
    does not show are left out; all points of a wrong coarse match count.
    """
    height, width = pair["surface"].shape

    def measure(xy0: np.ndarray, xy1: np.ndarray) -> np.ndarray:
        inside = ((xy0 >= 0) & (xy0 < (width, height))).all(axis=1)
        xy0, xy1 = xy0[inside], xy1[inside]
        column, row = xy0.astype(np.int64).T
        surface = pair["surface"][row, column]
        shown = surface >= 0
        return np.linalg.norm(xy1[shown] - apply_homographies(pair["b_from_a"][surface[shown]], xy0[shown]), axis=1)

    matches = matcher.match(*pair["images"])
    return measure(*matches.densify(DENSE_RADIUS / matcher.net.head.half)), measure(matches.xy0, matches.xy1)


def time_stages(matcher: HomoMatcher, pair: PosePair) -> Scores:
    """Milliseconds of the coarse stage of a pair of photos, and of the fine stage for TIMED_PATCHES patches.

    The patches are processed in chunks, as in matching. The time of the backbone, which runs once per image, is in
    neither.
    """
    net, device = matcher.net, matcher.device
    backbone, head = net.backbone, net.head
    generator = torch.Generator().manual_seed(0)

    def run_coarse() -> Tensor:
        cells = [net.coarse.describe(view.coarse)[0].flatten(1).T.contiguous() for view in views]
        return net.coarse.match(*cells, choose_threshold(net, matcher.config))[0]

    def run_fine() -> Tensor:
        for cell0, cell1 in zip(*(each.split(FINE_CHUNK) for each in cells)):
            estimates = head(*fine, torch.zeros_like(cell0[:, 0]), cell0, cell1)
        return estimates[-1].homography

    with torch.inference_mode(), autocast(device):
        photos = [prepare_image(read_ref(path), matcher.images.long_edge_px) for path in (pair.path0, pair.path1)]
        pixels = [torch.tensor(photo.grey, device=device) for photo in photos]
        views = [backbone(pad_image(grey, backbone.stride, backbone.standardised)) for grey in pixels]
        fine = [make_fine_map(view.fine) for view in views]
        draws = [torch.rand(TIMED_PATCHES, 2, generator=generator) * torch.tensor(view.size_wh) for view in fine]
        cells = [draw.long().to(device) for draw in draws]
        return {"coarse ms": time_calls(run_coarse), "fine ms": time_calls(run_fine)}


def time_calls(call: Callable[[], Tensor]) -> float:
    """Median milliseconds of TIMED_CALLS calls; the one before them does not count."""
    milliseconds = []
    for _ in range(TIMED_CALLS + 1):
        started = time.perf_counter()
        call().cpu()  # waits for a GPU
        milliseconds.append(1000 * (time.perf_counter() - started))
    return statistics.median(milliseconds[1:])


def drop_transformer(net: HomoNet) -> HomoNet:
    """The same network, matched by mutual nearest neighbours of the plain features."""
    plain = HomoNet(replace(net.config, coarse="cosine"))
    plain.load_state_dict({key: value for key, value in net.state_dict().items() if not key.startswith("coarse.")})
    return plain


def drop_head(weights: Path, path: Path) -> Path:
    """Where the weights without their head lie: at `path` now, or as they are where they are a backbone's alone."""
    content = read_checkpoint(weights)
    if "state_dict" not in content:
        return weights
    state = {key: value for key, value in content["state_dict"].items() if not key.startswith("head.")}
    path.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(path) as temporary:
        torch.save({**content, "state_dict": state}, temporary)
    return path


def describe_trial(config: TrainConfig, scene: Path, command: str) -> str:
    """What the tables say and how they were made, as Markdown."""
    net = config.network
    real = (
        "; the `real` columns: as many pairs of the real scenes kept for validation" if config.multiview.tracks else ""
    )
    return f"""# Ablations

Made by

    {command}

Each version of the fine stage is trained for {config.steps} steps of {config.pairs_per_step} pairs of
{config.size_px} px. It starts from the features of `{Path(config.start_from).name}`, which go on learning, and a
new head. The first table is of w/r/K = {net.window}/{net.radius}/{net.iterations}. In the second, homographies are
supervised as in the last row of the first; `expectation` is LoFTR's head, of which only the centre can be
supervised. With spacing 2 every second cell of a patch is looked up along each axis, a quarter of them, and the layers
are wider.

- `recall` and `precision`, in percent: the share of the true coarse matches that are matched, and the share of these
  that are right to within a cell, at a `threshold`, percent, of the cosine (without the transformer) or the confidence
  (with it, where the precision is nearest to that without it). {PAIRS} pairs of {SIZE_WH[0]} x {SIZE_WH[1]} px, made of
  photos held out from training{real}.
- `PCK@1` and `PCK@3`: visible points of the matched patches that are within 1 and 3 px of the ground truth, in
  percent, on the same pairs; all points of a wrong coarse match count. `centre`: the centres of the patches
  alone.
- `AUC@5`: of relative poses on all pairs of {scene.name}, at 5 degrees, in percent; OpenCV's RANSAC, as in LoFTR.
- `fine ms`: of {TIMED_PATCHES} patches; `coarse ms`: of a pair of {scene.name}. Medians of {TIMED_CALLS} calls,
  {torch.get_num_threads()} threads, PyTorch {torch.__version__}, device {config.device}.
"""
