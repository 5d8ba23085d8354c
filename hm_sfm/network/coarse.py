"""The coarse stage: which 1/8 cells of two images belong together.

A coarse stage is a module with `describe`, run once per image on the backbone's map, and `match`, run per pair.
"""

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hm_sfm.network.aspan import Flow, SpanTransformer
from hm_sfm.network.transformer import CoarseTransformer, encode_positions, place_positions

BLOCK_ROWS = 128
"""Rows of the similarity matrix that are held at a time: so few stay in the processor's cache."""
GROUP = 128
"""Columns of it among which the largest entry is found at once."""
LARGEST_SPREAD = 60.0
"""Logarithm of the range within which sums of exponentials share one scale in float32."""
SHARPNESS = 10.0
"""Of LoFTR's dual softmax: the inverse of its temperature."""

Matches = tuple[Tensor, Tensor, Tensor]
"""index0, index1 (M,) int64, one to one, and score (M,) float32."""


class CosineCoarse(nn.Module):
    """The coarse stage of `light`: mutual nearest neighbours by cosine similarity."""

    def describe(self, coarse: Tensor) -> Tensor:
        """(B, C, H, W) map of the backbone -> (B, C, H, W) float32 of unit length per cell."""
        return F.normalize(coarse.float(), dim=1)

    def match(self, coarse0: Tensor, coarse1: Tensor, threshold: float) -> Matches:
        """Match described cells (N0, C) and (N1, C): similarity of at least `threshold`."""
        return match_by_similarity(coarse0, coarse1, threshold)


class AttentionCoarse(nn.Module):
    """The coarse stage of `light` with context: attention between the cells corrects the backbone's features.

    It starts as these plain features: the correction is zero before it is trained. The first self-attention looks at
    one image only, so it is computed once per image, not per pair.
    """

    def __init__(self, channels: int = 64, width: int = 128, heads: int = 4, pairs: int = 2) -> None:
        super().__init__()
        self.channels, self.width = channels, width
        self.enter = nn.Linear(channels, width)
        self.transformer = CoarseTransformer(width, heads, pairs)
        self.leave = nn.Linear(width, channels)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)
        self.log_sharpness = nn.Parameter(torch.tensor(math.log(35.0)))

    @property
    def sharpness(self) -> Tensor:
        """Factor of the inner products before the dual softmax, a scalar."""
        return self.log_sharpness.exp()

    def describe(self, coarse: Tensor) -> Tensor:
        """(B, C, H, W) map of the backbone -> (B, C + width, H, W) float32: unit features, and what attends."""
        plain = F.normalize(coarse.float(), dim=1)
        batch, _, height, width = plain.shape
        cells = self.enter(plain.flatten(2).transpose(1, 2))
        cells = cells + place_positions(self.width, height, width, plain.device).flatten(1).T
        aware = self.transformer.layers[0](cells, cells)
        return torch.cat([plain, aware.float().transpose(1, 2).reshape(batch, -1, height, width)], dim=1)

    def forward(self, coarse0: Tensor, coarse1: Tensor) -> tuple[Tensor, Tensor]:
        """Described cells (B, N0, C + width) and (B, N1, C + width) -> corrected features (B, N0, C), (B, N1, C)."""
        sizes = [self.channels, self.width]
        (plain0, aware0), (plain1, aware1) = coarse0.split(sizes, dim=2), coarse1.split(sizes, dim=2)
        aware0, aware1 = self.transformer(aware0, aware1, first_layer=1)
        return plain0 + self.leave(aware0).float(), plain1 + self.leave(aware1).float()

    def match(self, coarse0: Tensor, coarse1: Tensor, threshold: float) -> Matches:
        """Match described cells (N0, C + width) and (N1, C + width): confidence of at least `threshold`."""
        corrected0, corrected1 = self(coarse0[None], coarse1[None])
        return match_by_dual_softmax(corrected0[0], corrected1[0], threshold, self.sharpness)


