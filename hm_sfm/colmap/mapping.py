"""Mapping, triangulation and bundle adjustment, through pycolmap.

Ctrl-C raises KeyboardInterrupt out of each of these functions within a second or so: pycolmap asks for signals while
it works; the last adjustment of a model, the global mapper and triangulation run through. What is written to disk
appears at once and complete, or not at all.
"""

import logging
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from hm_sfm.colmap.alignment import keep_frame
from hm_sfm.colmap.cameras import Cameras
from hm_sfm.colmap.database import copy_database, open_database, replace_database
from hm_sfm.colmap.mapping_attempts import build_scaled, find_models, sort_models
from hm_sfm.colmap.mapping_task import MappingTask
from hm_sfm.colmap.model_folders import replace_models, restore_models
from hm_sfm.colmap.rigs import lack_poses
from hm_sfm.colmap.scaled_database import needs_scaling
from hm_sfm.colmap.snapshots import SNAPSHOT_FOLDER, Snapshots, digest_inputs, discard_snapshots
from hm_sfm.io.colmap_log import quiet_colmap
from hm_sfm.photos.bitmaps import open_to_colmap
from hm_sfm.types import ImageRef, MappingResult

logger = logging.getLogger(__name__)

# Global bundle adjustment each time the model grew by 30 %, not COLMAP's 10 %: about a fifth less time on dense
# keypoints, at the same result; local bundle adjustment follows every image anyway.
GLOBAL_ADJUSTMENT_RATIO = 1.3

# While a model grows, its adjustments end where they gain less than this (relative); the last one, over everything, is
# exact. Half the time of COLMAP's own limits; points and poses are the same to a tenth of their error.
GLOBAL_TOLERANCE = 1e-4
LOCAL_TOLERANCE = 1e-3
GLOBAL_REFINEMENTS = 2
LOCAL_REFINEMENTS = 1

# Images, or frames of rigs, that a model gains from one snapshot to the next: mapping them takes longer by far than
# writing it.
SNAPSHOT_IMAGES = 20


def map_images(task: MappingTask, images: Sequence[ImageRef], cameras: Cameras) -> tuple[pycolmap.Reconstruction, ...]:
    """Build models from a verified database: triangulate_images where the poses are known, else by `config.mapper`.

    images, cameras: those that the database was written with; `cameras.known` decides whether the intrinsics are fixed.
    Where their rigs lack poses, calibrate_rigs finds them first. Results, and what is raised, are otherwise those of
    map_incrementally.
    """
    with open_to_colmap(images, task.image_folder) as readable_folder:
        task = replace(task, image_folder=readable_folder, fix_intrinsics=cameras.known)
        if cameras.cam_from_world:
            return triangulate_images(task, images, cameras)
        if lack_poses(cameras.rigs):
            calibrate_rigs(task, cameras.rigs)
        return map_by_config(task)


def map_by_config(task: MappingTask) -> tuple[pycolmap.Reconstruction, ...]:
    """map_incrementally or map_globally, as `config.mapper` says."""
    return map_globally(task) if task.config.mapper == "global" else map_incrementally(task)


def calibrate_rigs(task: MappingTask, rigs: Sequence[pycolmap.RigConfig]) -> bool:
    """Find the poses that `rigs` lack, and write them to the database, as COLMAP's rig_configurator does it.

    A model is built as if there were no rigs, by `config.mapper`; the poses are averages over it. COLMAP needs them to
    map with rigs. Returns whether all were calibrated; where not, the database has no rigs any more, and a warning is
    logged.
    """
    database_path = Path(task.database)
    with _make_work_folder(database_path.parent, ".rigs.") as work_folder:
        own_copy = work_folder / "database.db"
        copy_database(database_path, own_copy)
        with quiet_colmap(pycolmap.logging.FATAL), pycolmap.Database.open(own_copy) as database:
            pycolmap.apply_rig_config([], database)
        without_rigs = replace(
            task, database=own_copy, sparse_folder=work_folder / "sparse", split_cameras=False, on_image=None
        )
        models = map_by_config(without_rigs)
        with quiet_colmap(pycolmap.logging.FATAL), pycolmap.Database.open(own_copy) as database:
            if models:
                pycolmap.apply_rig_config(list(rigs), database, models[0])
            sensors = [pose for rig in database.read_all_rigs() for pose in rig.non_ref_sensors.values()]
            is_complete = bool(sensors) and all(pose is not None for pose in sensors)
            if not is_complete:
                pycolmap.apply_rig_config([], database)
        replace_database(own_copy, database_path)
    if not is_complete:
        logger.warning(
            "the rigs are left out: no model has photos of all their cameras, from which the missing "
            "cam_from_rig_rotation and cam_from_rig_translation could be estimated"
        )
    return is_complete


