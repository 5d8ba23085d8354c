"""The coarse stage with context: where it starts, what it computes once per image, and that it can learn."""

import math

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st

from hm_sfm.network.coarse import AttentionCoarse, find_largest, match_by_dual_softmax
from hm_sfm.network.transformer import CoarseTransformer, place_positions
from hm_sfm.training.losses import measure_coarse_loss
from hm_sfm.training.supervision import CoarseSupervision


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def maps(generator) -> torch.Tensor:
    """Two views of 6 x 9 cells: the second holds the first one's features, mirrored and changed."""
    first = torch.randn(1, 64, 6, 9, generator=generator)
    return torch.cat([first, first.flip(3) + 2 * torch.randn(1, 64, 6, 9, generator=generator)])


@pytest.fixture
def trained(generator) -> AttentionCoarse:
    """A coarse stage that corrects."""
    torch.manual_seed(1)
    coarse = AttentionCoarse().requires_grad_(False)
    coarse.leave.weight.normal_(0, 0.05, generator=generator)
    coarse.leave.bias.normal_(0, 0.05, generator=generator)
    return coarse


def as_cells(described: torch.Tensor) -> torch.Tensor:
    """(B, C, H, W) -> (B, N, C)."""
    return described.flatten(2).transpose(1, 2)


def test_it_starts_as_the_plain_features(maps):
    coarse = AttentionCoarse().requires_grad_(False)
    plain = as_cells(F.normalize(maps, dim=1))
    cells = as_cells(coarse.describe(maps))
    corrected0, corrected1 = coarse(cells[:1], cells[1:])
    assert torch.equal(corrected0, plain[:1]) and torch.equal(corrected1, plain[1:])
    matches = coarse.match(cells[0], cells[1], 0.2)
    expected = match_by_dual_softmax(plain[0], plain[1], 0.2, torch.tensor(35.0))
    assert len(matches[0]) > 40
    assert torch.equal(matches[0], expected[0]) and torch.equal(matches[1], expected[1])
    torch.testing.assert_close(matches[2], expected[2])
    assert 0 < len(coarse.match(cells[0], cells[1], 0.9)[0]) < len(matches[0])


def test_an_image_is_described_up_to_the_first_self_attention(maps, trained):
    described = trained.describe(maps)
    torch.testing.assert_close(described[:, :64], F.normalize(maps, dim=1))
    entered = trained.enter(as_cells(F.normalize(maps, dim=1)))
    entered = entered + as_cells(place_positions(128, 6, 9)[None])
    first = trained.transformer.layers[0]
    torch.testing.assert_close(as_cells(described[:, 64:]), first(entered, entered))
    # The rest, per pair, is what the whole transformer makes of the two images.
    cells = as_cells(described)
    corrected = trained(cells[:1], cells[1:])
    aware = trained.transformer(entered[:1], entered[1:])
    for number in range(2):
        expected = as_cells(described[:, :64])[number : number + 1] + trained.leave(aware[number])
        torch.testing.assert_close(corrected[number], expected)
        assert (corrected[number] - cells[number, :, :64]).abs().mean() > 0.01


def test_the_transformer_goes_on_after_the_layers_that_were_done(generator):
    transformer = CoarseTransformer(16, 2, 2).requires_grad_(False)
    cells0, cells1 = torch.randn(2, 7, 16, generator=generator), torch.randn(2, 5, 16, generator=generator)
    whole = transformer(cells0, cells1)
    first = transformer.layers[0]
    rest = transformer(first(cells0, cells0), first(cells1, cells1), first_layer=1)
    assert torch.equal(whole[0], rest[0]) and torch.equal(whole[1], rest[1])
    assert not torch.allclose(whole[0], transformer(cells0, cells1, first_layer=1)[0])


