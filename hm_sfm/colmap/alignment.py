"""Models in the frame of earlier ones: a model that grows by some photos is not turned and rescaled."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.distance import pdist

from hm_sfm.colmap.models import read_model
from hm_sfm.errors import InputError

MAX_ERROR = 0.05
"""Of a camera that agrees with the others about the frame, relative to how far the cameras are apart."""
SAME = 1e-6
"""Shifts below this, in the same unit, are rounding: the model then stays as it is, to the last digit."""

MOST_MEASURED = 1000
"""Cameras whose distances give the scale: all pairs of them."""


def keep_frame(models: Sequence[pycolmap.Reconstruction], sparse_folder: Path) -> None:
    """Transform each model to the frame of that one on disk with which it shares most images.

    sparse_folder: of the earlier models, as replace_models writes them. A model that shares fewer than two images with
    any of them, or disagrees with it about most of them, stays as it is.
    """
    earlier = []
    for folder in sorted(sparse_folder.glob("[0-9]*/")):
        try:
            earlier.append(list_poses(read_model(folder)))
        except InputError:  # no model, or a damaged one
            continue
    for model in models:
        poses = list_poses(model)
        nearest = max(earlier, key=lambda others: len(poses.keys() & others.keys()), default={})
        earlier_from_now = find_similarity(poses, nearest)
        if earlier_from_now is not None:
            model.transform(earlier_from_now)


def list_poses(model: pycolmap.Reconstruction) -> dict[str, pycolmap.Rigid3d]:
    """Image name -> world_from_cam."""
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    return {image.name: image.cam_from_world().inverse() for image in images}


def find_similarity(poses: dict[str, pycolmap.Rigid3d], others: dict[str, pycolmap.Rigid3d]) -> pycolmap.Sim3d | None:
    """The similarity, others_from_poses, on which most of the images agree; None where there is none, or the identity.

    Both: image name -> world_from_cam. Besides their places, images agree in their directions: cameras in a row leave
    no doubt about the rotation around it.
    """
    shared = sorted(poses.keys() & others.keys())
    if len(shared) < 2:
        return None
    here, there = ([of[name] for name in shared] for of in (poses, others))
    centres = [np.array([pose.translation for pose in of]) for of in (here, there)]
    some = np.unique(np.linspace(0, len(shared) - 1, min(len(shared), MOST_MEASURED)).round().astype(int))
    apart = [pdist(xyz[some]) for xyz in centres]
    if not min(map(np.median, apart)) > 0:
        return None
    scale = np.median(apart[1][apart[0] > 0] / apart[0][apart[0] > 0])
    extents = [np.median(apart[0]), scale * np.median(apart[0])]
    marks = [
        np.concatenate([xyz, *(xyz + [extent * pose.rotation.matrix()[:, axis] for pose in of] for axis in range(3))])
        for xyz, extent, of in zip(centres, extents, (here, there))
    ]
    options = pycolmap.RANSACOptions(max_error=float(MAX_ERROR * extents[1]), random_seed=0)
    # A dictionary, whatever its type says.
    estimate: Any = pycolmap.estimate_sim3d_robust(marks[0], marks[1], options)
    if estimate is None or estimate["num_inliers"] < len(marks[0]) / 2:
        return None
    similarity = estimate["tgt_from_src"]
    is_same = np.abs(similarity * marks[0] - marks[0]).max() < SAME * extents[0]
    return None if is_same else similarity
