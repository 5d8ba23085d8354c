"""The LoFTR networks against kornia's, and the blocked dual softmax against the naive one."""

import cv2
import numpy as np
import pytest
import torch
from kornia.feature import LoFTR

from hm_sfm.config import ImageConfig, MatchingConfig, NetworkConfig, load_config
from hm_sfm.errors import WeightsError
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.network.checkpoints import load_weights
from hm_sfm.network.coarse import SHARPNESS, make_log_confidences, match_by_dual_softmax, sum_exponentials
from hm_sfm.network.homonet import HomoNet
from hm_sfm.network.transformer import attend_linearly

LOFTR = NetworkConfig(backbone="loftr", coarse="attention", head="expectation", margin=0)


@pytest.fixture(scope="module")
def kornia_net():
    torch.manual_seed(0)
    net = LoFTR(pretrained=None).eval()
    # Running statistics other than 0 and 1, so that a batch norm that is left out shows.
    for module in net.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(std=0.1)
            module.running_var.uniform_(0.8, 1.2)
    return net


@pytest.fixture(scope="module")
def checkpoint(kornia_net, tmp_path_factory):
    """A file laid out as the public checkpoints are."""
    path = tmp_path_factory.mktemp("loftr") / "loftr.ckpt"
    torch.save({"state_dict": {f"matcher.{key}": value for key, value in kornia_net.state_dict().items()}}, path)
    return path


@pytest.mark.parametrize("size_hw", [(96, 128), (64, 160)])
@torch.inference_mode()
def test_coarse_confidences_equal_kornias(kornia_net, checkpoint, size_hw):
    net = load_weights(str(checkpoint), LOFTR).eval()
    image0, image1 = torch.rand(2, 1, 1, *size_hw, generator=torch.Generator().manual_seed(1))
    theirs0, theirs1 = kornia_net.loftr_coarse(
        *(kornia_net.extract_features(image)["coarse"].flatten(2).transpose(1, 2) for image in (image0, image1))
    )
    grid_hw = size_hw[0] // 8, size_hw[1] // 8
    data = {"bs": 1, "stride_c": 8, "stride_f": 2, "hw0_c": grid_hw, "hw1_c": grid_hw}
    kornia_net.coarse_matching(theirs0, theirs1, data)

    described = [
        net.coarse.describe(net.backbone(image).coarse).flatten(2).transpose(1, 2) for image in (image0, image1)
    ]
    aware0, aware1 = net.coarse(*described)
    scaled0 = aware0[0] * SHARPNESS / 256
    row, column, _ = sum_exponentials(scaled0, aware1[0], block=50)
    ours = torch.cat([cells.exp() for cells in make_log_confidences(scaled0, aware1[0], row, column, block=50)])
    assert torch.allclose(ours, data["conf_matrix"][0], atol=1e-4)
    assert ours.max() > 10 * ours.mean()


@torch.inference_mode()
def test_fine_maps_equal_kornias(kornia_net, checkpoint):
    net = load_weights(str(checkpoint), LOFTR).eval()
    image = torch.rand(1, 1, 64, 96, generator=torch.Generator().manual_seed(2))
    coarse, fine = kornia_net.backbone(image)
    maps = net.backbone(image)
    assert torch.allclose(maps.coarse, coarse, atol=1e-4)
    assert torch.allclose(maps.fine, fine, atol=1e-4)


def naive_dual_softmax(coarse0, coarse1, threshold, temperature=0.1):
    similarity = coarse0 @ coarse1.T / (coarse0.shape[1] * temperature)
    confidence = similarity.softmax(dim=0) * similarity.softmax(dim=1)
    mutual = (confidence == confidence.amax(0)) & (confidence == confidence.amax(1, keepdim=True))
    return (mutual & (confidence >= threshold)).nonzero(), confidence


@pytest.mark.parametrize("block", [1, 7, 64, 4096])
def test_blocked_dual_softmax_equals_the_naive_one(block):
    generator = torch.Generator().manual_seed(3)
    coarse0 = 3 * torch.randn(150, 32, generator=generator)
    coarse1 = torch.cat([coarse0[20:90], 3 * torch.randn(60, 32, generator=generator)])
    expected, confidence = naive_dual_softmax(coarse0, coarse1, 0.2)
    index0, index1, score = match_by_dual_softmax(
        coarse0, coarse1, 0.2, torch.tensor(10 / coarse0.shape[1]), block=block
    )
    assert len(expected) > 50
    assert torch.equal(torch.stack([index0, index1], dim=1), expected)
    assert torch.allclose(score, confidence[index0, index1], rtol=1e-4)


@pytest.mark.parametrize("counts", [(0, 5), (5, 0), (0, 0)])
def test_dual_softmax_of_nothing(counts):
    index0, index1, score = match_by_dual_softmax(
        torch.ones(counts[0], 8), torch.ones(counts[1], 8), 0.2, torch.tensor(1.25)
    )
    assert len(index0) == len(index1) == len(score) == 0


def test_linear_attention_equals_the_quadratic_form():
    generator = torch.Generator().manual_seed(4)
    query, key, value = (torch.randn(2, n, 4, 8, generator=generator) for n in (11, 13, 13))
    weight = torch.einsum("bnhd,bshd->bnsh", *(torch.nn.functional.elu(x) + 1 for x in (query, key)))
    naive = torch.einsum("bnsh,bshv->bnhv", weight / weight.sum(dim=2, keepdim=True), value)
    assert torch.allclose(attend_linearly(query, key, value), naive, atol=1e-5)


@pytest.mark.slow
def test_a_loftr_checkpoint_matches_images(checkpoint):
    net = load_weights(str(checkpoint), LOFTR)
    matcher = HomoMatcher.from_network(net, MatchingConfig(min_confidence=0.0), ImageConfig(long_edge_px=128))
    noise = np.random.default_rng(0).integers(0, 255, (100, 120), dtype=np.uint8)
    image = cv2.GaussianBlur(noise, (0, 0), 2)
    matches = matcher.match(image, image)
    assert len(matches) > 0 and np.isfinite(matches.homography).all()


def test_a_loftr_checkpoint_has_no_homography_head(checkpoint):
    with pytest.raises(WeightsError, match="loftr.ckpt has no homography head"):
        load_weights(str(checkpoint), NetworkConfig(backbone="loftr", coarse="attention"))


def test_a_checkpoint_that_lacks_keys_is_refused(kornia_net, tmp_path):
    state = kornia_net.state_dict()
    del state["loftr_coarse.layers.3.merge.weight"]
    torch.save({"state_dict": state}, tmp_path / "short.ckpt")
    with pytest.raises(WeightsError, match="layers.3.merge.weight"):
        load_weights(str(tmp_path / "short.ckpt"), LOFTR)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["loftr", "loftr_homo", "loftr_homo_heavy"])
@torch.inference_mode()
def test_the_papers_networks_run(name):
    config = load_config(f"configs/{name}.yaml")
    torch.manual_seed(0)
    matcher = HomoMatcher.from_network(
        HomoNet(config.network), MatchingConfig(min_confidence=0.0), ImageConfig(long_edge_px=96)
    )
    image = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 255, (96, 96), dtype=np.uint8), (0, 0), 2)
    matches = matcher.match(image, image)
    assert len(matches) > 0 and np.isfinite(matches.homography).all()
