"""The batched, fast forms of the network's operations against naive ones."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from hm_sfm.config import ImageConfig, MatchingConfig, NetworkConfig
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.network import estimates
from hm_sfm.network.coarse import match_by_similarity
from hm_sfm.network.fine import (
    ExpectationHead,
    HomographyHead,
    convolve,
    correlate_patches,
    gather_patches,
    make_fine_map,
    make_pooling,
    sample_windows,
)
from hm_sfm.network.homonet import HomoNet
from hm_sfm.photos.images import prepare_array


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def with_zero(maps: torch.Tensor) -> torch.Tensor:
    """(P, N, S, S) -> the layout of sample_windows, (P, N, S * S + 1)."""
    return F.pad(maps.flatten(2), (0, 1))


def sample_with_torch(maps: torch.Tensor, centre: torch.Tensor, radius: int) -> torch.Tensor:
    """sample_windows by torch's own bilinear sampling."""
    patches, count, side, _ = maps.shape
    steps = torch.arange(-radius, radius + 1.0)
    window = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1)
    index = centre.reshape(-1, 1, 1, 2) + window
    samples = F.grid_sample(
        maps.reshape(-1, 1, side, side), 2 * index / (side - 1) - 1, padding_mode="zeros", align_corners=True
    )
    return samples.reshape(patches * count, -1).T


@pytest.mark.parametrize("side", [5, 7, 13])
@pytest.mark.parametrize("radius", [0, 1, 2])
def test_windows_equal_torch_bilinear_sampling(side, radius, generator):
    maps = torch.randn(3, 40, side, side, generator=generator)
    centre = torch.rand(3, 40, 2, generator=generator) * (side + 6) - 3
    centre[0, :4] = torch.tensor([[0.0, 0.0], [side - 1, side - 1], [-1.0, side], [side / 2, 2.0]])
    found = sample_windows(with_zero(maps), centre, radius)
    torch.testing.assert_close(found, sample_with_torch(maps, centre, radius), atol=1e-4, rtol=0)


@pytest.mark.parametrize("far", [-1e9, -50.0, -4.0, 9.0, 50.0, 1e9])
def test_windows_far_outside_are_zero(far, generator):
    maps = torch.randn(1, 4, 5, 5, generator=generator)
    centre = torch.tensor([[[far, 2.0], [2.0, far], [far, far], [2.0, 2.0]]])
    found = sample_windows(with_zero(maps), centre, 1)
    assert not found[:, :3].any()
    torch.testing.assert_close(found[4, 3], maps[0, 3, 2, 2])


@pytest.mark.parametrize("side", [4, 5, 9, 13])
def test_pooling_equals_average_pooling(side, generator):
    maps = torch.randn(2, 3, side, side, generator=generator)
    expected = F.avg_pool2d(F.pad(maps, (0, side % 2, 0, side % 2)), 2)
    torch.testing.assert_close(with_zero(maps) @ make_pooling(side), with_zero(expected), atol=1e-6, rtol=0)


def test_pooled_cells_sit_where_the_head_samples_them():
    ramp = torch.arange(8.0).expand(8, 8)
    pooled = (with_zero(ramp[None, None]) @ make_pooling(8))[0, 0, :4]
    assert pooled.tolist() == [2 * k + 0.5 for k in range(4)]


@pytest.mark.parametrize(
    ("window", "radius", "spacing", "margin"), [(5, 1, 1, 0), (9, 1, 2, 2), (9, 3, 1, 2), (9, 0, 4, 1)]
)
def test_the_first_look_is_a_look_up_of_what_has_not_moved(window, radius, spacing, margin, generator):
    head = HomographyHead(window, radius, 1, margin, spacing)
    side, points = window + 2 * margin, len(head.grid)
    full = with_zero(torch.randn(3, points, side, side, generator=generator))
    expected = head.look_up(full, full @ head.pooling, head.grid.expand(3, -1, -1))
    found = torch.einsum("pnc,ncs->pns", full, head.first_look)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("spacing", [1, 2])
