"""The keypoints of an existing COLMAP database, whoever made them, refined by homographies and propagated.

Its verified matches are the coarse matches: homographies are estimated around them, and what follows is as in a run of
our own, with the matched keypoints of the database as the seeds of tracks. Its cameras are kept.
"""

import dataclasses
import logging
import tempfile
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pycolmap

from hm_sfm.colmap.cameras import Cameras
from hm_sfm.colmap.database import copy_database, open_database, read_verified_matches
from hm_sfm.config import Config
from hm_sfm.errors import ConfigError, InputError
from hm_sfm.formats.hloc import name_group
from hm_sfm.geometry.frames import pixel_index_from_px
from hm_sfm.io.atomic import replace_file
from hm_sfm.io.colmap_log import quiet_colmap
from hm_sfm.io.locks import release_locks
from hm_sfm.matching.providers.choice import check_coarse
from hm_sfm.photos.images import read_ref
from hm_sfm.photos.masks import read_masks
from hm_sfm.pipeline.collection import Collection
from hm_sfm.pipeline.output_folder import claim_folder
from hm_sfm.pipeline.run import Run, load_matcher
from hm_sfm.pipeline.timings import Timings
from hm_sfm.types import ImagePair, ImageRef

logger = logging.getLogger(__name__)

VERIFIED_FILE = "verified.h5"
"""The matches of the database, in OUT, as a file of coarse matches."""


@dataclass(frozen=True)
class DatabaseContent:
    """What is refined of a database."""

    images: tuple[ImageRef, ...]
    """Sorted by name."""
    cameras: Cameras
    keypoints: dict[str, np.ndarray]
    """Image name -> (K, 2) float32 px."""
    matches: dict[ImagePair, np.ndarray]
    """The verified ones: (M, 2) int64 indices of keypoints."""


@release_locks()
def refine_database(
    database: Path, image_folder: Path, out: Path, config: Config, quiet: bool = False
) -> tuple[Run, Path]:
    """A COLMAP database -> OUT/database.db with refined and persistent keypoints, matches and two-view geometries.

    The given database is not touched. OUT/matches.h5 keeps the homographies; the same call goes on from there. Returns
    the run and the path of the new database.

    Raises InputError where the database has no verified matches, its photos are missing or of another size, or OUT is
    unusable, ConfigError where the configuration names other coarse matches, and what match_pairs raises.
    """
    database, out, timings = Path(database), Path(out), Timings()
    if config.matching.coarse_matches or config.matching.coarse != "light":
        raise ConfigError("refine starts from the matches of the database: it takes no --coarse or --coarse-matches")
    if database.resolve() == (out / "database.db").resolve():
        raise InputError(f"{database} would be replaced by its own refinement: name another OUT")
    content = read_database(database, Path(image_folder))
    masks = read_masks(content.images, config.masks)
    collection = Collection(Path(image_folder), content.images, tuple(sorted(content.matches)), content.cameras, masks)
    claim_folder(out, photos=Path(image_folder))
    write_point_pairs(out / VERIFIED_FILE, content)
    matching = dataclasses.replace(config.matching, coarse_matches=str(out / VERIFIED_FILE))
    config = dataclasses.replace(config, matching=matching)
    check_coarse(matching, collection.pairs)
    run = Run(collection, out, config, load_matcher(config), timings=timings, quiet=quiet)
    run.match()
    return run, run.write_database(*run.make_keypoints(run.verify().pairs, rank_keypoints(content)))


def read_database(path: Path, image_folder: Path) -> DatabaseContent:
    """The photos, cameras, keypoints and verified matches of a database. Raises InputError as refine_database does."""
    # COLMAP brings databases of earlier versions up to date as it opens them: not this one.
    with tempfile.TemporaryDirectory() as folder:
        copy = copy_database(path, Path(folder) / "copy.db")
        try:
            with quiet_colmap(pycolmap.logging.FATAL), open_database(copy) as database:
                rows = sorted(database.read_all_images(), key=lambda row: row.name)
                cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
                keypoints = {row.name: database.read_keypoints(row.image_id)[:, :2] for row in rows}
            matches = read_verified_matches(copy)
        except (RuntimeError, ValueError) as error:
            raise InputError(f"{path} is damaged or no COLMAP database") from error
    if not matches:
        raise InputError(f"{path} has no verified matches of its {len(rows)} images: match them with COLMAP first")
    images = tuple(read_ref(image_folder / row.name, row.name) for row in rows)
    mirrored = [image.name for image in images if image.mirrored]
    if mirrored:
        logger.warning(
            "%d photos are mirrored, such as %s: the keypoints in %s are taken for px of the photos as stored, not of "
            "the flipped ones", len(mirrored), mirrored[0], path
        )  # fmt: skip
    for image, row in zip(images, rows):
        check_size(path, image, cameras[row.camera_id], keypoints[image.name])
    ids = list(dict.fromkeys(row.camera_id for row in rows))
    kept = [pycolmap.Camera(cameras[camera_id].todict()) for camera_id in ids]
    for number, camera in enumerate(kept, start=1):
        camera.camera_id = number
    index = tuple(ids.index(row.camera_id) for row in rows)
    return DatabaseContent(images, Cameras(tuple(kept), index), keypoints, matches)


def check_size(path: Path, image: ImageRef, camera: pycolmap.Camera, xy: np.ndarray) -> None:
    """Raises InputError where the photo is of another size than its camera or than its keypoints' image."""
    width, height = image.size_wh
    if (camera.width, camera.height) != (width, height):
        raise InputError(
            f"the camera of {image.name!r} in {path} is of {camera.width} x {camera.height} px, the photo is {width} x "
            f"{height} px"
        )
    if not np.all((xy >= -1) & (xy <= np.array(image.size_wh) + 1)):
        raise InputError(f"{path} has keypoints outside of {image.name!r}, which is {width} x {height} px")


def rank_keypoints(content: DatabaseContent) -> dict[str, np.ndarray]:
    """The matched keypoints of each image, (K, 2) float64 px, those that are matched in most pairs first."""
    counts = {name: np.zeros(len(xy), np.int64) for name, xy in content.keypoints.items()}
    for pair, indices in content.matches.items():
        for side, name in enumerate((pair.name0, pair.name1)):
            counts[name] += np.bincount(indices[:, side], minlength=len(counts[name]))
    ranked = {}
    for name, count in counts.items():
        order = np.argsort(-count, kind="stable")[: np.count_nonzero(count)]
        ranked[name] = content.keypoints[name][order].astype(np.float64)
    return ranked


def write_point_pairs(path: Path, content: DatabaseContent) -> None:
    """The verified matches as a file for MatchFile, atomically; the same bytes for the same matches."""
    with replace_file(path) as temporary, h5py.File(temporary, "w") as h5:
        for pair in sorted(content.matches):
            group = h5.create_group(name_group(pair.name0, pair.name1))
            for side, name in enumerate((pair.name0, pair.name1)):
                xy = content.keypoints[name][content.matches[pair][:, side]]
                group[f"keypoints{side}"] = pixel_index_from_px(xy.astype(np.float64))