class LoftrCoarse(CoarseTransformer):
    """LoFTR's coarse stage: positions, self- and cross-attention, dual softmax."""

    def __init__(self, channels: int = 256, heads: int = 8, pairs: int = 4) -> None:
        super().__init__(channels, heads, pairs)
        self.sharpness = torch.tensor(SHARPNESS / channels)

    def describe(self, coarse: Tensor) -> Tensor:
        """(B, C, H, W) map of the backbone -> (B, C, H, W) float32 with the positions added."""
        return coarse.float() + encode_positions(*coarse.shape[1:], device=coarse.device)

    def match(self, coarse0: Tensor, coarse1: Tensor, threshold: float) -> Matches:
        """Match described cells (N0, C) and (N1, C): confidence of at least `threshold`."""
        aware0, aware1 = self(coarse0[None], coarse1[None])
        return match_by_dual_softmax(aware0[0].float(), aware1[0].float(), threshold, self.sharpness)


class AspanCoarse(SpanTransformer):
    """ASpanFormer's coarse stage: attention within spans around a flow, dual softmax."""

    def __init__(self, channels: int = 256, heads: int = 8, blocks: int = 4) -> None:
        super().__init__(channels, heads, blocks)
        # Learnt, where LoFTR and ASpanFormer keep it: features start at one size, whatever the backbone.
        self.log_sharpness = nn.Parameter(torch.tensor(math.log(35.0 / channels)))

    @property
    def sharpness(self) -> Tensor:
        """Factor of the inner products before the dual softmax, a scalar."""
        return self.log_sharpness.exp()

    def describe(self, coarse: Tensor) -> Tensor:
        """(B, C, H, W) map of the backbone -> (B, C + 2, H, W) float32.

        These are features of unit variance with the positions added, and the column and row of each cell, by which
        `forward` knows the grid.

        The positions are relative to the image's size, which is what ASpanFormer's normalisation of them is for:
        photos may be larger than those it was trained on.
        """
        batch, channels, height, width = coarse.shape
        features = F.normalize(coarse.float(), dim=1) * channels**0.5
        features = features + place_positions(channels, height, width, coarse.device)
        row, column = torch.meshgrid(*(torch.arange(n, device=coarse.device) for n in (height, width)), indexing="ij")
        place = torch.stack([column, row]).float().expand(batch, -1, -1, -1)
        return torch.cat([features, place], dim=1)

    def estimate(self, coarse0: Tensor, coarse1: Tensor) -> tuple[Tensor, Tensor, list[tuple[Flow, Flow]]]:
        """Described cells (B, N0, C + 2), (B, N1, C + 2) -> features (B, N0, C), (B, N1, C), and flows.

        The features of each image are aware of the other one; the flows are those of each block in both directions.
        """
        map0, map1, flows = self.attend(*(as_map(cells) for cells in (coarse0, coarse1)))
        return map0.flatten(2).transpose(1, 2), map1.flatten(2).transpose(1, 2), flows

    def forward(self, coarse0: Tensor, coarse1: Tensor) -> tuple[Tensor, Tensor]:
        """The features alone, as in `estimate`."""
        return self.estimate(coarse0, coarse1)[:2]

    def match(self, coarse0: Tensor, coarse1: Tensor, threshold: float) -> Matches:
        """Match described cells (N0, C + 2) and (N1, C + 2), all of each image: confidence of at least `threshold`."""
        aware0, aware1 = self(coarse0[None], coarse1[None])
        return match_by_dual_softmax(aware0[0].float(), aware1[0].float(), threshold, self.sharpness)


def as_map(cells: Tensor) -> Tensor:
    """(B, H W, C + 2), the last two being each cell's column and row -> (B, C, H, W)."""
    rows = int(cells[0, -1, -1]) + 1
    return cells[:, :, :-2].transpose(1, 2).unflatten(2, (rows, -1))