def test_to_start_from_no_displacement_is_to_start_from_nothing(spacing, generator):
    head = HomographyHead(9, 1, 2, 2, spacing)
    fine = make_fine_map(torch.randn(1, 48, 24, 24, generator=generator))
    cell = torch.tensor([[12, 11], [3, 20]])
    index = torch.zeros(2, dtype=torch.int64)
    pairs = zip(head(fine, fine, index, cell, cell + 1), head(fine, fine, index, cell, cell + 1, torch.zeros(2, 4, 2)))
    for found, expected in pairs:
        torch.testing.assert_close(vars(found), vars(expected), atol=1e-5, rtol=0)


@pytest.mark.parametrize(("side", "stride", "pad"), [(3, 1, 1), (3, 2, 1), (2, 1, 0), (3, 1, 0)])
def test_convolutions_are_the_same_without_gradients(side, stride, pad, generator):
    torch.manual_seed(0)
    layer = torch.nn.Conv2d(6, 4, side, stride=stride, padding=pad)
    maps = torch.randn(2, 5, 5, 6, generator=generator)
    with torch.inference_mode():
        found = convolve(maps, layer)
    torch.testing.assert_close(found, convolve(maps, layer).detach(), atol=1e-5, rtol=0)


def test_patches_equal_a_naive_loop_also_across_the_border(generator):
    fine = torch.randn(2, 3, 6, 9, generator=generator)
    centre = torch.tensor([[4, 3], [0, 0], [8, 5], [-1, 2], [9, 6], [-40, 3], [4, 1000], [2, -3]])
    image_index = torch.tensor([0, 1, 0, 1, 0, 1, 0, 1])
    found = gather_patches(make_fine_map(fine), image_index, centre, 5)
    assert found.shape == (8, 25, 3)
    with_a_zero = gather_patches(make_fine_map(fine), image_index, centre, 5, add_zero=True)
    assert torch.equal(with_a_zero, F.pad(found, (0, 0, 0, 1)))
    for patch, image, (x, y) in zip(found, image_index, centre.tolist()):
        cells = [(x + i, y + j) for j in range(-2, 3) for i in range(-2, 3)]
        for value, (column, row) in zip(patch, cells):
            inside = 0 <= column < 9 and 0 <= row < 6
            expected = fine[image, :, row, column] if inside else torch.zeros(3)
            assert torch.equal(value, expected)


def test_correlation_is_the_scaled_positive_inner_product(generator):
    patch0, patch1 = torch.randn(2, 4, 16, generator=generator), torch.randn(2, 6, 16, generator=generator)
    found = correlate_patches(patch0, patch1)
    for p, i, j in np.ndindex(2, 4, 6):
        expected = max(float(patch0[p, i] @ patch1[p, j]) / 4, 0.0)
        assert found[p, i, j].item() == pytest.approx(expected, abs=1e-5)


def match_naively(coarse0: torch.Tensor, coarse1: torch.Tensor, threshold: float) -> set[tuple[int, int]]:
    similarity = (coarse0 @ coarse1.T).numpy()
    return {
        (i, j)
        for i, j in np.ndindex(similarity.shape)
        if similarity[i, j] == similarity[i].max() == similarity[:, j].max() and similarity[i, j] >= threshold
    }


@pytest.mark.parametrize("block", [1, 7, 50, 2048])
def test_cells_match_as_mutual_nearest_neighbours_of_the_whole_matrix(block, generator):
    coarse0 = F.normalize(torch.randn(50, 8, generator=generator), dim=1)
    coarse1 = F.normalize(torch.randn(61, 8, generator=generator), dim=1)
    index0, index1, similarity = match_by_similarity(coarse0, coarse1, 0.3, block)
    # The naive form multiplies whole matrices: sums differ in the last bit, nearest neighbours do not.
    assert set(zip(index0.tolist(), index1.tolist())) == match_naively(coarse0, coarse1, 0.3)
    assert len(index0) > 10
    torch.testing.assert_close(similarity, (coarse0[index0] * coarse1[index1]).sum(1))


