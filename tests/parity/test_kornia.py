"""LoFTR's own matches: kornia's network, with its points in px of the stored photos."""

import sys

import numpy as np
import pytest
import torch
from kornia.feature import LoFTR

from hm_sfm.config import ImageConfig, MatchingConfig
from hm_sfm.errors import MissingPackageError, WeightsError
from hm_sfm.evaluation.loftr import LoftrMatcher
from hm_sfm.photos.images import prepare_array


@pytest.fixture(scope="module")
def net() -> LoFTR:
    torch.manual_seed(0)
    return LoFTR(pretrained=None).eval()


@pytest.fixture(scope="module")
def checkpoint(net, tmp_path_factory):
    """A file laid out as the public checkpoints are."""
    path = tmp_path_factory.mktemp("loftr") / "loftr.ckpt"
    torch.save({"state_dict": {f"matcher.{key}": value for key, value in net.state_dict().items()}}, path)
    return path


@pytest.fixture(scope="module")
def matcher(checkpoint) -> LoftrMatcher:
    return LoftrMatcher(checkpoint, MatchingConfig(device="cpu", max_matches=3), ImageConfig(long_edge_px=100))


def test_the_network_is_that_of_the_checkpoint(matcher, net):
    image = torch.rand(1, 1, 32, 40, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        for actual, expected in zip(matcher.net.backbone(image), net.backbone(image)):
            assert torch.equal(actual, expected)


def test_points_are_px_of_the_stored_photos_best_first(matcher, monkeypatch):
    # 200 x 120 px reduced by two, to 100 x 60, padded to 104 x 64.
    features = matcher.encode(prepare_array(np.full((120, 200), 128, np.uint8), 100))
    assert features.pixels.shape == (1, 1, 64, 104) and features.size_bytes == 64 * 104 * 4
    assert features.pixels[0, 0, 59, 99] == pytest.approx(128 / 255) and features.pixels[0, 0, 60, 100] == 0
    output = {
        "keypoints0": torch.tensor([(8.0, 16), (16, 16), (24, 16), (32, 16), (40, 16), (99, 16)]),
        "keypoints1": torch.tensor([(9.5, 16), (18, 17), (101, 16), (32, 15), (40, 59), (99, 61)]),
        "confidence": torch.tensor([0.5, 0.9, 1.0, 0.7, 0.3, 1.0]),
    }
    monkeypatch.setattr(matcher.net, "forward", lambda data: output)
    matches = matcher.match_features(features, features)
    np.testing.assert_array_equal(matches.xy0, [(32, 32), (64, 32), (16, 32)])
    np.testing.assert_array_equal(matches.xy1, [(36, 34), (64, 30), (19, 32)])
    np.testing.assert_array_equal(matches.score, np.float32([0.9, 0.7, 0.5]))
    assert matches.patch_radius_px == 8
    shifted, valid = matches.warp(matches.xy0)
    assert valid.all()
    np.testing.assert_allclose(shifted, matches.xy1)


def test_photos_of_different_sizes_match(matcher):
    rng = np.random.default_rng(0)
    first, second = (
        matcher.encode(prepare_array(rng.integers(0, 255, size, np.uint8), 100)) for size in ((70, 90), (90, 70))
    )
    matches = matcher.match_features(first, second)
    assert np.isfinite(matches.xy1).all() and len(matches) <= 3


def test_what_the_matches_depend_on_is_named(matcher, checkpoint):
    other = LoftrMatcher(checkpoint, MatchingConfig(device="cpu", max_matches=3), ImageConfig(long_edge_px=200))
    assert {key for key in matcher.made_by if matcher.made_by[key] != other.made_by[key]} == {"images.long_edge_px"}


def test_unusable_checkpoints(tmp_path, net):
    with pytest.raises(WeightsError, match="none.ckpt"):
        LoftrMatcher(tmp_path / "none.ckpt", MatchingConfig(), ImageConfig())
    (tmp_path / "text.ckpt").write_text("no weights")
    with pytest.raises(WeightsError, match="text.ckpt is damaged"):
        LoftrMatcher(tmp_path / "text.ckpt", MatchingConfig(), ImageConfig())
    state = net.state_dict()
    del state["loftr_fine.layers.1.merge.weight"]
    torch.save({"state_dict": state}, tmp_path / "short.ckpt")
    with pytest.raises(WeightsError, match="loftr_fine.layers.1.merge.weight"):
        LoftrMatcher(tmp_path / "short.ckpt", MatchingConfig(), ImageConfig())


def test_missing_kornia_is_said_clearly(checkpoint, monkeypatch):
    monkeypatch.setitem(sys.modules, "kornia", None)
    with pytest.raises(MissingPackageError, match="kornia, which is not installed: pip install kornia"):
        LoftrMatcher(checkpoint, MatchingConfig(), ImageConfig())