def map_incrementally(task: MappingTask) -> tuple[pycolmap.Reconstruction, ...]:
    """Build models from a verified database with COLMAP's incremental mapper, then adjust and filter each of them.

    The mapper may register an image again in another model or attempt: on_image is called again, too. Unless the
    intrinsics are fixed, the models are judged, and where they cannot be right, other first guesses of the cameras are
    tried: the best is kept, the database gets its cameras, and a warning is logged, as also where the photos do not
    determine the focal length. Models with impossible cameras are left out. Two photos that are joined to no others
    have a model, too.

    While a model grows, the folder `snapshots` beside the sparse folder holds its newest snapshot. The same call goes
    on from there after it was killed; snapshots of another database or configuration are not used.

    Returns the models, most registered images first, then most points; the sparse folder has them in this order.
    Without a model, what was there stays. Raises InputError where there is no database.
    """
    return _write_models(task, partial(find_models, task, _run_mapper, _map_leftovers))


def map_globally(task: MappingTask) -> tuple[pycolmap.Reconstruction, ...]:
    """As map_incrementally, with COLMAP's global mapper: the rotations of all images, then all positions and points.

    Focal lengths that nothing is known about are estimated first, from all pairs together; where that does not lead to
    a model of all images, the guess of make_cameras is tried, too. on_image is called when all is done. The global
    mapper cannot be interrupted.

    It needs matches that are one to one and tracks with one keypoint per image, which IndexMatches and
    persist_keypoints guarantee: it stops at a match that occurs twice, and drops tracks whose observations in one image
    are more than 10 px apart.
    """
    return _write_models(task, partial(find_models, task, _run_global_mapper, _map_leftovers))


def triangulate_images(
    task: MappingTask, images: Sequence[ImageRef], cameras: Cameras
) -> tuple[pycolmap.Reconstruction, ...]:
    """The points of a verified database by the poses `cameras.cam_from_world`; poses and intrinsics stay as they are.

    images, cameras: those that the database was written with. on_image is called when all is done.

    Returns one model with all images, or none where there are no points; the sparse folder is as map_incrementally
    leaves it. Raises InputError where there is no database.
    """
    build = partial(_run_triangulator, images, cameras)
    return _write_models(task, partial(build_scaled, replace(task, fix_intrinsics=True), build), has_frame=True)


def _write_models(
    task: MappingTask, find: Callable[[Path], list[pycolmap.Reconstruction]], has_frame: bool = False
) -> tuple[pycolmap.Reconstruction, ...]:
    """Sort the models that `find` makes, given a folder to work in, and write them to the sparse folder.

    They are moved to the frame of the models that are there, unless has_frame says that they have one of their own, and
    replace them, see replace_models. Snapshots of them are then removed, and so is what killed processes left. Without
    verified matches there is nothing to build. Raises InputError where there is no database.
    """
    sparse_folder = Path(task.sparse_folder)
    sparse_folder.parent.mkdir(parents=True, exist_ok=True)
    with open_database(task.database) as database:
        can_map = database.num_inlier_matches() > 0  # rejected pairs count as verified pairs, without inliers
    prefix = f".{sparse_folder.name}."
    for left in sparse_folder.parent.glob(f"{prefix}*/"):
        restore_models(sparse_folder, left)
    with _make_work_folder(sparse_folder.parent, prefix) as work_folder:
        models: list[pycolmap.Reconstruction] = []
        if can_map:
            # The one error that COLMAP logs here is that there is no model, which the caller is told anyway.
            with quiet_colmap(pycolmap.logging.FATAL):
                models = find(work_folder)
        sort_models(models)

        if not has_frame:
            keep_frame(models, sparse_folder)
        replace_models(models, sparse_folder, work_folder)
        discard_snapshots(sparse_folder.with_name(SNAPSHOT_FOLDER), work_folder / SNAPSHOT_FOLDER)
    return tuple(models)


@contextmanager
def _make_work_folder(parent: Path, prefix: str) -> Iterator[Path]:
    """A folder for the block, in the place of those that killed processes left."""
    for left in parent.glob(f"{prefix}*/"):
        shutil.rmtree(left)
    with tempfile.TemporaryDirectory(dir=parent, prefix=prefix) as folder:
        yield Path(folder)