def match_by_similarity(coarse0: Tensor, coarse1: Tensor, threshold: float, block: int = BLOCK_ROWS) -> Matches:
    """Mutual nearest neighbours by inner product, without ever holding the whole similarity matrix.

    coarse0: (N0, C), coarse1: (N1, C) float32; block: rows of the matrix held at a time. Scores are the inner products,
    at least `threshold`; within torch.autocast they are of factors in half precision, but summed up in full.
    """
    with half_precision_factors(coarse0.device.type):
        return pick_mutual(multiply_blocks(coarse0, coarse1, block), coarse1, threshold)


@contextmanager
def half_precision_factors(device: str) -> Iterator[None]:
    """Where autocast is on, products of float32 matrices stay float32, of factors rounded to half precision.

    Autocast itself would round the products, and make equals of similarities that are not.
    """
    if device == "cuda":
        products: Any = torch.backends.cuda.matmul
    else:
        products = torch.backends.mkldnn.matmul  # pyright: ignore[reportAttributeAccessIssue] PyTorch's hints lack it
    before = products.fp32_precision
    if torch.is_autocast_enabled(device):
        products.fp32_precision = "tf32" if device == "cuda" else "bf16"
    try:
        with torch.autocast(device, enabled=False):
            yield
    finally:
        products.fp32_precision = before


def match_by_dual_softmax(
    coarse0: Tensor, coarse1: Tensor, threshold: float, sharpness: Tensor, block: int = BLOCK_ROWS
) -> Matches:
    """Mutual best matches by LoFTR's confidence, the product of the softmax over rows and that over columns.

    coarse0: (N0, C), coarse1: (N1, C) float32; sharpness: scalar, factor of their inner products. Two passes over
    blocks of rows: the first sums up rows and columns, the second compares; the whole matrix is never held.
    """
    least = math.log(max(threshold, 1e-30))
    with torch.autocast(coarse0.device.type, enabled=False):
        coarse0 = coarse0 * sharpness
        row, column, top = sum_exponentials(coarse0, coarse1, block)
        # A confidence is at most the softmax over the row: most rows of pairs with little overlap end here.
        able = (top - row >= least - 1e-3).nonzero().flatten()
        blocks = make_log_confidences(coarse0[able], coarse1, row[able], column, block)
        index0, index1, log_confidence = pick_mutual(blocks, coarse1, least)
    return able[index0], index1, log_confidence.exp()


def make_log_confidences(
    coarse0: Tensor, coarse1: Tensor, row: Tensor, column: Tensor, block: int = BLOCK_ROWS
) -> Iterator[Tensor]:
    """Blocks of rows (n, N1) of the logarithms of the dual-softmax confidences of coarse0 @ coarse1.T.

    row (N0,), column (N1,): its sums, as sum_exponentials makes them.
    """
    # 2 s - row - column, as one matrix product.
    rows = torch.cat([2 * coarse0, -row[:, None], -torch.ones_like(row)[:, None]], dim=1)
    columns = torch.cat([coarse1, torch.ones_like(column)[:, None], column[:, None]], dim=1)
    return multiply_blocks(rows, columns, block)


def multiply_blocks(rows: Tensor, columns: Tensor, block: int) -> Iterator[Tensor]:
    """Blocks of rows (n, N1) of rows @ columns.T, of (N0, C) and (N1, C), without gradient.

    All lie in the same memory, so that the next one overwrites the last: fresh memory takes longer than the product.
    """
    memory = rows.new_empty(min(block, len(rows)), len(columns))
    for cells in rows.split(block):
        yield torch.mm(cells, columns.T, out=memory[: len(cells)])


