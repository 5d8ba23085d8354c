"""Matches that stay in their place in the frame: those of an overlay are left out, those of equal photos are kept."""

import dataclasses
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from hm_sfm.colmap.overlays import find_overlays
from hm_sfm.types import ImagePair, ImageRef, PairMatches

SIZE_WH = (320, 240)
rng = np.random.default_rng(0)
SCENE = rng.uniform((0, 0), SIZE_WH, (400, 2))
LOGO = rng.uniform((230, 10), (310, 70), (120, 2))


def make_matches(pair: ImagePair, xy0: np.ndarray, xy1: np.ndarray, scale: float = 1.0) -> PairMatches:
    """Those that lie in both frames; scale: px of the stored photos per px of the matching resolution."""
    inside = np.all((xy1 >= 0) & (xy1 < SIZE_WH), axis=1)
    xy0, xy1 = xy0[inside] * scale, xy1[inside] * scale
    score, homography = np.full(len(xy0), 0.9), np.tile(np.eye(3), (len(xy0), 1, 1))
    return PairMatches(pair=pair, xy0=xy0, xy1=xy1, score=score, homography=homography, patch_radius_px=8.0)


class Collection:
    """Photos of a scene, by name, each shifted by so many px, and their matches; all have the `overlay`."""

    def __init__(self, shift_px: dict[str, float], overlay: np.ndarray, scale: float = 1.0) -> None:
        """scale: px of the stored photos per px of the matching resolution."""
        names = sorted(shift_px)
        self.scale = dict.fromkeys(names, scale)
        self.images = [ImageRef(name, Path(name), (round(320 * scale), round(240 * scale))) for name in names]
        self.pairs = [ImagePair(*pair) for pair in combinations(names, 2)]
        self.matches = {}
        for pair in self.pairs:
            shown = SCENE[:, None] if pair.name0[0] == pair.name1[0] else SCENE[:0, None]  # of one place
            moved = shown[:, 0] + (shift_px[pair.name1] - shift_px[pair.name0]) * np.array([1, 0.3])
            xy0, xy1 = np.concatenate([shown[:, 0], overlay]), np.concatenate([moved, overlay])
            self.matches[pair] = make_matches(pair, xy0, xy1 + rng.normal(0, 0.1, xy1.shape), scale)

    def drop(self) -> dict[ImagePair, PairMatches]:
        overlays = find_overlays(self.images, self.pairs, self.matches.__getitem__, self.scale, 0.5)
        return {pair: overlays.drop_still(matches) for pair, matches in self.matches.items()}


@pytest.mark.parametrize("scale", [1.0, 6.0])
def test_a_logo_joins_no_places(caplog, scale):
    photos = Collection({"a0": 0, "a1": 25, "a2": 60, "b0": 0, "b1": -30}, LOGO, scale)
    kept = photos.drop()
    for pair, matches in kept.items():
        of_one_place = pair.name0[0] == pair.name1[0]
        assert len(matches) == len(photos.matches[pair]) - len(LOGO) if of_one_place else len(matches) == 0
    (message,) = caplog.messages
    assert "of 5 photos" in message and "--camera-mask" in message


def test_photos_of_a_burst_stay_matched(caplog):
    """Two bursts of three, and nothing but the scene in them: what stays is where a tripod stood."""
    photos = Collection({"a0": 0, "a1": 0.2, "a2": 0.1, "a3": 40, "a4": 40.1, "a5": 40.2}, LOGO[:0])
    kept = photos.drop()
    assert all(len(kept[pair]) == len(photos.matches[pair]) > 300 for pair in photos.pairs)
    assert not caplog.messages


def test_a_logo_is_found_among_bursts():
    photos = Collection({"a0": 0, "a1": 0.2, "a2": 0.1, "a3": 40, "a4": 40.1, "b0": 0}, LOGO)
    kept = photos.drop()
    burst, apart, stranger = (kept[ImagePair(*names)] for names in (("a0", "a1"), ("a0", "a3"), ("a0", "b0")))
    assert len(stranger) == 0 and len(apart) > 300
    on_logo = np.all((burst.xy0 > (240, 20)) & (burst.xy0 < (300, 60)), axis=1)
    assert len(burst) > 330 and not on_logo.any()


@pytest.mark.parametrize("grows", [True, False], ids=["closer and closer", "turned about its middle"])
def test_the_point_that_a_camera_drives_to_is_no_overlay(caplog, grows):
    """Around it matches move a bit, and then more and more."""
    images = [ImageRef(f"{number}", Path(f"{number}"), SIZE_WH) for number in range(5)]
    middle = np.array(SIZE_WH) / 2
    grid = np.stack(np.meshgrid(np.arange(2, 320, 6.0), np.arange(2, 240, 6.0)), axis=-1).reshape(-1, 2)
    matches = {}
    for i, j in combinations(range(5), 2):
        angle, zoom = (0, 1 + 0.05 * (j - i)) if grows else (0.05 * (j - i), 1)
        rotation = zoom * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        pair = ImagePair(f"{i}", f"{j}")
        matches[pair] = make_matches(pair, grid, middle + (grid - middle) @ rotation.T)
    overlays = find_overlays(images, list(matches), matches.__getitem__, {f"{n}": 1.0 for n in range(5)}, 0.5)
    assert not overlays.cells and not caplog.messages


def test_frames_of_other_sizes_are_not_compared():
    photos = Collection({"a0": 0, "a1": 30, "a2": 60, "b0": 0}, LOGO)
    photos.images[-1] = dataclasses.replace(photos.images[-1], size_wh=(240, 320))
    for pair, matches in photos.drop().items():
        assert len(matches) == len(photos.matches[pair]) - (0 if pair.name1 == "b0" else len(LOGO))
