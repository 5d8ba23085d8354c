"""LightGlue (arXiv 2306.13643): keypoints of two images matched by self- and cross-attention between them.

Each keypoint is a state that starts as its descriptor. Layers of attention let it look at its own image (positions are
rotary codes) and at the other one; a double softmax weighted by matchability assigns them. The first self-attention
sees one image only, so it belongs to the image: `describe` is called once per image, `assign` once per pair. Names of
parameters are those of LightGlue's public weights; `light` takes LighterGlue's, trained on XFeat's descriptors. It
computes in float32 on CPUs: attention over 2048 keypoints takes twice as long in bfloat16, with AMX, too.
"""

from dataclasses import dataclass, replace
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

MIN_MATCHABILITY = 0.05
"""Keypoints less likely than this to have a match are dropped between layers (section 3.3; width confidence 0.95)."""


@dataclass(frozen=True)
class KeypointStates:
    """The keypoints of one image as LightGlue sees them after the first self-attention."""

    state: Tensor
    """(K, C) float32."""
    cos: Tensor
    sin: Tensor
    """(K, C) float32: the rotary code of each position."""

    def select(self, kept: Tensor) -> "KeypointStates":
        """Those that `kept`, (N,) int64 or (K,) bool, names."""
        return KeypointStates(self.state[kept], self.cos[kept], self.sin[kept])


class PositionCode(nn.Module):
    """Rotary codes of learnt frequencies (section 3.1)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.Wr = nn.Linear(2, channels // 2, bias=False)

    def forward(self, position: Tensor) -> tuple[Tensor, Tensor]:
        """(K, 2), in [-1, 1] along the longer side -> cosines and sines (K, C), each twice in a row."""
        angle = self.Wr(position).repeat_interleave(2, dim=-1)
        return angle.cos(), angle.sin()


def rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Rotate the pairs of channels of x (K, C) by the angles of a rotary code."""
    even, odd = x.unflatten(-1, (-1, 2)).unbind(-1)
    return x * cos + torch.stack([-odd, even], dim=-1).flatten(-2) * sin


def make_update(channels: int) -> nn.Sequential:
    """(K, 2 C) states and their messages -> (K, C) changes of the states."""
    return nn.Sequential(
        nn.Linear(2 * channels, 2 * channels), nn.LayerNorm(2 * channels), nn.GELU(), nn.Linear(2 * channels, channels)
    )


