"""Which tracks are kept where an image has more keypoints than it may have."""

import numpy as np

from hm_sfm.keypoints.selection import rank_in_groups, select_keypoints


def test_long_then_certain_tracks_are_selected():
    # Two images, six tracks in one cell; the first track is of three images, so longer.
    label = np.array([0, 1, 2, 3, 0, 1, 2, 3, 0])
    image = np.array([0, 0, 0, 0, 1, 1, 1, 1, 2])
    sigma = np.array([0.9, 0.5, 0.1, 0.3] * 2 + [0.9])
    length = np.bincount(label)[label]
    xy = np.tile([[5.0, 5.0]], (9, 1))
    for max_keypoints, kept in ((1, {0}), (2, {0, 2}), (3, {0, 2, 3}), (9, {0, 1, 2, 3}), (0, set())):
        chosen = select_keypoints(label, length, sigma, xy, image, max_keypoints)
        assert set(label[chosen].tolist()) == kept
        assert set(label[~chosen].tolist()).isdisjoint(kept), "whole tracks are kept"


def test_equal_tracks_spread_over_the_image():
    # One image, 20 keypoints in one cell and one each in four others.
    xy = np.r_[np.full((20, 2), 5.0), [[40, 5], [70, 5], [5, 40], [5, 70]]]
    chosen = select_keypoints(np.arange(24), np.full(24, 2), np.ones(24), xy, np.zeros(24, int), 8)
    assert chosen.sum() == 8 and chosen[20:].all()


def test_nothing_to_select_from():
    none = np.zeros(0, int)
    assert len(select_keypoints(none, none, np.zeros(0), np.zeros((0, 2)), none, 5)) == 0


def test_ranks_start_anew_in_every_group():
    assert rank_in_groups(np.array([3, 3, 3, 5, 7, 7])).tolist() == [0, 1, 2, 0, 0, 1]
