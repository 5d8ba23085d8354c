"""The result of a run in the formats of other programs, through pycolmap.

| format | what is written |
|---|---|
| hloc | a folder: features.h5, matches.h5, pairs.txt, see hm_sfm.formats.hloc |
| nerfstudio | a folder: undistorted images/, masks/ where there are any, transforms.json, points3D.ply |
| 3dgs | a folder: undistorted images/, transparent where they are masked, sparse/0 with PINHOLE cameras |
| ply | a file: the points and their colours |
| txt | a folder: the model as COLMAP's text files |
"""

import hashlib
import json
import logging
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

from hm_sfm.colmap.database import open_database
from hm_sfm.colmap.models import read_model
from hm_sfm.config import MaskConfig
from hm_sfm.errors import InputError
from hm_sfm.export.point_clouds import move_to_origin, write_ply
from hm_sfm.export.undistorted_photos import undistort_photos
from hm_sfm.formats.hloc import write_features, write_matches
from hm_sfm.formats.pairs_files import read_pairs, write_pairs
from hm_sfm.io.atomic import make_folder, replace_file, write_json
from hm_sfm.io.markers import MADE_MARKER
from hm_sfm.photos.images import read_run_ref
from hm_sfm.photos.masks import read_masks
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints

logger = logging.getLogger(__name__)

MAX_NAME_BYTES = 240
"""Of a file in one folder. Most file systems allow 255; some are left for the endings of copies that readers make."""
GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])
"""Cameras of OpenGL look along -z with y up, those of COLMAP along z with y down."""


def convert_run(
    out: Path, to: str, target: Path, image_folder: Path | None = None, masks: MaskConfig | None = None
) -> None:
    """Write the largest model of the run in `out`, or its database for hloc, in the format `to` to `target`.

    target: a new file for ply, a new or empty folder for all others; it appears whole or not at all.
    image_folder, masks: the photos and their masks, if they are no longer where they were in the run.

    Raises InputError where the run has no model or database, where photos or masks are missing or photos cannot be
    undistorted, where hloc cannot tell image names apart, and where the target is there already.
    """
    out, target = Path(out), Path(target)
    if to == "ply":
        convert_to_ply(out, target)
        return
    with make_folder(target) as folder:
        if to == "txt":
            convert_to_txt(out, folder)
        elif to == "hloc":
            convert_to_hloc(out, folder)
        elif to == "nerfstudio":
            convert_to_nerfstudio(out, folder, image_folder, masks)
        else:
            convert_to_3dgs(out, folder, image_folder, masks)


