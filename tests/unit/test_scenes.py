import itertools

import cv2
import numpy as np
import pytest
import torch

from hm_sfm.network.backbone import LightBackbone
from hm_sfm.synthetic.textures import make_texture
from hm_sfm.training.facet_views import measure_depth, plane_homography, relate_views, render_facets
from hm_sfm.training.facets import Facet, Texture, make_board, make_box, make_relief
from hm_sfm.training.photos import POINTS, SURFACES
from hm_sfm.training.scenes import RenderedScenes, ViewRange, draw_cameras, draw_lights, draw_scene, make_rotation
from hm_sfm.training.supervision import draw_patches
from hm_sfm.types import PinholeView

SIZE_WH = (112, 80)
K = np.array([[90.0, 0, 56], [0, 90, 40], [0, 0, 1]])
VIEW = PinholeView(K, SIZE_WH, np.eye(3, 4))
DARK = np.zeros(3)
"""No directed light: every facet shows its texture as it is."""


@pytest.fixture(scope="module")
def photos():
    rng = np.random.default_rng(0)
    return [cv2.cvtColor(make_texture(rng, name, (1.5, 1.0), 160), cv2.COLOR_RGB2GRAY) for name in ("stones", "mural")]


def map_points(homography, xy):
    mapped = np.column_stack([xy, np.ones(len(xy))]) @ homography.T
    return mapped[:, :2] / mapped[:, 2:]


def make_facet(origin, edge_u, edge_v, photo=None, **more):
    """A parallelogram under one copy of a photo, or of plain grey."""
    photo = np.full((4, 6), 100, np.uint8) if photo is None else photo
    edges = np.array(edge_u, float), np.array(edge_v, float)
    return Facet(np.array(origin, float), *edges, Texture(photo), np.diag([*photo.shape[::-1], 1.0]), **more)


def make_second_view(yaw_deg=8, pitch_deg=-3, roll_deg=5, shift=(-0.4, 0.1, 0.2)):
    return PinholeView(K, SIZE_WH, np.column_stack([make_rotation(yaw_deg, pitch_deg, roll_deg), shift]))


def relate(facets, view_a, view_b):
    views = view_a, view_b
    return relate_views(views, [measure_depth(facets, view) for view in views])


def render(facets, view=VIEW, light=DARK):
    return render_facets(measure_depth(facets, view), view, light)


def draw_test_scene(photos, seed):
    rng = np.random.default_rng(seed)
    views = draw_cameras(SIZE_WH, ViewRange(), rng)
    return draw_scene(photos, views, rng), views


# Ground truth


def test_a_plane_homography_carries_the_projections_of_its_points():
    view_b = make_second_view()
    facet = make_facet((-1, -0.8, 4.0), (2, 0.2, 0.7), (-0.1, 1.7, -0.4))
    u, v = np.random.default_rng(1).uniform(size=(2, 50, 1))
    points = facet.origin + u * facet.edge_u + v * facet.edge_v
    mapped = map_points(plane_homography(facet, VIEW, view_b), VIEW.project(points)[0])
    np.testing.assert_allclose(mapped, view_b.project(points)[0], atol=1e-8)


def cast_ray(facets, centre, direction):
    """The first facet on a ray, by brute force: (index or -1, distance in units of `direction`)."""
    nearest, least = -1, np.inf
    for index, facet in enumerate(facets):
        matrix = np.column_stack([facet.edge_u, facet.edge_v, -direction])
        u, v, t = np.linalg.solve(matrix, centre - facet.origin)
        inside = u >= 0 and v >= 0 and (u + v <= 1 if facet.is_triangle else max(u, v) <= 1)
        if inside and 1e-6 < t < least:
            nearest, least = index, t
    return nearest, least


