"""The coarse stage: which 1/8 cells of two images belong together."""

import torch
from torch import Tensor


def match_cells(coarse0: Tensor, coarse1: Tensor, threshold: float, block: int = 2048) -> tuple[Tensor, Tensor, Tensor]:
    """Mutual nearest neighbours by cosine similarity, without ever holding the whole similarity matrix.

    coarse0: (N0, C), coarse1: (N1, C) float32, unit rows; block: rows of the matrix held at a time.
    Returns index0, index1 (M,) int64, one to one, and similarity (M,) float32 >= threshold.
    """
    empty = torch.zeros(0, dtype=torch.int64, device=coarse0.device)
    if len(coarse0) == 0 or len(coarse1) == 0:
        return empty, empty, coarse0.new_zeros(0)
    best_of_row, arg_of_row = [], []
    best_of_column = coarse1.new_full((len(coarse1),), -torch.inf)
    for rows in coarse0.split(block):
        similarity = rows @ coarse1.T
        best, arg = similarity.max(dim=1)
        best_of_row.append(best)
        arg_of_row.append(arg)
        torch.maximum(best_of_column, similarity.amax(dim=0), out=best_of_column)
    best, arg = torch.cat(best_of_row), torch.cat(arg_of_row)
    mutual = (best == best_of_column[arg]) & (best >= threshold)
    index0 = mutual.nonzero().flatten()
    index1 = arg[index0]
    # Equal similarities (flat areas) can give a column to several rows: the first one keeps it.
    first = torch.full((len(coarse1),), len(coarse0), device=index0.device)
    first.scatter_reduce_(0, index1, index0, reduce="amin")
    keep = first[index1] == index0
    return index0[keep], index1[keep], best[index0[keep]]
