"""Seeds of keypoints: at corners, in px of the stored photo, apart from each other."""

import numpy as np

from hm_sfm.keypoints.seeds import find_seeds, thin_points
from hm_sfm.photos.images import prepare_array


def test_thinning_keeps_the_best_and_the_distance():
    xy = np.array([[0.0, 0.0], [1.0, 0.0], [5.0, 0.0], [5.5, 0.0], [20.0, 0.0]])
    assert thin_points(xy, 2.0).tolist() == [True, False, True, False, True]
    assert thin_points(np.zeros((0, 2)), 2.0).shape == (0,)
    rng = np.random.default_rng(0)
    kept = rng.uniform(0, 50, (500, 2))
    kept = kept[thin_points(kept, 2.0)]
    apart = np.linalg.norm(kept[:, None] - kept[None], axis=2)
    assert len(kept) > 50 and apart[~np.eye(len(kept), dtype=bool)].min() > 2.0


def test_seeds_are_at_corners():
    pixels = np.zeros((64, 96), np.uint8)
    pixels[20:44, 27:70] = 255
    seeds = find_seeds(prepare_array(pixels, 96))
    assert len(seeds) == 12 * 8
    for corner in ([27, 20], [70, 20], [27, 44], [70, 44]):
        assert np.linalg.norm(seeds[:4] - corner, axis=1).min() < 2
    cells = np.floor(seeds / 8)
    assert len(np.unique(cells, axis=0)) == len(cells)


def test_seeds_of_a_reduced_photo_are_in_stored_pixels():
    pixels = np.zeros((128, 192), np.uint8)
    pixels[40:88, 54:140] = 255
    seeds = find_seeds(prepare_array(pixels, 96))
    for corner in ([54, 40], [140, 40], [54, 88], [140, 88]):
        assert np.linalg.norm(seeds[:4] - corner, axis=1).min() < 4
