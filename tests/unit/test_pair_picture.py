"""The second photo warped into the first."""

import numpy as np
import pytest

from hm_sfm.photos.images import prepare_array
from hm_sfm.report.pair_picture import LONG_EDGE_PX, warp_photo
from hm_sfm.types import PatchMatches


@pytest.mark.parametrize("px_scale", [1, 4])
def test_the_warp_has_no_holes_between_patches_and_ends_with_photo_b(px_scale):
    """B shows what A does, 24 px of the matching resolution further to the left; matches grew over half of A."""
    rng = np.random.default_rng(0)
    cells = rng.integers(30, 220, (24 * px_scale, 32 * px_scale), np.uint8)
    wide = np.kron(cells, np.ones((8, 8), np.uint8))
    width, shift = 224 * px_scale, 24 * px_scale
    photo_a, photo_b = (prepare_array(wide[:, left : left + width], LONG_EDGE_PX) for left in (0, shift))
    column, row = np.indices((14, 24)).reshape(2, -1)
    centres = px_scale * (np.stack([column, row], axis=1)[(column + row) % 2 == 0] * 8.0 + 4)
    move = np.tile(np.eye(3), (len(centres), 1, 1))
    move[:, 0, 2] = -shift
    matches = PatchMatches(
        xy0=centres, xy1=centres - (shift, 0), score=np.ones(len(centres)), homography=move,
        patch_radius_px=8.0 * px_scale, size0_wh=photo_a.ref.size_wh, size1_wh=photo_b.ref.size_wh,
    )  # fmt: skip
    warped, is_covered = warp_photo(photo_a, photo_b, matches)
    scale = photo_a.scaled_wh[0] / 224
    x, y = (np.array([24, 112]) * scale).round().astype(int), round(8 * scale)
    assert is_covered[y:-y, x[0] + 1 : x[1] - 1].all()
    assert not is_covered[:, : x[0] - 1].any()  # to the left of all that B shows
    assert not is_covered[:, round(121 * scale) :].any()
    inner = np.s_[y + 1 : -y - 1, x[0] + 2 : x[1] - 2]
    assert np.abs(warped[inner].astype(float) - photo_a.grey[inner] * 255).mean() < 12
