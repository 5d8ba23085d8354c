"""The COLMAP database: cameras from EXIF or from the user, then images with positions from EXIF, keypoints and matches.

All of it through pycolmap.
"""

import difflib
import math
import os
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import pycolmap

from hm_sfm.colmap.models import find_known
from hm_sfm.colmap.rigs import assign_cameras, read_rigs
from hm_sfm.config import CameraConfig
from hm_sfm.errors import ConfigError, InputError
from hm_sfm.io.colmap_log import quiet_colmap
from hm_sfm.photos.bitmaps import read_bitmap
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints

# The first guess of a focal length that nothing is known about, relative to the longer side. COLMAP's 1.2 is too long
# for most phones and videos, which have 0.5 to 1.1: adjustment of a flat scene may then run off to a telephoto lens.
DEFAULT_FOCAL_RATIO = 0.9

# What SQLite leaves beside a database whose writer was killed; beside a new file they would damage it.
SQLITE_LEFTOVERS = ("-wal", "-shm", "-journal")


@dataclass(frozen=True)
class Cameras:
    """The cameras of a collection, and which one took which image."""

    cameras: tuple[pycolmap.Camera, ...]
    """camera_id is the position + 1. has_prior_focal_length is set where EXIF or the user gave the focal length."""
    camera_index: tuple[int, ...]
    """Per image, in the order of the images: index into `cameras`."""
    known: bool = False
    """Whether the intrinsics are known and stay as they are."""
    cam_from_world: tuple[pycolmap.Rigid3d, ...] = ()
    """Per image, in the order of the images; empty where the poses are not known."""
    rigs: tuple[pycolmap.RigConfig, ...] = ()
    """Each camera of a rig is one of `cameras`, with the images whose names begin with its image_prefix."""


@dataclass(frozen=True)
class _ExifFocal:
    """What EXIF tells about the lens. `label` holds make, model and focal length, as COLMAP compares cameras."""

    focal_px: float | None
    label: str | None


def make_cameras(images: Sequence[ImageRef], config: CameraConfig) -> Cameras:
    """Decide which images share a camera, and set its intrinsics (px of the stored image, COLMAP's frame).

    Modes: `single`, `per-folder` and `per-image` say it all. `auto` takes one camera where all images agree in size
    and EXIF lens (or have none), and otherwise one per folder, size and lens. The focal length comes from EXIF, or is
    0.9 times the longer side, to be refined. `config.params` are known intrinsics for every camera; EXIF is then not
    read. `config.file` and `config.poses` name a COLMAP model that has them; it also says which images share a camera.
    `config.rig` names a rig configuration: each camera of a rig is then a camera for itself; its intrinsics, where the
    configuration has them, are refined.

    Raises ConfigError on an unknown mode or model, on unusable params, where intrinsics are given twice and where other
    settings contradict the rigs; InputError where images that have to share a camera differ in size, where an image
    cannot be read, and what find_known, read_rigs and assign_cameras raise.
    """
    given = [name for name in ("params", "file", "poses") if getattr(config, name)]
    if len(given) > 1:
        raise ConfigError(f"cameras.{given[0]} and cameras.{given[1]} both give the intrinsics: leave one of them out")
    rigs = _read_rigs(config)
    taken_by = assign_cameras(rigs, [image.name for image in images], Path(config.rig))
    if config.file or config.poses:
        return _take_cameras(images, config, rigs, taken_by)
    model = _parse_model(config.model)
    params = _parse_params(config.params, model)
    exif = [_ExifFocal(None, None) if params else _read_exif_focal(image) for image in images]

    groups: dict[Hashable, list[int]] = {}
    for index, key in enumerate(_camera_keys(images, exif, config.mode, known=bool(params))):
        groups.setdefault(("rig", *taken_by[index]) if taken_by[index] else key, []).append(index)

    cameras = []
    camera_index = [0] * len(images)
    for members in groups.values():
        first = images[members[0]]
        for member in members:
            camera_index[member] = len(cameras)
            if images[member].size_wh != first.size_wh:
                raise InputError(
                    f"{first.name} ({_size(first)}) and {images[member].name} ({_size(images[member])}) cannot share "
                    f"a camera as {config.rig if taken_by[member] else f'camera mode {config.mode!r}'} asks for: their "
                    "sizes differ"
                )
        focal_px = next((exif[member].focal_px for member in members if exif[member].focal_px), None)
        camera = _make_camera(len(cameras) + 1, model, first.size_wh, focal_px)
        in_rig = _find_intrinsics(rigs, taken_by[members[0]])
        if params or in_rig:
            if in_rig:
                camera.model = in_rig.model
            camera.params = in_rig.params if in_rig else params
            camera.has_prior_focal_length = True
            if camera.has_bogus_params(0.0, math.inf, math.inf):
                raise ConfigError(
                    f"camera params {config.params or camera.params_to_string()!r} do not fit {first.name}: the focal "
                    f"length must be positive and the principal point within {_size(first)}"
                )
        cameras.append(camera)
    return Cameras(tuple(cameras), tuple(camera_index), known=bool(params), rigs=rigs)


