"""The coarse stage: which 1/8 cells of two images belong together.

A coarse stage is a module with `describe`, run once per image on the backbone's map, and `match`, run per pair.
"""

from collections.abc import Iterable, Iterator

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hm_sfm.network.transformer import CoarseTransformer, encode_positions

BLOCK_ROWS = 2048
"""Rows of the similarity matrix that are held at a time."""
TEMPERATURE = 0.1
"""Of LoFTR's dual softmax."""

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


class LoftrCoarse(CoarseTransformer):
    """LoFTR's coarse stage: positions, self- and cross-attention, dual softmax."""

    def __init__(self, channels: int = 256, heads: int = 8, pairs: int = 4) -> None:
        super().__init__(channels, heads, pairs)

    def describe(self, coarse: Tensor) -> Tensor:
        """(B, C, H, W) map of the backbone -> (B, C, H, W) float32 with the positions added."""
        return coarse.float() + encode_positions(*coarse.shape[1:], device=coarse.device)

    def match(self, coarse0: Tensor, coarse1: Tensor, threshold: float) -> Matches:
        """Match described cells (N0, C) and (N1, C): confidence of at least `threshold`."""
        aware0, aware1 = self(coarse0[None], coarse1[None])
        return match_by_dual_softmax(aware0[0].float(), aware1[0].float(), threshold)


def match_by_similarity(coarse0: Tensor, coarse1: Tensor, threshold: float, block: int = BLOCK_ROWS) -> Matches:
    """Mutual nearest neighbours by inner product, without ever holding the whole similarity matrix.

    coarse0: (N0, C), coarse1: (N1, C) float32; block: rows of the matrix held at a time. Scores are the inner products,
    at least `threshold`.
    """
    return pick_mutual((rows @ coarse1.T for rows in coarse0.split(block)), coarse1, threshold)


def match_by_dual_softmax(
    coarse0: Tensor, coarse1: Tensor, threshold: float, temperature: float = TEMPERATURE, block: int = BLOCK_ROWS
) -> Matches:
    """Mutual best matches by LoFTR's confidence, the product of the softmax over rows and that over columns.

    coarse0: (N0, C), coarse1: (N1, C) float32. Two passes over blocks of rows: the first sums up rows and columns, the
    second makes the confidences; the whole matrix is never held.
    """
    coarse0 = coarse0 / (coarse0.shape[1] * temperature)
    return pick_mutual(make_confidences(coarse0, coarse1, block), coarse1, threshold)


def make_confidences(coarse0: Tensor, coarse1: Tensor, block: int = BLOCK_ROWS) -> Iterator[Tensor]:
    """Blocks of rows (n, N1) of the dual-softmax confidences of coarse0 @ coarse1.T."""
    rows, column = [], coarse1.new_full((len(coarse1),), -torch.inf)
    for cells in coarse0.split(block):
        similarity = cells @ coarse1.T
        rows.append(similarity.logsumexp(dim=1))
        column = torch.logaddexp(column, similarity.logsumexp(dim=0))
    for cells, row in zip(coarse0.split(block), rows):
        yield torch.exp(2 * (cells @ coarse1.T) - row[:, None] - column)


def pick_mutual(blocks: Iterable[Tensor], coarse1: Tensor, threshold: float) -> Matches:
    """The entries of a matrix that are the largest of their row and of their column, and at least `threshold`.

    blocks: the matrix by blocks of rows, (n, N1) each.
    """
    best_of_row, arg_of_row = [coarse1.new_zeros(0)], [torch.zeros(0, dtype=torch.int64, device=coarse1.device)]
    best_of_column = coarse1.new_full((len(coarse1),), -torch.inf)
    for scores in blocks if len(coarse1) else ():
        best, arg = scores.max(dim=1)
        best_of_row.append(best)
        arg_of_row.append(arg)
        if len(scores):
            torch.maximum(best_of_column, scores.amax(dim=0), out=best_of_column)
    best, arg = torch.cat(best_of_row), torch.cat(arg_of_row)
    mutual = (best == best_of_column[arg]) & (best >= threshold)
    index0 = mutual.nonzero().flatten()
    index1 = arg[index0]
    # Equal scores (flat areas) can give a column to several rows: the first one keeps it.
    first = torch.full((len(coarse1),), len(best), device=coarse1.device)
    first.scatter_reduce_(0, index1, index0, reduce="amin")
    keep = first[index1] == index0
    return index0[keep], index1[keep], best[index0[keep]]
