"""Mapping from one first guess of the cameras after another, until the model is good."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap

from hm_sfm.colmap.camera_starts import MOST_LISTED, CameraStart, list_starts
from hm_sfm.colmap.database import copy_database, open_database, replace_database
from hm_sfm.colmap.mapping_task import Build, MappingTask
from hm_sfm.colmap.model_judgement import ENOUGH_AGREEMENT, Judgement, find_undetermined, is_impossible, judge_model
from hm_sfm.colmap.scaled_database import copy_scaled, needs_copy, restore_px

logger = logging.getLogger(__name__)

# Where no start leads to a good model, another one than that of the database must explain so many times more matches.
CLEAR_GAIN = 1.05


@dataclass(frozen=True)
class Attempt:
    """The models of one start of the cameras, the largest first."""

    task: MappingTask
    start: CameraStart | None
    """None for the cameras of the database."""
    models: list[pycolmap.Reconstruction]
    judgement: Judgement | None
    """Of the largest model; None where there is none, or where its intrinsics are known."""

    @property
    def is_good(self) -> bool:
        """Whether nothing asks for another start."""
        return self.judgement is not None and self.judgement.is_good

    @property
    def explained(self) -> int:
        """The matches that it explains, 0 where its cameras are impossible."""
        return 0 if self.judgement is None or self.judgement.impossible else self.judgement.explained


def find_models(
    task: MappingTask,
    build: Build,
    map_leftovers: Callable[[set[int], MappingTask, Path], list[pycolmap.Reconstruction]],
    work_folder: Path,
) -> list[pycolmap.Reconstruction]:
    """The models of the first start of the cameras that leads to a good one, or else of the best start.

    map_leftovers: given the ids of the images that are in models, it builds more of the others. What is doubtful about
    the models is logged as a warning. If the start is not that of the database, the database gets its cameras.
    """
    if task.fix_intrinsics:
        best = _attempt(task, None, build, work_folder / "given")
    else:
        best = _keep_exif(_try_starts(task, build, work_folder), build, work_folder / "exif")
    registered = {image_id for model in best.models for image_id in model.reg_image_ids()}
    leftovers = build_scaled(best.task, partial(map_leftovers, registered), work_folder / "leftovers")
    models = [*best.models, *leftovers]
    if best.start and models:
        replace_database(best.task.database, task.database)
    if best.task.fix_intrinsics:
        return models
    models = _drop_impossible(models)
    if models and not best.models:
        for camera_id in find_undetermined(models[0])[:1]:
            _warn_of_undetermined(models[0].camera(camera_id))
    return models


def _try_starts(task: MappingTask, build: Build, work_folder: Path) -> Attempt:
    best = None
    for number, start in enumerate((None, *list_starts(task.database, task.split_cameras))):
        attempt = _attempt(task, start, build, work_folder / str(number))
        gain = 1.0 if attempt.is_good else CLEAR_GAIN
        if best is None or attempt.explained > gain * best.explained:
            best = attempt
        if best.is_good:
            break
    assert best is not None  # there is a start at least
    if best.start and best.explained:
        _warn_of_start(task.database, best)
    if best.judgement and best.judgement.agreement < ENOUGH_AGREEMENT and not best.judgement.impossible:
        logger.warning(
            "%d %% of the verified matches contradict the model of %d photos: it may be wrong; try --camera-mode "
            "per-image if photos were zoomed, --camera-params if the lens is known, or --masks for what moves along "
            "with the camera",
            round(100 * (1 - best.judgement.agreement)),
            best.models[0].num_reg_images(),
        )
    return best


def _keep_exif(best: Attempt, build: Build, folder: Path) -> Attempt:
    """Where the photos do not determine the focal lengths: models with those of EXIF, if they agree with the photos.

    Otherwise a warning is logged.
    """
    if best.judgement is None or best.judgement.impossible:
        return best
    undetermined = find_undetermined(best.models[0])
    if not undetermined:
        return best
    with open_database(best.task.database) as database:
        known = {camera.camera_id for camera in database.read_all_cameras() if camera.has_prior_focal_length}
    if known.issuperset(undetermined):
        fixed = _attempt(replace(best.task, fix_intrinsics=True), None, build, folder)
        if fixed.is_good and fixed.explained * CLEAR_GAIN >= best.explained:
            return replace(fixed, start=best.start)
    _warn_of_undetermined(best.models[0].camera(undetermined[0]))
    return best


def _warn_of_undetermined(camera: pycolmap.Camera) -> None:
    logger.warning(
        "the photos do not determine the focal length (%.0f px in the model): directions and heights may be wrong; add "
        "photos that look obliquely at the scene, or give it by --camera-model and --camera-params",
        camera.mean_focal_length(),
    )


def _attempt(task: MappingTask, start: CameraStart | None, build: Build, folder: Path) -> Attempt:
    """Build models from one start. folder: a new one, which then holds the database of the start."""
    folder.mkdir()
    if start:
        own_copy = copy_database(task.database, folder / "database.db")
        start.apply(own_copy)
        task = replace(task, database=own_copy)
    models = build_scaled(task, build, folder)
    sort_models(models)
    if not models:
        return Attempt(task, start, models, None)
    with open_database(task.database) as database:
        pair_ids, geometries = database.read_two_view_geometries()
    verified = {
        pycolmap.pair_id_to_image_pair(pair_id): geometry.inlier_matches.astype(np.int64).reshape(-1, 2)
        for pair_id, geometry in zip(pair_ids, geometries)
    }
    return Attempt(task, start, models, judge_model(models[0], verified))


def _drop_impossible(models: Sequence[pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    """The models with cameras that a lens can be like; each other one is logged as a warning."""
    kept = []
    for model in models:
        cameras = [model.camera(model.image(image_id).camera_id) for image_id in model.reg_image_ids()]
        wrong = next((camera for camera in cameras if is_impossible(camera)), None)
        if wrong is None:
            kept.append(model)
        else:
            logger.warning(
                "a model of %d photos is left out, because no lens is like its camera (%s: %s); try --camera-model and "
                "--camera-params, --camera-mode per-image, or --masks for what moves along with the camera",
                model.num_reg_images(),
                wrong.params_info,
                ", ".join(f"{value:.3g}" for value in wrong.params),
            )
    return kept


def _warn_of_start(path: Path, attempt: Attempt) -> None:
    """Say what was changed about the cameras of a database."""
    assert attempt.start
    with open_database(path) as database:
        given = [camera for camera in database.read_all_cameras() if camera.has_prior_focal_length]
    first = (
        f"the focal length in EXIF ({_list_focal_lengths(given)})" if given else "the first guess of the focal length"
    )
    cameras = list(attempt.models[0].cameras.values())
    logger.warning(
        "%s led to no good model: it was built with %s (%s)", first, attempt.start.name, _list_focal_lengths(cameras)
    )


def _list_focal_lengths(cameras: Sequence[pycolmap.Camera]) -> str:
    focal_px = sorted({round(camera.mean_focal_length()) for camera in cameras})
    more = f" and {len(focal_px) - MOST_LISTED} more" if len(focal_px) > MOST_LISTED else ""
    return ", ".join(f"{value} px" for value in focal_px[:MOST_LISTED]) + more


def sort_models(models: list[pycolmap.Reconstruction]) -> None:
    models.sort(key=lambda model: (model.num_reg_images(), model.num_points3D()), reverse=True)


def build_scaled(task: MappingTask, build: Build, folder: Path) -> list[pycolmap.Reconstruction]:
    """What `build` makes of the database in px of the matching resolution, in px of the stored photos."""
    raw = folder / "mapper"
    raw.mkdir(parents=True)
    if not needs_copy(task.database, task.px_scale):
        return build(task, raw)
    scaled = folder / "scaled.db"
    copy_scaled(task.database, scaled, task.px_scale)
    models = build(replace(task, database=scaled), raw)
    for model in models:
        restore_px(model, task.database, task.px_scale, task.fix_intrinsics)
        model.extract_colors_for_all_images(task.image_folder)
    return models
