"""What a training depends on, read from YAML."""

import dataclasses
from dataclasses import dataclass, field
from typing import Literal

from hm_sfm.config import NetworkConfig, check_words, fingerprint
from hm_sfm.errors import ConfigError
from hm_sfm.training.photos import WarpRange
from hm_sfm.training.scenes import ViewRange

Stage = Literal["fine", "coarse", "joint"]


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
    stage: Stage = "fine"
    """fine (its features and the head) | coarse (the coarse stage alone) | joint (both)."""
    supervise: Literal["centre", "dense", "suppressed"] = "suppressed"
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
    precision: Literal["auto", "fp32"] = "auto"
    """auto (bf16 for convolutions and matrix products) | fp32."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    validate_every: int = 500
    coarse_threshold: float = 0.2
    """Least confidence of a coarse match, where held-out pairs are matched."""
    checkpoint_seconds: float = 120.0
    seed: int = 0

    def __post_init__(self) -> None:
        check_words(self, "")


def check_config(config: TrainConfig) -> None:
    """Raises ConfigError on a value that no training can use."""
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


def run_fingerprint(config: TrainConfig) -> str:
    """Fingerprint of what shapes the run; where things lie and how often they are saved does not."""
    ignored = {
        "images": "",
        "out": "",
        "start_from": "",
        "multiview": dataclasses.asdict(MultiviewSource()),
        "megadepth": dataclasses.asdict(MegaDepthSource()),
        "checkpoint_seconds": 0.0,
        "device": "",
    }
    return fingerprint(dataclasses.asdict(config) | ignored)
