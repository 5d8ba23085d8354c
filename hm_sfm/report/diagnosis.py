"""Why photos are not in the model, and what to try: what `reconstruct` prints if some fail to register."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np
import pycolmap

from hm_sfm.colmap.cameras import Cameras
from hm_sfm.colmap.database import open_database, read_verified_matches
from hm_sfm.colmap.overlays import STILL_PX, measure_moves
from hm_sfm.config import Config
from hm_sfm.photos.sizes import find_scale, measure_px_scale
from hm_sfm.types import ImagePair, ImageRef, PairMatches

MOST_LISTED = 4
"""Photos of one cause that a line names."""
MOST_ANGLES = 8
"""Pairs of a photo whose triangulation angle is measured: a few ms each."""
# COLMAP's mapper needs this many points to register a photo, and this angle for a first pair, even after it has relaxed
# its demands twice.
FEWEST_POINTS = 30
SMALLEST_ANGLE_DEG = 4.0


class Cause(Enum):
    """What kept a photo out of the model, from the first stage to the last."""

    UNPAIRED = "in no pair"
    FEW_MATCHES = "too few good matches"
    DISAGREEING = "matches that agree with no geometry"
    OTHER_MODEL = "in a separate model"
    APART = "verified pairs only with photos outside the model"
    FEW_POINTS = "too few points of the model in view"
    NO_POSE = "no pose found"
    SMALL_BASELINE = "cameras too close to each other"
    NO_START = "no pair that a model could start from"


BETWEEN = "photos taken in between"
FARTHER = "photos from places farther apart"
ALL_PAIRS = "--pairs exhaustive"
LARGER = "--set images.long_edge_px=1600"
INTRINSICS = "known intrinsics: --camera-model and --camera-params"
OWN_CAMERAS = "--camera-mode per-image"
FISHEYE = "--camera-model OPENCV_FISHEYE if the lens is a fisheye"
MASKS = "masks of what stays where it is in the frame (--masks, --camera-mask)"
ADVICE = {
    Cause.UNPAIRED: (ALL_PAIRS,),
    Cause.FEW_MATCHES: (BETWEEN, ALL_PAIRS, LARGER),
    Cause.DISAGREEING: (MASKS, INTRINSICS, BETWEEN, ALL_PAIRS, LARGER, FISHEYE),
    Cause.OTHER_MODEL: (MASKS, BETWEEN, ALL_PAIRS),
    Cause.APART: (MASKS, BETWEEN, ALL_PAIRS),
    Cause.FEW_POINTS: (MASKS, BETWEEN, ALL_PAIRS, LARGER),
    Cause.NO_POSE: (MASKS, INTRINSICS, OWN_CAMERAS),
    Cause.SMALL_BASELINE: (FARTHER, MASKS, INTRINSICS),
    Cause.NO_START: (MASKS, BETWEEN, INTRINSICS, LARGER),
}
"""What to try, the most promising first; choose_advice leaves out what is already the case."""


@dataclass(frozen=True)
class Diagnosis:
    """The photos that one cause kept out of the model."""

    cause: Cause
    reasons: dict[str, str]
    """Image name -> the evidence, with numbers."""
    advice: tuple[str, ...]

    def __str__(self) -> str:
        """One line, which names a few of the photos."""
        listed = [f"{name} ({reason})" for name, reason in list(self.reasons.items())[:MOST_LISTED]]
        more = len(self.reasons) - len(listed)
        text = f"{len(self.reasons)} not in the model, {self.cause.value}: {', '.join(listed)}"
        text += f" and {more} more" if more else ""
        return text + (f"; try {', or '.join(self.advice)}" if self.advice else "")


@dataclass(frozen=True)
class Evidence:
    """What the stages left behind."""

    images: dict[str, ImageRef]
    """By name."""
    pairs: tuple[ImagePair, ...]
    read: Callable[[ImagePair], PairMatches]
    """Gives the matches of a pair."""
    verified: dict[ImagePair, np.ndarray]
    """(M, 2) int64 matching keypoints."""
    database_path: Path
    models: tuple[pycolmap.Reconstruction, ...]
    """The largest first."""
    config: Config
    cameras: dict[str, pycolmap.Camera]
    """By image name: the first guess of each, or what the user gave."""
    cameras_known: bool
    """Whether the user gave the intrinsics."""

    def partners(self, name: str) -> dict[str, np.ndarray]:
        """The images that have verified matches with image `name` -> (M,) int64 keypoints of `name`, most first."""
        keypoints_of = {}
        for pair, matches in self.verified.items():
            if name in (pair.name0, pair.name1):
                keypoints_of[pair.name1 if name == pair.name0 else pair.name0] = matches[:, int(name == pair.name1)]
        return dict(sorted(keypoints_of.items(), key=lambda item: (-len(item[1]), item[0])))

    def may_lack_intrinsics(self, name: str, cause: Cause) -> bool:
        """Whether known intrinsics could help an image.

        Pairs of other than fisheye lenses are verified without them.
        """
        return not self.cameras_known and (cause != Cause.DISAGREEING or self.cameras[name].is_perspective_fisheye())

    def stays_still(self, name: str) -> bool:
        """Whether most matches of most of an image's pairs stay where they are in the frame.

        Photos from one place do that, and also those of an object that turns before a camera that does not move.
        """
        checks, long_edge_px = self.config.verification, self.config.images.long_edge_px
        px_scale = {image.name: measure_px_scale(image.size_wh, long_edge_px) for image in self.images.values()}
        still = []
        for pair in self.pairs:
            if name in (pair.name0, pair.name1):
                matches = self.read(pair)
                _, moved_px = measure_moves(matches.select(matches.score >= checks.min_score), px_scale)
                if len(moved_px) >= checks.min_inliers:
                    still.append(np.mean(moved_px <= STILL_PX) > 0.5)
        return bool(still) and float(np.mean(still)) > 0.5


def diagnose(
    images: Sequence[ImageRef],
    cameras: Cameras,
    pairs: Sequence[ImagePair],
    read: Callable[[ImagePair], PairMatches],
    database_path: Path,
    models: Sequence[pycolmap.Reconstruction],
    config: Config,
) -> tuple[Diagnosis, ...]:
    """Group the images that are not in models[0], the largest, by what kept them out; nothing where all are in it.

    cameras: of the images, in their order. read: gives the matches of a pair. database_path: the verified database that
    the models were built from. Raises InputError where there is no database.
    """
    model_of = {name: number for number, model in reversed(list(enumerate(models))) for name in list_names(model)}
    missing = [image.name for image in images if model_of.get(image.name) != 0]
    if not missing:
        return ()
    evidence = Evidence(
        images={image.name: image for image in images},
        pairs=tuple(pairs),
        read=read,
        verified=read_verified_matches(database_path),
        database_path=Path(database_path),
        models=tuple(models),
        config=config,
        cameras={image.name: cameras.cameras[index] for image, index in zip(images, cameras.camera_index)},
        cameras_known=cameras.known,
    )
    reasons_of: dict[Cause, dict[str, str]] = {}
    for name in missing:
        if name in model_of:
            number = model_of[name]
            cause, reason = Cause.OTHER_MODEL, f"sparse/{number}, {models[number].num_reg_images()} images"
        elif not evidence.partners(name):
            cause, reason = explain_unverified(name, evidence)
        elif models:
            cause, reason = explain_unregistered(name, evidence)
        else:
            cause, reason = explain_unmapped(name, evidence)
        if INTRINSICS in ADVICE[cause] and evidence.may_lack_intrinsics(name, cause):
            camera = evidence.cameras[name]
            exif = f"{camera.mean_focal_length():.0f} px from EXIF"
            reason += f", focal length {exif if camera.has_prior_focal_length else 'unknown'}"
        reasons_of.setdefault(cause, {})[name] = reason
    return tuple(
        Diagnosis(cause, reasons_of[cause], choose_advice(cause, list(reasons_of[cause]), evidence))
        for cause in Cause
        if cause in reasons_of
    )


def explain_unverified(name: str, evidence: Evidence) -> tuple[Cause, str]:
    """Why an image is in no verified pair."""
    checks = evidence.config.verification
    best, most = "", -1
    for pair in evidence.pairs:
        if name in (pair.name0, pair.name1):
            count = int(np.count_nonzero(evidence.read(pair).score >= checks.min_score))
            if count > most:
                best, most = pair.name1 if name == pair.name0 else pair.name0, count
    if not best:
        return Cause.UNPAIRED, "matched with no other photo"
    if most < checks.min_inliers:
        counted = f"at most {most}, with {best}" if most else "none with any photo"
        return Cause.FEW_MATCHES, f"{counted}; {checks.min_inliers} are needed"
    return Cause.DISAGREEING, f"{most} with {best}, too few of them agree"


def explain_unregistered(name: str, evidence: Evidence) -> tuple[Cause, str]:
    """Why an image that has verified pairs is in no model, where there is one."""
    partners = evidence.partners(name)
    model = evidence.models[0]
    ids = {model.image(image_id).name: image_id for image_id in model.reg_image_ids()}
    if not partners.keys() & ids.keys():
        best = next(iter(partners))
        return Cause.APART, f"{len(partners[best])} verified matches with {best}"
    seen = [np.zeros(0, np.int64)]
    for other in partners.keys() & ids.keys():
        has_point = np.zeros(model.image(ids[other]).num_points2D(), bool)
        has_point[model.image(ids[other]).get_observation_point2D_idxs()] = True
        keypoints_there = evidence.verified[ImagePair.of(name, other)][:, int(name < other)]
        seen.append(partners[other][has_point[keypoints_there]])
    points = len(np.unique(np.concatenate(seen)))
    if points < FEWEST_POINTS:
        return Cause.FEW_POINTS, f"{points}; {FEWEST_POINTS} are needed"
    return Cause.NO_POSE, f"{points} points of the model in view"


def explain_unmapped(name: str, evidence: Evidence) -> tuple[Cause, str]:
    """Why an image that has verified pairs is in no model, where there is none at all."""
    partners = evidence.partners(name)
    # The pairs with most matches have the smallest baselines: take weaker ones, too.
    chosen = np.unique(np.linspace(0, len(partners) - 1, MOST_ANGLES).round().astype(int))
    others = [list(partners)[index] for index in chosen]
    angles_deg = [measure_angle(ImagePair.of(name, other), evidence) for other in others]
    if max(angles_deg) < SMALLEST_ANGLE_DEG:
        return Cause.SMALL_BASELINE, f"rays meet at {max(angles_deg):.1f} degrees at most"
    best = next(iter(partners))
    return Cause.NO_START, f"{len(partners[best])} verified matches with {best}"


def measure_angle(pair: ImagePair, evidence: Evidence) -> float:
    """Degrees: COLMAP's median triangulation angle of a verified pair, 0 where it finds no relative pose."""
    with open_database(evidence.database_path) as database:
        rows = {row.name: row for row in database.read_all_images()}
        sides = [rows[pair.name0], rows[pair.name1]]
        geometry = database.read_two_view_geometry(*(row.image_id for row in sides))
        cameras = [database.read_camera(row.camera_id) for row in sides]
        xy = [database.read_keypoints(row.image_id)[:, :2].astype(np.float64) for row in sides]
    has_pose = pycolmap.estimate_two_view_geometry_pose(cameras[0], xy[0], cameras[1], xy[1], geometry)
    return float(np.degrees(geometry.tri_angle)) if has_pose else 0.0


def choose_advice(cause: Cause, names: Sequence[str], evidence: Evidence) -> tuple[str, ...]:
    """ADVICE without what would change nothing for these images."""
    config = evidence.config
    count = len(evidence.images)
    useless = {
        ALL_PAIRS: len(evidence.pairs) == count * (count - 1) // 2,
        LARGER: all(find_scale(evidence.images[name].size_wh, config.images.long_edge_px) == 1 for name in names)
        or config.images.long_edge_px >= 1600,
        INTRINSICS: not any(evidence.may_lack_intrinsics(name, cause) for name in names),
        FISHEYE: evidence.cameras_known or all(evidence.cameras[name].is_perspective_fisheye() for name in names),
        MASKS: not any(evidence.stays_still(name) for name in names),
        OWN_CAMERAS: config.cameras.mode == "per-image" or bool(config.cameras.rig),
    }
    return tuple(advice for advice in ADVICE[cause] if not useless.get(advice, False))


def list_names(model: pycolmap.Reconstruction) -> list[str]:
    """The names of a model's registered images."""
    return [model.image(image_id).name for image_id in model.reg_image_ids()]
