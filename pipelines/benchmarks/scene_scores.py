"""What benchmark_scenes.py measures: metrics of a model, and how many of its verified pairs a reference confirms."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from hm_sfm.colmap.database import open_database
from hm_sfm.evaluation.poses import measure_angle_deg, measure_rotation_deg, relative_pose
from hm_sfm.evaluation.relative_poses import PointMatches, estimate_pose_colmap

ROTATION_DEG, DIRECTION_DEG = 5.0, 10.0
"""A verified pair is correct where rotation and direction of translation are off by no more."""


@dataclass(frozen=True)
class SceneScore:
    scene: str
    method: str
    images: int
    registered: int
    """In the largest model."""
    verified: int
    """Image pairs with a two-view geometry."""
    judged: int | None
    """Of these, the pairs that the reference knows; None without a reference."""
    correct: int | None
    points: int
    track_length: float
    """In distinct images."""
    reprojection_px: float
    seconds: float
    """From the photos to the model; of an interrupted run, what was left to do."""


def read_reference(folder: Path) -> pycolmap.Reconstruction | None:
    """The first COLMAP model at or below `folder`, None where there is none."""
    files = sorted(folder.rglob("images.bin"))
    return pycolmap.Reconstruction(files[0].parent) if files else None


def count_verified(path: Path) -> int:
    """Pairs of a database that have a two-view geometry."""
    with open_database(path) as database:
        _, geometries = database.read_two_view_geometries()
    return sum(len(geometry.inlier_matches) > 0 for geometry in geometries)  # rejected pairs are stored without


def judge_pairs(path: Path, reference: pycolmap.Reconstruction, max_error_px: float) -> tuple[int, int]:
    """Of a database's verified pairs: how many the reference knows, and how many of these are correct.

    max_error_px: within which points agree with a geometry, as when the pairs were verified.
    """
    posed = {image.name: image for image in reference.images.values() if image.has_pose}
    correct = []
    with open_database(path) as database:
        name_of = {image.image_id: image.name for image in database.read_all_images()}
        for pair_id, geometry in zip(*database.read_two_view_geometries()):
            ids = pycolmap.pair_id_to_image_pair(pair_id)
            if len(geometry.inlier_matches) and all(name_of[image_id] in posed for image_id in ids):
                xy = [database.read_keypoints(i)[rows] for i, rows in zip(ids, geometry.inlier_matches.T)]
                views = [posed[name_of[image_id]] for image_id in ids]
                correct.append(is_correct(views, xy, max_error_px))
    return len(correct), sum(correct)


def is_correct(views: Sequence[pycolmap.Image], xy: Sequence[np.ndarray], max_error_px: float) -> bool:
    """Whether the points of two images, (M, 2) px, give the relative pose of their views in the reference."""
    ks = [view.camera.calibration_matrix() for view in views]
    # What a pinhole camera would have seen instead: the estimate knows no distortion.
    rays = [view.camera.cam_from_img(points.astype(np.float64)) for view, points in zip(views, xy)]
    usable = np.isfinite(np.hstack(rays)).all(axis=1)
    flat = [ray[usable] @ k[:2, :2].T + k[:2, 2] for ray, k in zip(rays, ks)]
    estimate = estimate_pose_colmap(PointMatches(*flat), *ks, max_error_px)
    true = relative_pose(*(view.cam_from_world().matrix() for view in views))
    return estimate is not None and bool(
        measure_rotation_deg(estimate[:, :3], true[:, :3]) <= ROTATION_DEG
        and measure_angle_deg(estimate[:, 3], true[:, 3]) <= DIRECTION_DEG
    )


def add_up(scores: Sequence[SceneScore]) -> SceneScore:
    """The metrics of one method over all scenes: sums, and means over all points."""
    points = sum(score.points for score in scores)

    def average(field: str) -> float:
        return sum(getattr(score, field) * score.points for score in scores) / max(points, 1)

    def count(field: str) -> int | None:
        known = [getattr(score, field) for score in scores if getattr(score, field) is not None]
        return sum(known) if known else None

    summed = {field: count(field) for field in ("images", "registered", "verified", "judged", "correct", "seconds")}
    means = {"track_length": average("track_length"), "reprojection_px": average("reprojection_px")}
    return SceneScore(scene="all", method=scores[0].method, points=points, **summed, **means)


def tabulate(scores: Sequence[SceneScore]) -> list[dict[str, object]]:
    """Rows of the table: all scores by scene, then, where there are several scenes, each method over all of them."""
    methods = list(dict.fromkeys(score.method for score in scores))
    by_method = [[score for score in scores if score.method == method] for method in methods]
    totals = [add_up(of_method) for of_method in by_method if len(of_method) > 1]
    return [
        {
            "scene": score.scene,
            "method": score.method,
            "registered": f"{score.registered}/{score.images}",
            "pairs": score.verified,
            "correct %": 100 * score.correct / score.judged if score.judged else None,
            "of judged": score.judged,
            "points": score.points,
            "track": score.track_length,
            "px": score.reprojection_px,
            "seconds": round(score.seconds),
        }
        for score in [*scores, *totals]
    ]


def count_held(scores: Sequence[SceneScore], method: str) -> tuple[int, int]:
    """In how many scenes a method registers at least as many images as the best of the others, and of how many."""
    others: dict[str, int] = {}
    for score in scores:
        if score.method != method:
            others[score.scene] = max(others.get(score.scene, 0), score.registered)
    compared = [score for score in scores if score.method == method and score.scene in others]
    return sum(score.registered >= others[score.scene] for score in compared), len(compared)
