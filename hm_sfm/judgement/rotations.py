"""Loops of rotations: the rotations between the photos of a triangle, one after another, come back to the first."""

import numpy as np
import pycolmap

from hm_sfm.judgement.triangles import Triangles
from hm_sfm.types import PairMatches

LOOP_DEG = 3.0
"""Standard deviation of the rotation around a loop of right pairs, generous to guessed focal lengths."""
FIT_MATCHES = 1000
"""The rotation between two photos is estimated from at most so many matches, which is exact enough for a loop."""
SHARPER = 0.5
"""Of the limit at which matches were verified: they have bent that geometry, and a narrower one shows it."""


def estimate_rotation(
    matches: PairMatches, camera0: pycolmap.Camera, camera1: pycolmap.Camera, max_error_px: float
) -> np.ndarray:
    """(3, 3) float64 cam1_from_cam0, by COLMAP's LO-RANSAC on verified matches; NaN where it fails.

    max_error_px: px of the stored images. Cameras with a guessed focal length give a rotation that is off by degrees.
    """
    # Matches come best first: even steps keep the spread over the image.
    chosen = np.linspace(0, len(matches) - 1, min(len(matches), FIT_MATCHES)).round().astype(np.int64)
    xy0, xy1 = matches.xy0[chosen].astype(np.float64), matches.xy1[chosen].astype(np.float64)
    options = pycolmap.RANSACOptions(max_error=SHARPER * max_error_px, random_seed=0, min_num_trials=50)
    estimate = pycolmap.estimate_essential_matrix(xy0, xy1, camera0, camera1, options) if len(chosen) >= 5 else None
    return np.full((3, 3), np.nan) if estimate is None else estimate["cam2_from_cam1"].rotation.matrix()


def measure_rotation_loops(rotations: np.ndarray, triangles: Triangles) -> np.ndarray:
    """(T,) float64 degrees: by how much the rotations of each triangle miss a closed loop; NaN where one is unknown.

    rotations: (P, 3, 3) cam1_from_cam0 by pair.
    """
    around = np.swapaxes(rotations[triangles.ac], 1, 2) @ rotations[triangles.bc] @ rotations[triangles.ab]
    cosine = (np.trace(around, axis1=1, axis2=2) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))
