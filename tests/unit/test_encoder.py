"""Encoding large photos in strips."""

import numpy as np
import pytest
import torch

from hm_sfm.config import NetworkConfig
from hm_sfm.matching import encoder
from hm_sfm.matching.encoder import Encoder
from hm_sfm.network.checkpoints import load_weights
from hm_sfm.network.homonet import HomoNet
from hm_sfm.photos.images import prepare_array

CPU = torch.device("cpu")


def make_net(backbone: str) -> HomoNet:
    if backbone == "light":
        return load_weights("light")
    torch.manual_seed(0)
    return HomoNet(NetworkConfig(backbone="loftr", coarse="attention", iterations=1))


@pytest.mark.parametrize(("backbone", "size_hw"), [("light", (1090, 70)), ("loftr", (210, 40))])
def test_strips_make_the_features_of_the_whole(monkeypatch, backbone, size_hw):
    """Bright at one end and dark at the other: a strip that were standardised by itself would differ, too."""
    noise = np.random.default_rng(0).normal(size=size_hw)
    light = np.linspace(60, 190, size_hw[0])[:, None]
    image = prepare_array(np.clip(light + 40 * noise, 0, 255).astype(np.uint8), 4096)
    encode = Encoder(make_net(backbone), CPU, 16).encode_fine
    monkeypatch.setattr(encoder, "STRIP_PX", 2048)
    whole = encode(image)
    monkeypatch.setattr(encoder, "STRIP_PX", 96)
    strips = encode(image)
    assert strips.size_wh == whole.size_wh
    largest = whole.cells.abs().max()
    np.testing.assert_allclose(strips.cells.float(), whole.cells.float(), rtol=0, atol=1e-4 * float(largest))
