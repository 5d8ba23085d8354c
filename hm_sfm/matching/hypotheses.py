"""Rotation and scale hypotheses, for pairs that match badly as they are: a photo on its side, or of another scale.

The network's features depend on rotation and scale. So where two photos have few good matches, small sketches of them
are compared, one rotated by quarter turns, then by angles between these, and either one reduced. Where one hypothesis
stands out, the photos are matched again under it. Patches are then nearly upright and of one scale: their homographies
start from the relative rotation and scale, not from the identity. The points are still those of the stored photos.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hm_sfm.config import GOOD_SCORE
from hm_sfm.matching.interfaces import CellMatcher, PairMatcher
from hm_sfm.matching.patches import is_inside
from hm_sfm.photos.hypotheses import IDENTITY, ROTATIONS_DEG, TILTS_DEG, Hypothesis, apply_hypothesis
from hm_sfm.photos.images import PreparedImage
from hm_sfm.types import PatchMatches

FEW_MATCHES = 500
"""Pairs with fewer good matches are compared as sketches: of rotated photos, a few hundred can be good by chance."""
SKETCH_LONG_EDGE_PX = 384
DOWNSCALES = (2, 3)
MIN_DOWNSCALE = 1.4
"""Smaller differences in scale are left as they are."""
NEAR_CELLS = 3
"""Cells, along each axis, within which the other matches of two sketches are neighbours of a match."""
LEAST_SUPPORT = 8
"""A match agrees with its neighbours where at least so many of them,"""
LEAST_SHARE = 0.5
"""and at least this share of them, lie beside it in the other sketch, too."""
ENOUGH_AGREEING = 40
"""Where a rotation has so many agreeing matches, other scales are not compared."""
SURE_AGREEING = 100
"""Where a quarter turn has so many, other angles are not: of photos with black corners, wrong turns have up to 60."""
LEAST_AGREEING = 30
"""Photos are matched again under a hypothesis with so many agreeing matches (different places have up to 16),"""
LEAST_GAIN = 2.0
"""and with so many times as many as the photos as they are."""

HypothesisPair = tuple[Hypothesis, Hypothesis]
"""How photo 0 and photo 1 are encoded."""

UNCHANGED = (IDENTITY, IDENTITY)
ROTATIONS: tuple[HypothesisPair, ...] = tuple((IDENTITY, Hypothesis(rotation_deg)) for rotation_deg in ROTATIONS_DEG)
"""Compared first,"""
TILTS: tuple[HypothesisPair, ...] = tuple((IDENTITY, Hypothesis(rotation_deg)) for rotation_deg in TILTS_DEG)
"""then these,"""
SCALES: tuple[HypothesisPair, ...] = tuple(
    hypotheses
    for downscale in DOWNSCALES
    for rotation_deg in ROTATIONS_DEG
    for hypotheses in (
        (IDENTITY, Hypothesis(rotation_deg, downscale)),
        (Hypothesis(downscale=downscale), Hypothesis(rotation_deg)),
    )
)
"""and these after them."""


class Sketch:
    """One photo at a small size, and its coarse cells under each hypothesis that was asked for."""

    def __init__(self, image: PreparedImage) -> None:
        self.downscale = max(1.0, max(image.scaled_wh) / SKETCH_LONG_EDGE_PX)
        self.image = apply_hypothesis(image, Hypothesis(downscale=self.downscale))
        self.cells: dict[Hypothesis, Tensor] = {}

    @property
    def size_bytes(self) -> int:
        """Memory that it takes."""
        return self.image.grey.nbytes + sum(cells.nbytes for cells in self.cells.values())

    def encode(self, hypothesis: Hypothesis, matcher: CellMatcher) -> Tensor:
        """(H, W, C) float32: the cells under a hypothesis, encoded once; zero beside a photo that is tilted."""
        if hypothesis not in self.cells:
            image = apply_hypothesis(self.image, hypothesis)
            cells = matcher.encode(image)
            inside = torch.tensor(find_cells_inside(image, *cells.shape[:2]), device=cells.device)
            self.cells[hypothesis] = cells * inside[..., None]
        return self.cells[hypothesis]


def find_cells_inside(image: PreparedImage, rows: int, columns: int) -> np.ndarray:
    """(rows, columns) bool: which cells of a prepared image show the photo."""
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1) + 0.5
    xy = grid.reshape(-1, 2) * np.array(image.scaled_wh) / (columns, rows)
    stored = xy @ image.stored_from_scaled[:2, :2].T + image.stored_from_scaled[:2, 2]
    return is_inside(stored, image.ref.size_wh).reshape(rows, columns)


def choose_hypotheses(matcher: CellMatcher, sketch0: Sketch, sketch1: Sketch) -> HypothesisPair | None:
    """The hypotheses under which two photos match; None where they match as they are, or where none stands out.

    Photo 0 is never rotated, and at most one of the two is reduced. Of equally good hypotheses the first one is taken:
    the one that reduces or rotates less.
    """

    def count(hypothesis0: Hypothesis, hypothesis1: Hypothesis) -> int:
        both = sketch0.encode(hypothesis0, matcher), sketch1.encode(hypothesis1, matcher)
        # The smaller sketch comes first: the matrix of similarities goes by its rows.
        cells0, cells1 = sorted(both, key=Tensor.numel)
        index0, index1, _ = matcher.match(cells0, cells1)
        return count_agreeing(place_cells(index0, cells0.shape[1]), place_cells(index1, cells1.shape[1]))

    counts = {hypotheses: count(*hypotheses) for hypotheses in ROTATIONS}
    for others, enough in ((TILTS, SURE_AGREEING), (SCALES, ENOUGH_AGREEING)):
        if max(counts.values()) < enough:
            counts |= {hypotheses: count(*hypotheses) for hypotheses in others}
    best = max(counts, key=counts.__getitem__)
    needed = LEAST_AGREEING if best == UNCHANGED else max(LEAST_AGREEING, LEAST_GAIN * counts[UNCHANGED])
    if counts[best] < needed:
        return None
    chosen = relate_scales(best, sketch0.downscale, sketch1.downscale)
    return None if chosen == UNCHANGED else chosen


def relate_scales(hypotheses: HypothesisPair, downscale0: float, downscale1: float) -> HypothesisPair:
    """The hypotheses of two photos that have the rotations and the relative scale of those of their sketches.

    downscale0, downscale1: of the sketches against the photos, which may be of different sizes.
    """
    reductions = hypotheses[0].downscale * downscale0, hypotheses[1].downscale * downscale1
    factors = [downscale / min(reductions) for downscale in reductions]
    hypothesis0, hypothesis1 = (
        Hypothesis(hypothesis.rotation_deg, factor if factor >= MIN_DOWNSCALE else 1)
        for hypothesis, factor in zip(hypotheses, factors)
    )
    return hypothesis0, hypothesis1


def place_cells(index: np.ndarray, columns: int) -> np.ndarray:
    """(M,) int64 cells, counted row by row -> (M, 2) int16 column and row."""
    return np.stack([index % columns, index // columns], axis=1).astype(np.int16)


def count_agreeing(cell0: np.ndarray, cell1: np.ndarray) -> int:
    """How many matches (M, 2) int16 of cells agree with the matches around them, in both images.

    Hardly any do in photos of different places, or in photos rotated against each other.
    """
    step0 = cell0[:, None] - cell0
    near = np.abs(step0).max(axis=2) <= NEAR_CELLS
    np.fill_diagonal(near, False)
    agrees = near & (np.abs(cell1[:, None] - cell1 - step0).max(axis=2) <= 1)
    support = agrees.sum(axis=1)
    return int(np.count_nonzero((support >= LEAST_SUPPORT) & (support >= LEAST_SHARE * near.sum(axis=1))))


def retry_hypotheses(
    matcher: PairMatcher,
    first: PatchMatches,
    encode: Callable[[int, Hypothesis], Any],
    sketch: Callable[[int], Sketch],
) -> PatchMatches:
    """The better matches of two photos: `first`, of the photos as they are, or those under other hypotheses.

    encode, sketch: give the features under a hypothesis, and the sketch, of photo 0 or 1. They are called only where
    `first` has few good matches and the matcher compares hypotheses. The result depends on nothing but the two photos.
    """
    if matcher.cell_matcher is None or count_good(first) >= FEW_MATCHES:
        return first
    hypotheses = choose_hypotheses(matcher.cell_matcher, sketch(0), sketch(1))
    if hypotheses is None:
        return first
    second = matcher.match_features(*(encode(side, hypothesis) for side, hypothesis in enumerate(hypotheses)))
    return max(first, second, key=count_good)


def count_good(matches: PatchMatches) -> int:
    """How many have at least GOOD_SCORE."""
    return int(np.count_nonzero(matches.score >= GOOD_SCORE))