def find_photos(out: Path, image_folder: Path | None) -> Path:
    """The folder of the photos of a run. Raises InputError where it is not there."""
    if image_folder is None:
        try:
            image_folder = Path(json.loads((out / "summary.json").read_text())["image_folder"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{out / 'summary.json'} does not say where the photos are: give --images") from error
    if not Path(image_folder).is_dir():
        raise InputError(f"the folder of photos {image_folder} does not exist: name it with --images")
    return Path(image_folder)


def find_masks(out: Path) -> MaskConfig:
    """The masks that a run was made with. Raises InputError where they are no longer there."""
    try:
        made_with = MaskConfig(**json.loads((out / "summary.json").read_text())["masks"])
    except (OSError, ValueError, KeyError, TypeError):  # runs of earlier versions do not say
        return MaskConfig()
    for path, option in ((made_with.folder, "--masks"), (made_with.camera, "--camera-mask")):
        if path and not Path(path).exists():
            raise InputError(f"the run was made with the masks {path}, which do not exist: name them with {option}")
    return made_with


def convert_to_ply(out: Path, target: Path) -> None:
    """The points of the model with their colours, as a binary PLY file of doubles."""
    model = _read_result(out)
    if target.exists():
        raise InputError(f"{target} is there already: name a new file")
    target.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(target) as temporary:
        write_ply(temporary, model)


def convert_to_txt(out: Path, folder: Path) -> None:
    """COLMAP's text files. Image names with spaces are logged as a warning: COLMAP cannot read them back."""
    model = _read_result(out)
    spaced = [image.name for image in model.images.values() if " " in image.name]
    if spaced:
        logger.warning("COLMAP cannot read names with spaces from text files, such as %r", min(spaced))
    model.write_text(folder)


def convert_to_hloc(out: Path, folder: Path) -> None:
    """features.h5 and matches.h5 from the database of a run, and its pairs.txt. hloc scales its limits by 1 px."""
    with open_database(out / "database.db") as database:
        rows = sorted(database.read_all_images(), key=lambda row: row.image_id)
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
        images, keypoints = [], []
        for row in rows:
            camera = cameras[row.camera_id]
            images.append(ImageRef(row.name, Path(row.name), (camera.width, camera.height)))
            xy = database.read_keypoints(row.image_id)[:, :2]
            keypoints.append(Keypoints(row.name, xy, np.ones(len(xy)), np.ones(len(xy))))
        pair_ids, all_indices = database.read_all_matches()
    name_of = {row.image_id: row.name for row in rows}
    matches = []
    for pair_id, indices in zip(pair_ids, all_indices):
        names = [name_of[image_id] for image_id in pycolmap.pair_id_to_image_pair(pair_id)]
        indices = indices if names[0] < names[1] else indices[:, ::-1]
        matches.append(IndexMatches(ImagePair.of(*names), indices, np.ones(len(indices))))
    pairs = read_pairs(out / "pairs.txt", list(name_of.values()))
    write_features(folder / "features.h5", images, keypoints, {image.name: 1.0 for image in images})
    write_matches(folder / "matches.h5", pairs, keypoints, matches)
    write_pairs(folder / "pairs.txt", pairs)


def convert_to_3dgs(out: Path, folder: Path, image_folder: Path | None, masks: MaskConfig | None) -> None:
    """Undistorted images and their model with PINHOLE cameras, laid out for Gaussian splatting.

    Its readers take the images from one folder by their last names, so that subfolders become part of the names. What
    is transparent is left out of training: that is what masks become.
    """
    model = undistort_run(out, folder, image_folder, masks, masks_as_alpha=True)
    names = flatten_names([image.name for image in model.images.values()])
    for image in model.images.values():
        if names[image.name] != image.name:
            os.replace(folder / "images" / image.name, folder / "images" / names[image.name])
            image.name = names[image.name]
    for path in sorted((folder / "images").rglob("*"), reverse=True):
        if path.is_dir():
            path.rmdir()
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write_binary(folder / "sparse" / "0")


def convert_to_nerfstudio(out: Path, folder: Path, image_folder: Path | None, masks: MaskConfig | None) -> None:
    """Undistorted images, masks, transforms.json and the points."""
    model = undistort_run(out, folder, image_folder, masks, masks_as_alpha=False)
    write_ply(folder / "points3D.ply", model)
    transforms = {
        "camera_model": "PINHOLE",
        "ply_file_path": "points3D.ply",
        **describe_frames(model, has_masks=(folder / "masks").is_dir()),
    }
    (folder / "transforms.json").write_text(json.dumps(transforms, indent=2) + "\n")


def describe_frames(model: pycolmap.Reconstruction, has_masks: bool = False) -> dict[str, object]:
    """Cameras and poses of a model of PINHOLE cameras as transforms.json has them, files in images/ and masks/.

    Intrinsics stand at the top where all images share them, else in each frame; transform_matrix is world_from_cam of
    a camera as in OpenGL.
    """
    frames = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        camera = model.cameras[image.camera_id]
        world_from_cam = np.eye(4)
        world_from_cam[:3] = image.cam_from_world().inverse().matrix()
        fx, fy, cx, cy = map(float, camera.params)
        intrinsics = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": camera.width, "h": camera.height}
        pose = {"file_path": f"images/{image.name}", "transform_matrix": (world_from_cam @ GL_FROM_CV).tolist()}
        if has_masks:
            pose["mask_path"] = f"masks/{image.name}.png"
        frames.append((intrinsics, pose))
    if all(intrinsics == frames[0][0] for intrinsics, _ in frames):
        return {**frames[0][0], "frames": [pose for _, pose in frames]}
    return {"frames": [{**intrinsics, **pose} for intrinsics, pose in frames]}


def undistort_run(
    out: Path, folder: Path, image_folder: Path | None, masks: MaskConfig | None, masks_as_alpha: bool
) -> pycolmap.Reconstruction:
    """Write the undistorted photos of the model to `folder`, see undistort_photos; returns the model of them.

    Where it lies far from the origin it is moved there, and folder/offset.json says how far. Raises InputError where a
    photo is missing or cannot be undistorted, or a mask is unusable.
    """
    model = _read_result(out)
    names = [image.name for image in model.images.values()]
    photos = find_photos(out, image_folder)
    missing = [name for name in names if not (photos / name).is_file()]
    if missing:
        raise InputError(
            f"{photos} lacks {len(missing)} of {len(names)} photos of the model, for example {missing[0]!r}: name the "
            "folder of photos with --images"
        )
    images = [read_run_ref(photos / name, name) for name in names]
    undistort_photos(model, images, folder, read_masks(images, masks or find_masks(out)), masks_as_alpha)
    (folder / MADE_MARKER).touch()
    offset = move_to_origin(model)
    if offset:
        write_json(folder / "offset.json", {"offset": offset})
        logger.warning(
            "the coordinates are too large for single precision: they are written less the offset (%s), which "
            "offset.json keeps",
            ", ".join(f"{value:.12g}" for value in offset),
        )
    return model


def flatten_names(names: Sequence[str]) -> dict[str, str]:
    """Names without folders that stay different, also where case does not count: a/b.jpg becomes a_b.jpg.

    What would be longer than a name of a file may be begins with a digest instead of its first folders.
    """
    flat: dict[str, str] = {}
    taken: set[str] = set()
    # Names without folders come first: they keep theirs.
    for name in sorted(names, key=lambda name: ("/" in name, name)):
        short = name.replace("/", "_")
        if len(short.encode()) > MAX_NAME_BYTES:
            digest = hashlib.sha256(name.encode()).hexdigest()[:8]
            short = f"{digest}_{short.encode()[len(digest) + 1 - MAX_NAME_BYTES :].decode(errors='ignore')}"
        while short.lower() in taken:
            short = f"_{short}"
        taken.add(short.lower())
        flat[name] = short
    return flat


def _read_result(out: Path) -> pycolmap.Reconstruction:
    folder = out / "sparse" / "0"
    if not folder.is_dir():
        raise InputError(f"{out} holds no model (sparse/0): run hm-sfm reconstruct first")
    return read_model(folder)