@pytest.mark.parametrize("seed", [1, 2, 4])
def test_surfaces_are_those_that_rays_hit_in_both_views(photos, seed):
    facets, views = draw_test_scene(photos, seed)
    _, surface = relate(facets, *views)
    inverse_k = np.linalg.inv(views[0].K)
    sides = [[facet.measure_side(view) > 0 for view in views] for facet in facets]
    rng = np.random.default_rng(0)
    rows, columns = rng.integers(SIZE_WH[1], size=500), rng.integers(SIZE_WH[0], size=500)
    expected = []
    for row, column in zip(rows, columns):
        direction = inverse_k @ (column + 0.5, row + 0.5, 1)
        index, distance = cast_ray(facets, np.zeros(3), direction)
        if index >= 0:
            (xy,), (depth,) = views[1].project(distance * direction[None])
            shown = depth > 0 and (xy >= 0).all() and (xy < SIZE_WH).all() and sides[index][0] == sides[index][1]
            there = distance * direction - views[1].center
            if not shown or cast_ray(facets, views[1].center, there)[1] < 1 - 1e-5:
                index = -1
        expected.append(index)
    actual = surface[rows, columns]
    assert np.array_equal(actual, expected)
    assert len(np.unique(actual)) > 5 and 0.1 < (actual >= 0).mean() < 0.95


def test_what_hides_behind_a_board_has_no_partner():
    view_b = make_second_view()
    wall = make_facet((-6, -6, 6), (12, 0, 0), (0, 12, 0))
    board = make_facet((-0.5, -0.5, 3), (1, 0, 0), (0, 1, 0))
    _, surface = relate((wall, board), VIEW, view_b)
    _, wall_alone = relate((wall,), VIEW, view_b)
    assert (surface == 1).sum() > 300
    hidden = (surface == -1) & (wall_alone == 0)
    assert 50 < hidden.sum() < 1000


def test_the_other_side_of_a_board_is_no_partner():
    board = make_facet((-1, -1, 3), (2, 0, 0), (0, 2, 0))
    behind = PinholeView(K, SIZE_WH, np.column_stack([np.diag([-1.0, 1, -1]), [0, 0, 6]]))
    assert (measure_depth((board,), behind).index == 0).sum() > 1000
    assert (relate((board,), VIEW, behind)[1] == -1).all()
    assert (relate((board,), VIEW, VIEW)[1] == 0).sum() > 1000


def test_facets_behind_the_camera_and_edge_on_are_not_seen():
    behind = make_facet((-1, -1, -3), (2, 0, 0), (0, 2, 0))
    edge_on = make_facet((0, -1, 2), (0, 2, 0), (0, 0, 2))
    shown = measure_depth((behind, edge_on), VIEW)
    assert (shown.index == -1).all() and (shown.inverse_depth == 0).all()
    b_from_a, surface = relate((behind, edge_on), VIEW, make_second_view())
    assert np.isfinite(b_from_a).all() and (surface == -1).all()


# Pictures


@pytest.mark.parametrize("depth", [1.2, 2.5, 5.0])
def test_a_dot_of_the_texture_appears_where_its_point_projects(depth):
    """In COLMAP's frame: half a pixel off would fail, at any resolution of the texture."""
    texel = np.array([70.5, 30.5])
    x, y = np.arange(140) + 0.5, np.arange(100)[:, None] + 0.5
    photo = np.rint(250 * np.exp(-((x - texel[0]) ** 2 + (y - texel[1]) ** 2) / 12)).astype(np.uint8)
    facet = make_facet((-0.8, -0.5, depth), (1.5, 0.1, 0.2), (-0.1, 1.1, 0.1), photo)
    wall = make_facet((-9, -9, 9), (18, 0, 0), (0, 18, 0), np.zeros((8, 8), np.uint8))
    image = render((wall, facet))
    u, v = texel / (140, 100)
    expected, _ = VIEW.project((facet.origin + u * facet.edge_u + v * facet.edge_v)[None])
    rows, columns = np.mgrid[: SIZE_WH[1], : SIZE_WH[0]] + 0.5
    actual = np.array([(image * columns).sum(), (image * rows).sum()]) / image.sum()
    np.testing.assert_allclose(actual, expected[0], atol=0.06)


