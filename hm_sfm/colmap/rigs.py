"""Rigs: cameras that are mounted together and take photos at the same moments, from a configuration as COLMAP has it.

The photos of a camera are those whose names begin with its `image_prefix`; what follows it is the same for photos that
were taken at the same moment.
"""

import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pycolmap

from hm_sfm.config import parse_config
from hm_sfm.errors import InputError
from hm_sfm.io.colmap_log import quiet_colmap
from hm_sfm.types import ImagePair

UNIT_TOLERANCE = 0.01
"""How far from 1 the length of a rotation's quaternion may be: of numbers that were rounded."""


@dataclass(frozen=True)
class RigCameraEntry:
    """A camera of a rig as the file has it."""

    image_prefix: str
    ref_sensor: bool = False
    cam_from_rig_rotation: list = field(default_factory=list)
    """w, x, y, z."""
    cam_from_rig_translation: list = field(default_factory=list)
    camera_model_name: str = ""
    camera_params: list = field(default_factory=list)


def read_rigs(path: Path) -> tuple[pycolmap.RigConfig, ...]:
    """Read a rig configuration in COLMAP's format, JSON.

    Raises InputError where the file cannot be read or is no such configuration, ConfigError on a key that is unknown or
    of another type. COLMAP itself ignores such keys, and trusts that rotations and translations are as long as they
    should be.
    """
    path = Path(path)
    try:
        tree = json.loads(path.read_text())
    except OSError as error:
        raise InputError(f"cannot read the rig configuration {path}: {error.strerror}") from error
    except ValueError as error:
        raise InputError(f"the rig configuration {path} is not valid JSON: {' '.join(str(error).split())}") from error
    if not isinstance(tree, list) or not tree:
        raise InputError(f"the rig configuration {path} must be a list of rigs, found {str(tree)[:40]!r}")
    for number, rig in enumerate(tree, start=1):
        entries = rig.get("cameras") if isinstance(rig, dict) else None
        if not isinstance(entries, list):
            raise InputError(f"rig {number} of {path} has no list of cameras")
        cameras = [
            parse_config(entry, RigCameraEntry, f"camera {place} of rig {number} in {path}")
            for place, entry in enumerate(entries, start=1)
        ]
        for camera in cameras:
            _check_camera(camera, path)
        references = sum(camera.ref_sensor for camera in cameras)
        if references != 1:
            raise InputError(f"rig {number} of {path} needs one camera with ref_sensor true, found {references}")
    try:
        with quiet_colmap(pycolmap.logging.FATAL):
            rigs = pycolmap.read_rig_config(path)
    except (RuntimeError, ValueError) as error:
        raise InputError(f"COLMAP cannot read the rig configuration {path} ({' '.join(str(error).split())})") from error
    for rig in rigs:
        cameras = rig.cameras
        for camera in cameras:
            _check_intrinsics(camera, path)
            if camera.cam_from_rig is not None:  # COLMAP takes it to be of unit length
                quaternion = camera.cam_from_rig.rotation.quat
                rotation = pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion))
                camera.cam_from_rig = pycolmap.Rigid3d(rotation, camera.cam_from_rig.translation)
        rig.cameras = cameras
    has_pose = {camera.cam_from_rig is not None for rig in rigs for camera in rig.cameras if not camera.ref_sensor}
    if len(has_pose) > 1:  # calibrated ones would have another scale than those that are known
        raise InputError(
            f"{path} has a cam_from_rig for some cameras only: give it for all but those with ref_sensor, or for none"
        )
    return tuple(rigs)


def _check_camera(camera: RigCameraEntry, path: Path) -> None:
    """Raises InputError where the prefix is empty or the pose incomplete."""
    where = f"the camera {camera.image_prefix!r} in {path}"
    if not camera.image_prefix:
        raise InputError(f"{where} needs an image_prefix, with which the names of its photos begin")
    rotation, translation = camera.cam_from_rig_rotation, camera.cam_from_rig_translation
    if camera.ref_sensor and (rotation or translation):
        raise InputError(f"{where} is the reference of its rig: it must not have a cam_from_rig")
    if rotation or translation:
        if len(rotation) != 4 or len(translation) != 3 or not _are_numbers(rotation + translation):
            raise InputError(
                f"{where} needs 4 numbers as cam_from_rig_rotation (w, x, y, z) and 3 as cam_from_rig_translation, "
                f"found {rotation} and {translation}"
            )
        if abs(math.hypot(*rotation) - 1) > UNIT_TOLERANCE:
            raise InputError(f"{where} needs a cam_from_rig_rotation of length 1, found {rotation}")
    if not _are_numbers(camera.camera_params) or bool(camera.camera_model_name) != bool(camera.camera_params):
        raise InputError(f"{where} needs both camera_model_name and camera_params, a list of numbers, or neither")


