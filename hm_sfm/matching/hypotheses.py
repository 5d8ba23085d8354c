"""Photos turned or reduced, for pairs that match badly as they are: on their side, upside down, or of another scale.

The network's features know what is up and how large things are. So where two photos have few good matches, small
sketches of them are compared, one turned by quarters and either one reduced; where one way stands out, the photos are
matched again that way. Patches are upright and of one scale then: their homographies start from the relative turn and
scale, not from the identity. The points are those of the stored photos all the same.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from torch import Tensor

from hm_sfm.geometry.frames import rotation_matrix
from hm_sfm.photos.images import CV_ROTATIONS, PreparedImage
from hm_sfm.types import PatchMatches

if TYPE_CHECKING:
    from hm_sfm.matching.matcher import HomoMatcher, ImageFeatures

GOOD_SCORE = 0.5
"""As in VerificationConfig.min_score."""
FEW_MATCHES = 500
"""Pairs with fewer good matches are compared as sketches: of turned photos, a few hundred can be good by chance."""
SKETCH_LONG_EDGE_PX = 384
ROTATIONS_DEG = (0, *CV_ROTATIONS)
DOWNSCALES = (2, 3)
MIN_DOWNSCALE = 1.4
"""What differs less in scale is matched as it is."""
NEAR_CELLS = 3
"""Matches of two sketches agree with others so far away, along each axis,"""
LEAST_SUPPORT = 8
"""if so many of them,"""
LEAST_SHARE = 0.5
"""and this part of them, are matched side by side in the other sketch, too."""
ENOUGH_AGREEING = 40
"""Where turned ones have so many matches that agree, other scales are not looked at."""
LEAST_AGREEING = 30
"""Photos are matched again where another way has so many, photos of different places having up to 16 in some way,"""
LEAST_GAIN = 2.0
"""and so many times as many as the photos as they are."""


@dataclass(frozen=True)
class Hypothesis:
    """How a prepared photo is shown to the network."""

    rotation_deg: int = 0
    """Clockwise: 0, 90, 180 or 270."""
    downscale: float = 1
    """By how much it is smaller along both axes."""


IDENTITY = Hypothesis()
UNCHANGED = (IDENTITY, IDENTITY)
ROTATIONS = tuple((IDENTITY, Hypothesis(rotation_deg)) for rotation_deg in ROTATIONS_DEG)
"""Variants of photo 0 and photo 1 that are compared first,"""
SCALES = tuple(
    way
    for downscale in DOWNSCALES
    for rotation_deg in ROTATIONS_DEG
    for way in (
        (IDENTITY, Hypothesis(rotation_deg, downscale)),
        (Hypothesis(downscale=downscale), Hypothesis(rotation_deg)),
    )
)
"""and after them."""


def apply_hypothesis(image: PreparedImage, hypothesis: Hypothesis) -> PreparedImage:
    """The image turned and reduced; its points map back to px of the same stored photo."""
    if hypothesis == IDENTITY:
        return image
    width, height = image.scaled_wh
    reduced_wh = tuple(max(1, round(size / hypothesis.downscale)) for size in image.scaled_wh)
    grey = cv2.resize(image.grey, reduced_wh, interpolation=cv2.INTER_AREA)
    if hypothesis.rotation_deg:
        grey = cv2.rotate(grey, CV_ROTATIONS[hypothesis.rotation_deg])
    scaled_wh = (grey.shape[1], grey.shape[0])
    scaled_from_reduced = np.diag([width / reduced_wh[0], height / reduced_wh[1], 1.0])
    reduced_from_turned = rotation_matrix(scaled_wh, -hypothesis.rotation_deg % 360)
    # Providers of coarse matches that read the photo themselves turn it as its reference says.
    ref = dataclasses.replace(image.ref, rotation_deg=(image.ref.rotation_deg + hypothesis.rotation_deg) % 360)
    return PreparedImage(ref, grey, scaled_wh, image.stored_from_scaled @ scaled_from_reduced @ reduced_from_turned)


class Sketch:
    """The coarse features of one photo at a small size, by hypothesis, made as they are asked for."""

    def __init__(self, matcher: "HomoMatcher", image: PreparedImage) -> None:
        self.downscale = max(1.0, max(image.scaled_wh) / SKETCH_LONG_EDGE_PX)
        self.matcher, self.image = matcher, apply_hypothesis(image, Hypothesis(downscale=self.downscale))
        self.cells: dict[Hypothesis, Tensor] = {}

    @property
    def size_bytes(self) -> int:
        """Memory that it takes."""
        return self.image.grey.nbytes + sum(cells.nbytes for cells in self.cells.values())

    def get(self, hypothesis: Hypothesis) -> Tensor:
        """(H, W, C) float32, as HomoMatcher.encode_coarse makes them."""
        if hypothesis not in self.cells:
            self.cells[hypothesis] = self.matcher.encode_coarse(apply_hypothesis(self.image, hypothesis))
        return self.cells[hypothesis]


def choose_hypotheses(matcher: "HomoMatcher", sketch0: Sketch, sketch1: Sketch) -> tuple[Hypothesis, Hypothesis] | None:
    """How to show two photos so that they match, or None where they do as they are, or no way stands out.

    Photo 0 is never turned, and at most one of the two is reduced. Of equally good ways the first one is taken: the one
    that reduces or turns less.
    """

    def count(hypothesis0: Hypothesis, hypothesis1: Hypothesis) -> int:
        # The smaller sketch comes first: the matrix of similarities goes by its rows.
        cells0, cells1 = sorted((sketch0.get(hypothesis0), sketch1.get(hypothesis1)), key=Tensor.numel)
        index0, index1, _ = matcher.match_coarse(cells0, cells1)
        return count_agreeing(place_cells(index0, cells0.shape[1]), place_cells(index1, cells1.shape[1]))

    counts = {way: count(*way) for way in ROTATIONS}
    if max(counts.values()) < ENOUGH_AGREEING:
        counts |= {way: count(*way) for way in SCALES}
    best = max(counts, key=counts.__getitem__)
    needed = LEAST_AGREEING if best == UNCHANGED else max(LEAST_AGREEING, LEAST_GAIN * counts[UNCHANGED])
    if counts[best] < needed:
        return None
    chosen = relate_scales(best, sketch0.downscale, sketch1.downscale)
    return None if chosen == UNCHANGED else chosen


def relate_scales(
    way: tuple[Hypothesis, Hypothesis], downscale0: float, downscale1: float
) -> tuple[Hypothesis, Hypothesis]:
    """Variants of two photos that have the turns and the relative scale of these hypotheses of their sketches.

    downscale0, downscale1: of the sketches against the photos, which may be of different sizes.
    """
    reductions = way[0].downscale * downscale0, way[1].downscale * downscale1
    factors = [downscale / min(reductions) for downscale in reductions]
    hypothesis0, hypothesis1 = (
        Hypothesis(hypothesis.rotation_deg, factor if factor >= MIN_DOWNSCALE else 1)
        for hypothesis, factor in zip(way, factors)
    )
    return hypothesis0, hypothesis1


def place_cells(index: np.ndarray, columns: int) -> np.ndarray:
    """(M,) int64 cells, counted row by row -> (M, 2) int16 column and row."""
    return np.stack([index % columns, index // columns], axis=1).astype(np.int16)


def count_agreeing(cell0: np.ndarray, cell1: np.ndarray) -> int:
    """How many matches (M, 2) int16 of cells lie as the matches around them do, in both images.

    Of photos of different places hardly any do, nor of photos turned against each other.
    """
    step0 = cell0[:, None] - cell0
    near = np.abs(step0).max(axis=2) <= NEAR_CELLS
    np.fill_diagonal(near, False)
    agrees = near & (np.abs(cell1[:, None] - cell1 - step0).max(axis=2) <= 1)
    support = agrees.sum(axis=1)
    return int(np.count_nonzero((support >= LEAST_SUPPORT) & (support >= LEAST_SHARE * near.sum(axis=1))))


def retry_hypotheses(
    matcher: "HomoMatcher",
    first: PatchMatches,
    encode: Callable[[int, Hypothesis], "ImageFeatures"],
    sketch: Callable[[int], Sketch],
) -> PatchMatches:
    """The matches of two photos: `first`, found in the photos as they are, or those found another way, if better.

    encode, sketch: give the features and the sketch of photo 0 or 1; called only where `first` has few good matches and
    the configuration allows it. The result depends on nothing but the two photos.
    """
    if not matcher.config.try_hypotheses or count_good(first) >= FEW_MATCHES:
        return first
    hypotheses = choose_hypotheses(matcher, sketch(0), sketch(1))
    if hypotheses is None:
        return first
    second = matcher.match_features(*(encode(side, hypothesis) for side, hypothesis in enumerate(hypotheses)))
    return max(first, second, key=count_good)


def count_good(matches: PatchMatches) -> int:
    """How many have a good score."""
    return int(np.count_nonzero(matches.score >= GOOD_SCORE))
