import numpy as np
import pycolmap
import pytest

import hm_sfm.synthetic.demo
from hm_sfm.formats.strecha import read_strecha_cameras
from hm_sfm.synthetic.demo import expose_photo, make_box, make_demo_scene, make_demo_views, write_demo
from hm_sfm.synthetic.rendering import Quad, render_view
from hm_sfm.synthetic.textures import MATERIALS, make_texture
from hm_sfm.types import PinholeView

BLACK = (0.0, 0.0, 0.0)
K = np.array([[100.0, 0, 60], [0, 100, 45], [0, 0, 1]])
SIZE_WH = (120, 90)
# The camera of most tests stands at the world's origin, so that world and camera coordinates are the same.
VIEW = PinholeView(K, SIZE_WH, np.eye(3, 4))


def make_plain(colour):
    return np.full((8, 8, 3), colour, dtype=np.uint8)


def make_slanted_quad(texture):
    return Quad((-1.1, -0.8, 3.0), (2.0, 0.3, 1.0), (-0.2, 1.6, 0.7), texture)


def measure_centroid(image):
    """Px of the centre of brightness, a pixel's weight being at its centre (column + 0.5, row + 0.5)."""
    weight = image[..., 0].astype(float)
    rows, columns = np.indices(weight.shape) + 0.5
    return np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()


def lift_pixels(view, depth):
    """World points (N, 3) of all pixel centres with a depth, and their rows and columns."""
    rows, columns = np.nonzero(np.isfinite(depth))
    rays = np.linalg.inv(view.K) @ np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
    points = (rays * depth[rows, columns]).T
    return (points - view.cam_from_world[:, 3]) @ view.cam_from_world[:, :3], rows, columns


def test_depth_lies_on_the_quad_and_covers_its_projection():
    quad = make_slanted_quad(make_plain(200))
    depth = render_view((quad,), VIEW).depth
    points, _, _ = lift_pixels(VIEW, depth)
    axes = np.column_stack([quad.edge_u, quad.edge_v, np.cross(quad.edge_u, quad.edge_v)])
    u, v, off_plane = np.linalg.solve(axes, (points - quad.origin).T)
    assert np.abs(off_plane).max() < 1e-6
    assert min(u.min(), v.min()) > -1e-5 and max(u.max(), v.max()) < 1 + 1e-5
    corners, _ = VIEW.project(quad.origin + np.array([[0, 0, 0], quad.edge_u, quad.edge_u + quad.edge_v, quad.edge_v]))
    x, y = corners.T
    area = 0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))
    assert len(points) == pytest.approx(area, rel=0.01)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.25, 0.4), (0.5, 0.5), (0.8, 0.1)])
def test_spot_appears_where_its_point_projects(shift):
    rows, columns = np.indices((200, 200))
    spot = np.exp(-((columns + 0.5 - 90) ** 2 + (rows + 0.5 - 120) ** 2) / (2 * 6**2)) * 255
    texture = np.repeat(np.rint(spot)[..., None], 3, axis=2).astype(np.uint8)
    # At depth 2 the focal length of 100 px makes 0.02 of the world one pixel.
    quad = Quad((-1 + 0.02 * shift[0], -0.8 + 0.02 * shift[1], 2), (2, 0, 0), (0, 1.6, 0), texture)
    expected, _ = VIEW.project((quad.origin + 90 / 200 * quad.edge_u + 120 / 200 * quad.edge_v)[None])
    image = render_view((quad,), VIEW, BLACK).image
    assert measure_centroid(image) == pytest.approx(expected[0], abs=0.03)


@pytest.mark.parametrize("shift", [0.0, 0.25, 0.5, 0.75])
def test_edge_is_where_its_corner_projects(shift):
    quad = Quad((0.02 * shift, -5, 2), (5, 0, 0), (0, 10, 0), make_plain(200))
    row = render_view((quad,), VIEW, BLACK).image[45, :, 0].astype(float)
    # Sixty columns lie right of the centre; two samples per pixel tell quarters of one apart.
    assert row.sum() / row.max() == pytest.approx(60 - shift, abs=0.26)
    assert row[:60].sum() == 0 and (row[61:] == row.max()).all()


@pytest.mark.parametrize("order", [1, -1])
def test_nearer_quad_hides_the_other(order):
    near = Quad((-0.2, -0.2, 1), (0.4, 0, 0), (0, 0.4, 0), make_plain((255, 0, 0)))
    far = Quad((-2, -2, 3), (4, 0, 0), (0, 4, 0), make_plain((0, 255, 0)))
    result = render_view((near, far)[::order], VIEW)
    assert result.depth[45, 60] == pytest.approx(1) and result.image[45, 60, 1] == 0 and result.image[45, 60, 0] > 0
    assert result.depth[45, 100] == pytest.approx(3) and result.image[45, 100, 0] == 0
    assert np.isclose(result.depth, 1).sum() == 40 * 40