def _read_rigs(config: CameraConfig) -> tuple[pycolmap.RigConfig, ...]:
    """The rigs, if any. Raises ConfigError where other settings contradict them, and what read_rigs raises."""
    if not config.rig:
        return ()
    if config.mode not in ("auto", "per-folder"):
        raise ConfigError(
            f"cameras.rig gives each camera of a rig intrinsics of its own: leave out camera mode {config.mode!r}"
        )
    if config.poses:
        raise ConfigError("cameras.poses gives the pose of each photo, which leaves nothing to cameras.rig: drop one")
    rigs = read_rigs(Path(config.rig))
    has_intrinsics = any(camera.camera is not None for rig in rigs for camera in rig.cameras)
    for name in ("params", "file"):
        if getattr(config, name) and has_intrinsics:
            raise ConfigError(
                f"cameras.{name} and the rig configuration {config.rig} both give the intrinsics: drop one"
            )
    return rigs


def _find_intrinsics(rigs: Sequence[pycolmap.RigConfig], taker: tuple[int, int] | None) -> pycolmap.Camera | None:
    return rigs[taker[0]].cameras[taker[1]].camera if taker else None


def _take_cameras(
    images: Sequence[ImageRef],
    config: CameraConfig,
    rigs: tuple[pycolmap.RigConfig, ...],
    taken_by: Sequence[tuple[int, int] | None],
) -> Cameras:
    """The cameras of a COLMAP model, and its poses where these are asked for."""
    known, poses = find_known(Path(config.poses or config.file), images)
    # A camera that several cameras of a rig share becomes one each: what is known stays the same.
    keys = [(camera.camera_id, taker) for camera, taker in zip(known, taken_by)]
    number_of = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    in_rigs = [taker for _, taker in number_of if taker]
    if len(set(in_rigs)) < len(in_rigs):
        raise InputError(f"a rig needs one camera for each image_prefix in {config.rig}, {config.file} has several")
    camera_index = tuple(number_of[key] for key in keys)
    cameras = [known[camera_index.index(number)] for number in range(len(number_of))]
    for camera_id, camera in enumerate(cameras, start=1):
        camera.camera_id = camera_id
        camera.has_prior_focal_length = True
    return Cameras(tuple(cameras), camera_index, True, tuple(poses) if config.poses else (), rigs)


def _camera_keys(images: Sequence[ImageRef], exif: Sequence[_ExifFocal], mode: str, known: bool) -> list[Hashable]:
    """Per image, what it must have in common with another to share its camera."""
    folders = [PurePosixPath(image.name).parent for image in images]
    if mode == "single":
        return [None] * len(images)
    if mode == "per-folder":
        return folders
    if mode == "per-image":
        return [image.name for image in images]
    if mode != "auto":
        raise ConfigError(f"camera mode must be auto, single, per-folder or per-image, found {mode!r}")
    lenses = [(image.size_wh, lens) for image, lens in zip(images, exif)]
    if known or len(set(lenses)) == 1:
        return [None] * len(images)
    return list(zip(folders, lenses))


def _read_exif_focal(image: ImageRef) -> _ExifFocal:
    bitmap = read_bitmap(image.path, as_rgb=False)
    if bitmap is None:
        raise InputError(f"cannot read {image.path}: it is not an image that COLMAP can open")
    return _ExifFocal(bitmap.exif_focal_length(), bitmap.exif_camera_model())


def _make_camera(
    camera_id: int, model: pycolmap.CameraModelId, size_wh: tuple[int, int], focal_px: float | None
) -> pycolmap.Camera:
    camera = pycolmap.Camera.create_from_model_id(
        camera_id, model, focal_px or DEFAULT_FOCAL_RATIO * max(size_wh), *size_wh
    )
    camera.has_prior_focal_length = focal_px is not None
    return camera


def _parse_model(name: str) -> pycolmap.CameraModelId:
    models = {
        known: model
        for known, model in pycolmap.CameraModelId.__members__.items()
        if model != pycolmap.CameraModelId.INVALID and _make_camera(1, model, (2, 2), None).is_perspective()
    }
    if name not in models:
        near = difflib.get_close_matches(name.upper(), models, n=1, cutoff=0.0)
        raise ConfigError(f"unknown camera model {name!r}: did you mean {near[0]!r}?")
    return models[name]


def _parse_params(text: str, model: pycolmap.CameraModelId) -> tuple[float, ...]:
    """The numbers of `f,...`; none where text is empty."""
    if not text:
        return ()
    names = _make_camera(1, model, (2, 2), None).params_info
    count = len(names.split(","))
    try:
        params = tuple(float(word) for word in text.split(","))
    except ValueError:
        params = ()
    if len(params) != count or not all(math.isfinite(value) for value in params):
        raise ConfigError(f"camera model {model.name} expects {count} numbers ({names}), found {text!r}")
    return params


