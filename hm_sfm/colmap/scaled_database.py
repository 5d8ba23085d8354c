"""Databases in px of the matching resolution, so that verification and mapping treat photos of all sizes alike.

COLMAP has one limit, in px, for all photos, and some that cannot be set at all. So whatever has a unit, cameras,
keypoints and two-view geometries, is divided by each photo's scale first, and multiplied by it afterwards.

Fisheye cameras with an unknown focal length are changed, too: COLMAP would look for the fundamental matrices of their
pairs, which do not exist, and finds essential ones with any focal length.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from hm_sfm.colmap.database import copy_database, open_database


def needs_scaling(px_scale: Mapping[str, float]) -> bool:
    """Whether stored photos differ from the matching resolution. px_scale: by image name; 1 where it is left out."""
    return any(scale != 1.0 for scale in px_scale.values())


def needs_copy(path: Path, px_scale: Mapping[str, float]) -> bool:
    """Whether COLMAP needs a copy_scaled of a database. Raises InputError where there is no database."""
    with open_database(path) as database:
        cameras = database.read_all_cameras()
    unknown = any(camera.is_perspective_fisheye() and not camera.has_prior_focal_length for camera in cameras)
    return unknown or needs_scaling(px_scale)


def scale_camera(camera: pycolmap.Camera, px_scale: float) -> pycolmap.Camera:
    """The camera of a photo that is reduced by px_scale. Parameters without a unit, like distortion, stay the same."""
    scaled = pycolmap.Camera(camera.todict())
    scaled.width, scaled.height = (max(1, round(size / px_scale)) for size in (camera.width, camera.height))
    params = np.array(camera.params)
    in_px = (*camera.focal_length_idxs(), *camera.principal_point_idxs(), *camera.metadata_params_idxs())
    params[list(in_px)] /= px_scale
    scaled.params = params.tolist()
    return scaled


def copy_scaled(path: Path, target: Path, px_scale: Mapping[str, float]) -> None:
    """Copy a database; cameras, keypoints and two-view geometries of the copy are px of the matching resolution.

    The focal lengths of fisheye cameras count as known in it. px_scale: by image name, px of the stored image per px of
    the matching resolution; 1 where it is left out. Images that share a camera are of one size, and so have one scale.
    Raises InputError where there is no database.
    """
    with open_database(path) as database:
        fisheye = [camera for camera in database.read_all_cameras() if camera.is_perspective_fisheye()]
    copy_database(path, target)
    if fisheye:
        claim_focal_lengths(target, [camera.camera_id for camera in fisheye])
    if not needs_scaling(px_scale):
        return
    with pycolmap.Database.open(target) as database, pycolmap.DatabaseTransaction(database):
        images = database.read_all_images()
        scale_of_camera = {image.camera_id: px_scale.get(image.name, 1.0) for image in images}
        for camera in database.read_all_cameras():
            database.update_camera(scale_camera(camera, scale_of_camera.get(camera.camera_id, 1.0)))
        for image in images:
            xy = database.read_keypoints(image.image_id)[:, :2].astype(np.float64)
            database.update_keypoints(image.image_id, (xy / px_scale.get(image.name, 1.0)).astype(np.float32))
        scale_of_image = {image.image_id: px_scale.get(image.name, 1.0) for image in images}
        for pair_id, geometry in zip(*database.read_two_view_geometries()):
            id0, id1 = pycolmap.pair_id_to_image_pair(pair_id)
            scale_geometry(geometry, scale_of_image[id0], scale_of_image[id1])
            database.update_two_view_geometry(id0, id1, geometry)


def claim_focal_lengths(path: Path, camera_ids: Sequence[int]) -> None:
    """Take the focal lengths of these cameras for known. Raises InputError where there is no database."""
    with open_database(path) as database, pycolmap.DatabaseTransaction(database):
        for camera_id in camera_ids:
            camera = database.read_camera(camera_id)
            camera.has_prior_focal_length = True
            database.update_camera(camera)


def scale_geometry(geometry: pycolmap.TwoViewGeometry, px_scale0: float, px_scale1: float) -> None:
    """Change F and H as if the photos were reduced by px_scale0 and px_scale1; all else has no unit."""
    scale0, scale1 = np.diag([px_scale0, px_scale0, 1.0]), np.diag([px_scale1, px_scale1, 1.0])
    if geometry.F is not None:
        geometry.F = scale1 @ geometry.F @ scale0
    if geometry.H is not None:
        geometry.H = np.linalg.inv(scale1) @ geometry.H @ scale0


def restore_px(
    model: pycolmap.Reconstruction, path: Path, px_scale: Mapping[str, float], fixed_intrinsics: bool
) -> None:
    """Bring a model that was built from a copy_scaled back to px of the stored photos.

    path: the database that was copied. fixed_intrinsics: the model has the intrinsics of the database, to the last bit.
    """
    with open_database(path) as database:
        original = {camera.camera_id: camera for camera in database.read_all_cameras()}
        scale_of_camera = {}
        for image in model.images.values():
            scale_of_camera[image.camera_id] = px_scale.get(image.name, 1.0)
            for point, xy in zip(image.points2D, database.read_keypoints(image.image_id)[:, :2].astype(np.float64)):
                point.xy = xy
    for camera_id, camera in model.cameras.items():
        params = scale_camera(camera, 1 / scale_of_camera.get(camera_id, 1.0)).params
        camera.params = original[camera_id].params if fixed_intrinsics else params
        camera.width, camera.height = original[camera_id].width, original[camera_id].height
    model.update_point_3d_errors()
