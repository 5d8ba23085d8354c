"""Two-view geometry, through pycolmap: which matches agree, and which pairs are convincing.

Ctrl-C raises KeyboardInterrupt out of each of these functions within a second or so.
"""

import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
from tqdm import tqdm

from hm_sfm.colmap.database import open_database
from hm_sfm.colmap.scaled_database import claim_focal_lengths, copy_scaled, needs_copy, scale_camera, scale_geometry
from hm_sfm.config import VerificationConfig
from hm_sfm.io.colmap_log import quiet_colmap
from hm_sfm.types import ImagePair, ImageRef, PairMatches, PatchMatches, freeze_array

# Fewer matches than this prove nothing about an epipolar geometry.
MIN_MATCHES = 8

# verify_pair fits the geometry to at most so many matches and then tests all of them: the time of a trial grows with
# the matches, the precision of the fit hardly does.
FIT_MATCHES = 1000

# Enough for 30 % inliers; pairs with more stop earlier, and pairs of different places need none.
MAX_TRIALS = 1500

KINDS = pycolmap.TwoViewGeometryConfiguration
# A plane or a rotation explains the pair. These have an essential matrix, too, where both focal lengths are known.
PLANAR_KINDS = tuple(map(int, (KINDS.PLANAR, KINDS.PANORAMIC, KINDS.PLANAR_OR_PANORAMIC)))


