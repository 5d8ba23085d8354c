"""The sizes at which photos are matched."""

import math

from hm_sfm.errors import InputError

MIN_EDGE_PX = 32
"""The network's coarse cells are 8 px: below this there is nothing to match."""
MAX_ASPECT = 1000
"""Of a photo that can be matched, longer side to shorter side."""
ORDINARY_ASPECT = 3
"""Photos up to this are reduced by their longer side alone."""
ORDINARY_AREA = 3 / 4
"""Pixels of a photo of 4:3, relative to the square of its longer side."""


def check_size(size_wh: tuple[int, int], what: str) -> None:
    """Raises InputError where an image is too small or too elongated to be matched. what: its name in the message."""
    longer, shorter = max(size_wh), min(size_wh)
    if shorter < MIN_EDGE_PX:
        raise InputError(f"{what} is {size_wh[0]} x {size_wh[1]} px, at least {MIN_EDGE_PX} px a side are needed")
    if longer > MAX_ASPECT * shorter:
        raise InputError(
            f"{what} is {size_wh[0]} x {size_wh[1]} px, photos more than {MAX_ASPECT} times as long as wide cannot be "
            "matched"
        )


def find_scale(size_wh: tuple[int, int], long_edge_px: int) -> float:
    """By how much a photo is reduced to be matched, at most 1: its longer side to long_edge_px.

    Panoramas and strips of more than 3:1 would have too little height then. Their shorter side is reduced to a third of
    long_edge_px, or further, until they have no more pixels than a photo of 4:3, but not below 32 px.
    """
    longer, shorter = max(size_wh), min(size_wh)
    scale = long_edge_px / longer
    if longer > ORDINARY_ASPECT * shorter:
        by_height = long_edge_px / ORDINARY_ASPECT / shorter
        by_area = long_edge_px * math.sqrt(ORDINARY_AREA / (longer * shorter))
        scale = max(scale, min(by_height, by_area), MIN_EDGE_PX / shorter)
    return min(1.0, scale)


def measure_px_scale(size_wh: tuple[int, int], long_edge_px: int) -> float:
    """Px of the stored photo per px of the photo at the size where its longer side is long_edge_px, see find_scale."""
    return 1 / find_scale(size_wh, long_edge_px)