def _run_mapper(task: MappingTask, output_folder: Path) -> list[pycolmap.Reconstruction]:
    options = _pipeline_options(task)
    made_from = digest_inputs(task.database, task.config, task.max_error_px, task.fix_intrinsics)
    snapshot_folder = Path(task.sparse_folder).with_name(SNAPSHOT_FOLDER)
    snapshots = Snapshots(snapshot_folder, output_folder.with_name("growing"), made_from)
    options.snapshot_path = snapshots.growing
    options.snapshot_frames_freq = SNAPSHOT_IMAGES
    on_image = task.on_image or (lambda: None)

    def on_first_images() -> None:
        for _ in range(snapshots.begin_model()):
            on_image()

    def on_next_image() -> None:
        snapshots.add_image()
        on_image()

    models = pycolmap.incremental_mapping(
        task.database,
        task.image_folder,
        output_folder,
        options,
        input_path=snapshots.newest or "",
        initial_image_pair_callback=on_first_images,
        next_image_callback=on_next_image,
    )
    for model in models.values():
        _adjust(model, options)
    return list(models.values())


def _map_leftovers(registered: set[int], task: MappingTask, output_folder: Path) -> list[pycolmap.Reconstruction]:
    """Models of the photos that verified pairs join to each other, but to no registered one.

    Of these, the matches of just two photos count as well. COLMAP leaves them out, because they are less reliable than
    those that a third photo confirms: where there is no third photo, it never has a model.
    """
    with open_database(task.database) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        pair_ids, counts = database.read_two_view_geometry_num_inliers()
    pairs = [pycolmap.pair_id_to_image_pair(pair_id) for pair_id, count in zip(pair_ids, counts) if count]
    if registered.issuperset(image_id for pair in pairs for image_id in pair):
        return []
    count = max(names) + 1
    edges = coo_array((np.ones(len(pairs)), tuple(np.array(pairs).T)), shape=(count, count))
    _, group = connected_components(edges, directed=False)
    mapped = {group[image_id] for image_id in registered}
    left = sorted({image_id for pair in pairs for image_id in pair if group[image_id] not in mapped})
    if not left:
        return []
    options = _pipeline_options(task)
    options.triangulation.ignore_two_view_tracks = False
    options.image_names = [names[image_id] for image_id in left]
    found = pycolmap.incremental_mapping(
        task.database,
        task.image_folder,
        output_folder,
        options,
        initial_image_pair_callback=lambda: _report_images(2, task.on_image),
        next_image_callback=lambda: _report_images(1, task.on_image),
    )
    for model in found.values():
        _adjust(model, options)
    return list(found.values())


def _pipeline_options(task: MappingTask) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = task.config.seed
    options.min_model_size = task.config.min_model_size
    options.mapper.filter_max_reproj_error = task.max_error_px
    options.extract_colors = not needs_scaling(task.px_scale)  # the mapper would look for them at the scaled keypoints
    options.ba_global_frames_ratio = GLOBAL_ADJUSTMENT_RATIO
    options.ba_global_points_ratio = GLOBAL_ADJUSTMENT_RATIO
    options.ba_global_function_tolerance = GLOBAL_TOLERANCE
    options.ba_local_function_tolerance = LOCAL_TOLERANCE
    options.ba_global_max_refinements = GLOBAL_REFINEMENTS
    options.ba_local_max_refinements = LOCAL_REFINEMENTS
    if task.fix_intrinsics:
        options.ba_refine_focal_length = False
        options.ba_refine_principal_point = False
        options.ba_refine_extra_params = False
        options.max_extra_param = np.inf  # known distortion, however strong, is no sign of a failed calibration
    return options


def _run_global_mapper(task: MappingTask, output_folder: Path) -> list[pycolmap.Reconstruction]:
    with open_database(task.database) as database:
        cameras = database.read_all_cameras()
        pair_ids, geometries = database.read_two_view_geometries()
    verified = [pair_id for pair_id, geometry in zip(pair_ids, geometries) if len(geometry.inlier_matches)]
    num_connected = len({image_id for pair_id in verified for image_id in pycolmap.pair_id_to_image_pair(pair_id)})
    unknown_focal = not task.fix_intrinsics and not all(camera.has_prior_focal_length for camera in cameras)

    def rank(models: list[pycolmap.Reconstruction]) -> tuple[int, int]:
        return max(((model.num_reg_images(), model.num_points3D()) for model in models), default=(0, 0))

    best: list[pycolmap.Reconstruction] = []
    # Where all cameras look at one point, two views say nothing about the focal length, and calibration may return
    # anything: the first guess, which adjustment refines, is then the better start.
    for calibrate in (True, False) if unknown_focal else (False,):
        own_copy = output_folder / "database.db"  # calibration writes to it
        copy_database(task.database, own_copy)
        if calibrate:
            long_edge_px = max(max(camera.width, camera.height) for camera in cameras)
            max_error_px = task.max_error_px / 1000 * long_edge_px
            options = pycolmap.ViewGraphCalibrationOptions(random_seed=task.config.seed, relpose_max_error=max_error_px)
            if not pycolmap.calibrate_view_graph(own_copy, options):
                continue
        best = max(best, _map_all(replace(task, database=own_copy), output_folder), key=rank)
        if rank(best)[0] == num_connected:
            break
    _report_images(sum(model.num_reg_images() for model in best), task.on_image)
    return best


