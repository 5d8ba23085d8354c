"""The COLMAP database: written with images, positions from EXIF, keypoints and matches; read for verified matches.

All of it goes through pycolmap.
"""

import os
import shutil
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap

from hm_sfm.colmap.cameras import Cameras
from hm_sfm.errors import InputError
from hm_sfm.io.colmap_log import quiet_colmap
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints

# What SQLite leaves beside a database whose writer was killed; beside a new file they would damage it.
SQLITE_LEFTOVERS = ("-wal", "-shm", "-journal")


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
            raise ValueError(f"keypoints of {points.name!r} are given for the image {image.name!r}")
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
                _write_image(database, image_ids[image.name], image, cameras.cameras[index].camera_id, points)
            for pair_matches in matches:
                if len(pair_matches):
                    pair = pair_matches.pair
                    database.write_matches(image_ids[pair.name0], image_ids[pair.name1], pair_matches.indices)
        if cameras.rigs:
            with pycolmap.Database.open(temporary) as database, pycolmap.DatabaseTransaction(database), quiet_colmap():
                pycolmap.apply_rig_config(list(cameras.rigs), database)
        replace_database(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
        _remove_leftovers(temporary)


def _write_image(
    database: pycolmap.Database, image_id: int, image: ImageRef, camera_id: int, keypoints: Keypoints
) -> None:
    """The rows of one image: the image, a frame of its own, its keypoints and, with GPS, its pose prior."""
    row = pycolmap.Image(name=image.name, camera_id=camera_id, image_id=image_id)
    database.write_image(row, use_image_id=True)
    frame = pycolmap.Frame(frame_id=image_id, rig_id=camera_id)
    frame.add_data_id(row.data_id)
    database.write_frame(frame, use_frame_id=True)
    database.write_keypoints(image_id, keypoints.xy)
    if image.gps and image.gps[2] is not None:  # as COLMAP, which wants an altitude, too
        wgs84 = pycolmap.PosePriorCoordinateSystem.WGS84
        prior = pycolmap.PosePrior(position=image.gps, coordinate_system=wgs84, corr_data_id=row.data_id)
        database.write_pose_prior(prior)


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


def copy_database(path: Path, target: Path) -> Path:
    """Copy a database to a new file, with all that has been written to it by now; returns the new path.

    A program that has it open, such as COLMAP's GUI, keeps the latest in a file beside it. Raises InputError where
    there is no database, or it cannot be read as SQLite.
    """
    if not path.is_file():
        raise InputError(f"there is no database {path}")
    beside = [path.with_name(path.name + ending) for ending in SQLITE_LEFTOVERS]
    if not any(file.is_file() and file.stat().st_size for file in beside):
        shutil.copy(path, target)  # reading by SQLite would leave a file beside it
        return target
    try:
        uri = f"{path.absolute().as_uri()}?mode=ro"
        with closing(sqlite3.connect(uri, uri=True)) as source, closing(sqlite3.connect(target)) as copy:
            source.backup(copy)
    except sqlite3.Error as error:
        raise InputError(f"cannot read the database {path}, which is in use: {error}") from error
    return target


def replace_database(new: Path, path: Path) -> None:
    """Move a closed database to the place of another one, on the same disk."""
    _remove_leftovers(path)
    os.replace(new, path)


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
