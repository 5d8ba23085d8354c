"""A file of matches, as a provider of coarse matches."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from hm_sfm.errors import InputError
from hm_sfm.formats.hloc import find_group, open_h5, read_features, read_pair
from hm_sfm.geometry.frames import flip_matrix, px_from_pixel_index
from hm_sfm.io.arrays import open_group, read_array
from hm_sfm.matching.interfaces import ImageFeatures, PointPairs
from hm_sfm.photos.images import PreparedImage
from hm_sfm.types import ImagePair, ImageRef


class MatchFile:
    """Matches of any matcher, from a file with a group per pair, named as hloc names them.

    A group holds point pairs, `keypoints0` and `keypoints1` (M, 2) and, if there are any, `scores` (M,), as hloc's
    match_dense writes them; or `matches0`, as in hloc's sparse matches, and then `features` is the file with the
    keypoints of the images. Coordinates are hloc's: px of the stored image, pixel centres at integers.
    """

    def __init__(self, matches: Path, features: Path | None = None) -> None:
        self.matches, self.features = Path(matches).absolute(), features and Path(features).absolute()

    def describe(self, image: PreparedImage) -> dict[str, Any]:
        """Nothing: the file knows the images by name."""
        return {}

    def match(self, features0: ImageFeatures, features1: ImageFeatures) -> PointPairs:
        """The pair's matches. Raises InputError where it has none in the file, or these are of other images."""
        sides = sorted((features0, features1), key=lambda features: features.image.name)
        images = [features.image for features in sides]
        if images[0].name == images[1].name:
            raise InputError(f"{self.matches} knows images by name, and both are named {images[0].name!r}")
        pair = ImagePair(images[0].name, images[1].name)
        with open_h5(self.matches) as h5:
            group, swapped = locate_pairs(h5, self.matches, [pair])[0]
            data = open_group(h5, group)
            if "matches0" in data:
                stored, score = self.read_indexed(h5, pair, group, swapped, images)
            else:
                stored, score = self.read_points(data, swapped, images)
        xy = {}
        for features, points in zip(sides, stored):
            scaled_from_stored = np.linalg.inv(features.stored_from_scaled)
            if features.image.flipped:  # others know the photo as it is stored
                scaled_from_stored = scaled_from_stored @ flip_matrix(features.image.size_wh[0])
            xy[features.image.name] = points @ scaled_from_stored[:2, :2].T + scaled_from_stored[:2, 2]
        return PointPairs(xy[features0.image.name], xy[features1.image.name], score)

    def read_indexed(
        self, h5: h5py.File, pair: ImagePair, group: str, swapped: bool, images: Sequence[ImageRef]
    ) -> tuple[list[np.ndarray], np.ndarray]:
        """As read_points, of a pair whose matches are indices into the keypoints of the features file."""
        if self.features is None:
            raise InputError(
                f"{self.matches} matches keypoints by their indices: name the file that holds them with "
                "--coarse-features"
            )
        keypoints = read_features(self.features, images)
        counts = {points.name: len(points) for points in keypoints}
        matches = read_pair(h5, self.matches, pair, group, swapped, counts)
        xy = [points.xy[matches.indices[:, side]].astype(np.float64) for side, points in enumerate(keypoints)]
        return xy, matches.score

    def read_points(
        self, group: h5py.Group, swapped: bool, images: Sequence[ImageRef]
    ) -> tuple[list[np.ndarray], np.ndarray]:
        """(M, 2) float64 px of the two stored images, in their order, and (M,) scores. Raises as match does."""
        where = f"{self.matches} has in its group {str(group.name)[1:]!r}"
        points = [read_array(group, name) for name in ("keypoints0", "keypoints1")]
        for xy in points:
            if xy.ndim != 2 or xy.shape[1] != 2 or xy.shape != points[0].shape:
                shapes = " and ".join(str(xy.shape) for xy in points)
                raise InputError(f"{where} points of shapes {shapes}: both must have the same shape (M, 2)")
        score = read_array(group, "scores") if "scores" in group else np.ones(len(points[0]))
        if score.shape != (len(points[0]),):
            raise InputError(f"{where} {len(points[0])} matches but scores of shape {score.shape}")
        if not all(np.isfinite(values).all() for values in (*points, score)):
            raise InputError(f"{where} points or scores that are not finite")
        points = [px_from_pixel_index(xy.astype(np.float64)) for xy in (points[::-1] if swapped else points)]
        for image, xy in zip(images, points):
            # As in hloc.read_keypoints: half precision puts points at the edge a bit outside.
            if not np.all((xy >= -1) & (xy <= np.array(image.size_wh) + 1)):
                raise InputError(f"{where} points outside of {image.name!r}: they are of other photos")
        return points, score


def locate_pairs(h5: h5py.File, path: Path, pairs: Sequence[ImagePair]) -> list[tuple[str, bool]]:
    """For each pair, its group in the file and whether the images are the other way round there.

    Raises InputError where some have none.
    """
    groups = [find_group(h5, pair, "keypoints1") or find_group(h5, pair, "matches0") for pair in pairs]
    missing = [pair for pair, group in zip(pairs, groups) if group is None]
    if missing:
        raise InputError(
            f"{path} lacks {len(missing)} of {len(pairs)} pairs, for example {missing[0].name0!r} and "
            f"{missing[0].name1!r}: it is of other photos, or of another list of pairs (name its own with --pairs FILE)"
        )
    return [group for group in groups if group is not None]