@dataclass(frozen=True)
class VerifiedPair:
    """A pair of images whose matches agree with a two-view geometry."""

    pair: ImagePair
    inliers: np.ndarray
    """(M,) bool: which of the pair's matches agree."""
    strength: float
    """Number of inliers times the share of the image that they cover, in the image where it is smaller."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "inliers", freeze_array(self.inliers, np.bool_, (None,), "inliers"))


def _two_view_options(
    max_error_px: float, min_inliers: int, min_inlier_ratio: float, seed: int
) -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = min_inliers
    options.min_inlier_ratio = min_inlier_ratio
    options.detect_watermark = False  # a label that nothing here reads
    options.ransac.max_error = max_error_px
    options.ransac.max_num_trials = MAX_TRIALS
    options.ransac.random_seed = seed
    return options


def verify_pair(
    matches: PatchMatches,
    camera0: pycolmap.Camera,
    camera1: pycolmap.Camera,
    config: VerificationConfig,
    px_scale: tuple[float, float] = (1.0, 1.0),
    seed: int = 0,
) -> np.ndarray:
    """Which matches agree with the two-view geometry of their images.

    camera0, camera1: of image 0 and 1; where both have a known focal length, the geometry is calibrated. Pairs that
    see a plane, or that only rotate, are valid: matches then agree with a homography, or with an essential or
    fundamental matrix. Fisheye images have no fundamental matrix: their focal lengths are taken for known.
    px_scale: of image 0 and 1, px of the stored image per px at the matching resolution.

    Returns (M,) bool, the same for the same seed; all False where fewer than `config.min_inliers` or a smaller part
    than `config.min_inlier_ratio` of the matches agree, and for fewer than 8 matches. Scores are not looked at.
    """
    rejected = np.zeros(len(matches), dtype=bool)
    if len(matches) < MIN_MATCHES:
        return rejected
    xy0 = matches.xy0.astype(np.float64) / px_scale[0]
    xy1 = matches.xy1.astype(np.float64) / px_scale[1]
    cameras = [scale_camera(camera, scale) for camera, scale in zip((camera0, camera1), px_scale)]
    for camera in cameras:
        camera.has_prior_focal_length |= camera.is_perspective_fisheye()
    kind, inliers = _find_inliers(xy0, xy1, cameras, config.max_error_px, seed)
    if kind in PLANAR_KINDS and not all(camera.has_prior_focal_length for camera in cameras):
        # COLMAP then looks for a homography only. Told that the focal lengths are known, it also looks for an essential
        # and a fundamental matrix, which have room for the plane and for what stands before it.
        for camera in cameras:
            camera.has_prior_focal_length = True
        _, with_focal = _find_inliers(xy0, xy1, cameras, config.max_error_px, seed, try_fundamental=True)
        inliers = max(inliers, with_focal, key=np.count_nonzero)
    accepted = np.count_nonzero(inliers) >= max(config.min_inliers, config.min_inlier_ratio * len(matches))
    return inliers if accepted else rejected


def _find_inliers(
    xy0: np.ndarray,
    xy1: np.ndarray,
    cameras: Sequence[pycolmap.Camera],
    max_error_px: float,
    seed: int,
    try_fundamental: bool = False,
) -> tuple[int, np.ndarray]:
    """The kind of the two-view geometry of matches (M, 2), px as `cameras` have them, and (M,) bool: which agree.

    The kind is a value of TwoViewGeometryConfiguration. try_fundamental: focal lengths that are known may be wrong.
    """
    # Matches come best first: even steps keep the mixture of good and bad, and the spread over the image.
    chosen = np.linspace(0, len(xy0) - 1, min(len(xy0), FIT_MATCHES)).round().astype(np.int64)
    identity = np.repeat(np.arange(len(chosen), dtype=np.uint32)[:, None], 2, axis=1)
    with quiet_colmap():
        geometry = pycolmap.estimate_two_view_geometry(
            cameras[0],
            xy0[chosen],
            cameras[1],
            xy1[chosen],
            identity,
            _two_view_options(max_error_px, MIN_MATCHES, 0.0, seed),
        )
    kind = geometry.config
    inliers = np.zeros(len(xy0), dtype=bool)
    if kind == int(KINDS.UNCALIBRATED) and geometry.F is not None:
        inliers = _epipolar_inliers(xy0, xy1, geometry.F, max_error_px)
    elif kind == int(KINDS.CALIBRATED) or kind in PLANAR_KINDS:
        # As COLMAP does: a plane that dominates the pair must not cost it what stands before the plane.
        if geometry.E is not None:
            max_error = float(np.mean([camera.cam_from_img_threshold(max_error_px) for camera in cameras]))
            rays0, rays1 = (np.asarray(camera.cam_from_img(xy)) for camera, xy in zip(cameras, (xy0, xy1)))
            inliers = _epipolar_inliers(rays0, rays1, geometry.E, max_error)
        if kind != int(KINDS.CALIBRATED) and geometry.H is not None:
            planar = _planar_inliers(xy0, xy1, geometry.H, max_error_px)
            inliers = max(inliers, planar, key=np.count_nonzero)
        if try_fundamental and geometry.F is not None:
            inliers = max(inliers, _epipolar_inliers(xy0, xy1, geometry.F, max_error_px), key=np.count_nonzero)
    return kind, inliers


def _epipolar_inliers(xy0: np.ndarray, xy1: np.ndarray, matrix: np.ndarray, max_error: float) -> np.ndarray:
    """(M,) bool: Sampson error within `max_error`, px or normalised as the points (M, 2) are; NaN is no inlier."""
    squared = np.array(pycolmap.compute_squared_sampson_error(xy0, xy1, matrix))
    return squared <= max_error**2


def _planar_inliers(xy0: np.ndarray, xy1: np.ndarray, homography: np.ndarray, max_error_px: float) -> np.ndarray:
    """(M,) bool: the homography puts the point of image 0 within `max_error_px` of its match; points (M, 2) px."""
    projected = np.column_stack([xy0, np.ones(len(xy0))]) @ homography.T
    with np.errstate(divide="ignore", invalid="ignore"):  # points on the horizon are no inliers
        offset = projected[:, :2] / projected[:, 2:] - xy1
    return (offset**2).sum(axis=1) <= max_error_px**2


def verify_pairs(
    images: Sequence[ImageRef],
    pairs: Sequence[ImagePair],
    read: Callable[[ImagePair], PairMatches],
    cameras: Mapping[str, pycolmap.Camera],
    px_scale: Mapping[str, float],
    config: VerificationConfig,
    quiet: bool = False,
) -> dict[ImagePair, VerifiedPair]:
    """verify_pair for many pairs; pairs that are rejected are left out.

    read: gives the matches of a pair. cameras, px_scale: by image name; px_scale is px of the stored image per px at
    the matching resolution, in which `config` states the error of each image. quiet: no progress bar.
    """
    size_wh = {image.name: image.size_wh for image in images}
    verified = {}
    for pair in tqdm(pairs, desc="verify", unit="pair", disable=quiet):
        matches = read(pair)
        confident = np.flatnonzero(matches.score >= config.min_score)
        agreeing = verify_pair(
            matches.select(confident),
            cameras[pair.name0],
            cameras[pair.name1],
            config,
            (px_scale[pair.name0], px_scale[pair.name1]),
        )
        if is_convincing(int(np.count_nonzero(agreeing)), len(confident), config):
            inliers = np.zeros(len(matches), dtype=bool)
            inliers[confident[agreeing]] = True
            cover0 = measure_cover(matches.xy0[inliers], size_wh[pair.name0])
            cover1 = measure_cover(matches.xy1[inliers], size_wh[pair.name1])
            verified[pair] = VerifiedPair(pair, inliers, np.count_nonzero(inliers) * min(cover0, cover1))
    return verified


def rank_pairs(verified: Mapping[ImagePair, VerifiedPair]) -> tuple[ImagePair, ...]:
    """The verified pairs, strongest first."""
    ranked = sorted(verified.values(), key=lambda checked: (-checked.strength, checked.pair))
    return tuple(checked.pair for checked in ranked)


def is_convincing(inliers: int, matches: int, config: VerificationConfig) -> bool:
    """Whether so many inliers among so many matches prove that two photos show the same place."""
    certainty = min(inliers / config.sure_inliers, 1.0)
    ratio = config.doubtful_inlier_ratio + certainty * (config.min_inlier_ratio - config.doubtful_inlier_ratio)
    return inliers > 0 and inliers >= ratio * matches


def measure_cover(xy: np.ndarray, size_wh: tuple[int, int]) -> float:
    """Share of the cells of an 8 x 8 division of the image that hold a point. xy: (N, 2) px."""
    cell = np.clip((xy / np.array(size_wh) * 8).astype(int), 0, 7)
    return len(np.unique(cell[:, 1] * 8 + cell[:, 0])) / 64


def verify_database(
    path: Path,
    config: VerificationConfig,
    px_scale: Mapping[str, float] | None = None,
    seed: int = 0,
    num_threads: int = -1,
) -> None:
    """Estimate the two-view geometry of all matched pairs of a database and store it there, replacing earlier ones.

    px_scale: by image name, px of the stored image per px at the matching resolution, in which `config` states the
    error of each image; 1 for images that it leaves out. Cameras without a known focal length are used as in
    verify_pair. num_threads: -1 takes all cores. Raises InputError where there is no database.
    """
    px_scale = px_scale or {}
    path = Path(path)
    with open_database(path) as database:
        database.clear_two_view_geometries()  # pycolmap skips pairs that have one
    verify = partial(_verify_missing, config=config, seed=seed, num_threads=num_threads)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        copy = Path(folder) / "copy.db"
        if needs_copy(path, px_scale):
            copy_scaled(path, copy, px_scale)
            verify(copy)
            _copy_geometries(copy, path, px_scale)
        else:
            verify(path)
        planar, cameras = _list_unfocused_planar(path)
        if planar:
            copy_scaled(path, copy, px_scale)
            claim_focal_lengths(copy, cameras)
            _forget(copy, planar)
            verify(copy)
            _add_inliers(copy, path, planar)


def _verify_missing(path: Path, config: VerificationConfig, seed: int, num_threads: int) -> None:
    """Estimate the two-view geometries that a database lacks."""
    verifier = pycolmap.GeometricVerifierOptions(num_threads=num_threads)
    # Ctrl-C takes effect between batches.
    pairing = pycolmap.ExistingMatchedPairingOptions(batch_size=4 * (os.cpu_count() or 1))
    options = _two_view_options(config.max_error_px, config.min_inliers, config.min_inlier_ratio, seed)
    with quiet_colmap():
        pycolmap.geometric_verification(path, verifier, pairing, options)


def _copy_geometries(copy: Path, path: Path, px_scale: Mapping[str, float]) -> None:
    """Write the two-view geometries of a copy_scaled to its original, which has none."""
    with open_database(copy) as scaled, open_database(path) as database, pycolmap.DatabaseTransaction(database):
        scale = {image.image_id: px_scale.get(image.name, 1.0) for image in scaled.read_all_images()}
        for pair_id, geometry in zip(*scaled.read_two_view_geometries()):
            id0, id1 = pycolmap.pair_id_to_image_pair(pair_id)
            scale_geometry(geometry, 1 / scale[id0], 1 / scale[id1])
            database.write_two_view_geometry(id0, id1, geometry)


def _list_unfocused_planar(path: Path) -> tuple[list[tuple[int, int]], list[int]]:
    """The pairs (ids of images) whose geometry is planar and was estimated without focal lengths, and their cameras."""
    with open_database(path) as database:
        cameras = database.read_all_cameras()
        unknown = {c.camera_id for c in cameras if not c.has_prior_focal_length and not c.is_perspective_fisheye()}
        images = {image.image_id for image in database.read_all_images() if image.camera_id in unknown}
        rows = zip(*database.read_two_view_geometries())
        planar = [pycolmap.pair_id_to_image_pair(row) for row, geometry in rows if geometry.config in PLANAR_KINDS]
    return [pair for pair in planar if images.intersection(pair)], sorted(unknown)


def _forget(path: Path, pairs: Sequence[tuple[int, int]]) -> None:
    """Remove two-view geometries."""
    with open_database(path) as database, pycolmap.DatabaseTransaction(database):
        for pair in pairs:
            database.delete_two_view_geometry(*pair)


def _add_inliers(copy: Path, path: Path, pairs: Sequence[tuple[int, int]]) -> None:
    """Give the two-view geometries of these pairs the inliers that they have in the copy, where these are more."""
    with open_database(copy) as other, open_database(path) as database, pycolmap.DatabaseTransaction(database):
        for pair in pairs:
            geometry = database.read_two_view_geometry(*pair)
            matches = other.read_two_view_geometry(*pair).inlier_matches
            if len(matches) > len(geometry.inlier_matches):
                geometry.inlier_matches = matches
                database.update_two_view_geometry(*pair, geometry)
