"""Whether a model can be right: what its cameras are like, and how well it agrees with the verified matches."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap

from hm_sfm.colmap.cameras import FOCAL_RATIOS
from hm_sfm.colmap.models import list_observations

# The limit of COLMAP's mapper for the coefficients of distortion, which the last adjustment of a model may leave.
MAX_DISTORTION = 1.0

# Right models agree with 99.5 to 100 % of the matches of their median pair, models with wrong cameras with 70 to 96 %.
ENOUGH_AGREEMENT = 0.97
ENOUGH_REGISTERED = 0.5

# A focal length is determined if its standard deviation, by the errors of the points, is less than this part of it.
MAX_DEVIATION = 0.03
# So much of a model tells whether its cameras are determined; all of a large one would take long.
MOST_IMAGES = 30
MOST_POINTS = 500


@dataclass(frozen=True)
class Judgement:
    """What speaks against a model."""

    agreement: float
    """Median over its pairs: of the verified matches with a point of the model at one end at least, the part that has
    this point at both ends."""
    explained: int
    """Verified matches that see one point of the model at both ends."""
    registered: float
    """Of the images of the model and those with verified matches to them, the part that is in the model."""
    impossible: tuple[int, ...]
    """Ids of the cameras that no lens is like."""

    @property
    def is_good(self) -> bool:
        """Whether nothing asks for another start."""
        return not self.impossible and self.agreement >= ENOUGH_AGREEMENT and self.registered >= ENOUGH_REGISTERED


def judge_model(model: pycolmap.Reconstruction, verified: Mapping[tuple[int, int], np.ndarray]) -> Judgement:
    """Judge a model whose intrinsics were estimated.

    verified: pairs of image ids -> their verified matches, (M, 2) int64 indices of keypoints.
    """
    points_of = {}
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        points_of[image_id] = np.full(image.num_points2D(), -1)
        seen = [point2D.point3D_id for point2D in image.get_observation_points2D()]
        points_of[image_id][image.get_observation_point2D_idxs()] = seen
    explained, agreements, joined = 0, [], set(points_of)
    for (id0, id1), matches in verified.items():
        if len(matches) and (id0 in points_of or id1 in points_of):
            joined.update((id0, id1))
        if id0 not in points_of or id1 not in points_of:
            continue
        point0, point1 = points_of[id0][matches[:, 0]], points_of[id1][matches[:, 1]]
        has_point = (point0 >= 0) | (point1 >= 0)
        agrees = has_point & (point0 == point1)
        explained += int(np.count_nonzero(agrees))
        if has_point.any():
            agreements.append(float(agrees.sum() / has_point.sum()))
    cameras = {model.image(image_id).camera_id for image_id in model.reg_image_ids()}
    return Judgement(
        float(np.median(agreements)) if agreements else 1.0,
        explained,
        len(points_of) / len(joined),
        tuple(sorted(number for number in cameras if is_impossible(model.camera(number)))),
    )


def is_impossible(camera: pycolmap.Camera) -> bool:
    """Whether focal length or distortion are beyond what COLMAP's mapper admits."""
    return camera.has_bogus_params(*FOCAL_RATIOS, MAX_DISTORTION)


def find_undetermined(model: pycolmap.Reconstruction) -> tuple[int, ...]:
    """Ids of the cameras whose focal length might as well be another one, by the covariance of bundle adjustment.

    Views of flat ground from straight above are the usual case. Of a large model only a part is looked at.
    """
    part = _take_part(model)
    extent = pycolmap.BundleAdjustmentConfig()
    for image_id in part.reg_image_ids():
        extent.add_image(image_id)
    extent.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, extent, part)
    covariance = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), part, adjuster)
    error_px = model.compute_mean_reprojection_error()
    undetermined = []
    for camera_id, camera in sorted(part.cameras.items()):
        # Without a covariance, some change of the cameras costs nothing at all.
        of_params = np.full((1, 1), np.inf) if covariance is None else covariance.get_other_params_cov(camera.params)
        if of_params is None or not np.sqrt(of_params[0, 0]) * error_px <= MAX_DEVIATION * camera.mean_focal_length():
            undetermined.append(camera_id)
    return tuple(undetermined)


def _take_part(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """The first images of a model and, of its points, those that most of them see, without the rigs."""
    image_ids = sorted(model.reg_image_ids())[:MOST_IMAGES]
    point, number, keypoint = list_observations(model)
    point, number, keypoint = (values[number < MOST_IMAGES] for values in (point, number, keypoint))
    points, length = np.unique(point, return_counts=True)
    points = points[np.argsort(-length, kind="stable")[:MOST_POINTS]]
    chosen = np.isin(point, points)
    point, number, keypoint = point[chosen], number[chosen], keypoint[chosen]

    part = pycolmap.Reconstruction()
    tracks: dict[int, pycolmap.Track] = {int(point_id): pycolmap.Track() for point_id in points}
    for place, image_id in enumerate(image_ids):
        image = model.image(image_id)
        if image.camera_id not in part.cameras:
            part.add_camera_with_trivial_rig(model.camera(image.camera_id))
        xy = np.array([image.point2D(index).xy for index in keypoint[number == place]]).reshape(-1, 2)
        taken = pycolmap.Image(name=image.name, keypoints=xy, camera_id=image.camera_id, image_id=image_id)
        part.add_image_with_trivial_frame(taken, image.cam_from_world())
        for index, point_id in enumerate(point[number == place].tolist()):
            tracks[point_id].add_element(image_id, index)
    for point_id, track in tracks.items():
        if track.length() >= 2:
            part.add_point3D(model.point3D(point_id).xyz, track)
    return part
