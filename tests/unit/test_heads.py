"""The fine heads: shapes, finiteness, and that the homography head can learn."""

import pytest
import torch

from hm_sfm.config import NetworkConfig
from hm_sfm.errors import ConfigError
from hm_sfm.network.fine import ExpectationHead, HomographyHead, gather_patches, make_fine_map
from hm_sfm.network.homography import apply_homography, make_corners
from hm_sfm.network.homonet import HomoNet
from hm_sfm.training.losses import measure_loss
from hm_sfm.training.supervision import PatchSupervision


def make_waves(size: int, channels: int, seed: int = 0):
    """Features that are known everywhere: a function from positions (..., 2), cells, to (..., channels)."""
    generator = torch.Generator().manual_seed(seed)
    frequency = torch.randn(2, channels, generator=generator) * 0.7
    phase = torch.rand(channels, generator=generator) * 6.3
    return lambda xy: torch.sin(xy @ frequency + phase)


def make_cells(size: int) -> torch.Tensor:
    """(size, size, 2) float32: the positions of a feature map's cells."""
    y, x = torch.meshgrid(torch.arange(float(size)), torch.arange(float(size)), indexing="ij")
    return torch.stack([x, y], dim=-1)


@pytest.mark.parametrize(
    ("window", "radius", "iterations", "margin", "spacing"),
    [(9, 1, 3, 2, 1), (5, 1, 1, 0, 1), (17, 3, 2, 0, 1), (9, 1, 2, 2, 2), (9, 0, 1, 2, 4), (5, 1, 1, 2, 2)],
)
def test_homography_head_gives_one_estimate_per_iteration(window, radius, iterations, margin, spacing):
    torch.manual_seed(0)
    head = HomographyHead(window, radius, iterations, margin, spacing)
    fine = make_fine_map(torch.randn(2, 48, 24, 32))
    cell = torch.tensor([[5, 5], [0, 0], [31, 23]])
    estimates = head(fine, fine, torch.tensor([0, 1, 1]), cell, cell)
    assert len(estimates) == iterations
    for estimate in estimates:
        assert estimate.displacement.shape == (3, 4, 2)
        assert estimate.homography.shape == (3, 3, 3)
        assert estimate.log_scale.shape == (3,)
        assert all(t.isfinite().all() for t in (estimate.displacement, estimate.homography, estimate.log_scale))
        assert all(t.dtype == torch.float32 for t in (estimate.displacement, estimate.homography))


def test_spaced_patches_are_every_second_cell_of_the_whole():
    fine = make_fine_map(torch.randn(1, 48, 12, 12))
    index, cell = torch.tensor([0, 0]), torch.tensor([[6, 5], [1, 11]])
    whole = gather_patches(fine, index, cell, 9).view(2, 9, 9, 48)
    torch.testing.assert_close(gather_patches(fine, index, cell, 5, 2).view(2, 5, 5, 48), whole[:, ::2, ::2])


def test_an_untrained_homography_head_starts_near_the_identity():
    torch.manual_seed(0)
    head = HomographyHead(9, 1, 3, 2)
    fine = make_fine_map(torch.randn(1, 48, 24, 24))
    cell = torch.tensor([[12, 12]])
    estimate = head(fine, fine, torch.tensor([0]), cell, cell)[-1]
    torch.testing.assert_close(estimate.homography, torch.eye(3)[None], atol=0.2, rtol=0)


def test_expectation_head_finds_a_shifted_cell():
    features = torch.zeros(1, 48, 24, 24)
    features[0, :, 10, 10] = 40.0
    shifted = features.roll((2, -3), dims=(2, 3))
    head = ExpectationHead(9, 2)
    cell = torch.tensor([[10, 10]])
    estimate = head(make_fine_map(features), make_fine_map(shifted), torch.tensor([0]), cell, cell)[-1]
    torch.testing.assert_close(estimate.displacement, torch.tensor([-3.0, 2.0]).expand(1, 4, 2))
    centre = apply_homography(estimate.homography, torch.zeros(1, 2))
    torch.testing.assert_close(centre, torch.tensor([[[-3.0, 2.0]]]))
    assert estimate.log_scale.item() < -3


def test_expectation_head_is_unsure_of_a_flat_patch():
    fine = make_fine_map(torch.ones(1, 48, 24, 24))
    cell = torch.tensor([[12, 12]])
    estimate = ExpectationHead(9, 2)(fine, fine, torch.tensor([0]), cell, cell)[-1]
    torch.testing.assert_close(estimate.displacement, torch.zeros(1, 4, 2), atol=1e-5, rtol=0)
    # The spread of 13 x 13 equally likely cells: variance 14 along each axis.
    assert estimate.log_scale.exp().item() == pytest.approx(28**0.5, rel=1e-4)


@pytest.mark.parametrize("head", ["homography", "expectation"])
@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("window", 8), ("window", 3), ("radius", -1), ("iterations", 0), ("margin", -1), ("spacing", 0),
        ("spacing", 3), ("spacing", 8),
    ],
)  # fmt: skip
def test_impossible_networks_are_refused(head, field, value):
    with pytest.raises(ConfigError, match=f"network.{field}"):
        HomoNet(NetworkConfig(**{"head": head, field: value}))


@pytest.mark.parametrize("field", ["head", "backbone"])
def test_unknown_parts_are_refused(field):
    with pytest.raises(ConfigError, match=f"network.{field} .*'heavy'"):
        HomoNet(NetworkConfig(**{field: "heavy"}))


@pytest.mark.slow
@pytest.mark.parametrize("spacing", [1, 2])
def test_homography_head_learns_a_small_warp(spacing):
    """The features are exact functions of position, so what is left to learn is to read the correlations."""
    torch.manual_seed(0)
    waves, size = make_waves(48, 16), 48
    b_from_a = torch.tensor([[1.05, -0.08, 2.0], [0.06, 0.97, -1.0], [0.0, 0.0, 1.0]])
    positions = make_cells(size)
    in_a = (positions - b_from_a[:2, 2]) @ torch.linalg.inv(b_from_a[:2, :2]).T
    fine_a, fine_b = (make_fine_map(waves(xy).permute(2, 0, 1)[None]) for xy in (positions, in_a))
    count = 32
    cell_a = torch.randint(10, size - 10, (count, 2))
    in_b = cell_a.float() @ b_from_a[:2, :2].T + b_from_a[:2, 2]
    cell_b = in_b.round().long() + torch.randint(-2, 3, (count, 2))
    homography = b_from_a.repeat(count, 1, 1)
    homography[:, :2, 2] = in_b - cell_b
    head = HomographyHead(9, 1, 2, 2, spacing)
    displacement = apply_homography(homography, make_corners(head.half)) - make_corners(head.half)
    index = torch.zeros(count, dtype=torch.int64)
    correct, start = torch.ones(count, dtype=torch.bool), torch.zeros_like(displacement)
    supervision = PatchSupervision(index, cell_a, cell_b, homography, displacement, correct, start)
    optimizer = torch.optim.Adam(head.parameters(), lr=3e-3)
    dense = []
    for _ in range(70):
        parts = measure_loss(head(fine_a, fine_b, index, cell_a, cell_b), supervision, head.half)
        optimizer.zero_grad()
        parts["loss"].backward()
        optimizer.step()
        dense.append(parts["dense"].item())
    assert sum(dense[-5:]) / 5 < dense[0] / 3