def sum_exponentials(coarse0: Tensor, coarse1: Tensor, block: int = BLOCK_ROWS) -> tuple[Tensor, Tensor, Tensor]:
    """Sums of exp(coarse0 @ coarse1.T), as logarithms: over each row, (N0,), and over each column, (N1,).

    The third is the largest entry of coarse0 @ coarse1.T in each row, (N0,). One exponential an entry serves both sums,
    relative to the largest entry of the block. That is exact unless a row or column lies so far below it that it
    underflows; then the sums are made again, each relative to its own largest.
    """
    rows, tops, top = [coarse0.new_zeros(0)], [coarse0.new_zeros(0)], coarse0.new_tensor(-torch.inf)
    column = coarse0.new_zeros(len(coarse1))
    for similarity in multiply_blocks(coarse0, coarse1, block) if len(coarse0) and len(coarse1) else ():
        tops.append(similarity.amax(dim=1))
        block_top = tops[-1].max()
        power = similarity.sub_(block_top).exp_()
        rows.append(power.sum(dim=1).log_() + block_top)
        higher = torch.maximum(top, block_top)
        column = column * (top - higher).exp() + power.sum(dim=0) * (block_top - higher).exp()
        top = higher
    row, column = torch.cat(rows), column.log() + top
    lowest = min((sums.min().item() for sums in (row, column) if len(sums)), default=0.0)
    if top - lowest < LARGEST_SPREAD:
        return row, column, torch.cat(tops)
    column = coarse0.new_full((len(coarse1),), -torch.inf)
    rows = []
    for similarity in multiply_blocks(coarse0, coarse1, block):
        rows.append(similarity.logsumexp(dim=1))
        column = torch.logaddexp(column, similarity.logsumexp(dim=0))
    return torch.cat(rows), column, torch.cat(tops)


def find_largest(scores: Tensor) -> tuple[Tensor, Tensor]:
    """The largest entry of each row of (N, K), K > 0, and its column, (N,) each.

    Largest of groups of columns first: torch.argmax over whole rows takes ten times as long on a CPU.
    """
    count = scores.shape[1]
    whole = count // GROUP * GROUP
    tops = [scores[:, :whole].unflatten(1, (-1, GROUP)).amax(dim=2)] if whole else []
    tops += [scores[:, whole:].amax(dim=1, keepdim=True)] if whole < count else []
    best, group = torch.cat(tops, dim=1).max(dim=1)
    columns = (group[:, None] * GROUP + torch.arange(GROUP, device=scores.device)).clamp_max_(count - 1)
    within = scores.gather(1, columns).argmax(dim=1, keepdim=True)
    return best, columns.gather(1, within)[:, 0]


def pick_mutual(blocks: Iterable[Tensor], coarse1: Tensor, threshold: float) -> Matches:
    """The entries of a matrix that are the largest of their row and of their column, and at least `threshold`.

    blocks: the matrix by blocks of rows, (n, N1) each.
    """
    none = torch.zeros(0, dtype=torch.int64, device=coarse1.device)
    candidates, arguments, bests = [none], [none], [coarse1.new_zeros(0)]
    best_of_column = coarse1.new_full((len(coarse1),), -torch.inf)
    first_row = 0
    for scores in filter(len, blocks) if len(coarse1) else ():
        best, argument = find_largest(scores)
        torch.maximum(best_of_column, scores.amax(dim=0), out=best_of_column)
        good = (best >= threshold).nonzero().flatten()
        candidates.append(good + first_row)
        arguments.append(argument[good])
        bests.append(best[good])
        first_row += len(scores)
    index0, index1, best = torch.cat(candidates), torch.cat(arguments), torch.cat(bests)
    mutual = best == best_of_column[index1]
    index0, index1, best = index0[mutual], index1[mutual], best[mutual]
    # Equal scores (flat areas) can give a column to several rows: the first one keeps it.
    first = torch.full((len(coarse1),), first_row, device=coarse1.device)
    first.scatter_reduce_(0, index1, index0, reduce="amin")
    keep = first[index1] == index0
    return index0[keep], index1[keep], best[keep]
