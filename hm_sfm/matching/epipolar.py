"""The epipolar geometry of a pair as far as growing asks for it, before cameras are known."""

import numpy as np
import pycolmap

MAX_ERROR_PX = 3.0
"""Px of the network's input."""
MIN_MATCHES = 16
MIN_INLIERS = 15
MIN_SHARE = 0.7
"""Of the matches that the geometry is fitted to: where fewer agree with it, it may be wrong itself."""
SURE_PLACE = 0.55
"""The geometry is fitted to matches whose place is as likely as this,"""
ENOUGH_SURE = 50
"""where there are so many of them."""


def fit_fundamental(xy0: np.ndarray, xy1: np.ndarray, place: np.ndarray) -> np.ndarray | None:
    """The fundamental matrix (3, 3) of matches, by COLMAP's LO-RANSAC; None where too few agree with one.

    xy0, xy1: (M, 2) float64 px of the two networks' inputs; place: (M,), see PatchEstimates.
    """
    sure = place >= SURE_PLACE
    if np.count_nonzero(sure) >= ENOUGH_SURE:
        xy0, xy1 = xy0[sure], xy1[sure]
    if len(xy0) < MIN_MATCHES:
        return None
    options = pycolmap.RANSACOptions(max_error=MAX_ERROR_PX, random_seed=0)
    estimate = pycolmap.estimate_fundamental_matrix(xy0, xy1, options)
    needed = max(MIN_INLIERS, MIN_SHARE * len(xy0))
    return None if estimate is None or estimate["num_inliers"] < needed else estimate["F"]


def agree_with(fundamental: np.ndarray, xy0: np.ndarray, xy1: np.ndarray) -> np.ndarray:
    """(M,) bool: which matches, (M, 2) float64 px, are within MAX_ERROR_PX (Sampson's error) of the geometry."""
    return np.array(pycolmap.compute_squared_sampson_error(xy0, xy1, fundamental)) <= MAX_ERROR_PX**2
