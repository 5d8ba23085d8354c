"""Snapshots of a growing model: what a mapping that was killed goes on from.

COLMAP writes a snapshot file by file. When it is whole it moves to a folder of finished ones, under a name that says
what the model is made from and how many images it has: nothing half-written is ever there.
"""

import hashlib
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pycolmap

from hm_sfm.colmap.database import open_database
from hm_sfm.config import MappingConfig, fingerprint
from hm_sfm.io.atomic import move_folder

SNAPSHOT_FOLDER = "snapshots"


class Snapshots:
    """Keeps the newest snapshot of the largest model, and counts images as the incremental mapper registers them.

    Images here are frames, where there are rigs.
    """

    def __init__(self, folder: Path, growing: Path, made_from: str) -> None:
        """Look for snapshots that fit.

        folder: of finished snapshots, which may be missing. growing: a new folder, on the same disk, that COLMAP writes
        to. made_from: a fingerprint; snapshots of another one are not used.
        """
        self.folder, self.growing, self.made_from = Path(folder), Path(growing), made_from
        self.growing.mkdir()
        usable = {int(path.suffix[1:]): path for path in self.folder.glob(f"{made_from}.*")}
        self.stored = max(usable, default=0)
        """Images of the newest snapshot."""
        self.newest = usable.get(self.stored)
        """Its folder, None where there is none."""
        self.registered = 0
        """Images of the model that grows."""
        self._resumed = self.stored

    def begin_model(self) -> int:
        """A model has its first images: those of the newest snapshot, or the two of an initial pair. Their number."""
        self.registered = self._resumed or 2
        self._resumed = 0
        return self.registered

    def add_image(self) -> None:
        """Another image was registered, and what COLMAP may have written before is whole."""
        self.registered += 1
        for written in list(self.growing.iterdir()):
            if self.registered <= self.stored:  # a smaller model, after the largest
                shutil.rmtree(written)
                continue
            self.folder.mkdir(exist_ok=True)
            self.newest = self.folder / f"{self.made_from}.{self.registered}"
            self.stored = self.registered
            move_folder(written, self.newest)
            for older in set(list_snapshots(self.folder)) - {self.newest}:
                shutil.rmtree(older)


def list_snapshots(folder: Path) -> list[Path]:
    """The finished snapshots in a folder, of whatever they were made from; what else is there is not ours."""
    return [path for path in folder.glob("*/") if re.fullmatch(r"[0-9a-f]+\.[0-9]+", path.name)]


def discard_snapshots(folder: Path, work_folder: Path) -> None:
    """Move all snapshots to a new folder on the same disk, which is to be removed: none is left with files missing."""
    work_folder.mkdir()
    for path in list_snapshots(folder):
        os.replace(path, work_folder / path.name)
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


def digest_inputs(database_path: Path, config: MappingConfig, max_error_px: float, fix_intrinsics: bool) -> str:
    """A fingerprint of all that the incremental mapper starts from: 16 hex digits.

    Two-view geometries are left out: they follow from the matches. Raises InputError where there is no database.
    """
    digest = hashlib.sha256()

    def add(values: object, dtype: type) -> None:
        digest.update(np.ascontiguousarray(values, dtype).tobytes())

    with open_database(database_path) as database:
        for camera in database.read_all_cameras():
            digest.update(f"{camera.camera_id} {camera.model_name} {camera.has_prior_focal_length}".encode())
            add(camera.params, np.float64)
        for rig in database.read_all_rigs():
            digest.update(str(rig).encode())
            for pose in rig.non_ref_sensors.values():
                add([] if pose is None else pose.matrix(), np.float64)
        for image in database.read_all_images():
            digest.update(f"{image.image_id} {image.name!r} {image.camera_id} {image.frame_id}".encode())
            add(database.read_keypoints(image.image_id), np.float32)
        for pair_id in sorted(database.read_num_matches()[0]):
            digest.update(str(pair_id).encode())
            add(database.read_matches(*pycolmap.pair_id_to_image_pair(pair_id)), np.uint32)
    return fingerprint(digest.hexdigest(), config, max_error_px, fix_intrinsics, pycolmap.__version__)
