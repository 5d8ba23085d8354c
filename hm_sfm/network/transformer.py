"""LoFTR's coarse transformer: sinusoidal positions, then self- and cross-attention between two images' cells.

The names of the parameters are those of the public LoFTR checkpoints (Sun et al., CVPR 2021), which load by name.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def encode_positions(channels: int, height: int, width: int, device: torch.device | None = None) -> Tensor:
    """Sinusoidal position encoding of a grid, (C, H, W) float32, C a multiple of 4; cells count from 1.

    The frequencies are those that LoFTR's public weights were trained with: its formula divides by C and then floors,
    which leaves only whole exponents (LoFTR issue 41).
    """
    exponent = torch.arange(0, channels // 2, 2, device=device).float() * (-math.log(10000.0) / channels // 2)
    frequency = torch.exp(exponent)[:, None, None]
    x = torch.arange(1, width + 1, device=device).float()[None, None, :] * frequency
    y = torch.arange(1, height + 1, device=device).float()[None, :, None] * frequency
    x, y = x.expand(-1, height, -1), y.expand(-1, -1, width)
    return torch.stack([x.sin(), x.cos(), y.sin(), y.cos()], dim=1).flatten(0, 1)


def place_positions(channels: int, height: int, width: int, device: torch.device | None = None) -> Tensor:
    """Sinusoidal positions relative to the grid's longer side, (C, H, W) float32, C a multiple of 4.

    Wavelengths from 1/16 of the longer side to four times it: a photo has the same positions at every resolution, so
    the network may match larger photos than it was trained on.
    """
    half_waves = torch.logspace(math.log10(0.5), math.log10(32.0), channels // 4, device=device)
    longer = max(height, width)
    y, x = ((torch.arange(size, device=device) + 0.5) / longer for size in (height, width))
    phase_x = (torch.pi * half_waves[:, None, None] * x).expand(-1, height, -1)
    phase_y = (torch.pi * half_waves[:, None, None] * y[:, None]).expand(-1, -1, width)
    return torch.cat([phase_x.sin(), phase_x.cos(), phase_y.sin(), phase_y.cos()])


class AttentionLayer(nn.Module):
    """One encoder layer: what `x` gathers from `source` by linear attention, and a feed-forward network over both."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.q_proj = nn.Linear(channels, channels, bias=False)
        self.k_proj = nn.Linear(channels, channels, bias=False)
        self.v_proj = nn.Linear(channels, channels, bias=False)
        self.merge = nn.Linear(channels, channels, bias=False)
        self.mlp = nn.Sequential(
            nn.Linear(2 * channels, 2 * channels, bias=False),
            nn.ReLU(inplace=True),
            nn.Linear(2 * channels, channels, bias=False),
        )
        self.norm1 = nn.LayerNorm(channels)
        self.norm2 = nn.LayerNorm(channels)

    def forward(self, x: Tensor, source: Tensor) -> Tensor:
        """x: (B, N, C), source: (B, S, C). Returns (B, N, C)."""
        query, key, value = (
            layer(cells).unflatten(2, (self.heads, -1))
            for layer, cells in ((self.q_proj, x), (self.k_proj, source), (self.v_proj, source))
        )
        message = self.norm1(self.merge(attend_linearly(query, key, value).flatten(2)))
        return x + self.norm2(self.mlp(torch.cat([x, message], dim=2)))


def attend_linearly(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """Linear attention (Katharopoulos et al., ICML 2020): cost and memory linear in the number of cells.

    query: (B, N, H, D), key and value: (B, S, H, D). Returns (B, N, H, D).
    """
    query, key = F.elu(query) + 1, F.elu(key) + 1
    # Divided by S and multiplied again, the sums stay in the range of half precision.
    count = value.shape[1]
    summary = torch.einsum("bshd,bshv->bhdv", key, value / count)
    weight = torch.einsum("bnhd,bhd->bnh", query, key.sum(dim=1)) + 1e-6
    return torch.einsum("bnhd,bhdv,bnh->bnhv", query, summary, 1 / weight) * count


class CoarseTransformer(nn.Module):
    """Pairs of (self, cross) layers, the same weights for both images."""

    def __init__(self, channels: int, heads: int, pairs: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList([AttentionLayer(channels, heads) for _ in range(2 * pairs)])
        for parameter in self.parameters():
            if parameter.dim() > 1:
                nn.init.xavier_uniform_(parameter)

    def forward(self, coarse0: Tensor, coarse1: Tensor, first_layer: int = 0) -> tuple[Tensor, Tensor]:
        """Cells (B, N0, C) and (B, N1, C), after the layers before `first_layer` -> both, each aware of the other."""
        for number, layer in enumerate(self.layers[first_layer:], start=first_layer):
            if number % 2:
                coarse0 = layer(coarse0, coarse1)
                coarse1 = layer(coarse1, coarse0)
            else:
                coarse0, coarse1 = layer(coarse0, coarse0), layer(coarse1, coarse1)
        return coarse0, coarse1
