"""The frozen domain types that flow between the stages. Read this first.

Every coordinate is in COLMAP's frame: pixels of the stored (unrotated, full-resolution) image, the pixel in
column c and row r spans [c, c+1) x [r, r+1), so the centre of the top-left pixel is (0.5, 0.5).

Arrays are copied and made read-only on creation; shape and dtype are checked. M = 0 is valid everywhere.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np

from hm_sfm.geometry.homographies import apply_homographies
from hm_sfm.geometry.nearest import find_pairs_within


def freeze_array(value: Any, dtype: type, shape: tuple[int | None, ...], what: str) -> np.ndarray:
    """Copy `value` into a read-only C-contiguous array of `dtype` after checking its shape.

    `None` in `shape` matches any length. Raises ValueError with the expected and the actual shape.
    """
    array = np.array(value, dtype=dtype, order="C")
    fits = array.ndim == len(shape) and all(want in (None, have) for want, have in zip(shape, array.shape))
    if not fits:
        expected = "(" + ", ".join("*" if n is None else str(n) for n in shape) + ")"
        raise ValueError(f"{what} must have shape {expected}, got {array.shape}")
    array.setflags(write=False)
    return array


Position = tuple[float, float, float | None]
"""Latitude and longitude in degrees (WGS84) and altitude in m, None where it is not known."""


@dataclass(frozen=True)
class ImageRef:
    """One photo of the collection. `name` is the key everywhere: its POSIX path relative to the image folder.

    EXIF's orientation is a clockwise turn by `rotation_deg`, followed by a flip where the photo is `mirrored`.
    """

    name: str
    path: Path
    size_wh: tuple[int, int]
    """Stored size, px, before any EXIF rotation."""
    rotation_deg: int = 0
    """Clockwise turn (0, 90, 180, 270) that EXIF asks for to show the photo upright."""
    gps: Position | None = None
    """As EXIF has it."""
    mirrored: bool = False
    """Whether EXIF asks for the photo, once it is turned, to be flipped left to right as well."""
    flipped: bool = False
    """Whether coordinates are px of the photo as stored but flipped left to right. Those of a run are where a photo is
    mirrored: no camera of COLMAP takes mirrored photos, and its model would be wrong."""

    def __post_init__(self) -> None:
        if self.rotation_deg not in (0, 90, 180, 270):
            raise ValueError(f"rotation_deg must be 0, 90, 180 or 270, got {self.rotation_deg}")


@dataclass(frozen=True, order=True)
class ImagePair:
    """Two different image names in sorted order; hashable."""

    name0: str
    name1: str

    def __post_init__(self) -> None:
        if not self.name0 < self.name1:
            raise ValueError(f"an ImagePair needs name0 < name1, got {self.name0!r} and {self.name1!r}")

    @classmethod
    def of(cls, name_a: str, name_b: str) -> "ImagePair":
        """The pair of two names given in any order."""
        return cls(min(name_a, name_b), max(name_a, name_b))


@dataclass(frozen=True, kw_only=True)
class PatchMatches:
    """Semi-dense matches of two images with the homography of each matched patch, best score first."""

    xy0: np.ndarray
    """(M, 2) float32 px: patch centres in image 0."""
    xy1: np.ndarray
    """(M, 2) float32 px: where the homographies put these centres in image 1."""
    score: np.ndarray
    """(M,) float32 in [0, 1]: the probability that a match is off by less than 1 px of the matching resolution."""
    homography: np.ndarray
    """(M, 3, 3) float32: image 0 px -> image 1 px around match i, scaled so that its denominator is 1 at xy0[i]."""
    patch_radius_px: float
    """Half the side of a patch in image 0 px: homography i is estimated from |x - x0[i]|, |y - y0[i]| <= this."""
    size0_wh: tuple[int, int] | None = None
    size1_wh: tuple[int, int] | None = None
    """Px of image 0 and image 1; None where they are not known, as in matches that were read from a file."""

    def __post_init__(self) -> None:
        count = len(self.score)
        object.__setattr__(self, "xy0", freeze_array(self.xy0, np.float32, (count, 2), "xy0"))
        object.__setattr__(self, "xy1", freeze_array(self.xy1, np.float32, (count, 2), "xy1"))
        object.__setattr__(self, "score", freeze_array(self.score, np.float32, (count,), "score"))
        object.__setattr__(self, "homography", freeze_array(self.homography, np.float32, (count, 3, 3), "homography"))

    def __len__(self) -> int:
        return len(self.score)

    def select(self, chosen: np.ndarray) -> Self:
        """The matches that `chosen`, (M,) bool or indices, names; in its order."""
        return replace(
            self,
            xy0=self.xy0[chosen],
            xy1=self.xy1[chosen],
            score=self.score[chosen],
            homography=self.homography[chosen],
        )

    def warp(self, xy0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Transfer points of image 0 into image 1, each by that of the patches it lies in whose centre is nearest.

        xy0: (N, 2) px. Returns xy1 (N, 2) float32 px, NaN where not valid, and valid (N,) bool: the point lies in a
        patch and, where the size of image 1 is known, ends up inside of it.
        """
        xy0 = np.asarray(xy0)
        point, patch, apart = find_pairs_within(xy0, self.xy0, np.sqrt(2) * self.patch_radius_px)
        is_in_patch = np.abs(xy0[point] - self.xy0[patch]).max(axis=1, initial=0) <= self.patch_radius_px
        point, patch, apart = point[is_in_patch], patch[is_in_patch], apart[is_in_patch]
        order = np.lexsort((patch, apart, point))
        point, first = np.unique(point[order], return_index=True)
        xy1 = np.full((len(xy0), 2), np.nan, np.float32)
        xy1[point] = apply_homographies(self.homography[patch[order][first]], xy0[point])
        valid = np.isfinite(xy1).all(axis=1) & self._ends_inside(xy1)
        xy1[~valid] = np.nan
        return xy1, valid

    def densify(self, radius: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """The dense matches M_d of the paper: all pixels of image 0 that patches cover, and where they are in image 1.

        radius: how far from its centre a patch counts, in parts of patch_radius_px, in (0, 1]. With the whole radius,
        no pixel between neighbouring patches is left out. Where patches overlap, the one whose centre is nearest
        counts. Where the sizes of the images are known, nothing lies outside of either. Returns xy0, pixel centres,
        and xy1, (N, 2) float32 px each, row by row. Raises ValueError on another radius.
        """
        if not 0 < radius <= 1:
            raise ValueError(f"radius must be in (0, 1], in parts of the patches' own radius, got {radius}")
        centres = self.xy0.astype(np.float64)
        reach_px = radius * self.patch_radius_px
        first = np.ceil(centres - reach_px - 0.5).astype(np.int64)
        end = np.floor(centres + reach_px + 0.5).astype(np.int64)
        if self.size0_wh:
            first, end = first.clip(0, self.size0_wh), end.clip(0, self.size0_wh)
        origin = first.min(axis=0, initial=0)
        width, height = end.max(axis=0, initial=0) - origin
        nearest, index = np.full((height, width), np.inf), np.full((height, width), -1)
        for number, (centre, corner, opposite) in enumerate(zip(centres, first, end)):
            (left, top), (right, bottom) = corner - origin, opposite - origin
            (x, y), window = corner + 0.5 - centre, (slice(top, bottom), slice(left, right))
            apart = np.hypot(x + np.arange(right - left), y + np.arange(bottom - top)[:, None])
            is_nearer = apart < nearest[window]
            nearest[window][is_nearer] = apart[is_nearer]
            index[window][is_nearer] = number
        row, column = np.nonzero(index >= 0)
        xy0 = (np.stack([column, row], axis=1) + origin + 0.5).astype(np.float32)
        xy1 = apply_homographies(self.homography[index[row, column]], xy0)
        kept = self._ends_inside(xy1)
        return xy0[kept], xy1[kept]

    def _ends_inside(self, xy1: np.ndarray) -> np.ndarray:
        """(N,) bool: which points (N, 2) px lie in image 1; all where its size is not known."""
        return np.all((xy1 >= 0) & (xy1 < self.size1_wh), axis=1) if self.size1_wh else np.ones(len(xy1), bool)


@dataclass(frozen=True, kw_only=True)
class PairMatches(PatchMatches):
    """The PatchMatches of a pair of the collection: image 0 is pair.name0."""

    pair: ImagePair


@dataclass(frozen=True)
class Keypoints:
    """The persistent keypoints of one image."""

    name: str
    xy: np.ndarray
    """(K, 2) float32 px."""
    sigma_px: np.ndarray
    """(K,) float32: estimated standard deviation of the position."""
    score: np.ndarray
    """(K,) float32: higher is better. Of persistent keypoints it is the share of all photos that show their track."""

    def __post_init__(self) -> None:
        count = len(self.score)
        object.__setattr__(self, "xy", freeze_array(self.xy, np.float32, (count, 2), "xy"))
        object.__setattr__(self, "sigma_px", freeze_array(self.sigma_px, np.float32, (count,), "sigma_px"))
        object.__setattr__(self, "score", freeze_array(self.score, np.float32, (count,), "score"))

    def __len__(self) -> int:
        return len(self.score)


@dataclass(frozen=True)
class IndexMatches:
    """Matches of one image pair as indices into the Keypoints of its images, one to one."""

    pair: ImagePair
    indices: np.ndarray
    """(M, 2) uint32: keypoint of image 0, keypoint of image 1."""
    score: np.ndarray
    """(M,) float32: higher is better. Of persistent keypoints it is a probability, as in PatchMatches."""

    def __post_init__(self) -> None:
        count = len(self.score)
        object.__setattr__(self, "indices", freeze_array(self.indices, np.uint32, (count, 2), "indices"))
        object.__setattr__(self, "score", freeze_array(self.score, np.float32, (count,), "score"))
        for side in range(2):
            if len(np.unique(self.indices[:, side])) != count:
                raise ValueError(f"indices of {self.pair} are not one to one on side {side}")

    @classmethod
    def of_best(cls, pair: ImagePair, indices: np.ndarray, score: np.ndarray) -> "IndexMatches":
        """The matches that are the best-scored ones of both their keypoints, the first of equal ones, in their order.

        indices: (M, 2) int, in which keypoints may repeat; score: (M,), higher is better.
        """
        order = np.argsort(-score, kind="stable")
        kept = np.ones(len(score), bool)
        for side in range(2):
            _, first = np.unique(indices[order, side], return_index=True)
            is_best = np.zeros(len(score), bool)
            is_best[order[first]] = True
            kept &= is_best
        return cls(pair, indices[kept], score[kept])

    def __len__(self) -> int:
        return len(self.score)


@dataclass(frozen=True)
class Tracks:
    """Tracks as compressed rows: the observations of track t are offsets[t]:offsets[t + 1].

    A track has at most one observation per image.
    """

    offsets: np.ndarray
    """(T + 1,) int64."""
    image_index: np.ndarray
    """(O,) int64: index into the list of images."""
    keypoint_index: np.ndarray
    """(O,) int64: index into the Keypoints of that image."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "offsets", freeze_array(self.offsets, np.int64, (None,), "offsets"))
        count = int(self.offsets[-1]) if len(self.offsets) else -1
        if count < 0 or self.offsets[0] != 0 or np.any(np.diff(self.offsets) < 0):
            raise ValueError("offsets must start at 0, never decrease and have at least one entry")
        object.__setattr__(self, "image_index", freeze_array(self.image_index, np.int64, (count,), "image_index"))
        object.__setattr__(
            self, "keypoint_index", freeze_array(self.keypoint_index, np.int64, (count,), "keypoint_index")
        )

    def __len__(self) -> int:
        return len(self.offsets) - 1


@dataclass(frozen=True)
class PinholeView:
    """A camera whose intrinsics and pose are known: a view to render, or the ground truth of a photo."""

    K: np.ndarray
    """(3, 3) float64 px, in COLMAP's frame."""
    size_wh: tuple[int, int]
    cam_from_world: np.ndarray
    """(3, 4) float64: rigid; the camera looks along its +z, its y points down."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", freeze_array(self.K, np.float64, (3, 3), "K"))
        object.__setattr__(
            self, "cam_from_world", freeze_array(self.cam_from_world, np.float64, (3, 4), "cam_from_world")
        )

    @property
    def center(self) -> np.ndarray:
        """(3,) float64: where the camera stands, in the world."""
        return -self.cam_from_world[:, :3].T @ self.cam_from_world[:, 3]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World points (N, 3) -> their px (N, 2) and z-depths (N,), float64; px mean nothing where depth <= 0."""
        rays = (points @ self.cam_from_world[:, :3].T + self.cam_from_world[:, 3]) @ self.K.T
        with np.errstate(divide="ignore", invalid="ignore"):
            return rays[:, :2] / rays[:, 2:], rays[:, 2]


@dataclass(frozen=True)
class MappingResult:
    """The models that the mapper built, and the metrics in summary.json of the largest of them."""

    models: tuple[Any, ...]
    """pycolmap.Reconstruction, largest (most registered images) first."""
    num_images: int
    registered: int
    points: int
    observations: int
    mean_track_length: float
    """In distinct images."""
    mean_reprojection_px: float


class TrainingPairs(Protocol):
    """Training pairs of one kind: an item is made when it is asked for, the same one each time."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> dict[str, np.ndarray]: ...
