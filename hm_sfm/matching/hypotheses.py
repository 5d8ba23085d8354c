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
TURNS_DEG = (0, *CV_ROTATIONS)
REDUCTIONS = (2, 3)
LEAST_REDUCTION = 1.4
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
class Variant:
    """How a prepared photo is shown to the network."""

    turn_deg: int = 0
    """Clockwise: 0, 90, 180 or 270."""
    reduction: float = 1
    """By how much it is smaller along both axes."""


UPRIGHT = Variant()
AS_THEY_ARE = (UPRIGHT, UPRIGHT)
TURNS = tuple((UPRIGHT, Variant(turn_deg)) for turn_deg in TURNS_DEG)
"""Variants of photo 0 and photo 1 that are compared first,"""
SCALES = tuple(
    way
    for reduction in REDUCTIONS
    for turn_deg in TURNS_DEG
    for way in ((UPRIGHT, Variant(turn_deg, reduction)), (Variant(reduction=reduction), Variant(turn_deg)))
)
"""and after them."""


def show_image(image: PreparedImage, variant: Variant) -> PreparedImage:
    """The image turned and reduced; its points map back to px of the same stored photo."""
    if variant == UPRIGHT:
        return image
    width, height = image.scaled_wh
    reduced_wh = tuple(max(1, round(size / variant.reduction)) for size in image.scaled_wh)
    grey = cv2.resize(image.grey, reduced_wh, interpolation=cv2.INTER_AREA)
    if variant.turn_deg:
        grey = cv2.rotate(grey, CV_ROTATIONS[variant.turn_deg])
    scaled_wh = (grey.shape[1], grey.shape[0])
    scaled_from_reduced = np.diag([width / reduced_wh[0], height / reduced_wh[1], 1.0])
    reduced_from_turned = rotation_matrix(scaled_wh, -variant.turn_deg % 360)
    # Providers of coarse matches that read the photo themselves turn it as its reference says.
    ref = dataclasses.replace(image.ref, rotation_deg=(image.ref.rotation_deg + variant.turn_deg) % 360)
    return PreparedImage(ref, grey, scaled_wh, image.stored_from_scaled @ scaled_from_reduced @ reduced_from_turned)


class Sketch:
    """The coarse features of one photo at a small size, by variant, made as they are asked for."""

    def __init__(self, matcher: "HomoMatcher", image: PreparedImage) -> None:
        self.reduction = max(1.0, max(image.scaled_wh) / SKETCH_LONG_EDGE_PX)
        self.matcher, self.image = matcher, show_image(image, Variant(reduction=self.reduction))
        self.cells: dict[Variant, Tensor] = {}

    @property
    def size_bytes(self) -> int:
        """Memory that it takes."""
        return self.image.grey.nbytes + sum(cells.nbytes for cells in self.cells.values())

    def get(self, variant: Variant) -> Tensor:
        """(H, W, C) float32, as HomoMatcher.encode_coarse makes them."""
        if variant not in self.cells:
            self.cells[variant] = self.matcher.encode_coarse(show_image(self.image, variant))
        return self.cells[variant]


def choose_variants(matcher: "HomoMatcher", sketch0: Sketch, sketch1: Sketch) -> tuple[Variant, Variant] | None:
    """How to show two photos so that they match, or None where they do as they are, or no way stands out.

    Photo 0 is never turned, and at most one of the two is reduced. Of equally good ways the first one is taken: the one
    that reduces or turns less.
    """

    def count(variant0: Variant, variant1: Variant) -> int:
        # The smaller sketch comes first: the matrix of similarities goes by its rows.
        cells0, cells1 = sorted((sketch0.get(variant0), sketch1.get(variant1)), key=Tensor.numel)
        index0, index1, _ = matcher.match_coarse(cells0, cells1)
        return count_agreeing(place_cells(index0, cells0.shape[1]), place_cells(index1, cells1.shape[1]))

    counts = {way: count(*way) for way in TURNS}
    if max(counts.values()) < ENOUGH_AGREEING:
        counts |= {way: count(*way) for way in SCALES}
    best = max(counts, key=counts.__getitem__)
    needed = LEAST_AGREEING if best == AS_THEY_ARE else max(LEAST_AGREEING, LEAST_GAIN * counts[AS_THEY_ARE])
    if counts[best] < needed:
        return None
    chosen = relate_scales(best, sketch0.reduction, sketch1.reduction)
    return None if chosen == AS_THEY_ARE else chosen


def relate_scales(way: tuple[Variant, Variant], reduction0: float, reduction1: float) -> tuple[Variant, Variant]:
    """Variants of two photos that have the turns and the relative scale of these variants of their sketches.

    reduction0, reduction1: of the sketches against the photos, which may be of different sizes.
    """
    reductions = way[0].reduction * reduction0, way[1].reduction * reduction1
    factors = [reduction / min(reductions) for reduction in reductions]
    variant0, variant1 = (
        Variant(variant.turn_deg, factor if factor >= LEAST_REDUCTION else 1) for variant, factor in zip(way, factors)
    )
    return variant0, variant1


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


def match_again(
    matcher: "HomoMatcher",
    first: PatchMatches,
    encode: Callable[[int, Variant], "ImageFeatures"],
    sketch: Callable[[int], Sketch],
) -> PatchMatches:
    """The matches of two photos: `first`, found in the photos as they are, or those found another way, if better.

    encode, sketch: give the features and the sketch of photo 0 or 1; called only where `first` has few good matches and
    the configuration allows it. The result depends on nothing but the two photos.
    """
    if not matcher.config.retry_turned or count_good(first) >= FEW_MATCHES:
        return first
    variants = choose_variants(matcher, sketch(0), sketch(1))
    if variants is None:
        return first
    second = matcher.match_features(*(encode(side, variant) for side, variant in enumerate(variants)))
    return max(first, second, key=count_good)


def count_good(matches: PatchMatches) -> int:
    """How many have a good score."""
    return int(np.count_nonzero(matches.score >= GOOD_SCORE))