def test_repeated_photos_are_mirrored():
    photo = np.tile(np.arange(0, 240, 2, dtype=np.uint8), (90, 1))
    board = make_board(photo, np.array([0, 0, 2.0]), np.eye(3), 2.0, focal_px=120.0)
    image = render((board,))
    assert board.texture.copies == 1
    twice = make_board(photo, np.array([0, 0, 2.0]), np.eye(3), 2.0, focal_px=240.0)
    assert twice.texture.copies == 2
    mirrored = render((twice,))
    middle = mirrored[SIZE_WH[1] // 2, 16:96]
    np.testing.assert_allclose(middle, middle[::-1], atol=4)
    assert np.all(np.diff(image[SIZE_WH[1] // 2, 16:96]) > 0)


def test_far_textures_do_not_alias():
    checker = ((np.indices((300, 300)).sum(axis=0) % 2) * 200 + 20).astype(np.uint8)
    far = make_board(checker, np.array([0, 0, 3.0]), make_rotation(50, 0, 10), 2.5, focal_px=90.0)
    shown = measure_depth((far,), VIEW).index == 0
    inside = cv2.erode(shown.astype(np.uint8), np.ones((5, 5))) > 0
    assert inside.sum() > 1000
    assert render((far,))[inside].std() < 8


def test_edges_are_smooth_and_unbiased():
    white = np.full((8, 8), 250, np.uint8)
    wall = make_facet((-9, -9, 6), (18, 0, 0), (0, 18, 0), np.zeros((8, 8), np.uint8))
    for dx in np.linspace(0, 0.03, 4):
        board = make_facet((-0.7 + dx, -0.6, 3), (1.3, 0.2, 0), (-0.3, 1.1, 0), white)
        area = abs(np.linalg.det(np.array([board.edge_u[:2], board.edge_v[:2]]))) * (90 / 3) ** 2
        image = render((wall, board))
        assert image.sum() / 250 == pytest.approx(area, rel=0.006)
        assert ((image > 20) & (image < 230)).sum() > 60


def test_light_comes_from_its_direction():
    wall = make_facet((-9, -9, 6), (18, 0, 0), (0, 18, 0))
    assert render((wall,)).mean() == pytest.approx(100, abs=1)
    front, back = (render((wall,), light=np.array([0, 0, z])).mean() for z in (-0.5, 0.5))
    assert front > 110 and back == pytest.approx(50, abs=1)
    first, second = draw_lights(np.random.default_rng(0))
    assert not np.allclose(first, second)


def test_views_of_a_scene_agree_where_they_show_the_same_surface(photos):
    """Undisturbed views, compared through the homographies: the images themselves say whether geometry is right."""
    rng = np.random.default_rng(5)
    views = draw_cameras((160, 120), ViewRange(yaw_deg=8, pitch_deg=4, roll_deg=5, distance_ratio=1.1), rng)
    facets = draw_scene(photos, views, rng)
    grey_a, grey_b = (render(facets, view) for view in views)
    b_from_a, surface = relate(facets, *views)
    rows, columns = np.nonzero(surface >= 0)
    assert len(rows) > 0.3 * surface.size
    xy = np.stack([columns, rows], axis=1) + 0.5
    mapped = np.array([map_points(b_from_a[s].astype(float), p[None])[0] for s, p in zip(surface[rows, columns], xy)])

    def measure_difference(shift):
        index = (mapped + shift - 0.5).astype(np.float32)[None]
        there = cv2.remap(grey_b, index, None, cv2.INTER_LINEAR)[0]
        return np.abs(there - grey_a[rows, columns]).mean()

    exact = measure_difference(np.zeros(2))
    for shift in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        assert exact < 0.8 * measure_difference(np.array(shift))


# Scenes


def test_the_faces_of_a_box_look_outwards_and_close_it(photos):
    centre = np.array([0.3, -0.2, 4.0])
    faces = make_box([photos[0]] * 6, centre, make_rotation(30, -20, 5), np.array([0.5, 0.8, 1.2]), 100.0)
    assert all(face.normal @ (face.corners.mean(axis=0) - centre) > 0 for face in faces)
    corners = np.concatenate([face.corners for face in faces])
    assert len(np.unique(corners.round(9), axis=0)) == 8
    assert sorted(np.linalg.norm(face.corners.mean(axis=0) - centre).round(9) for face in faces) == pytest.approx(
        [0.25, 0.25, 0.4, 0.4, 0.6, 0.6]
    )


def test_a_relief_is_one_surface_under_one_photo(photos):
    facets = make_relief(
        photos[0], np.random.default_rng(0), np.array([0, 0, 5.0]), make_rotation(10, 5, 0), 4.0, 100.0
    )
    texels = {}
    for facet, (u, v) in itertools.product(facets, ((0, 0), (1, 0), (0, 1))):
        vertex = tuple((facet.origin + u * facet.edge_u + v * facet.edge_v).round(9))
        texels.setdefault(vertex, []).append(facet.texel_from_uv @ (u, v, 1))
    assert len(facets) == 40 and len(texels) == 30
    assert all(np.allclose(actual, actual[0]) for actual in texels.values())
    height, width = photos[0].shape
    corners = np.array([actual[0] for actual in texels.values()])
    assert corners[:, 0].max() == pytest.approx(width * facets[0].texture.copies)
    assert corners[:, 1].max() == pytest.approx(height * facets[0].texture.copies)
    normals = np.array([facet.normal for facet in facets])
    assert normals.std(axis=0).max() > 0.05


def test_scenes_have_depth_and_fit_the_format(photos):
    counts, ranges = [], []
    for seed in range(12):
        facets, views = draw_test_scene(photos, seed)
        counts.append(len(facets))
        shown = measure_depth(facets, views[0])
        seen = shown.inverse_depth[shown.index >= 0]
        ranges.append(np.percentile(seen, 95) / np.percentile(seen, 5))
    assert max(counts) <= SURFACES and min(counts) >= 2
    assert np.median(ranges) > 1.5


def test_items_are_deterministic_and_of_one_form(photos):
    scenes, again = (RenderedScenes(photos, SIZE_WH, 3, 10, ViewRange()) for _ in range(2))
    item = scenes[4]
    assert len(scenes) == 10
    assert item["images"].shape == (2, SIZE_WH[1], SIZE_WH[0]) and item["images"].dtype == np.uint8
    assert item["b_from_a"].shape == (SURFACES, 3, 3) and item["b_from_a"].dtype == np.float32
    assert item["surface"].shape == (SIZE_WH[1], SIZE_WH[0]) and item["surface"].dtype == np.int64
    assert item["surface"].min() >= -1 and item["surface"].max() < SURFACES
    assert item["points"].shape == (POINTS, 4) and np.isnan(item["points"]).all()
    for key in item:
        assert np.array_equal(item[key], again[4][key], equal_nan=key == "points")
    assert not np.array_equal(item["images"], scenes[5]["images"])


def test_patches_of_scenes_follow_their_own_surface(photos):
    views = ViewRange(yaw_deg=6, pitch_deg=3, roll_deg=3, distance_ratio=1.05)
    item = RenderedScenes(photos, (96, 96), 7, 10, views)[2]
    b_from_a, surface = torch.tensor(item["b_from_a"])[None], torch.tensor(item["surface"])[None]
    coarse, fine = LightBackbone.coarse_grid, LightBackbone.fine_grid
    features, generator = torch.ones(1, 2, 1, 12, 12), torch.Generator().manual_seed(0)
    supervision = draw_patches(b_from_a, surface, features, 600, coarse, fine, 4.0, generator)
    assert supervision.correct.sum() > 50
    for i in supervision.correct.nonzero().flatten().tolist()[:40]:
        # The patch centre is one px right of and below the coarse cell's centre, which is what must be shown.
        centre_px = fine.to_px(supervision.cell0[i].double()).numpy()
        index = item["surface"][tuple((centre_px - 1).astype(int)[::-1])]
        assert index >= 0
        expected = map_points(item["b_from_a"][index].astype(float), centre_px[None])[0]
        moved = supervision.homography[i, :2, 2] / supervision.homography[i, 2, 2]
        actual = fine.to_px(supervision.cell1[i].double()).numpy() + 2 * moved.numpy()
        np.testing.assert_allclose(actual, expected, atol=0.02)
