"""Cameras of the photos: which of them share one, and its intrinsics, from EXIF or from the user."""

import difflib
import logging
import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import pycolmap

from hm_sfm.colmap.models import find_known
from hm_sfm.colmap.rigs import assign_cameras, read_rigs
from hm_sfm.config import CameraConfig
from hm_sfm.errors import ConfigError, InputError
from hm_sfm.photos.bitmaps import read_bitmap, read_camera_label
from hm_sfm.types import ImageRef

logger = logging.getLogger(__name__)

# The first guess of a focal length that nothing is known about, relative to the longer side. COLMAP's 1.2 is too long
# for most phones and videos, which have 0.5 to 1.1: adjustment of a flat scene may then run off to a telephoto lens.
DEFAULT_FOCAL_RATIO = 0.9
# For fisheye lenses, whose pixels are angles: the longer side then spans 140 degrees.
DEFAULT_FISHEYE_RATIO = 0.41
# Focal lengths beyond these, relative to the longer side (views of 157 and 6 degrees), are refused by COLMAP's mapper.
FOCAL_RATIOS = (0.1, 10.0)


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
    and EXIF lens (or have none), and otherwise one per folder, size and lens. The focal length comes from EXIF, except
    for impossible ones, which are ignored with a warning, or is guess_focal_px; it is refined. `config.params` are
    known intrinsics for every camera; EXIF is then not read. `config.file` and `config.poses` name a COLMAP model that
    has them; it also says which images share a camera. `config.rig` names a rig configuration: each camera of a rig is
    then a camera for itself; its intrinsics, where the configuration has them, are refined.

    Raises ConfigError on an unknown model, on unusable params, where intrinsics are given twice and where other
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
    exif = [_ExifFocal(None, None)] * len(images) if params else _read_exif_focals(images)

    groups: dict[Hashable, list[int]] = {}
    for index, key in enumerate(_camera_keys(images, exif, config.mode, known=bool(params))):
        groups.setdefault(("rig", taken_by[index]) if taken_by[index] else key, []).append(index)

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
            camera.params = list(in_rig.params) if in_rig else params
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
    folders: list[Hashable] = [PurePosixPath(image.name).parent for image in images]
    if mode == "single":
        return [None] * len(images)
    if mode == "per-folder":
        return folders
    if mode == "per-image":
        return [image.name for image in images]
    lenses = [(image.size_wh, lens) for image, lens in zip(images, exif)]
    if known or len(set(lenses)) == 1:
        return [None] * len(images)
    return list(zip(folders, lenses))


def _read_exif_focals(images: Sequence[ImageRef]) -> list[_ExifFocal]:
    """What EXIF tells, without focal lengths that are impossible: these are ignored with a warning."""
    exif = [_read_exif_focal(image) for image in images]
    low, high = FOCAL_RATIOS
    wrong = [
        index
        for index, (image, focal) in enumerate(zip(images, exif))
        if focal.focal_px and not low < focal.focal_px / max(image.size_wh) < high
    ]
    if wrong:
        image = images[wrong[0]]
        logger.warning(
            "the focal length in EXIF is ignored for %d of %d photos, because no lens has it: %.4g px for %s (%s)",
            len(wrong),
            len(images),
            exif[wrong[0]].focal_px,
            image.name,
            _size(image),
        )
    for index in wrong:
        exif[index] = replace(exif[index], focal_px=None)
    return exif


def _read_exif_focal(image: ImageRef) -> _ExifFocal:
    bitmap = read_bitmap(image.path, as_rgb=False)
    if bitmap is None:
        raise InputError(f"cannot read {image.path}: it is not an image that COLMAP can open")
    return _ExifFocal(bitmap.exif_focal_length(), read_camera_label(bitmap))


def guess_focal_px(model: pycolmap.CameraModelId, size_wh: tuple[int, int]) -> float:
    """The first guess of a focal length that nothing is known about, for photos of this size."""
    is_fisheye = pycolmap.Camera.create_from_model_id(1, model, 1.0, *size_wh).is_perspective_fisheye()
    return (DEFAULT_FISHEYE_RATIO if is_fisheye else DEFAULT_FOCAL_RATIO) * max(size_wh)


def _make_camera(
    camera_id: int, model: pycolmap.CameraModelId, size_wh: tuple[int, int], focal_px: float | None
) -> pycolmap.Camera:
    camera = pycolmap.Camera.create_from_model_id(
        camera_id, model, focal_px or guess_focal_px(model, size_wh), *size_wh
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