def test_crossing_quads_are_split_where_they_meet():
    left_near = Quad((-1, -1, 2), (2, 0, 2), (0, 2, 0), make_plain((255, 0, 0)))
    right_near = Quad((-1, -1, 4), (2, 0, -2), (0, 2, 0), make_plain((0, 255, 0)))
    image = render_view((left_near, right_near), VIEW, BLACK).image
    assert image[45, 50, 0] > 0 and image[45, 50, 1] == 0
    assert image[45, 70, 1] > 0 and image[45, 70, 0] == 0


def test_only_what_is_in_front_is_drawn():
    behind = Quad((-1, -1, -3), (2, 0, 0), (0, 2, 0), make_plain(255))
    edge_on = Quad((-1, 0, 1), (2, 0, 0), (0, 0, 2), make_plain(255))
    beside = Quad((50, 0, 3), (1, 0, 0), (0, 1, 0), make_plain(255))
    for quads in ((), (behind, edge_on, beside)):
        result = render_view(quads, VIEW, (10.0, 20.0, 30.0))
        assert np.isinf(result.depth).all() and (result.image == (10, 20, 30)).all()


def test_ground_that_reaches_behind_the_camera_has_its_depth():
    ground = Quad((-100, 1.5, -100), (200, 0, 0), (0, 0, 200), make_plain(128))
    depth = render_view((ground,), VIEW).depth
    # A ray through row y falls (y + 0.5 - 45) / 100 per unit of depth and meets the ground 1.5 below.
    assert depth[89, 0] == pytest.approx(1.5 * 100 / 44.5) and depth[60, 119] == pytest.approx(1.5 * 100 / 15.5)
    assert np.isinf(depth[:45]).all()


def test_distant_fine_texture_turns_grey_instead_of_aliasing():
    checks = np.indices((512, 512)).sum(axis=0) % 2 * 255
    quad = make_slanted_quad(np.repeat(checks[..., None], 3, axis=2).astype(np.uint8))
    result = render_view((quad,), VIEW, BLACK)
    # Pixels all of whose neighbours see the quad: no background is mixed into them.
    seen = np.isfinite(np.pad(result.depth, 1, constant_values=np.inf))
    inner = np.all([np.roll(seen, (dy, dx), (0, 1)) for dy in (-1, 0, 1) for dx in (-1, 0, 1)], axis=0)[1:-1, 1:-1]
    lit = result.image[inner][:, 0].astype(float)
    assert lit.mean() > 50 and lit.std() < 0.06 * lit.mean()


def test_shading_tells_the_faces_of_a_box_apart():
    box = [
        Quad(q.origin, q.edge_u, q.edge_v, make_plain(200))
        for q in make_box(np.random.default_rng(0), "paint", (0, 0), (1, 1, 1), 30, texels_per_m=16)
    ]
    view = make_demo_views(1, SIZE_WH)[0]
    image = render_view(tuple(box), view, BLACK).image[..., 0]
    tones, counts = np.unique(image, return_counts=True)
    assert np.sum((counts > 15) & (tones > 0)) == 3  # two sides and the top


def test_box_is_closed_and_of_the_stated_size():
    quads = make_box(np.random.default_rng(0), "paint", (1, 2), (3, 2, 1), 90, base_m=0.5, texels_per_m=8)
    corners = np.concatenate([q.origin + np.array([(0, 0, 0), q.edge_u, q.edge_v, q.edge_u + q.edge_v]) for q in quads])
    assert len(np.unique(corners.round(9), axis=0)) == 8
    assert corners.min(axis=0) == pytest.approx([0, 0.5, 0.5]) and corners.max(axis=0) == pytest.approx([2, 3.5, 1.5])


def test_malformed_quads_are_refused():
    with pytest.raises(ValueError, match="parallel"):
        Quad((0, 0, 0), (1, 0, 0), (2, 0, 0), make_plain(0))
    with pytest.raises(ValueError, match="texture"):
        Quad((0, 0, 0), (1, 0, 0), (0, 1, 0), np.zeros((4, 4), np.uint8))


@pytest.mark.parametrize("material", MATERIALS)
def test_texture_is_rich_everywhere_and_does_not_repeat(material):
    texture = make_texture(np.random.default_rng(1), material, (2.0, 1.5), 128)
    assert texture.shape == (192, 256, 3) and texture.dtype == np.uint8
    again = make_texture(np.random.default_rng(1), material, (2.0, 1.5), 128)
    other = make_texture(np.random.default_rng(2), material, (2.0, 1.5), 128)
    assert (texture == again).all() and (texture != other).mean() > 0.5
    grey = texture.mean(axis=2)
    blocks = grey.reshape(12, 16, 16, 16).std(axis=(1, 3))
    assert (blocks > 4).mean() > 0.95
    assert 40 < grey.mean() < 215
    left, right = grey[:, :128].ravel(), grey[:, 128:].ravel()
    assert abs(np.corrcoef(left, right)[0, 1]) < 0.5