def _size(image: ImageRef) -> str:
    return f"{image.size_wh[0]} x {image.size_wh[1]} px"


def write_database(
    path: Path,
    images: Sequence[ImageRef],
    cameras: Cameras,
    keypoints: Sequence[Keypoints],
    matches: Sequence[IndexMatches],
) -> None:
    """Write a fresh COLMAP database, replacing the file at `path` when it is complete.

    keypoints: one per image, in the order of the images; they are in COLMAP's frame already and are stored bit for
    bit as float32 (K, 2). matches: any pairs of these images; empty ones are left out. Image ids are 1..N in the order
    of the images; each camera has a rig of its own, each image a frame of its own, except for those of `cameras.rigs`.
    Positions from EXIF become pose priors (latitude, longitude, altitude), for COLMAP's tools: the mappers here do not
    use them.

    Raises ValueError where the arguments contradict each other.
    """
    if not len(images) == len(cameras.camera_index) == len(keypoints):
        raise ValueError(
            f"{len(images)} images need as many camera indices and keypoints, "
            f"got {len(cameras.camera_index)} and {len(keypoints)}"
        )
    image_ids = {image.name: image_id for image_id, image in enumerate(images, start=1)}
    for image, points in zip(images, keypoints):
        if points.name != image.name:
            raise ValueError(f"keypoints of {points.name!r} stand in the place of image {image.name!r}")
    for pair_matches in matches:
        _check_matches(pair_matches, keypoints, image_ids)

    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with pycolmap.Database.open(temporary) as database, pycolmap.DatabaseTransaction(database):
            for camera in cameras.cameras:
                database.write_camera(camera, use_camera_id=True)
                rig = pycolmap.Rig(rig_id=camera.camera_id)
                rig.add_ref_sensor(camera.sensor_id)
                database.write_rig(rig, use_rig_id=True)
            for image, index, points in zip(images, cameras.camera_index, keypoints):
                image_id = image_ids[image.name]
                row = pycolmap.Image(name=image.name, camera_id=cameras.cameras[index].camera_id, image_id=image_id)
                database.write_image(row, use_image_id=True)
                frame = pycolmap.Frame(frame_id=image_id, rig_id=row.camera_id)
                frame.add_data_id(row.data_id)
                database.write_frame(frame, use_frame_id=True)
                database.write_keypoints(image_id, points.xy)
                if image.gps:
                    wgs84 = pycolmap.PosePriorCoordinateSystem.WGS84
                    prior = pycolmap.PosePrior(position=image.gps, coordinate_system=wgs84, corr_data_id=row.data_id)
                    database.write_pose_prior(prior)
            for pair_matches in matches:
                if len(pair_matches):
                    pair = pair_matches.pair
                    database.write_matches(image_ids[pair.name0], image_ids[pair.name1], pair_matches.indices)
        if cameras.rigs:
            with pycolmap.Database.open(temporary) as database, pycolmap.DatabaseTransaction(database), quiet_colmap():
                pycolmap.apply_rig_config(list(cameras.rigs), database)
        _remove_leftovers(path)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
        _remove_leftovers(temporary)


def _check_matches(matches: IndexMatches, keypoints: Sequence[Keypoints], image_ids: dict[str, int]) -> None:
    """COLMAP trusts the indices: one beyond the keypoints would crash it, so it is refused here."""
    for side, name in enumerate((matches.pair.name0, matches.pair.name1)):
        if name not in image_ids:
            raise ValueError(f"matches of {matches.pair} name an image that is not in the collection: {name!r}")
        count = len(keypoints[image_ids[name] - 1])
        if len(matches) and matches.indices[:, side].max() >= count:
            raise ValueError(f"matches of {matches.pair} point beyond the {count} keypoints of {name!r}")


def _remove_leftovers(path: Path) -> None:
    for ending in SQLITE_LEFTOVERS:
        path.with_name(path.name + ending).unlink(missing_ok=True)


def open_database(path: Path) -> pycolmap.Database:
    """Open an existing COLMAP database, for use in a `with`. Raises InputError where there is no such file."""
    if not Path(path).is_file():  # pycolmap would create it
        raise InputError(f"there is no database {path}")
    return pycolmap.Database.open(path)


def read_verified_matches(path: Path) -> dict[ImagePair, np.ndarray]:
    """The matches of each pair that agree with its two-view geometry, (M, 2) int64 indices of keypoints, M > 0.

    Raises InputError where there is no database.
    """
    with open_database(path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        pair_ids, geometries = database.read_two_view_geometries()
    verified = {}
    for pair_id, geometry in zip(pair_ids, geometries):
        name0, name1 = (names[image_id] for image_id in pycolmap.pair_id_to_image_pair(pair_id))
        matches = geometry.inlier_matches.astype(np.int64).reshape(-1, 2)
        if len(matches):
            verified[ImagePair.of(name0, name1)] = matches if name0 < name1 else matches[:, ::-1]
    return verified
