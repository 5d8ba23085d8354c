"""pipelines/training/calibrate_scores.py: the error scale that makes scores true."""

import dataclasses
import importlib
from pathlib import Path

import pytest
import torch

from hm_sfm.config import NetworkConfig
from hm_sfm.errors import ConfigError
from hm_sfm.network.checkpoints import load_weights, save_weights
from hm_sfm.network.estimates import accuracy_from_scale
from hm_sfm.network.homonet import HomoNet


@pytest.fixture
def recipe(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "pipelines" / "training")
    return importlib.import_module("calibrate_scores")


def test_the_fitted_scale_makes_scores_true(recipe):
    """Matches that are right more often than their scores say where these are high, and less often where low."""
    generator = torch.Generator().manual_seed(0)
    log_scale = torch.rand(6000, generator=generator) * 4 - 2.5
    right = torch.rand(6000, generator=generator) < accuracy_from_scale(1.6 * log_scale + 0.3)
    factor, term = recipe.fit_scale(log_scale, right)
    assert factor == pytest.approx(1.6, abs=0.1) and term == pytest.approx(0.3, abs=0.1)


@pytest.mark.slow
def test_only_the_error_scale_is_changed(recipe, training, tmp_path, monkeypatch):
    monkeypatch.setattr(recipe, "HELD_OUT_PAIRS", 2)
    monkeypatch.setattr(recipe, "fit_scale", lambda log_scale, right: (1.5, -0.25))
    network = NetworkConfig(coarse="cosine")
    torch.manual_seed(0)
    save_weights(tmp_path / "weights.pt", HomoNet(network))
    config = dataclasses.replace(training, network=network)
    recipe.calibrate_scores(config, str(tmp_path / "weights.pt"), tmp_path / "out.pt")
    before, after = (load_weights(str(tmp_path / name)) for name in ("weights.pt", "out.pt"))
    code = torch.randn(5, 128, 3, 3, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(after.head.scale(code), 1.5 * before.head.scale(code) - 0.25)
    changed = {key for key, value in before.state_dict().items() if not torch.equal(value, after.state_dict()[key])}
    assert changed == {"head.scale.weight", "head.scale.bias"}


def test_a_head_without_a_learnt_scale_is_refused(recipe, training, tmp_path):
    network = NetworkConfig(coarse="cosine", head="expectation")
    save_weights(tmp_path / "weights.pt", HomoNet(network))
    with pytest.raises(ConfigError, match="weights.pt must have network.head homography"):
        recipe.calibrate_scores(dataclasses.replace(training, network=network), str(tmp_path / "weights.pt"), tmp_path)
