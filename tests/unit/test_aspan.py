"""ASpanFormer's coarse stage: spans around a flow, what attends to what, and that flow and features can learn."""

import csv
import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F

from hm_sfm.config import ImageConfig, MatchingConfig, NetworkConfig, load_config
from hm_sfm.errors import ConfigError, WeightsError
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.network import aspan
from hm_sfm.network.aspan import (
    GLOBAL_POOL,
    GROUP,
    LEAST_SIGMA,
    SAMPLES,
    SPAN_SIGMAS,
    Flow,
    attend_globally,
    attend_locally,
    enlarge,
    find_cells,
    measure_spans,
    place_samples,
    shrink,
)
from hm_sfm.network.checkpoints import load_weights
from hm_sfm.network.coarse import AspanCoarse
from hm_sfm.network.homonet import HomoNet
from hm_sfm.training.config import TrainConfig, check_config
from hm_sfm.training.loop import train
from hm_sfm.training.losses import CORNER_WEIGHT, FLOW_WEIGHT, SCALE_WEIGHT, measure_coarse_loss, measure_flow_loss
from hm_sfm.training.state import start_network
from hm_sfm.training.supervision import CoarseSupervision


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def coarse(one_thread) -> AspanCoarse:
    torch.manual_seed(1)
    return AspanCoarse(channels=32, heads=4, blocks=2)


def as_cells(described: torch.Tensor) -> torch.Tensor:
    """(B, C, H, W) -> (B, N, C)."""
    return described.flatten(2).transpose(1, 2)


def make_shifted(generator: torch.Generator, shift: tuple[int, int]) -> tuple[torch.Tensor, CoarseSupervision]:
    """Two views (2, 32, 9, 12) of a larger map, the second one `shift` (x, y) cells on, and their true matches."""
    world = torch.randn(32, 9 + abs(shift[1]), 12 + abs(shift[0]), generator=generator)
    x, y = max(shift[0], 0), max(shift[1], 0)
    first = world[:, y - shift[1] :, x - shift[0] :][:, :9, :12]
    second = world[:, y:, x:][:, :9, :12]
    row, column = torch.meshgrid(torch.arange(9), torch.arange(12), indexing="ij")
    there_x, there_y = (column - shift[0]).flatten(), (row - shift[1]).flatten()
    seen = ((there_x >= 0) & (there_x < 12) & (there_y >= 0) & (there_y < 9)).nonzero().flatten()
    supervision = CoarseSupervision(torch.zeros_like(seen), seen, (there_y * 12 + there_x)[seen])
    return torch.stack([first, second]), supervision


def make_flow(height: int, width: int, sigma: float, generator: torch.Generator) -> Flow:
    centre = 6 * torch.rand(2, 2, height, width, generator=generator)
    return Flow(centre, torch.full((2, 2, height, width), sigma).log())


# Shapes


@pytest.mark.parametrize("sizes", [((8, 8), (8, 8)), ((9, 13), (6, 5)), ((1, 3), (17, 2))])
@torch.no_grad()
def test_photos_may_have_any_shape_each(coarse, generator, sizes):
    described = [coarse.describe(torch.randn(2, 32, *size, generator=generator)) for size in sizes]
    cells = [as_cells(x) for x in described]
    aware0, aware1, flows = coarse.estimate(*cells)
    for size, x, aware in zip(sizes, described, (aware0, aware1)):
        assert x.shape == (2, 34, *size) and aware.shape == (2, size[0] * size[1], 32)
        assert x.dtype == aware.dtype == torch.float32
    assert len(flows) == 2
    for flow in flows:
        for own, size in zip(flow, sizes):
            assert own.centre.shape == own.log_sigma.shape == (2, 2, *size)
    assert torch.equal(coarse(*cells)[0], aware0)


@torch.no_grad()
def test_pairs_of_a_batch_do_not_mix_and_both_images_are_treated_alike(coarse, generator):
    maps0, maps1 = (torch.randn(3, 32, *size, generator=generator) for size in ((6, 9), (7, 5)))
    cells0, cells1 = as_cells(coarse.describe(maps0)), as_cells(coarse.describe(maps1))
    aware0, aware1 = coarse(cells0, cells1)
    turned1, turned0 = coarse(cells1, cells0)
    torch.testing.assert_close((turned0, turned1), (aware0, aware1), atol=1e-5, rtol=1e-4)
    for item in range(3):
        one = slice(item, item + 1)
        torch.testing.assert_close(coarse(cells0[one], cells1[one])[1], aware1[one], atol=1e-5, rtol=1e-4)
    assert not torch.allclose(coarse(cells0, cells1.flip(0))[0], aware0, atol=1e-3)


