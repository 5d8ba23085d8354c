"""ASpanFormer's coarse transformer (Chen et al., ECCV 2022, arXiv 2208.14201, section 3): cells attend around a flow.

The flow is a Gaussian for every cell: where in the other image it lies. Each block regresses it anew and lets the cell
gather from the other image twice: from all of it on a reduced grid, and from a span around the flow, which is as wide
as the flow is uncertain. Both images go through the same weights. As in the published code, all attention is between
the images: within an image, cells exchange what they know by a 3x3 convolution after each attention.

The parameters have names of our own. Ours, too, are the starting values: messages are small and queries resemble keys,
so that a new network begins near the plain features, and a short training gets somewhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hm_sfm.network.transformer import place_positions

GLOBAL_POOL = 4
"""Side of the squares of 1/8 cells that are one token of the global attention: its grid is that of 1/32."""
LOCAL_POOLS = (2, 1)
"""The same for the local attention, which works at 1/16 and at 1/8."""
GROUP = 2
"""Side of the squares of tokens that share a span."""
SAMPLES = 8
"""Side of the square of positions that a span is sampled at: what attends locally sees SAMPLES**2 tokens, however wide
its span and however large the images."""
GROUP_CHUNK = 128
"""Groups whose samples are held at a time: so few stay in the processor's cache."""
SPAN_SIGMAS = 5.0
"""n: half the side of a span, standard deviations of the flow."""
START_LAYERS = 2
"""Of global attention before the first flow."""
LEAST_SIGMA = 0.1
"""Cells; the ground truth is known to half a cell, so a flow need never be surer."""
WIDEST_SIGMA = 0.25
"""Of a flow that knows nothing yet, relative to the longer side of the other image: its span is all of it."""
FIRST_GAIN = 0.1
"""Size of the messages of a new network, relative to the features."""


@dataclass(frozen=True)
class Flow:
    """Where the cells of an image lie in the other one: a Gaussian along each axis."""

    centre: Tensor
    """(B, 2, H, W) float32: x, y, cells of the other image's grid; the centre of its first cell is (0, 0)."""
    log_sigma: Tensor
    """(B, 2, H, W) float32: the standard deviations, log cells."""


class ChannelNorm(nn.LayerNorm):
    """Layer norm over the channels of a map (B, C, H, W)."""

    def forward(self, input: Tensor) -> Tensor:
        return super().forward(input.movedim(1, -1)).movedim(-1, 1)


class GlobalLayer(nn.Module):
    """Attention between all tokens of two reduced maps; the values say where they come from."""

    def __init__(self, channels: int, heads: int, place_channels: int) -> None:
        super().__init__()
        self.heads = heads
        self.query, self.key = make_twins(channels)
        self.value = _point(channels + place_channels, channels)
        self.merge = _point(channels, channels)
        self.norm1 = ChannelNorm(channels)
        self.mlp = nn.Sequential(
            _point(2 * channels, 2 * channels), nn.ReLU(inplace=True), _point(2 * channels, channels)
        )
        self.norm2 = make_small(ChannelNorm(channels))

    def forward(self, cells: Tensor, source: Tensor, source_places: Tensor) -> Tensor:
        """cells: (B, C, H0, W0), source: (B, C, H1, W1), source_places: (B, P, H1, W1). Returns (B, C, H0, W0)."""
        value = self.value(torch.cat([source, source_places], dim=1))
        message = self.merge(attend_globally(self.query(cells), self.key(source), value, self.heads, pool=1))
        return cells + self.norm2(self.mlp(torch.cat([cells, self.norm1(message)], dim=1)))


