"""A training small enough for tests."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from hm_sfm.config import NetworkConfig
from hm_sfm.network.backbone import XFeatTrunk
from hm_sfm.training import loop
from hm_sfm.training.config import TrainConfig


def make_photo(width: int, height: int, seed: int = 0) -> np.ndarray:
    """(H, W) uint8: smoothed noise."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(height, width)), (0, 0), 2.5)
    return np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)


def write_xfeat(path: Path) -> Path:
    """A file with the names of XFeat's, including its heads, and random values."""
    torch.manual_seed(5)
    trunk = XFeatTrunk()
    content = {"keypoint_head.0.layer.0.weight": torch.zeros(64, 64, 1, 1)}
    for name, value in trunk.state_dict().items():
        parts = name.split(".")
        if len(parts) == 4:
            parts.insert(2, "layer")
        content[".".join(parts)] = value
    torch.save(content, path)
    return path


@pytest.fixture
def training(tmp_path, one_thread, monkeypatch) -> TrainConfig:
    """Six steps of one pair, validated on four pairs after every third one, saved after each; no pictures."""
    monkeypatch.setattr(loop, "HELD_OUT_PAIRS", 4)
    monkeypatch.setattr(loop, "draw_curves", lambda log, validation, path: path.touch())
    (tmp_path / "photos").mkdir()
    for i in range(4):
        cv2.imwrite(str(tmp_path / "photos" / f"{i}.png"), make_photo(160, 144, i))
    return TrainConfig(
        images=str(tmp_path / "photos"),
        out=str(tmp_path / "out"),
        start_from=str(write_xfeat(tmp_path / "xfeat.pt")),
        network=NetworkConfig(coarse="attention", window=5, iterations=2, margin=0),
        steps=6,
        size_px=64,
        pairs_per_step=1,
        patches_per_pair=16,
        warmup_steps=2,
        validate_every=3,
        precision="fp32",
        device="cpu",
        checkpoint_seconds=0.0,
    )
