"""The fine stage: fine patches around coarse matches -> one homography and one error scale per patch.

Patch coordinates are those of homography.py: cells of the 1/2 grid relative to the patch centre.
"""

import math
from dataclasses import dataclass
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hm_sfm.network.homography import apply_homography, homography_from_corners, make_patch_grid


@dataclass(frozen=True)
class FineEstimate:
    """What a head says about P patches after one iteration (the last one is the result)."""

    displacement: Tensor
    """(P, 4, 2) cells: the four corners' displacements."""
    homography: Tensor
    """(P, 3, 3): cells of patch A -> cells of patch B."""
    log_scale: Tensor
    """(P,): log of the expected error (Laplace scale), cells."""


@dataclass(frozen=True)
class FineMap:
    """Fine features laid out for cutting patches: made once per image, by make_fine_map."""

    cells: Tensor
    """(B, H * W + 1, C): row by row; the last row is zero and stands for all cells outside the map."""
    size_wh: tuple[int, int]
    """Cells."""


def make_fine_map(fine: Tensor) -> FineMap:
    """(B, C, H, W) fine features -> FineMap."""
    height, width = fine.shape[2:]
    return FineMap(F.pad(fine.flatten(2).transpose(1, 2), (0, 0, 0, 1)), (width, height))


def gather_patches(
    fine: FineMap, image_index: Tensor, centre: Tensor, side: int, spacing: int = 1, add_zero: bool = False
) -> Tensor:
    """Cut square patches out of fine features; cells outside the map are zero.

    image_index: (P,) int64; centre: (P, 2) int64 cells (x, y); side: odd, so many cells, each `spacing` from the next.
    Returns (P, side * side, C), row by row; add_zero: with a last cell of zero, (P, side * side + 1, C).
    """
    width, height = fine.size_wh
    cells = width * height
    steps = spacing * torch.arange(-(side // 2), side // 2 + 1, device=centre.device)
    x, y = (centre[:, :, None] + steps).unbind(dim=1)
    # Out of range in either direction, the sum is at least `cells`, and clamps to the row of zeros.
    x = torch.where((x >= 0) & (x < width), x, cells)
    y = torch.where((y >= 0) & (y < height), y * width, cells)
    index = (y[:, :, None] + x[:, None]).clamp_max_(cells).flatten(1)
    if add_zero:
        index = F.pad(index, (0, 1), value=cells)
    index += image_index[:, None] * (cells + 1)
    channels = fine.cells.shape[2]
    return fine.cells.reshape(-1, channels).index_select(0, index.flatten()).view(*index.shape, channels)


def correlate_patches(patch0: Tensor, patch1: Tensor) -> Tensor:
    """C of the paper (section 3.2): ReLU of scaled inner products.

    patch0: (P, N0, C), patch1: (P, N1, C). Returns (P, N0, N1).
    """
    return F.relu(torch.bmm(patch0 * patch0.shape[-1] ** -0.5, patch1.transpose(1, 2)))


def sample_windows(maps: Tensor, centre: Tensor, radius: int) -> Tensor:
    """Bilinear samples of correlation maps on square windows; zero outside the maps.

    maps: (P, N, S * S + 1), row by row, and a last entry of zero that stands for all cells outside; centre:
    (P, N, 2) real-valued map indices (x, y), without gradient. Returns ((2 * radius + 1)**2, P * N), windows row by
    row. All samples of a window share one sub-cell shift, so a window needs (2 * radius + 2)**2 look-ups, not four
    per sample; the windows' offsets come first so that every operation runs over long contiguous rows.
    """
    cells = maps.shape[2]
    side = math.isqrt(cells - 1)
    centre = centre.reshape(-1, 2).T
    low = centre.floor()
    x_shift, y_shift = (centre - low).to(maps.dtype)
    steps = torch.arange(-radius, radius + 2, device=maps.device, dtype=torch.int32)
    x, y = low.to(torch.int32)[:, None] + steps[:, None]
    # Out of range in either direction, the sum is at least `cells`, and clamps to the entry of zero.
    x = torch.where((x >= 0) & (x < side), x, cells)
    y = torch.where((y >= 0) & (y < side), y * side, cells)
    index = (y[:, None] + x).clamp_max_(cells - 1)
    values = maps.view(-1, cells).gather(1, index.flatten(0, 1).T.long()).T.contiguous().view(index.shape)
    rows = torch.lerp(values[:-1], values[1:], y_shift)
    return torch.lerp(rows[:, :-1], rows[:, 1:], x_shift).flatten(0, 1)


def make_pooling(side: int) -> Tensor:
    """(S * S + 1, H * H + 1) float32: times maps of layout sample_windows it halves them, H = ceil(S / 2).

    Average pool of stride 2, as the matrix product that it is: several times faster on small maps. Odd sides are
    padded by zeros. Cell k of the result sits at index 2 k + 0.5 of the input.
    """
    half_side = (side + 1) // 2
    y, x = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    pooling = torch.zeros(side * side + 1, half_side * half_side + 1)
    pooling[torch.arange(side * side), (y // 2 * half_side + x // 2).flatten()] = 0.25
    return pooling


def make_first_look(index: Tensor, radius: int, pooling: Tensor) -> Tensor:
    """(N, S * S + 1, 2 * (2 * radius + 1)**2) float32: times maps of layout sample_windows, what lies around `index`.

    index: (N, 2) map indices, the same ones in all maps; the samples are those of the maps, then those of the pooled
    ones, see make_pooling. Nothing has moved yet at the first update: where it samples is known before, and one small
    matrix product takes a third of the time of two sample_windows.
    """
    maps = torch.eye(len(pooling))[:, None]  # one that holds a single 1 at each cell: samples are linear in the maps
    pooled = maps @ pooling
    centres = index[:, None, None].expand(-1, len(maps), -1, -1)
    parts = [
        torch.cat([sample_windows(maps, full, radius), sample_windows(pooled, (full - 0.5) / 2, radius)]).T
        for full in centres
    ]
    return torch.stack(parts)


def convolve(maps: Tensor, layer: nn.Conv2d) -> Tensor:
    """`layer` on maps (P, H, W, C) -> (P, H', W', C').

    Without gradients as one matrix product: on so small maps PyTorch's own convolution takes half as long again, but
    its backward pass is the faster one.
    """
    if torch.is_grad_enabled():
        return layer(maps.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
    side, stride, pad = (int(value[0]) for value in (layer.kernel_size, layer.stride, layer.padding))
    windows = F.pad(maps, (0, 0, pad, pad, pad, pad)).unfold(1, side, stride).unfold(2, side, stride)
    weight = layer.weight.permute(0, 2, 3, 1).flatten(1)
    return F.linear(windows.permute(0, 1, 2, 4, 5, 3).flatten(3), weight, layer.bias)


class HomographyHead(nn.Module):
    """The paper's fine module (section 3.2): K residual updates of the corner displacements.

    window: w, side of the patch of A, 2**n + 1. margin: cells by which the patch of B is larger on each side (the
    paper: 0), so that points moved beyond w x w still see features. radius: r of the sampled windows. spacing: a power
    of 2, at most (w - 1) / 2: of the patch of A, only cells so far from each other are looked up in B (the paper: 1).
    """

    grid: Tensor
    pooling: Tensor
    first_look: Tensor

    def __init__(self, window: int, radius: int, iterations: int, margin: int, spacing: int = 1) -> None:
        super().__init__()
        self.window, self.radius, self.iterations, self.margin = window, radius, iterations, margin
        self.spacing, self.side = spacing, (window - 1) // spacing + 1
        channels = 2 * (2 * radius + 1) ** 2 + 4
        # Fewer points take less time each, so they may have wider layers.
        width, side = 64 if spacing == 1 else 96, self.side
        layers: list[nn.Module] = [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU(inplace=True)]
        while side > 3:
            layers += [nn.Conv2d(width, width + 32, 3, stride=2, padding=1), nn.ReLU(inplace=True)]
            width, side = width + 32, (side + 1) // 2
        self.encoder = nn.Sequential(*layers)
        self.corners = nn.Conv2d(width, 2, 2)
        self.scale = nn.Conv2d(width, 1, 3)
        for layer in (self.corners, self.scale):
            nn.init.normal_(layer.weight, std=1e-3)
            nn.init.zeros_(cast(Tensor, layer.bias))
        self.register_buffer("grid", make_patch_grid((window - 1) / 2, spacing), persistent=False)
        self.register_buffer("pooling", make_pooling(window + 2 * margin), persistent=False)
        first_look = make_first_look(self.grid + self.half + margin, radius, self.pooling)
        self.register_buffer("first_look", first_look, persistent=False)

    @property
    def half(self) -> float:  # pyright: ignore[reportIncompatibleMethodOverride] nobody casts a head to half precision
        """Distance of a patch's corner cells from its centre along each axis, cells."""
        return (self.window - 1) / 2

    def forward(
        self,
        fine0: FineMap,
        fine1: FineMap,
        image_index: Tensor,
        cell0: Tensor,
        cell1: Tensor,
        start: Tensor | None = None,
        iterations: int | None = None,
    ) -> list[FineEstimate]:
        """Homographies from the patch around cell0 of fine0 to the patch around cell1 of fine1.

        image_index: (P,) int64, into both batches; cell0, cell1: (P, 2) int64, cells of the 1/2 grid; start: (P, 4, 2)
        float32 cells, displacements of the corners to start from, None for the paper's identity; iterations: None for
        the network's own. Returns the FineEstimate of each iteration.
        """
        patch0 = gather_patches(fine0, image_index, cell0, self.side, self.spacing)
        # A last cell of zero features makes the zero that sample_windows takes outside the maps.
        patch1 = gather_patches(fine1, image_index, cell1, self.window + 2 * self.margin, add_zero=True)
        full = correlate_patches(patch0, patch1)
        iterations = iterations or self.iterations
        pooled = full @ self.pooling.to(full.dtype) if iterations > 1 or start is not None else None
        displacement, estimates = start, []
        for _ in range(iterations):
            if displacement is None:
                displacement = full.new_zeros((len(cell0), 4, 2), dtype=torch.float32)
                target = self.grid.expand(len(cell0), -1, -1)
                samples = torch.bmm(full.transpose(0, 1), self.first_look.to(full.dtype)).transpose(0, 1)
            else:
                displacement = displacement.detach()
                with torch.no_grad():
                    target = apply_homography(homography_from_corners(displacement, self.half), self.grid)
                assert pooled is not None  # as iterations > 1 or start is given
                samples = self.look_up(full, pooled, target)
            residual, log_scale = self.decode(samples, target)
            displacement = displacement + residual
            homography = homography_from_corners(displacement, self.half)
            estimates.append(FineEstimate(displacement, homography, log_scale))
        return estimates

    def look_up(self, full: Tensor, pooled: Tensor, target: Tensor) -> Tensor:
        """The correlations around `target` (P, N, 2): (P, N, 2 (2 radius + 1)**2), those of the pooled maps last."""
        index = target + self.half + self.margin
        samples = torch.cat(
            [sample_windows(full, index, self.radius), sample_windows(pooled, (index - 0.5) / 2, self.radius)]
        )
        return samples.T.unflatten(0, target.shape[:2])

    def decode(self, samples: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """One update: what the samples (P, N, C) around `target` (P, N, 2) say. Returns (P, 4, 2) cells and (P,)."""
        shift = ((target - self.grid) / self.half).to(samples.dtype)
        grid = (self.grid / self.half).to(samples.dtype).expand_as(shift)
        code = torch.cat([samples, shift, grid], dim=2).unflatten(1, (self.side, self.side))
        for layer in self.encoder:
            code = convolve(code, layer) if isinstance(layer, nn.Conv2d) else layer(code)
        # A bounded step: unbounded ones fold patches over early in training, and never recover.
        residual = self.half * torch.tanh(convolve(code, self.corners).float())
        log_scale = convolve(code, self.scale).float().flatten().clamp(-5.0, 5.0)
        return residual.flatten(1, 2), log_scale


class ExpectationHead(nn.Module):
    """LoFTR's point-to-patch head, the baseline: the expected position of A's centre cell in B's patch.

    The homography is the plain shift to it; the error scale is the spread of the distribution.
    """

    positions: Tensor

    def __init__(self, window: int, margin: int) -> None:
        super().__init__()
        self.window, self.margin = window, margin
        half1 = (window - 1) / 2 + margin
        self.register_buffer("positions", make_patch_grid(half1), persistent=False)

    @property
    def half(self) -> float:  # pyright: ignore[reportIncompatibleMethodOverride] nobody casts a head to half precision
        """As in HomographyHead."""
        return (self.window - 1) / 2

    def forward(
        self, fine0: FineMap, fine1: FineMap, image_index: Tensor, cell0: Tensor, cell1: Tensor
    ) -> list[FineEstimate]:
        """As HomographyHead.forward; a list of one FineEstimate."""
        patch0 = gather_patches(fine0, image_index, cell0, 1)
        patch1 = gather_patches(fine1, image_index, cell1, self.window + 2 * self.margin)
        logits = torch.bmm(patch0, patch1.transpose(1, 2)).float() * patch0.shape[-1] ** -0.5
        heatmap = logits.squeeze(1).softmax(dim=1)
        weighted = heatmap[..., None] * self.positions
        shift = weighted.sum(dim=1)
        variance = (weighted * self.positions).sum(dim=1) - shift.square()
        log_scale = 0.5 * variance.sum(dim=1).clamp_min(1e-6).log()
        displacement = shift[:, None].expand(-1, 4, -1)
        return [FineEstimate(displacement, homography_from_corners(displacement, self.half), log_scale)]
