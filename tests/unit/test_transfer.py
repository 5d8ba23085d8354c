"""Points placed by the patches around them."""

import numpy as np

from hm_sfm.geometry.homographies import differentiate


def test_the_derivative_of_a_homography():
    homography = np.array([[[1.2, -0.2, 4], [0.1, 0.9, -2], [1e-3, -2e-3, 1]]])
    xy, step = np.array([[30.0, 40.0]]), 1e-3
    numeric = np.stack(
        [
            (map_exactly(homography[0], xy[0] + offset) - map_exactly(homography[0], xy[0] - offset)) / (2 * step)
            for offset in step * np.eye(2)
        ],
        axis=1,
    )
    np.testing.assert_allclose(differentiate(homography, xy)[0], numeric, atol=1e-6)
    assert differentiate(np.zeros((0, 3, 3)), np.zeros((0, 2))).shape == (0, 2, 2)


def map_exactly(homography: np.ndarray, xy: np.ndarray) -> np.ndarray:
    mapped = homography @ [*xy, 1.0]
    return mapped[:2] / mapped[2]