class FlowStart(nn.Module):
    """The initialisation: global attention on the reduced maps makes the first features of the flow."""

    def __init__(self, channels: int, heads: int, flow_channels: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList([GlobalLayer(channels, heads, flow_channels) for _ in range(START_LAYERS)])
        self.split = nn.Conv2d(channels, channels + flow_channels, 1)
        self.merge = nn.Conv2d(2 * channels, channels, 1)

    def forward(self, cells: tuple[Tensor, Tensor], places: tuple[Tensor, Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        """Cells (B, C, H, W) and places (B, P, H, W) of both images -> cells, and features of the flow (B, P, H, W)."""
        first, second = (shrink(x, GLOBAL_POOL) for x in cells)
        place0, place1 = (shrink(x, GLOBAL_POOL) for x in places)
        for layer in self.layers:
            first, second = layer(first, second, place1), layer(second, first, place0)
        aware, flows = [], []
        for own, reduced in zip(cells, (first, second)):
            enlarged = F.interpolate(self.split(reduced).float(), scale_factor=GLOBAL_POOL, mode="bilinear")
            context, flow = enlarged[:, :, : own.shape[2], : own.shape[3]].tensor_split([own.shape[1]], dim=1)
            aware.append(own + self.merge(torch.cat([own, context], dim=1)))
            flows.append(flow)
        return aware, flows


class GlobalLocalBlock(nn.Module):
    """The global-local attention (GLA).

    A flow is read from its features, then each cell attends to all of the other image on a reduced grid and to the
    spans around its flow; a feed-forward network takes in the result.
    keeps_flow: the features of the flow are updated with the cells', for the next block; the last one needs none.
    """

    def __init__(self, channels: int, heads: int, flow_channels: int, keeps_flow: bool) -> None:
        super().__init__()
        self.heads, self.channels, self.keeps_flow = heads, channels, keeps_flow
        self.flow = nn.Sequential(
            _point(flow_channels, flow_channels // 2), nn.ReLU(inplace=True), nn.Conv2d(flow_channels // 2, 4, 1)
        )
        self.query, self.key = make_twins(channels)
        self.value = _point(channels + flow_channels, channels)
        levels = 1 + len(LOCAL_POOLS)
        self.merge = nn.Sequential(
            _point(levels * channels, channels), nn.ReLU(inplace=True), _point(channels, channels)
        )
        self.norm1 = ChannelNorm(channels)
        updated = channels + flow_channels * keeps_flow
        self.mlp = nn.Sequential(
            _point(updated + channels, channels + flow_channels),
            nn.ReLU(inplace=True),
            nn.Conv2d(channels + flow_channels, updated, 3, padding=1, bias=False),
        )
        self.norm2 = make_small(ChannelNorm(updated))

    def read_flow(self, features: Tensor, size_hw: Sequence[int]) -> Flow:
        """The flow that features (B, P, H, W) of it stand for; size_hw: of the other image's grid.

        Relative to its longer side, as the positions are, so that both mean the same in images of any shape.
        """
        # Half precision would round positions to a good part of a cell.
        with torch.autocast(features.device.type, enabled=False):
            place, log_sigma = self.flow(features.float()).chunk(2, dim=1)
            longer = max(size_hw)
            log_sigma = log_sigma + features.new_tensor(WIDEST_SIGMA * longer).log()
            least = features.new_tensor(LEAST_SIGMA).log()
            return Flow(place.sigmoid() * longer - 0.5, torch.logaddexp(log_sigma, least))

    def forward(
        self, cells: Tensor, features: Tensor, source: Tensor, source_places: Tensor
    ) -> tuple[Tensor, Tensor, Flow]:
        """Cells, features and the flow that was read from the given features.

        cells: (B, C, H0, W0), features: (B, P, H0, W0) of their flow; source: (B, C, H1, W1), source_places:
        (B, P, H1, W1).
        """
        flow = self.read_flow(features, source.shape[2:])
        query, key = self.query(cells), self.key(source)
        value = self.value(torch.cat([source, source_places], dim=1))
        messages = [attend_globally(query, key, value, self.heads, GLOBAL_POOL)]
        messages += [attend_locally(query, key, value, flow, self.heads, pool) for pool in LOCAL_POOLS]
        message = self.norm1(self.merge(torch.cat(messages, dim=1)))
        state = torch.cat([cells, features], dim=1) if self.keeps_flow else cells
        state = state + self.norm2(self.mlp(torch.cat([state, message], dim=1)))
        return state[:, : self.channels], state[:, self.channels :], flow


class SpanTransformer(nn.Module):
    """The initialisation and the blocks, the same weights for both images."""

    def __init__(self, channels: int, heads: int, blocks: int) -> None:
        super().__init__()
        self.channels = channels
        flow_channels = channels // 2
        self.place = nn.Conv2d(channels, flow_channels, 1, bias=False)
        self.start = FlowStart(channels, heads, flow_channels)
        self.blocks = nn.ModuleList(
            [GlobalLocalBlock(channels, heads, flow_channels, number < blocks) for number in range(1, blocks + 1)]
        )
        for name, parameter in self.named_parameters():
            if parameter.dim() > 1 and not name.endswith("key.weight"):
                nn.init.xavier_uniform_(parameter, FIRST_GAIN if name == "start.merge.weight" else 1.0)
        for layer in self.modules():
            if isinstance(layer, GlobalLayer | GlobalLocalBlock):
                layer.key.load_state_dict(layer.query.state_dict())

    def attend(self, map0: Tensor, map1: Tensor) -> tuple[Tensor, Tensor, list[tuple[Flow, Flow]]]:
        """Both maps, each aware of the other, and the flow of each block, from image 0 to image 1 and back.

        map0, map1: (B, C, H0, W0), (B, C, H1, W1) float32, with positions added.
        """
        cells = map0, map1
        places = tuple(
            self.place(place_positions(self.channels, x.shape[2], x.shape[3], x.device)[None]).expand(
                len(x), -1, -1, -1
            )
            for x in cells
        )
        cells, features = self.start(cells, places)
        flows = []
        for block in self.blocks:
            updated = [block(cells[own], features[own], cells[1 - own], places[1 - own]) for own in (0, 1)]
            cells, features, flow = zip(*updated)
            flows.append(flow)
        return *cells, flows


def attend_globally(query: Tensor, key: Tensor, value: Tensor, heads: int, pool: int) -> Tensor:
    """What every token of a reduced map gathers from all of another.

    Queries (B, C, H0, W0), keys and values (B, C, H1, W1) -> (B, C, H0, W0); pool: side of the squares of cells that
    are a token.
    """
    reduced = shrink(query, pool)
    queries, keys, values = (
        _split_heads(shrink(x, pool).flatten(2).transpose(1, 2), heads) for x in (query, key, value)
    )
    message = F.scaled_dot_product_attention(queries, keys, values)
    message = message.transpose(2, 3).reshape(len(query), -1, *reduced.shape[2:])
    return enlarge(message, pool, query.shape[2:])


def attend_locally(query: Tensor, key: Tensor, value: Tensor, flow: Flow, heads: int, pool: int) -> Tensor:
    """What every token gathers from the samples of its group's span: shapes and pool as in attend_globally."""
    size_hw = query.shape[2:]
    query, key, value = (shrink(x, pool) for x in (query, key, value))
    positions = place_samples(flow, pool, key.shape[2:])
    batch, channels, height, width = query.shape
    rows, columns = positions.shape[1:3]
    # Groups at the lower and right edges may lack tokens.
    grouped = F.pad(query, (0, GROUP * columns - width, 0, GROUP * rows - height))
    grouped = grouped.unflatten(3, (columns, GROUP)).unflatten(2, (rows, GROUP)).permute(0, 2, 4, 3, 5, 1)
    grouped = grouped.reshape(batch * rows * columns, GROUP**2, channels)
    index, weight = (x.flatten(0, 2) for x in find_cells(positions, key.shape[2:]))
    # In float32, as gradients of a cell are summed; each cell in one piece of memory, which is read many times.
    cells = torch.cat([key, value], dim=1).float().flatten(2).transpose(1, 2).flatten(0, 1).contiguous()
    messages = []
    for own, seen, share in zip(*(x.split(GROUP_CHUNK) for x in (grouped, index, weight))):
        # A sum of four rows of a table: on a CPU faster than grid_sample, above all on the way back.
        samples = F.embedding_bag(seen.flatten(0, 1), cells, mode="sum", per_sample_weights=share.flatten(0, 1))
        keys, values = samples.unflatten(0, (-1, SAMPLES**2)).chunk(2, dim=2)
        queries, keys, values = (_split_heads(x, heads) for x in (own, keys, values))
        messages.append(F.scaled_dot_product_attention(queries, keys, values))
    message = torch.cat(messages)
    message = message.transpose(1, 2).reshape(batch, rows, columns, GROUP, GROUP, channels)
    message = message.permute(0, 5, 1, 3, 2, 4).reshape(batch, channels, rows * GROUP, columns * GROUP)
    return enlarge(message[:, :, :height, :width], pool, size_hw)


def place_samples(flow: Flow, pool: int, size_hw: Sequence[int]) -> Tensor:
    """Where the spans around a flow are sampled, (B, R, C, SAMPLES**2, 2) float32, for each of R x C groups of tokens.

    These are x, y, in cells of the other image's grid reduced by `pool`, which has the size size_hw.
    Without gradient, as in the published code: the likelihood alone teaches the flow.
    """
    centre = (shrink(flow.centre.detach(), GROUP * pool) + 0.5) / pool - 0.5
    span = shrink(measure_spans(flow.log_sigma.detach(), size_hw), GROUP * pool)
    step = (torch.arange(SAMPLES, device=span.device) + 0.5) / SAMPLES - 0.5
    offset = torch.cartesian_prod(step, step)
    return centre.permute(0, 2, 3, 1)[..., None, :] + offset * span.permute(0, 2, 3, 1)[..., None, :]


def measure_spans(log_sigma: Tensor, size_hw: Sequence[int]) -> Tensor:
    """Sides of the spans of flows with standard deviations log_sigma (B, 2, H, W), log cells: (B, 2, H, W).

    From SAMPLES, where samples are neighbouring tokens, to the size of the other grid, size_hw. As in the published
    code they count tokens of the grid that is sampled, so that at 1/16 one looks twice as far as at 1/8.
    """
    most = torch.tensor(size_hw[::-1], device=log_sigma.device).clamp_min(SAMPLES)[:, None, None]
    return torch.minimum((2 * SPAN_SIGMAS * log_sigma.exp()).clamp_min(SAMPLES), most)


def find_cells(positions: Tensor, size_hw: Sequence[int]) -> tuple[Tensor, Tensor]:
    """The four cells around each of positions (B, R, C, S, 2), and their weights in bilinear interpolation.

    positions: x, y in cells of grids of size_hw. Returns (B, R, C, S, 4) int64, counted row by row and grid by grid,
    and (B, R, C, S, 4) float32.
    Beyond its edges a grid goes on as it ends.
    """
    height, width = size_hw
    last = torch.tensor([width - 1, height - 1], device=positions.device)
    inside = torch.minimum(positions.clamp_min(0), last)
    corner = inside.floor()
    right, down = (inside - corner).unbind(dim=-1)
    x0, y0 = corner.long().unbind(dim=-1)
    x1, y1 = torch.minimum(corner.long() + 1, last).unbind(dim=-1)
    first = height * width * torch.arange(len(positions), device=positions.device).view(-1, 1, 1, 1)
    index = torch.stack([first + y * width + x for y in (y0, y1) for x in (x0, x1)], dim=-1)
    weight = torch.stack([y * x for y in (1 - down, down) for x in (1 - right, right)], dim=-1)
    return index, weight


def shrink(x: Tensor, pool: int) -> Tensor:
    """Means over squares of `pool` x `pool` cells, (B, C, H, W) -> (B, C, ceil(H / pool), ceil(W / pool)).

    Squares at the lower and right edges may be cut off.
    """
    return x if pool == 1 else F.avg_pool2d(x, pool, ceil_mode=True)


def enlarge(x: Tensor, pool: int, size_hw: Sequence[int]) -> Tensor:
    """Give every cell the value of its square: the shape that shrink made of a map of size_hw -> (B, C, H, W)."""
    repeated = x.repeat_interleave(pool, dim=2).repeat_interleave(pool, dim=3)
    return repeated[:, :, : size_hw[0], : size_hw[1]]


def make_twins(channels: int) -> tuple[nn.Conv2d, nn.Conv2d]:
    """Projections to queries and keys; SpanTransformer starts them alike, so that like attends to like."""
    return _point(channels, channels), _point(channels, channels)


def make_small(norm: ChannelNorm) -> ChannelNorm:
    """The same norm, with FIRST_GAIN as its gain."""
    nn.init.constant_(norm.weight, FIRST_GAIN)
    return norm


def _point(in_channels: int, out_channels: int) -> nn.Conv2d:
    """A linear layer over the channels of each cell."""
    return nn.Conv2d(in_channels, out_channels, 1, bias=False)


def _split_heads(tokens: Tensor, heads: int) -> Tensor:
    """(B, N, C) -> (B, heads, N, C / heads)."""
    return tokens.unflatten(2, (heads, -1)).transpose(1, 2)