def attend(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """One head of attention: (K, C), (N, C), (N, C) -> (K, C)."""
    return F.scaled_dot_product_attention(query[None, None], key[None, None], value[None, None])[0, 0]


class SelfAttention(nn.Module):
    """Keypoints look at those of their own image."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.Wqkv = nn.Linear(channels, 3 * channels)
        self.out_proj = nn.Linear(channels, channels)
        self.ffn = make_update(channels)

    def forward(self, keypoints: KeypointStates) -> KeypointStates:
        # In the public weights query, key and value of a channel follow each other.
        weight, bias = (p.unflatten(0, (-1, 3)).transpose(0, 1).flatten(0, 1) for p in self.Wqkv.parameters())
        query, key, value = F.linear(keypoints.state, weight, bias).chunk(3, dim=-1)
        query, key = (rotate(x, keypoints.cos, keypoints.sin) for x in (query, key))
        message = self.out_proj(attend(query.to(value.dtype), key.to(value.dtype), value))
        state = keypoints.state + self.ffn(torch.cat([keypoints.state, message.to(keypoints.state.dtype)], dim=-1))
        return KeypointStates(state, keypoints.cos, keypoints.sin)


class CrossAttention(nn.Module):
    """Keypoints look at those of the other image; both directions share their similarities (section 3.1)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.to_qk = nn.Linear(channels, channels)
        self.to_v = nn.Linear(channels, channels)
        self.to_out = nn.Linear(channels, channels)
        self.ffn = make_update(channels)

    def forward(self, keypoints0: KeypointStates, keypoints1: KeypointStates) -> tuple[KeypointStates, KeypointStates]:
        states = keypoints0.state, keypoints1.state
        key0, key1 = (self.to_qk(state) for state in states)
        value0, value1 = (self.to_v(state) for state in states)
        messages = attend(key0, key1, value1), attend(key1, key0, value0)
        state0, state1 = (
            state + self.ffn(torch.cat([state, self.to_out(message).to(state.dtype)], dim=-1))
            for state, message in zip(states, messages)
        )
        return replace(keypoints0, state=state0), replace(keypoints1, state=state1)


class Layer(nn.Module):
    """Self-attention in both images, then cross-attention."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.self_attn = SelfAttention(channels)
        self.cross_attn = CrossAttention(channels)


class Assignment(nn.Module):
    """Which keypoints belong together (section 3.2)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.matchability = nn.Linear(channels, 1)
        self.final_proj = nn.Linear(channels, channels)

    def forward(self, state0: Tensor, state1: Tensor) -> Tensor:
        """States (K0, C), (K1, C) -> (K0, K1) float32: logs of the assignment's probabilities."""
        features = (self.final_proj(state).float() / state.shape[-1] ** 0.25 for state in (state0, state1))
        similarity = torch.mm(next(features), next(features).T)
        log_matchable = [F.logsigmoid(self.matchability(state).float()) for state in (state0, state1)]
        row = log_matchable[0] - similarity.logsumexp(dim=1, keepdim=True)
        column = log_matchable[1] - similarity.logsumexp(dim=0)[:, None]
        return 2 * similarity + row + column.T


class LightGlue(nn.Module):
    """Matches keypoints by their descriptors and positions. One attention head, as LighterGlue has it."""

    def __init__(self, input_channels: int = 64, channels: int = 96, layers: int = 6) -> None:
        super().__init__()
        self.input_proj = nn.Linear(input_channels, channels)
        self.posenc = PositionCode(channels)
        self.transformers = nn.ModuleList(Layer(channels) for _ in range(layers))
        self.log_assignment = nn.ModuleList(Assignment(channels) for _ in range(layers))

    def describe(self, descriptors: Tensor, xy: Tensor, size_wh: tuple[int, int]) -> KeypointStates:
        """The keypoints of one image, ready to be matched with any other's.

        descriptors: (K, 64) float32 of unit length; xy: (K, 2) float32 px of an image of size_wh px.
        """
        size = torch.tensor(size_wh, dtype=xy.dtype, device=xy.device)
        code = self.posenc((xy - size / 2) / (size.max() / 2))
        first, _ = self.list_layers()[0]
        return first.self_attn(KeypointStates(self.input_proj(descriptors), *code))

    def list_layers(self) -> list[tuple[Layer, Assignment]]:
        """Each layer, and what assigns the states that it leaves."""
        pairs = zip(self.transformers, self.log_assignment)
        return [(cast(Layer, layer), cast(Assignment, assignment)) for layer, assignment in pairs]

    def assign(self, keypoints0: KeypointStates, keypoints1: KeypointStates) -> tuple[Tensor, Tensor, Tensor]:
        """Match two images: index0, index1 (M,) int64, one to one, and score (M,) float32.

        The score is the probability of the assignment. Mutual best ones are returned, however unlikely.
        """
        sides = [keypoints0, keypoints1]
        index = [torch.arange(len(side.state), device=side.state.device) for side in sides]
        layers = self.list_layers()
        for number, (layer, assignment) in enumerate(layers):
            if number:
                sides = [layer.self_attn(side) for side in sides]
            sides = list(layer.cross_attn(*sides))
            if number < len(layers) - 1:
                for k, side in enumerate(sides):
                    matchable = torch.sigmoid(assignment.matchability(side.state).float())[:, 0]
                    kept = (matchable > MIN_MATCHABILITY).nonzero()[:, 0]
                    if len(kept) < len(index[k]):
                        sides[k], index[k] = side.select(kept), index[k][kept]
            if not all(len(kept) for kept in index):
                none = index[0].new_zeros(0)
                return none, none, none.float()
        log_probability = layers[-1][1](sides[0].state, sides[1].state)
        best, partner = log_probability.max(dim=1)
        mutual = log_probability.argmax(dim=0)[partner] == torch.arange(len(partner), device=partner.device)
        return index[0][mutual], index[1][partner[mutual]], best[mutual].exp()
