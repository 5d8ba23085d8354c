"""Reconstruct a scene whose cameras are known, and print how good the model is.

    python pipelines/examples/score_against_ground_truth.py SCENE OUT

SCENE has the layout of Strecha's data sets: images/, gt_dense_cameras/<image name>.camera, and K.txt, the 3 x 3 matrix
of intrinsics of the files in images/, in COLMAP's frame. With K.txt the intrinsics are known and kept; without it they
start from EXIF and are refined. Poses are unknown in any case.
"""

import sys
import time
from pathlib import Path

import numpy as np

from hm_sfm.config import CameraConfig, Config
from hm_sfm.evaluation.poses import measure_position_error, score_model
from hm_sfm.formats.strecha import read_strecha_cameras
from hm_sfm.pipeline.reconstruction import reconstruct

AUC_SHOWN_DEG = (0.25, 0.5, 1, 3, 5)


def score_against_ground_truth(scene: Path, out: Path) -> None:
    ground_truth = read_strecha_cameras(scene / "gt_dense_cameras")
    cameras = read_intrinsics(scene / "K.txt") if (scene / "K.txt").exists() else CameraConfig()

    started = time.monotonic()
    result = reconstruct(scene / "images", out, Config(cameras=cameras))
    seconds = time.monotonic() - started

    score = score_model(result.models[0], ground_truth)
    auc = [score.auc_percent[limit] for limit in AUC_SHOWN_DEG]
    print(f"registered          {score.registered} of {score.num_images}")
    print(f"AUC at degrees      {' / '.join(f'{limit:5}' for limit in AUC_SHOWN_DEG)}")
    print(f"    of pose errors  {' / '.join(f'{value:5.1f}' for value in auc)} %")
    print(f"median rotation     {score.median_rotation_deg:.3f} deg")
    print(f"median translation  {score.median_translation_deg:.3f} deg")
    position_percent = 100 * measure_position_error(result.models[0], ground_truth)
    print(f"camera positions    {position_percent:.3f} % of the scene's extent off")
    print(f"points              {result.points}")
    print(f"mean track length   {result.mean_track_length:.2f} images")
    print(f"mean reprojection   {result.mean_reprojection_px:.3f} px")
    print(f"seconds             {seconds:.0f}")


def read_intrinsics(path: Path) -> CameraConfig:
    """Known intrinsics, the same for all photos, from a 3 x 3 matrix."""
    k = np.loadtxt(path)
    return CameraConfig(model="PINHOLE", params=",".join(str(value) for value in (k[0, 0], k[1, 1], k[0, 2], k[1, 2])))


if __name__ == "__main__":
    score_against_ground_truth(Path(sys.argv[1]), Path(sys.argv[2]))
