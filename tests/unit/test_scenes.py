import cv2
import numpy as np
import pytest
import torch

from hm_sfm.network.backbone import LightBackbone
from hm_sfm.rendering import Quad, render_view
from hm_sfm.textures import make_texture
from hm_sfm.training.photos import SURFACES, WarpedPhotos, WarpRange
from hm_sfm.training.scenes import (
    MixedPairs,
    RenderedScenes,
    ViewRange,
    draw_cameras,
    draw_scene,
    plane_homography,
    relate_views,
    turn,
)
from hm_sfm.training.supervision import draw_patches
from hm_sfm.types import PinholeView

SIZE = 96
K = np.array([[90.0, 0, 48], [0, 90, 48], [0, 0, 1]])


@pytest.fixture(scope="module")
def photos():
    rng = np.random.default_rng(0)
    return [cv2.cvtColor(make_texture(rng, name, (1.5, 1.0), 160), cv2.COLOR_RGB2GRAY) for name in ("stones", "mural")]


def map_points(homography, xy):
    mapped = np.column_stack([xy, np.ones(len(xy))]) @ homography.T
    return mapped[:, :2] / mapped[:, 2:]


def make_plain(value):
    return np.full((4, 4, 3), value, dtype=np.uint8)


def make_two_views():
    second = np.column_stack([turn(8, -3, 5), [-0.4, 0.1, 0.2]])
    return PinholeView(K, (SIZE, SIZE), np.eye(3, 4)), PinholeView(K, (SIZE, SIZE), second)


def test_a_plane_homography_carries_the_projections_of_its_points():
    view_a, view_b = make_two_views()
    quad = Quad((-1, -0.8, 4.0), (2, 0.2, 0.7), (-0.1, 1.7, -0.4), make_plain(0))
    u, v = np.random.default_rng(1).uniform(size=(2, 50, 1))
    points = quad.origin + u * quad.edge_u + v * quad.edge_v
    mapped = map_points(plane_homography(quad, view_a, view_b), view_a.project(points)[0])
    np.testing.assert_allclose(mapped, view_b.project(points)[0], atol=1e-8)


def test_what_hides_behind_a_board_has_no_partner():
    view_a, view_b = make_two_views()
    wall = Quad((-6, -6, 6), (12, 0, 0), (0, 12, 0), make_plain(50))
    board = Quad((-0.5, -0.5, 3), (1, 0, 0), (0, 1, 0), make_plain(200))
    _, surface = relate_views((wall, board), view_a, view_b)
    shown_b = render_view((wall, board), view_b).image[..., 0]
    assert (surface == 1).sum() > 300
    b_from_a, _ = relate_views((wall, board), view_a, view_b)
    # The light leaves half of what faces the camera: 25 for the wall, 100 for the board; edges mix them.
    halfway = 62
    for index in (0, 1):
        rows, columns = np.nonzero(surface == index)
        centres = np.stack([columns, rows], axis=1) + 0.5
        x, y = np.floor(map_points(b_from_a[index].astype(float), centres)).astype(int).T
        assert ((shown_b[y, x] > halfway) == bool(index)).mean() > 0.95
    # Some of the wall that A sees beside the board is hidden from B, or out of its view.
    _, wall_alone = relate_views((wall,), view_a, view_b)
    hidden = (surface == -1) & (wall_alone == 0)
    assert 50 < hidden.sum() < 1000


def test_views_of_a_scene_agree_where_they_show_the_same_surface(photos):
    """Undisturbed views, compared through the homographies: the images themselves say whether geometry is right."""
    rng = np.random.default_rng(5)
    quads = draw_scene(photos, rng)
    view_a, view_b = draw_cameras(128, ViewRange(yaw_deg=8, pitch_deg=4, roll_deg=5, distance_ratio=1.1), rng)
    grey_a, grey_b = (
        cv2.cvtColor(render_view(quads, v).image, cv2.COLOR_RGB2GRAY).astype(float) for v in (view_a, view_b)
    )
    b_from_a, surface = relate_views(quads, view_a, view_b)
    rows, columns = np.nonzero(surface >= 0)
    assert len(rows) > 0.3 * surface.size
    xy = np.stack([columns, rows], axis=1) + 0.5
    mapped = np.array([map_points(b_from_a[s].astype(float), p[None])[0] for s, p in zip(surface[rows, columns], xy)])

    def measure_difference(shift):
        index = (mapped + shift - 0.5).astype(np.float32)[None]
        there = cv2.remap(grey_b.astype(np.float32), index, None, cv2.INTER_LINEAR)[0]
        return np.abs(there - grey_a[rows, columns]).mean()

    exact = measure_difference(np.zeros(2))
    for shift in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        assert exact < 0.8 * measure_difference(np.array(shift))


def test_items_are_deterministic_and_of_one_form(photos):
    scenes, again = (RenderedScenes(photos, SIZE, 3, 10, ViewRange()) for _ in range(2))
    warped = WarpedPhotos(photos, SIZE, 3, 10, WarpRange())
    for item in (scenes[4], warped[4]):
        assert item["images"].shape == (2, SIZE, SIZE) and item["images"].dtype == np.uint8
        assert item["b_from_a"].shape == (SURFACES, 3, 3) and item["b_from_a"].dtype == np.float32
        assert item["surface"].shape == (SIZE, SIZE) and item["surface"].max() < SURFACES
    for key in scenes[4]:
        assert np.array_equal(scenes[4][key], again[4][key])
    assert not np.array_equal(scenes[4]["images"], scenes[5]["images"])


def test_the_mixture_has_its_share_of_scenes(photos):
    class Tagged(list):
        pass

    warped, scenes = Tagged(["warped"] * 400), Tagged(["rendered"] * 400)
    drawn = [MixedPairs(warped, scenes, 0.3, seed=1)[i] for i in range(400)]
    assert 80 < drawn.count("rendered") < 160
    assert [MixedPairs(warped, scenes, 0.0, seed=1)[i] for i in range(50)] == ["warped"] * 50


def test_patches_of_scenes_follow_their_own_surface(photos):
    item = RenderedScenes(photos, SIZE, 7, 10, ViewRange(yaw_deg=6, pitch_deg=3, roll_deg=3, distance_ratio=1.05))[2]
    b_from_a, surface = torch.tensor(item["b_from_a"])[None], torch.tensor(item["surface"])[None]
    coarse, fine = LightBackbone.coarse_grid, LightBackbone.fine_grid
    truth = draw_patches(b_from_a, surface, 600, coarse, fine, 4.0, torch.Generator().manual_seed(0))
    assert truth.correct.sum() > 50
    for i in truth.correct.nonzero().flatten().tolist()[:40]:
        # The patch centre is one px right of and below the coarse cell's centre, which is what must be shown.
        centre_px = fine.to_px(truth.cell0[i].double()).numpy()
        index = item["surface"][tuple((centre_px - 1).astype(int)[::-1])]
        assert index >= 0
        expected = map_points(item["b_from_a"][index].astype(float), centre_px[None])[0]
        moved = truth.homography[i, :2, 2] / truth.homography[i, 2, 2]
        found = fine.to_px(truth.cell1[i].double()).numpy() + 2 * moved.numpy()
        np.testing.assert_allclose(found, expected, atol=0.02)