@pytest.mark.parametrize("size_m", [(0.05, 0.05), (3.0, 0.1), (0.1, 3.0)])
@pytest.mark.parametrize("material", MATERIALS)
def test_texture_of_any_shape(material, size_m):
    texture = make_texture(np.random.default_rng(0), material, size_m, 80)
    assert texture.shape == (max(round(size_m[1] * 80), 8), max(round(size_m[0] * 80), 8), 3)


@pytest.mark.parametrize("count", [1, 2, 12, 30])
def test_demo_views_look_at_the_scene_from_an_arc(count):
    views = make_demo_views(count)
    assert len(views) == count
    centers = np.array([view.center for view in views])
    bearings = np.degrees(np.arctan2(centers[:, 0], 1.2 - centers[:, 1]))
    assert ((np.diff(bearings) > 0) & (np.diff(bearings) < 9)).all()
    if count == 12:
        assert (np.diff(bearings) > 6).all() and np.ptp(centers[:, 2]) > 0.5
    for view in views:
        rotation = view.cam_from_world[:, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0 and rotation[1] @ [0, 0, -1] > 0.9  # y points down
        xy_px, depth = view.project(np.array([[0.0, 1.2, 1.0]]))
        assert depth > 0 and (np.abs(xy_px - [320, 240]) < 80).all()


@pytest.mark.slow
def test_demo_scene_is_the_same_place_from_two_views():
    quads = make_demo_scene(0)
    views = make_demo_views(12, (320, 240))[4:6]
    first, second = (render_view(quads, view) for view in views)
    assert np.isfinite(first.depth).mean() > 0.75
    points, rows, columns = lift_pixels(views[0], first.depth)
    xy_px, depth = views[1].project(points)
    inside = (xy_px > 3).all(axis=1) & (xy_px < np.array([317, 237])).all(axis=1)
    column, row = xy_px[inside].astype(int).T
    seen = np.abs(second.depth[row, column] / depth[inside] - 1) < 0.01
    assert 0.6 < seen.mean() < 0.99  # most is seen by both, some is hidden in one of them
    before = first.image[rows, columns][inside][seen].astype(float)
    there = np.abs(second.image[row, column][seen] - before).mean()
    beside = np.abs(second.image[row, column + 3][seen] - before).mean()
    assert there < 0.6 * beside


def test_photo_has_noise_and_exposure_of_its_own():
    image = np.full((60, 80, 3), 120, dtype=np.uint8)
    photos = [expose_photo(image, np.random.default_rng(seed)) for seed in (0, 0, 1)]
    assert (photos[0] == photos[1]).all()
    assert abs(photos[0].mean() - photos[2].mean()) > 1
    assert all(1 < photo[..., 0].std() < 6 for photo in photos)


def test_demo_files_hold_the_cameras_they_were_rendered_with(tmp_path, monkeypatch):
    # A small scene in place of the courtyard: what is tested here is what is written.
    scene = make_box(np.random.default_rng(0), "mural", (0, 1), (3, 3, 2), 20, texels_per_m=40)
    monkeypatch.setattr(hm_sfm.synthetic.demo, "make_demo_scene", lambda seed: scene)
    views = write_demo(tmp_path / "a", seed=0, count=3, size_wh=(160, 120))
    assert list(views) == ["view_00.jpg", "view_01.jpg", "view_02.jpg"]
    ground_truth = read_strecha_cameras(tmp_path / "a" / "ground_truth")
    assert list(ground_truth) == list(views)
    for name, view in views.items():
        np.testing.assert_allclose(ground_truth[name].cam_from_world, view.cam_from_world, atol=1e-12)
        np.testing.assert_allclose(ground_truth[name].K, view.K, atol=1e-9)
        camera = pycolmap.infer_camera_from_image(tmp_path / "a" / "images" / name)
        assert camera.has_prior_focal_length and (camera.width, camera.height) == view.size_wh
        np.testing.assert_allclose(camera.calibration_matrix(), view.K, atol=1e-6)
    write_demo(tmp_path / "b", seed=0, count=3, size_wh=(160, 120))
    for path in (tmp_path / "a").rglob("*.*"):
        assert path.read_bytes() == (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes()
    assert len(list((tmp_path / "a").rglob("*.*"))) == 6