def test_both_images_see_each_other(maps, trained):
    cells = as_cells(trained.describe(maps))
    corrected0, corrected1 = trained(cells[:1], cells[1:])
    other0, other1 = trained(cells[:1], cells[1:].flip(2))
    assert not torch.allclose(corrected0, other0) and not torch.allclose(corrected1, other1)


def test_positions_are_the_same_at_every_resolution():
    # The centre of each cell is that of the middle one of the nine it is cut into.
    small, large = place_positions(32, 4, 6), place_positions(32, 12, 18)
    torch.testing.assert_close(large[:, 1::3, 1::3], small, atol=1e-4, rtol=0)
    landscape, portrait = place_positions(32, 4, 6), place_positions(32, 6, 4)
    torch.testing.assert_close(landscape[:16], portrait[16:].transpose(1, 2))
    cells = place_positions(32, 12, 18).flatten(1).T
    apart = torch.cdist(cells, cells) + 9 * torch.eye(len(cells))
    assert apart.min() > 0.1


def test_pairs_of_a_batch_do_not_mix(trained, generator):
    maps0, maps1 = torch.randn(3, 64, 4, 5, generator=generator), torch.randn(3, 64, 6, 3, generator=generator)
    together = trained(as_cells(trained.describe(maps0)), as_cells(trained.describe(maps1)))
    assert together[0].shape == (3, 20, 64) and together[1].shape == (3, 18, 64)
    for item in range(3):
        one = slice(item, item + 1)
        alone = trained(as_cells(trained.describe(maps0[one])), as_cells(trained.describe(maps1[one])))
        torch.testing.assert_close(together[0][one], alone[0], atol=1e-5, rtol=1e-4)
        torch.testing.assert_close(together[1][one], alone[1], atol=1e-5, rtol=1e-4)


def test_half_precision_stays_inside(maps, trained):
    with torch.autocast("cpu", dtype=torch.bfloat16):
        described = trained.describe(maps.bfloat16())
        corrected = trained(*as_cells(described)[:, None])
    assert described.dtype == corrected[0].dtype == corrected[1].dtype == torch.float32
    exact = trained(*as_cells(trained.describe(maps))[:, None])
    torch.testing.assert_close(corrected[0], exact[0], atol=0.05, rtol=0)


@pytest.mark.slow
def test_it_learns_which_of_two_equal_windows_is_meant(generator, one_thread):
    """Both halves of the view look alike: plain features cannot tell them apart, positions and context can."""
    half = torch.randn(1, 64, 4, 4, generator=generator)
    view = torch.cat([half, half], dim=3)
    every = torch.arange(32)
    supervision = CoarseSupervision(torch.zeros(32, dtype=torch.int64), every, every)
    torch.manual_seed(0)
    coarse = AttentionCoarse()
    optimizer = torch.optim.Adam(coarse.parameters(), lr=2e-3)
    losses = []
    for _ in range(40):
        cells = as_cells(coarse.describe(view))
        losses.append(measure_coarse_loss(*coarse(cells, cells), coarse.sharpness, supervision))
        optimizer.zero_grad()
        losses[-1].backward()
        optimizer.step()
    # Rows and columns each leave it to chance between two cells at first.
    assert losses[0].item() == pytest.approx(0.9 * (1 - 0.25**0.25) / 0.25 - 0.1 * math.log(0.25), rel=0.05)
    with torch.no_grad():
        index0, index1, confidence = coarse.match(cells[0], cells[0], 0.2)
    assert index0.tolist() == index1.tolist() == every.tolist()
    assert confidence.min() > 0.8


@given(st.integers(1, 5), st.integers(1, 300), st.integers(0, 2**32 - 1))
def test_the_largest_entry_of_a_row_and_its_place(rows, columns, seed):
    scores = torch.randn(rows, columns, generator=torch.Generator().manual_seed(seed))
    best, place = find_largest(scores)
    assert torch.equal(best, scores.amax(dim=1))
    assert torch.equal(place, scores.argmax(dim=1))
