"""Undistorted copies of the photos of a model, and the pinhole cameras that belong to them.

The copies show the photos in the frame of the model's coordinates. They have no EXIF that asks for a rotation, which
readers would obey. What is transparent in a photo is so in its copy.
"""

import os
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

from hm_sfm.errors import InputError
from hm_sfm.io.pictures import encode_picture
from hm_sfm.photos.bitmaps import is_read_by_colmap, read_alpha, read_frame
from hm_sfm.photos.masks import Masks
from hm_sfm.types import ImageRef

WRITTEN_ENDINGS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
"""Of the kinds that COLMAP can write; other photos become JPEGs."""


@dataclass(frozen=True)
class _Copy:
    """What becomes of one photo."""

    image: ImageRef
    camera: pycolmap.Camera
    """As the model has it, with distortion."""
    pixels: np.ndarray | None
    """(H, W, 3) uint8 RGB; None where the file can stay as it is."""
    alpha: np.ndarray | None
    """(H, W) uint8: 0 is transparent; None where all is opaque."""
    mask: np.ndarray | None
    """(H, W) bool: what may be used, for a file of its own; None for none."""

    @property
    def name(self) -> str:
        """Of the copy: the photo's, with another ending where it becomes a file of another kind."""
        ending = Path(self.image.name).suffix.lower()
        if self.alpha is not None:
            return self.image.name if ending == ".png" else f"{self.image.name}.png"
        return self.image.name if self.pixels is None or ending in WRITTEN_ENDINGS else f"{self.image.name}.jpg"


def undistort_photos(
    model: pycolmap.Reconstruction, images: Sequence[ImageRef], folder: Path, masks: Masks, masks_as_alpha: bool
) -> None:
    """Write undistorted photos to folder/images, and change the model to one of them: names, cameras and keypoints.

    Its cameras are PINHOLE then. images: all of the model. masks: what is masked out becomes transparent where
    masks_as_alpha is set; else there is a mask folder/masks/<name of the copy>.png for each photo.

    Raises InputError where a photo cannot be read, is of another size than its camera, or spherical, and where a copy
    cannot be written.
    """
    ref_of = {image.name: image for image in images}
    posed = sorted(model.images.values(), key=lambda image: image.name)
    distorted = {camera_id: pycolmap.Camera(camera.todict()) for camera_id, camera in model.cameras.items()}
    for image in posed:
        check_camera(ref_of[image.name], distorted[image.camera_id])
    batch = os.cpu_count() or 1
    with ThreadPoolExecutor(batch) as executor:  # some at a time, so that memory is bounded
        for start in range(0, len(posed), batch):
            some = posed[start : start + batch]
            copies = [
                _read_photo(ref_of[image.name], distorted[image.camera_id], masks, masks_as_alpha) for image in some
            ]
            list(executor.map(lambda copy: _write_copy(copy, folder), copies))
            for image, copy in zip(some, copies):
                image.name = copy.name
    for camera_id, camera in model.cameras.items():
        pinhole = make_pinhole(distorted[camera_id])
        camera.model, camera.width, camera.height = pinhole.model, pinhole.width, pinhole.height
        camera.params = pinhole.params
    for image in posed:
        if not is_pinhole(distorted[image.camera_id]):
            _undistort_keypoints(model, image, distorted[image.camera_id])


def check_camera(image: ImageRef, camera: pycolmap.Camera) -> None:
    """Raises InputError where a photo cannot be undistorted by its camera."""
    if not camera.is_perspective():
        raise InputError(f"the camera of {image.path} is {camera.model_name}: spherical photos cannot be undistorted")
    if (camera.width, camera.height) != tuple(image.size_wh):
        raise InputError(
            f"{image.path} is {image.size_wh[0]} x {image.size_wh[1]} px but its camera in the model is of "
            f"{camera.width} x {camera.height} px: name the folder of its photos with --images"
        )