@torch.no_grad()
def test_half_precision_stays_inside(coarse, generator):
    maps = torch.randn(2, 32, 6, 9, generator=generator)
    exact = coarse.estimate(*as_cells(coarse.describe(maps))[:, None])
    with torch.autocast("cpu", dtype=torch.bfloat16):
        described = coarse.describe(maps)
        rough = coarse.estimate(*as_cells(described)[:, None])
    assert described.dtype == rough[0].dtype == rough[2][0][0].centre.dtype == torch.float32
    torch.testing.assert_close(rough[0], exact[0], atol=0.1, rtol=0)


@pytest.mark.parametrize("pool", [1, 2, 4])
def test_a_map_is_reduced_to_means_and_back(pool):
    x = torch.arange(30.0).view(1, 1, 5, 6)
    small = shrink(x, pool)
    assert small.shape[2:] == (-(-5 // pool), -(-6 // pool))
    assert (
        small[0, 0, 0, 0] == x[0, 0, :pool, :pool].mean()
        and small[0, 0, -1, -1] == x[0, 0, 4 - 4 % pool :, 6 - (6 % pool or pool) :].mean()
    )
    assert torch.equal(enlarge(small, pool, (5, 6))[0, 0, :, 0], small[0, 0, :, 0].repeat_interleave(pool)[:5])


# Spans


def test_a_span_grows_with_the_uncertainty_between_its_limits():
    sigma = torch.tensor([0.01, 0.5, 1.0, 2.0, 3.0, 100.0, 1e30])
    log_sigma = sigma.log().expand(1, 2, 1, -1)
    width, height = measure_spans(log_sigma, (12, 24))[0, :, 0]
    assert width.tolist() == pytest.approx([8, 8, 10, 20, 24, 24, 24])
    assert height.tolist() == pytest.approx([8, 8, 10, 12, 12, 12, 12])
    assert SAMPLES == 8 and SPAN_SIGMAS == 5
    # A grid smaller than the least span.
    assert measure_spans(log_sigma, (3, 5)).unique().tolist() == [8]


def test_samples_surround_the_flow_evenly(generator):
    flow = make_flow(4, 6, 1.2, generator)
    positions = place_samples(flow, 1, (40, 40))
    assert positions.shape == (2, 2, 3, SAMPLES**2, 2)
    centre = F.avg_pool2d(flow.centre, GROUP).permute(0, 2, 3, 1)
    torch.testing.assert_close(positions.mean(dim=3), centre)
    ends = positions.amax(dim=3) - positions.amin(dim=3)
    torch.testing.assert_close(ends, torch.full_like(ends, 2 * 5 * 1.2 * 7 / 8))
    # On a grid of half the size, cell 2 i + 0.5 is cell i.
    halved = place_samples(flow, 2, (40, 40))
    assert halved.shape == (2, 1, 2, SAMPLES**2, 2)
    first = (flow.centre[:, :, :4, :4].mean(dim=(2, 3)) - 0.5) / 2
    torch.testing.assert_close(halved[:, 0, 0].mean(dim=1), first)


def test_a_sure_flow_samples_neighbouring_cells():
    flow = Flow(torch.full((1, 2, 2, 2), 10.5), torch.full((1, 2, 2, 2), -9.0))
    positions = place_samples(flow, 1, (30, 30))[0, 0, 0]
    assert positions[:, 0].unique().tolist() == positions[:, 1].unique().tolist() == list(range(7, 15))


def sample(x: torch.Tensor, positions: torch.Tensor) -> torch.Tensor:
    """(B, C, H, W) at positions (B, R, C', S, 2) -> (B, R, C', S, C)."""
    index, weight = find_cells(positions, x.shape[2:])
    return (as_cells(x).flatten(0, 1)[index] * weight[..., None]).sum(dim=-2)


def test_a_map_is_sampled_between_its_cells_and_goes_on_beyond_its_edges(generator):
    x = torch.randn(2, 3, 5, 4, generator=generator)
    positions = 10 * torch.rand(2, 2, 3, 7, 2, generator=generator) - 3
    expected = F.grid_sample(
        x,
        ((2 * positions + 1) / torch.tensor([4, 5]) - 1).flatten(1, 2),
        padding_mode="border",
        align_corners=False,
    )
    actual = sample(x, positions).flatten(1, 2).permute(0, 3, 1, 2)
    torch.testing.assert_close(actual, expected, atol=1e-5, rtol=1e-4)
    ends = torch.tensor([[0.0, 0.0], [3.0, 4.0], [9.0, 9.0]]).view(1, 1, 1, 3, 2)
    assert torch.equal(sample(x[:1], ends)[0, 0, 0], torch.stack([x[0, :, 0, 0], x[0, :, 4, 3], x[0, :, 4, 3]]))


# Attention


def attend_plainly(query: torch.Tensor, key: torch.Tensor, value: torch.Tensor, heads: int) -> torch.Tensor:
    """One token (C,) and what it sees, (N, C) -> (C,)."""
    messages = []
    for q, k, v in zip(query.chunk(heads), key.chunk(heads, dim=1), value.chunk(heads, dim=1)):
        messages.append((k @ q / len(q) ** 0.5).softmax(dim=0) @ v)
    return torch.cat(messages)


def test_a_cell_attends_to_the_samples_of_its_group(generator, monkeypatch):
    monkeypatch.setattr(aspan, "GROUP_CHUNK", 5)
    query = torch.randn(2, 8, 5, 7, generator=generator)
    key, value = torch.randn(2, 2, 8, 6, 9, generator=generator)
    flow = make_flow(5, 7, 0.9, generator)
    message = attend_locally(query, key, value, flow, 2, 1)
    positions = place_samples(flow, 1, (6, 9))
    keys, values = sample(key, positions), sample(value, positions)
    for item, row, column in ((0, 0, 0), (1, 1, 2), (0, 4, 6), (1, 2, 5)):
        group = item, row // GROUP, column // GROUP
        expected = attend_plainly(query[item, :, row, column], keys[group], values[group], 2)
        torch.testing.assert_close(message[item, :, row, column], expected)
    halved = attend_locally(query, key, value, flow, 2, 2)
    assert halved.shape == query.shape and torch.equal(halved[:, :, 0, 0], halved[:, :, 1, 1])
    assert not torch.allclose(halved[:, :, 0, 1], halved[:, :, 0, 2])


def test_a_token_attends_globally_to_all_of_the_other_image(generator):
    query = torch.randn(2, 8, 5, 7, generator=generator)
    key, value = torch.randn(2, 2, 8, 6, 9, generator=generator)
    message = attend_globally(query, key, value, 2, GLOBAL_POOL)
    tokens = [as_cells(shrink(x, GLOBAL_POOL)) for x in (query, key, value)]
    for item, row, column, token in ((0, 0, 3, 0), (1, 2, 4, 1), (0, 4, 0, 2)):
        expected = attend_plainly(tokens[0][item, token], tokens[1][item], tokens[2][item], 2)
        torch.testing.assert_close(message[item, :, row, column], expected)


@pytest.mark.parametrize("size_hw", [(16, 24), (32, 48)])
@torch.no_grad()
def test_the_tokens_that_a_cell_sees_are_bounded(coarse, generator, monkeypatch, size_hw):
    """However uncertain its flow: 64 samples for four tokens on two grids, and the reduced grid of 1/32."""

    def count(query, key, value):
        seen.append((query.shape[0] * query.shape[2] * key.shape[2], key.shape[2]))
        return attend(query, key, value)

    seen = []
    attend = F.scaled_dot_product_attention
    monkeypatch.setattr(aspan.F, "scaled_dot_product_attention", count)
    maps = torch.randn(2, 32, *size_hw, generator=generator)
    coarse.estimate(*as_cells(coarse.describe(maps))[:, None])
    cells = size_hw[0] * size_hw[1]
    reduced = cells // GLOBAL_POOL**2
    assert {tokens for _, tokens in seen} == {SAMPLES**2, reduced}
    # Each way, two layers and two blocks attend globally, the blocks to samples at 1/16 and at 1/8.
    expected = 2 * (4 * reduced**2 + 2 * (cells // 4 + cells) * SAMPLES**2)
    assert sum(scores for scores, _ in seen) == expected


# Matching and learning


@torch.no_grad()
def test_a_new_network_starts_near_the_plain_features(coarse, generator):
    maps, supervision = make_shifted(generator, (2, -1))
    cells = as_cells(coarse.describe(maps))
    index0, index1, confidence = coarse.match(cells[0], cells[1], 0.2)
    assert len(index0.unique()) == len(index1.unique()) == len(index0) > 0.9 * len(supervision.index0)
    assert (confidence >= 0.2).all() and confidence.max() <= 1
    actual, true = (
        set(zip(i.tolist(), j.tolist())) for i, j in ((index0, index1), (supervision.index0, supervision.index1))
    )
    assert len(actual & true) > 0.9 * len(true)
    back1, back0, _ = coarse.match(cells[1], cells[0], 0.2)
    assert set(zip(back0.tolist(), back1.tolist())) == actual
    assert not len(coarse.match(cells[0], cells[1], 1.1)[0])


def test_gradients_reach_all_parameters(coarse, generator):
    maps, supervision = make_shifted(generator, (2, -1))
    cells = as_cells(coarse.describe(maps))
    cells0, cells1 = cells[:1], as_cells(coarse.describe(maps[1:, :, :7]))
    kept = supervision.index1 < 7 * 12
    supervision = CoarseSupervision(
        *(getattr(supervision, field.name)[kept] for field in dataclasses.fields(supervision))
    )
    aware0, aware1, flows = coarse.estimate(cells0, cells1)
    loss = measure_coarse_loss(aware0, aware1, coarse.sharpness, supervision) + measure_flow_loss(flows, supervision)
    loss.backward()
    assert [name for name, p in coarse.named_parameters() if p.grad is None or not p.grad.any()] == []
    assert all(p.grad.isfinite().all() for p in coarse.parameters())


@pytest.mark.slow
def test_the_flow_of_a_shifted_map_is_learnt(coarse, generator):
    maps, supervision = make_shifted(generator, (4, -2))
    cells = as_cells(coarse.describe(maps))
    optimizer = torch.optim.Adam(coarse.parameters(), lr=8e-3)

    def measure_error() -> tuple[torch.Tensor, torch.Tensor]:
        """Median error of the last block's flow, and the median of its standard deviations, cells."""
        with torch.no_grad():
            *_, (flow, _) = coarse.estimate(cells[:1], cells[1:])[2]
        true = torch.stack([supervision.index1 % 12, supervision.index1 // 12])
        sigma = flow.log_sigma[0].flatten(1)[:, supervision.index0].exp()
        return (flow.centre[0].flatten(1)[:, supervision.index0] - true).norm(dim=0).median(), sigma.median()

    first_error, first_sigma = measure_error()
    losses = []
    for _ in range(40):
        *_, flows = coarse.estimate(cells[:1], cells[1:])
        losses.append(measure_flow_loss(flows, supervision))
        optimizer.zero_grad()
        losses[-1].backward()
        optimizer.step()
    error, sigma = measure_error()
    assert first_error > 2 and first_sigma == pytest.approx(3, rel=0.7)
    assert error < 0.7 and sigma < 0.5 * first_sigma
    assert losses[-1] < losses[0] - 2


def test_the_flow_loss_is_the_likelihood_of_a_gaussian(generator):
    flows = [
        tuple(Flow(*torch.randn(2, 2, 2, *size, generator=generator)) for size in ((3, 4), (5, 2))) for _ in range(3)
    ]
    supervision = CoarseSupervision(torch.tensor([0, 1, 1]), torch.tensor([0, 7, 11]), torch.tensor([3, 9, 0]))
    expected = []
    for flow0, flow1 in flows:
        for item, i, j in zip(
            supervision.image_index.tolist(), supervision.index0.tolist(), supervision.index1.tolist()
        ):
            here, there = (i // 4, i % 4), (j // 2, j % 2)
            for flow, at, true in ((flow0, here, there), (flow1, there, here)):
                gaussian = torch.distributions.Normal(flow.centre[item, :, *at], flow.log_sigma[item, :, *at].exp())
                expected.append(-gaussian.log_prob(torch.tensor(true[::-1])).sum() - np.log(2 * np.pi))
    torch.testing.assert_close(measure_flow_loss(flows, supervision), torch.stack(expected).mean())


def test_pairs_without_matches_teach_the_flow_nothing(generator):
    centre, log_sigma = torch.randn(2, 1, 2, 3, 4, generator=generator, requires_grad=True)
    nothing = torch.zeros(0, dtype=torch.int64)
    loss = measure_flow_loss([(Flow(centre, log_sigma),) * 2], CoarseSupervision(nothing, nothing, nothing))
    assert loss == 0
    loss.backward()


@torch.no_grad()
def test_a_flow_is_never_surer_than_the_truth_can_be(coarse):
    block = coarse.blocks[0]
    block.flow[2].bias.copy_(torch.tensor([0.0, 20.0, -50.0, 0.0]))
    block.flow[2].weight.zero_()
    flow = block.read_flow(torch.zeros(1, 16, 2, 3), (10, 40))
    assert flow.centre[0, :, 0, 0].tolist() == pytest.approx([19.5, 39.5])
    assert flow.log_sigma[0, :, 0, 0].exp().tolist() == pytest.approx([LEAST_SIGMA, 10 + LEAST_SIGMA])


# In the network


@pytest.mark.slow
@pytest.mark.parametrize(("name", "window", "radius"), [("aspan_homo", 9, 1), ("aspan_homo_heavy", 17, 3)])
def test_the_papers_networks_run(name, window, radius):
    config = load_config(Path(f"configs/{name}.yaml"))
    network = config.network
    assert (network.window, network.radius, network.iterations) == (window, radius, 3)
    torch.manual_seed(0)
    net = HomoNet(network)
    assert isinstance(net.coarse, AspanCoarse) and len(net.coarse.blocks) == 4 and net.coarse.channels == 256
    matcher = HomoMatcher.from_network(net, MatchingConfig(min_confidence=0.0), ImageConfig(long_edge_px=96))
    image = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 255, (72, 96), dtype=np.uint8), (0, 0), 2)
    matches = matcher.match(image, image[:, :80])
    assert len(matches) > 0 and np.isfinite(matches.homography).all()


def test_the_short_training_is_one_of_the_coarse_stage_on_rendered_scenes():
    config = load_config(Path("configs/train_aspan.yaml"), cls=TrainConfig)
    check_config(config)
    assert config.network == dataclasses.replace(NetworkConfig(), coarse="aspan")
    assert config.stage == "coarse" and config.rendered_share == 1 and Path(config.start_from).exists()


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["coarse", "joint"])
def test_the_loop_trains_it_by_matches_and_flow(training, stage):
    network = dataclasses.replace(training.network, coarse="aspan")
    training = dataclasses.replace(training, network=network, stage=stage, steps=2, pairs_per_step=2)
    path = train(training, quiet=True)
    with path.with_name("log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2
    for row in rows:
        value = {name: float(text) for name, text in row.items()}
        assert value["coarse"] > 0 and value["flow"] != 0
        loss = value["coarse"] + FLOW_WEIGHT * value["flow"]
        if stage == "joint":
            loss += value["dense"] + CORNER_WEIGHT * value["corner"] + SCALE_WEIGHT * value["scale"] + value["point"]
        assert value["loss"] == pytest.approx(loss, rel=1e-4)
    assert load_weights(str(path)).config.coarse == "aspan"


def test_unknown_coarse_stages_are_refused_and_the_known_ones_named():
    with pytest.raises(ConfigError, match="network.coarse must be context, cosine, attention or aspan, found 'span'"):
        HomoNet(NetworkConfig(coarse="span"))


def test_of_a_loftr_checkpoint_the_backbone_alone_is_taken(tmp_path):
    network = NetworkConfig(backbone="loftr", coarse="aspan", head="expectation", window=5, margin=0)
    torch.manual_seed(0)
    source = HomoNet(network).backbone.state_dict()
    state = {f"matcher.backbone.{name}": value for name, value in source.items()}
    state["matcher.loftr_coarse.layers.0.merge.weight"] = torch.zeros(256, 256)
    path = tmp_path / "loftr.ckpt"
    torch.save({"state_dict": state}, path)
    net = HomoNet(network)
    start_network(net, path)
    assert all(torch.equal(value, source[name]) for name, value in net.backbone.state_dict().items())
    with pytest.raises(WeightsError, match="loftr.ckpt has no coarse stage for network.coarse aspan"):
        load_weights(str(path), network)