def _map_all(task: MappingTask, output_folder: Path) -> list[pycolmap.Reconstruction]:
    """The global mapper's models, adjusted, without the images that hardly any point supports."""
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = task.config.seed
    options.min_model_size = task.config.min_model_size
    if task.fix_intrinsics:
        options.mapper.bundle_adjustment.refine_focal_length = False
        options.mapper.bundle_adjustment.refine_principal_point = False
        options.mapper.bundle_adjustment.refine_extra_params = False
        options.mapper.retriangulation.max_extra_param = np.inf
    models = list(pycolmap.global_mapping(task.database, task.image_folder, output_folder, options).values())
    adjustment = _pipeline_options(task)
    for model in models:
        _adjust(model, adjustment)
        # It poses every image, the incremental mapper only those that so many points agree with.
        min_points = adjustment.mapper.abs_pose_min_num_inliers
        frames = {image.frame_id for image in model.images.values() if image.num_points3D >= min_points}
        for frame_id in set(model.reg_frame_ids()) - frames:
            model.deregister_frame(frame_id)
    return [model for model in models if model.num_reg_images() >= task.config.min_model_size]


def _run_triangulator(
    images: Sequence[ImageRef], cameras: Cameras, task: MappingTask, output_folder: Path
) -> list[pycolmap.Reconstruction]:
    model = pycolmap.Reconstruction()
    with open_database(task.database) as database:
        for camera in database.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
    rows = zip(images, cameras.camera_index, cameras.cam_from_world, strict=True)
    for image_id, (image, index, cam_from_world) in enumerate(rows, start=1):  # the ids of write_database
        row = pycolmap.Image(name=image.name, camera_id=cameras.cameras[index].camera_id, image_id=image_id)
        model.add_image_with_trivial_frame(row, cam_from_world)
    options = _pipeline_options(task)
    triangulate = partial(pycolmap.triangulate_points, model, task.database, task.image_folder, output_folder)
    model = triangulate(options=options)
    if not model.num_points3D():  # where no three photos see the same, two must do
        options.triangulation.ignore_two_view_tracks = False
        model = triangulate(options=options)
    if not model.num_points3D():
        return []
    model.update_point_3d_errors()
    _report_images(model.num_reg_images(), task.on_image)
    return [model]


def _report_images(count: int, on_image: Callable[[], object] | None) -> None:
    """Call on_image for each of so many registered images."""
    if on_image:
        for _ in range(count):
            on_image()


def _adjust(model: pycolmap.Reconstruction, options: pycolmap.IncrementalPipelineOptions) -> None:
    """Adjust all of a model once more, and drop observations as COLMAP's mapper does after each adjustment."""
    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.refine_focal_length = options.ba_refine_focal_length
    adjustment.refine_principal_point = options.ba_refine_principal_point
    adjustment.refine_extra_params = options.ba_refine_extra_params
    adjustment.print_summary = False
    extent = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        extent.add_image(image_id)
    extent.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # Not pycolmap.bundle_adjustment, which does the same but turns COLMAP's messages back on.
    pycolmap.create_default_bundle_adjuster(adjustment, extent, model).solve()
    limits = options.mapper
    pycolmap.ObservationManager(model).filter_all_points3D(limits.filter_max_reproj_error, limits.filter_min_tri_angle)
    model.update_point_3d_errors()


def summarise_models(models: Sequence[pycolmap.Reconstruction], num_images: int) -> MappingResult:
    """The metrics of the largest model, `models[0]`; all 0 where there is none.

    num_images: of the collection, registered or not. A track's length is the number of distinct images that see it;
    mean_reprojection_px is the mean over the points of each point's mean error, as COLMAP prints it.
    """
    if not models:
        return MappingResult((), num_images, 0, 0, 0, 0.0, 0.0)
    model = models[0]
    points = model.num_points3D()
    sightings = sum(
        len({point2D.point3D_id for point2D in image.get_observation_points2D()}) for image in model.images.values()
    )
    return MappingResult(
        models=tuple(models),
        num_images=num_images,
        registered=model.num_reg_images(),
        points=points,
        observations=model.compute_num_observations(),
        mean_track_length=sightings / points if points else 0.0,
        mean_reprojection_px=model.compute_mean_reprojection_error(),
    )
