"""Other first guesses of the cameras, where matches contradict the first ones or these lead to no good model.

They are written into a verified database.
"""

import logging
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap

from hm_sfm.colmap.cameras import FOCAL_RATIOS, guess_focal_px
from hm_sfm.colmap.database import copy_database, open_database
from hm_sfm.io.colmap_log import quiet_colmap

logger = logging.getLogger(__name__)

WIDER, LONGER = 0.6, 1.8
"""Guesses of focal lengths beside the first one, relative to it."""
MOST_LISTED = 3
"""Focal lengths that a warning names."""


@dataclass(frozen=True)
class CameraStart:
    """A first guess of all cameras of a database."""

    name: str
    """What is guessed, to finish the sentence: the model is built with ..."""
    apply: Callable[[Path], object]
    """Changes the cameras of a database."""


def list_starts(path: Path, may_split: bool) -> tuple[CameraStart, ...]:
    """The starts that may help, the most promising first. may_split: photos need not share cameras.

    Raises InputError where there is no database.
    """
    with open_database(path) as database:
        cameras = database.read_all_cameras()
        may_split = may_split and len(cameras) < database.num_images()
        may_split = may_split and not any(rig.num_sensors() > 1 for rig in database.read_all_rigs())
    starts = []
    is_fisheye = any(camera.is_perspective_fisheye() for camera in cameras)
    if not is_fisheye:  # their pairs have no fundamental matrix
        starts.append(CameraStart("focal lengths estimated from the pairs", estimate_focal_lengths))
        if may_split:
            starts.append(CameraStart("a camera for each photo", partial(estimate_focal_lengths, split=True)))
    starts += [
        CameraStart(f"focal lengths of {factor} times the first guess", partial(guess_focal_lengths, factor=factor))
        for factor in (WIDER, LONGER)
    ]
    return tuple(starts)


def guess_focal_lengths(path: Path, factor: float = 1.0) -> None:
    """Forget all focal lengths, and take `factor` times the first guess of photos without EXIF."""
    with open_database(path) as database, pycolmap.DatabaseTransaction(database):
        for camera in database.read_all_cameras():
            _set_focal_px(camera, factor * guess_focal_px(camera.model, (camera.width, camera.height)))
            database.update_camera(camera)


def estimate_focal_lengths(path: Path, split: bool = False) -> None:
    """Take the focal lengths that the fundamental matrices of the pairs agree on, by COLMAP's calibration.

    Where there are none, as where all cameras look at one point, the first guess of photos without EXIF is taken.
    split: first give each photo a camera of its own.
    """
    guess_focal_lengths(path)
    if split:
        split_cameras(path)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".calibration.") as folder:
        copy = copy_database(path, Path(folder) / "copy.db")  # calibration changes its two-view geometries
        low, high = FOCAL_RATIOS
        options = pycolmap.ViewGraphCalibrationOptions(
            random_seed=0, reestimate_relative_pose=False, min_focal_length_ratio=low, max_focal_length_ratio=high
        )
        with quiet_colmap(pycolmap.logging.FATAL):
            is_calibrated = pycolmap.calibrate_view_graph(copy, options)
        if not is_calibrated:
            return
        with open_database(copy) as database:
            focal_px = {camera.camera_id: camera.mean_focal_length() for camera in database.read_all_cameras()}
    with open_database(path) as database, pycolmap.DatabaseTransaction(database):
        for camera in database.read_all_cameras():
            _set_focal_px(camera, focal_px[camera.camera_id])
            database.update_camera(camera)


def split_cameras(path: Path) -> None:
    """Give each photo a camera of its own, with the intrinsics that it has now. There are no rigs afterwards."""
    with open_database(path) as database, pycolmap.DatabaseTransaction(database):
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
        images = database.read_all_images()
        database.clear_frames()
        database.clear_rigs()
        kept = set()
        for image in images:
            if image.camera_id in kept:  # others have it as theirs: it cannot be removed
                camera = pycolmap.Camera(cameras[image.camera_id].todict())
                image.camera_id = database.write_camera(camera)
            kept.add(image.camera_id)
            row = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
            database.update_image(row)
        with quiet_colmap(pycolmap.logging.FATAL):
            pycolmap.apply_rig_config([], database)


def correct_focal_lengths(path: Path) -> None:
    """Replace the known focal lengths that most pairs contradict by estimates from the pairs, with a warning.

    Raises InputError where there is no database.
    """
    doubtful = find_doubtful(path)
    if not doubtful:
        return
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".estimates.") as folder:
        copy = copy_database(path, Path(folder) / "copy.db")
        estimate_focal_lengths(copy)
        with open_database(copy) as database:
            estimates = {camera.camera_id: camera for camera in database.read_all_cameras()}
    with open_database(path) as database, pycolmap.DatabaseTransaction(database):
        changes = []
        for camera_id in doubtful:
            given_px = database.read_camera(camera_id).mean_focal_length()
            changes.append(f"{given_px:.0f} px by {estimates[camera_id].mean_focal_length():.0f} px")
            database.update_camera(estimates[camera_id])
    more = f" and {len(changes) - MOST_LISTED} more" if len(changes) > MOST_LISTED else ""
    logger.warning(
        "the focal length in EXIF contradicts the matches (cropped photos?): estimates from the pairs replace it, %s%s",
        ", ".join(changes[:MOST_LISTED]),
        more,
    )


def find_doubtful(path: Path) -> tuple[int, ...]:
    """Ids of the cameras whose known focal length most of their pairs contradict.

    Their matches agree with a fundamental matrix, and clearly fewer of them with an essential one. Raises InputError
    where there is no database.
    """
    with open_database(path) as database:
        known = {camera.camera_id for camera in database.read_all_cameras() if camera.has_prior_focal_length}
        camera_of = {image.image_id: image.camera_id for image in database.read_all_images()}
        pair_ids, geometries = database.read_two_view_geometries()
    kinds = pycolmap.TwoViewGeometryConfiguration
    votes = dict.fromkeys(known, 0)
    for pair_id, geometry in zip(pair_ids, geometries):
        cameras = {camera_of[image_id] for image_id in pycolmap.pair_id_to_image_pair(pair_id)}
        if cameras <= known:
            for camera_id in cameras:
                votes[camera_id] += {int(kinds.UNCALIBRATED): 1, int(kinds.CALIBRATED): -1}.get(geometry.config, 0)
    return tuple(sorted(camera_id for camera_id, vote in votes.items() if vote > 0))


def _set_focal_px(camera: pycolmap.Camera, focal_px: float) -> None:
    """Set a focal length that is no more than a guess, and no distortion."""
    guess = pycolmap.Camera.create_from_model_id(1, camera.model, focal_px, camera.width, camera.height)
    params = np.array(guess.params)
    centre = list(camera.principal_point_idxs())
    params[centre] = camera.params[centre]
    camera.params = params.tolist()
    camera.has_prior_focal_length = False