def test_half_precision_rounds_the_cells_alone(generator):
    coarse0 = F.normalize(torch.randn(300, 64, generator=generator), dim=1)
    coarse1 = F.normalize(coarse0 + 0.05 * torch.randn(300, 64, generator=generator), dim=1)
    before = torch.backends.mkldnn.matmul.fp32_precision
    with torch.autocast("cpu", dtype=torch.bfloat16):
        index0, index1, similarity = match_by_similarity(coarse0, coarse1, 0.5)
    assert torch.backends.mkldnn.matmul.fp32_precision == before
    assert torch.equal(index0, torch.arange(300)) and torch.equal(index1, index0)
    assert similarity.dtype == torch.float32
    # Rounded products would be at most 2**-8 apart, so near 1: there are about 20 such numbers here.
    assert len(similarity.unique()) > 250
    torch.testing.assert_close(similarity, (coarse0 * coarse1).sum(1), atol=4e-3, rtol=0)


def test_a_threshold_that_nothing_meets_matches_nothing(generator):
    coarse = F.normalize(torch.randn(9, 8, generator=generator), dim=1)
    assert len(match_by_similarity(coarse, coarse, 1.1)[0]) == 0


@pytest.mark.parametrize("block", [1, 3, 100])
def test_equal_cells_still_match_one_to_one(block):
    # Cells 0-3 of image 0 and all of image 1 look alike, as in flat areas; cell 4 of image 0 has no partner.
    alike = torch.tensor([1.0, 0.0])
    coarse0 = torch.stack([alike] * 4 + [torch.tensor([0.0, 1.0])])
    index0, index1, _ = match_by_similarity(coarse0, alike.repeat(6, 1), 0.8, block)
    assert len(index0) >= 1 and 4 not in index0
    assert len(index0.unique()) == len(index1.unique()) == len(index0)


@pytest.mark.parametrize("counts", [(0, 5), (5, 0), (0, 0)])
def test_no_cells_match_nothing(counts):
    index0, index1, similarity = match_by_similarity(torch.ones(counts[0], 4), torch.ones(counts[1], 4), 0.5)
    assert len(index0) == len(index1) == len(similarity) == 0
    assert index0.dtype == index1.dtype == torch.int64


@pytest.mark.parametrize("head", [HomographyHead(9, 1, 3, 2), ExpectationHead(9, 2)], ids=["homography", "expectation"])
def test_heads_take_no_patches(head):
    fine = make_fine_map(torch.zeros(1, 48, 8, 8))
    none = torch.zeros(0, 2, dtype=torch.int64)
    estimate = head(fine, fine, torch.zeros(0, dtype=torch.int64), none, none)[-1]
    assert estimate.displacement.shape == (0, 4, 2)
    assert estimate.homography.shape == (0, 3, 3)
    assert estimate.log_scale.shape == (0,)


def test_patches_in_chunks_equal_patches_at_once(monkeypatch):
    monkeypatch.setattr("hm_sfm.network.device.computes_in_half", lambda device: False)
    torch.manual_seed(0)
    net = HomoNet(NetworkConfig(coarse="cosine"))
    for layer in (net.head.corners, net.head.scale):
        torch.nn.init.normal_(layer.weight, std=0.1)
    matcher = HomoMatcher.from_network(net, MatchingConfig(device="cpu", min_cosine=0.0), ImageConfig())
    pixels = np.random.default_rng(0).integers(0, 256, (96, 128), dtype=np.uint8)
    features0, features1 = (matcher.encode(prepare_array(image, 128)) for image in (pixels, pixels[::-1]))
    whole = matcher.match_features(features0, features1)
    monkeypatch.setattr(estimates, "FINE_CHUNK", 7)
    pieces = matcher.match_features(features0, features1)
    assert len(whole) > 14
    order, piece_order = (np.lexsort(found.xy0.T) for found in (whole, pieces))
    for field in ("xy0", "xy1", "score", "homography"):
        np.testing.assert_allclose(
            getattr(pieces, field)[piece_order], getattr(whole, field)[order], atol=2e-3, err_msg=field
        )
