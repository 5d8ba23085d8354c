"""LightGlue against kornia's, with LighterGlue's architecture."""

import pytest
import torch
import torch.nn.functional as F
from kornia.feature import LightGlue as KorniaLightGlue

from hm_sfm.network.checkpoints import load_weights
from hm_sfm.network.lightglue import LightGlue

SIZE_WH = (1024, 683)
LIGHTERGLUE = {
    "input_dim": 64, "descriptor_dim": 96, "n_layers": 6, "num_heads": 1, "add_scale_ori": False, "add_laf": False,
    "flash": False, "depth_confidence": -1, "width_confidence": 0.95, "filter_threshold": 0.1, "weights": None,
}  # fmt: skip


@pytest.fixture(scope="module")
def kornia_net(request) -> KorniaLightGlue:
    default = KorniaLightGlue.default_conf
    KorniaLightGlue.default_conf = {**default, **LIGHTERGLUE, "name": "xfeat"}
    try:
        net = KorniaLightGlue(None).eval()
    finally:
        KorniaLightGlue.default_conf = default
    net.load_state_dict(load_weights("light").context.state_dict(), strict=False)
    return net


@pytest.fixture(scope="module")
def net() -> LightGlue:
    return load_weights("light").context.eval()


def make_keypoints(count: int, noise: float, seed: int = 0):
    """Descriptors and positions of the keypoints of two images, and which of image 0 each of image 1 is.

    All keypoints of the first image are in the second one, shuffled and moved, beside a quarter as many others.
    """
    generator = torch.Generator().manual_seed(seed)
    descriptors0 = F.normalize(torch.randn(count, 64, generator=generator), dim=1)
    xy0 = torch.rand(count, 2, generator=generator) * torch.tensor([900.0, 600.0])
    order = torch.randperm(count, generator=generator)
    disturbed = descriptors0[order] + noise * torch.randn(count, 64, generator=generator)
    other = F.normalize(torch.randn(count // 4, 64, generator=generator), dim=1)
    descriptors1 = F.normalize(torch.cat([disturbed, other]), dim=1)
    xy1 = torch.cat([xy0[order] + 30, torch.rand(count // 4, 2, generator=generator) * 600])
    return (descriptors0, xy0), (descriptors1, xy1), order


@pytest.mark.parametrize("count", [8, 300, 700])
def test_the_same_matches_and_scores_as_kornias(net, kornia_net, count):
    side0, side1, _ = make_keypoints(count, 0.03)
    size = torch.tensor([SIZE_WH])
    sides = [{"keypoints": xy[None], "descriptors": d[None], "image_size": size} for d, xy in (side0, side1)]
    with torch.inference_mode():
        expected = kornia_net({"image0": sides[0], "image1": sides[1]})
        index0, index1, score = net.assign(*(net.describe(*side, SIZE_WH) for side in (side0, side1)))
    confident = score > 0.1
    torch.testing.assert_close(
        torch.stack([index0[confident], index1[confident]], dim=1), expected["matches"][0], rtol=0, atol=0
    )
    torch.testing.assert_close(score[confident], expected["scores"][0], rtol=0, atol=1e-4)
    assert count < 100 or len(expected["matches"][0]) > 20


def test_most_assignments_of_an_easy_pair_are_true(net):
    side0, side1, order = make_keypoints(400, 0.02)
    with torch.inference_mode():
        index0, index1, score = net.assign(*(net.describe(*side, SIZE_WH) for side in (side0, side1)))
    confident = (score > 0.1) & (index1 < 400)
    assert confident.sum() > 100
    assert (order[index1[confident]] == index0[confident]).float().mean() > 0.95


def test_the_two_images_may_change_places(net):
    side0, side1, _ = make_keypoints(300, 0.06)
    with torch.inference_mode():
        described = [net.describe(*side, SIZE_WH) for side in (side0, side1)]
        index0, index1, score = net.assign(*described)
        back1, back0, back_score = net.assign(*described[::-1])
    order = back0.argsort()
    assert torch.equal(index0, back0[order]) and torch.equal(index1, back1[order])
    torch.testing.assert_close(score, back_score[order], atol=1e-5, rtol=1e-4)


def test_one_keypoint_and_none(net):
    side0, side1, _ = make_keypoints(8, 0.06)
    with torch.inference_mode():
        one, none = (net.describe(side0[0][:k], side0[1][:k], SIZE_WH) for k in (1, 0))
        full = net.describe(*side1, SIZE_WH)
        for sides in ((one, full), (full, one), (one, one)):
            index0, index1, score = net.assign(*sides)
            assert len(index0) == len(index1) == len(score) <= 1
        for sides in ((none, full), (full, none), (none, none)):
            assert all(len(values) == 0 for values in net.assign(*sides))