def is_pinhole(camera: pycolmap.Camera) -> bool:
    """Whether a camera has no distortion. A fisheye lens has, also where all its parameters are 0."""
    return camera.is_perspective_pinhole() and camera.is_undistorted()


def make_pinhole(camera: pycolmap.Camera) -> pycolmap.Camera:
    """The PINHOLE camera of undistorted photos, of the same size where the camera has no distortion."""
    if not is_pinhole(camera):
        return pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    pinhole = pycolmap.Camera.create_from_model_name(camera.camera_id, "PINHOLE", 1.0, camera.width, camera.height)
    pinhole.params = [
        camera.focal_length_x, camera.focal_length_y, camera.principal_point_x, camera.principal_point_y,
    ]  # fmt: skip
    return pinhole


def _read_photo(image: ImageRef, camera: pycolmap.Camera, masks: Masks, masks_as_alpha: bool) -> _Copy:
    """Raises InputError where the photo cannot be decoded."""
    alpha, mask = read_alpha(image), masks.unpack(image)
    can_stay = is_pinhole(camera) and not image.rotation_deg and not image.mirrored and is_read_by_colmap(image.path)
    if masks_as_alpha and mask is not None:
        alpha, mask = np.where(mask, 255 if alpha is None else alpha, 0).astype(np.uint8), None
        can_stay = False
    elif masks.packed and mask is None and not masks_as_alpha:
        mask = np.ones(image.size_wh[::-1], bool)  # readers want one for each photo, or none at all
    if can_stay:
        return _Copy(image, camera, None, None, mask)
    pixels = read_frame(image)
    if pixels is None:
        raise InputError(f"{image.path} cannot be decoded as an image")
    return _Copy(image, camera, pixels, alpha, mask)


def _write_copy(copy: _Copy, folder: Path) -> None:
    """Raises InputError where that fails."""
    path = folder / "images" / copy.name
    path.parent.mkdir(parents=True, exist_ok=True)
    if copy.pixels is None:
        shutil.copyfile(copy.image.path, path)
    elif copy.alpha is None:
        if not pycolmap.Bitmap.from_array(_undistort(copy.pixels, copy.camera)).write(path):
            raise InputError(f"cannot write the undistorted photo {path}: the disk may be full")
    else:
        layers = [_undistort(pixels, copy.camera) for pixels in (copy.pixels, copy.alpha)]
        Image.fromarray(np.dstack(layers)).save(path, "PNG")
    if copy.mask is not None:
        path = folder / "masks" / f"{copy.name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        visible = _undistort(copy.mask * np.uint8(255), copy.camera) > 127
        path.write_bytes(encode_picture(visible * np.uint8(255), ".png"))


def _undistort(pixels: np.ndarray, camera: pycolmap.Camera) -> np.ndarray:
    """(H, W) or (H, W, 3) uint8 -> the same, of the size of make_pinhole(camera)."""
    if is_pinhole(camera):
        return pixels
    bitmap, _ = pycolmap.undistort_image(
        pycolmap.UndistortCameraOptions(), pycolmap.Bitmap.from_array(np.ascontiguousarray(pixels)), camera
    )
    return bitmap.to_array().reshape(bitmap.height, bitmap.width, *pixels.shape[2:])


def _undistort_keypoints(model: pycolmap.Reconstruction, image: pycolmap.Image, distorted: pycolmap.Camera) -> None:
    """Move the keypoints of an image to where the undistorted photo shows them; without those that it cannot show."""
    if not len(image.points2D):
        return
    rays = np.asarray(distorted.cam_ray_from_img(np.array([point.xy for point in image.points2D])))
    xy = np.asarray(model.cameras[image.camera_id].img_from_cam(rays))  # NaN where there is none
    for index in range(len(image.points2D)):
        if np.isfinite(xy[index]).all():
            image.points2D[index].xy = xy[index]
        elif image.points2D[index].has_point3D():
            model.delete_observation(image.image_id, index)
