"""Anchors of keypoints at exact seeds."""

import numpy as np

from hm_sfm.keypoints.graph import Photo
from hm_sfm.keypoints.settled_tracks import find_anchors


def make_photo(name: str, *seeds: tuple[float, float], px_scale: float = 1.0, exact: bool = True) -> Photo:
    size_wh = (round(128 * px_scale), round(96 * px_scale))
    return Photo(name, size_wh, px_scale, np.array(seeds, float), seeds_are_exact=exact)


def test_anchors_are_the_nearest_exact_seeds_of_the_own_photo():
    photos = [
        make_photo("a", (10, 10), (30, 30), (50, 50), px_scale=2.0),
        make_photo("b", (10, 10), exact=False),
        make_photo("c", (10, 10)),
    ]
    # Of two near one seed the nearer is held; one is too far from any.
    xy = [np.array([[5.4, 5.0], [5.1, 5.0], [15.0, 16.5]]), np.array([[10.0, 10.0]]), np.array([[10.2, 10.0]])]
    anchors = find_anchors(photos, xy)
    assert anchors.keypoint.tolist() == [1, 4]
    assert anchors.xy.tolist() == [[5, 5], [10, 10]]
