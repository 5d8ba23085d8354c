"""The coarse stage: which 1/8 cells of two images belong together.

A coarse stage is a module with `describe`, run once per image on the backbone's map, and `match`, run per pair.
"""

import math
from collections.abc import Iterable, Iterator

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hm_sfm.network.transformer import CoarseTransformer, encode_positions, place_positions

BLOCK_ROWS = 256
"""Rows of the similarity matrix that are held at a time: so few stay in the processor's cache."""
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


def match_by_similarity(coarse0: Tensor, coarse1: Tensor, threshold: float, block: int = BLOCK_ROWS) -> Matches:
    """Mutual nearest neighbours by inner product, without ever holding the whole similarity matrix.

    coarse0: (N0, C), coarse1: (N1, C) float32; block: rows of the matrix held at a time. Scores are the inner products,
    at least `threshold`.
    """
    with torch.autocast(coarse0.device.type, enabled=False):
        return pick_mutual((rows @ coarse1.T for rows in coarse0.split(block)), coarse1, threshold)


def match_by_dual_softmax(
    coarse0: Tensor, coarse1: Tensor, threshold: float, sharpness: Tensor, block: int = BLOCK_ROWS
) -> Matches:
    """Mutual best matches by LoFTR's confidence, the product of the softmax over rows and that over columns.

    coarse0: (N0, C), coarse1: (N1, C) float32; sharpness: scalar, factor of their inner products. Two passes over
    blocks of rows: the first sums up rows and columns, the second compares; the whole matrix is never held.
    """
    with torch.autocast(coarse0.device.type, enabled=False):
        blocks = make_log_confidences(coarse0 * sharpness, coarse1, block)
        index0, index1, log_confidence = pick_mutual(blocks, coarse1, math.log(max(threshold, 1e-30)))
    return index0, index1, log_confidence.exp()


def make_log_confidences(coarse0: Tensor, coarse1: Tensor, block: int = BLOCK_ROWS) -> Iterator[Tensor]:
    """Blocks of rows (n, N1) of the logarithms of the dual-softmax confidences of coarse0 @ coarse1.T."""
    row, column = sum_exponentials(coarse0, coarse1, block)
    # 2 s - row - column, as one matrix product.
    rows = torch.cat([2 * coarse0, -row[:, None], -torch.ones_like(row)[:, None]], dim=1)
    columns = torch.cat([coarse1, torch.ones_like(column)[:, None], column[:, None]], dim=1)
    for cells in rows.split(block):
        yield cells @ columns.T


def sum_exponentials(coarse0: Tensor, coarse1: Tensor, block: int) -> tuple[Tensor, Tensor]:
    """The logarithms of the sums of exp(coarse0 @ coarse1.T) over each row, (N0,), and over each column, (N1,).

    One exponential an entry serves both sums, relative to the largest entry of the block. That is exact unless a row
    or column lies so far below it that it underflows; then the sums are made again, each relative to its own largest.
    """
    rows, top = [coarse0.new_zeros(0)], coarse0.new_tensor(-torch.inf)
    column = coarse0.new_zeros(len(coarse1))
    for cells in coarse0.split(block) if len(coarse0) and len(coarse1) else ():
        similarity = cells @ coarse1.T
        block_top = similarity.max()
        power = similarity.sub_(block_top).exp_()
        rows.append(power.sum(dim=1).log_() + block_top)
        higher = torch.maximum(top, block_top)
        column = column * (top - higher).exp() + power.sum(dim=0) * (block_top - higher).exp()
        top = higher
    row, column = torch.cat(rows), column.log() + top
    lowest = min((sums.min().item() for sums in (row, column) if len(sums)), default=0.0)
    if top - lowest < LARGEST_SPREAD:
        return row, column
    column = coarse0.new_full((len(coarse1),), -torch.inf)
    rows = []
    for cells in coarse0.split(block):
        similarity = cells @ coarse1.T
        rows.append(similarity.logsumexp(dim=1))
        column = torch.logaddexp(column, similarity.logsumexp(dim=0))
    return torch.cat(rows), column


def pick_mutual(blocks: Iterable[Tensor], coarse1: Tensor, threshold: float) -> Matches:
    """The entries of a matrix that are the largest of their row and of their column, and at least `threshold`.

    blocks: the matrix by blocks of rows, (n, N1) each.
    """
    none = torch.zeros(0, dtype=torch.int64, device=coarse1.device)
    candidates, arguments, bests = [none], [none], [coarse1.new_zeros(0)]
    best_of_column = coarse1.new_full((len(coarse1),), -torch.inf)
    first_row = 0
    for scores in blocks if len(coarse1) else ():
        best = scores.amax(dim=1)
        # An entry that could outdo another in its column has a row whose best is good enough, too.
        good = (best >= threshold).nonzero().flatten()
        if len(good):
            rows = scores[good]
            arguments.append(rows.argmax(dim=1))
            torch.maximum(best_of_column, rows.amax(dim=0), out=best_of_column)
        candidates.append(good + first_row)
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
