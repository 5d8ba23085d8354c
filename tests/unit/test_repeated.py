"""Scenes that repeat themselves: what is equal is equal, and every camera sees it."""

import numpy as np
import pytest

from hm_sfm.synthetic.rendering import render_view
from hm_sfm.synthetic.repeated import REPEATED_SCENES


@pytest.mark.slow
@pytest.mark.parametrize(("name", "twins"), [("box", 2), ("corridor", 6), ("courtyard", 4)])
def test_twins_share_a_texture_and_every_camera_sees_one(name, twins):
    quads, views = REPEATED_SCENES[name](count=6, size_wh=(32, 24))
    textures = [quad.texture.tobytes() for quad in quads]
    assert max(map(textures.count, textures)) == twins
    assert len(views) == 6
    for view in views:
        rendering = render_view(quads, view)
        assert np.isfinite(rendering.depth).mean() > 0.5
        assert rendering.depth[12, 16] < 12