def _are_numbers(values: list) -> bool:
    return all(type(value) in (int, float) and math.isfinite(value) for value in values)


def _check_intrinsics(camera: pycolmap.RigConfigCamera, path: Path) -> None:
    """Raises InputError where the camera model is unknown or has another number of parameters."""
    known = camera.camera
    if known is not None and (known.model == pycolmap.CameraModelId.INVALID or not known.verify_params()):
        raise InputError(
            f"the camera {camera.image_prefix!r} in {path} has an unknown camera_model_name, or one that takes another "
            f"number of camera_params than {len(known.params)}"
        )


def assign_cameras(
    rigs: Sequence[pycolmap.RigConfig], names: Sequence[str], path: Path
) -> list[tuple[int, int] | None]:
    """Which camera took each photo: (rig, camera), positions in `rigs` and its `cameras`; None outside of all rigs.

    names: of the images. path: of the configuration, for messages. Raises InputError where a camera has no photo or
    none that was taken together with one of another camera, and where a photo is of two cameras.
    """
    prefixes = {
        (number, place): camera.image_prefix
        for number, rig in enumerate(rigs)
        for place, camera in enumerate(rig.cameras)
    }
    taken_by: list[tuple[int, int] | None] = []
    moments: dict[tuple[int, str], dict[tuple[int, int], str]] = {}
    for name in names:
        takers = [taker for taker, prefix in prefixes.items() if name.startswith(prefix)]
        taken_by.append(takers[0] if takers else None)
        if len(takers) > 1:
            cameras = " and ".join(repr(prefixes[taker]) for taker in takers[:2])
            raise InputError(f"{name!r} is of two cameras in {path}, {cameras}: end each image_prefix with a /")
        for taker in takers:
            moment = moments.setdefault((taker[0], name.rpartition(prefixes[taker])[2]), {})  # as COLMAP does
            if taker in moment:
                raise InputError(f"{path} makes {moment[taker]!r} and {name!r} photos of one camera at the same moment")
            moment[taker] = name
    joined = {taker for moment in moments.values() if len(moment) > 1 for taker in moment}
    for taker, prefix in prefixes.items():
        if taker not in taken_by:
            raise InputError(f"{path} does not match: no photo has a name that begins with {prefix!r}")
    for taker, prefix in prefixes.items():
        if taker not in joined and len(rigs[taker[0]].cameras) > 1:
            raise InputError(
                f"{path} does not match: no photo in {prefix!r} has the same name as one of another camera of the rig, "
                "which would mean that both were taken at the same moment"
            )
    return taken_by


def expand_pairs(
    pairs: Sequence[ImagePair], rigs: Sequence[pycolmap.RigConfig], names: Sequence[str], path: Path
) -> tuple[ImagePair, ...]:
    """All pairs of the photos that rigs took at the moments of the two photos of a pair, for each of the pairs.

    names, path, and what is raised: as in assign_cameras.
    """
    moments: dict[tuple[int, str], list[str]] = {}
    moment_of = {}
    for name, taker in zip(names, assign_cameras(rigs, names, path)):
        if taker:
            key = (taker[0], name.rpartition(rigs[taker[0]].cameras[taker[1]].image_prefix)[2])
            moment_of[name] = moments.setdefault(key, [])
            moment_of[name].append(name)
    expanded: dict[ImagePair, None] = {}
    for pair in pairs:
        both = dict.fromkeys(name for one in (pair.name0, pair.name1) for name in moment_of.get(one, [one]))
        expanded |= dict.fromkeys(ImagePair.of(a, b) for a, b in itertools.combinations(both, 2))
    return tuple(expanded)


def lack_poses(rigs: Sequence[pycolmap.RigConfig]) -> bool:
    """Whether cameras have no cam_from_rig."""
    return any(camera.cam_from_rig is None and not camera.ref_sensor for rig in rigs for camera in rig.cameras)
