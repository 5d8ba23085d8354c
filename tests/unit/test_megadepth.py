"""MegaDepth pairs, on a tiny MegaDepth that is rendered: the ground truth of every pixel is known."""

import dataclasses
import pickle
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import torch

from hm_sfm.errors import ConfigError, InputError
from hm_sfm.network.backbone import LightBackbone
from hm_sfm.synthetic.rendering import Quad, render_view
from hm_sfm.synthetic.textures import make_texture
from hm_sfm.training import megadepth
from hm_sfm.training.megadepth import (
    DepthView,
    MegaDepthPairs,
    OverlapRange,
    load_scenes,
    read_scene,
    read_view,
    relate_depths,
)
from hm_sfm.training.photos import POINTS
from hm_sfm.training.supervision import draw_patches
from hm_sfm.types import PinholeView

SIZE_WH = (192, 160)
"""Landscape photos are padded below, portrait ones at the right; neither reduction is by a whole number."""
ALL_PAIRS = ((0, 1), (1, 0), (0, 2), (2, 1))
ALL = OverlapRange(0, 1)


def make_quads() -> tuple[Quad, ...]:
    rng = np.random.default_rng(0)
    stones, mural = (make_texture(rng, name, (1.5, 1.0), 400) for name in ("stones", "mural"))
    wall = Quad((-7, -5, 5.0), (14, 0, 4.0), (-1, 11, 1.0), stones)
    board = Quad((-0.9, -0.7, 3.6), (1.5, 0.2, -0.7), (-0.1, 1.3, 0.4), mural)
    return wall, board


def turn(yaw_deg: float, pitch_deg: float, roll_deg: float) -> np.ndarray:
    yaw, pitch, roll = (
        cv2.Rodrigues(np.radians(angle) * np.eye(3)[axis])[0]
        for axis, angle in ((1, yaw_deg), (0, pitch_deg), (2, roll_deg))
    )
    return roll @ pitch @ yaw


def make_cameras() -> tuple[PinholeView, ...]:
    """They differ in scale and roll: with a shift of one view only, errors of half a pixel would cancel."""
    landscape = np.array([[290.0, 0, 158], [0, 292, 123], [0, 0, 1]])
    portrait = np.array([[240.0, 0, 88], [0, 241, 121], [0, 0, 1]])
    near = np.column_stack([turn(12, -5, 35), [-0.5, 0.1, -0.9]])
    aside = np.column_stack([turn(-14, 4, -12), [0.9, -0.2, 0.6]])
    return (
        PinholeView(landscape, (320, 240), np.eye(3, 4)),
        PinholeView(landscape, (320, 240), near),
        PinholeView(portrait, (180, 240), aside),
    )


QUADS, CAMERAS = make_quads(), make_cameras()


@pytest.fixture(scope="module")
def renderings():
    return [render_view(QUADS, camera) for camera in CAMERAS]


def write_megadepth(folder: Path, renderings, shift_px: float = 0.0) -> tuple[Path, Path]:
    """(root, scene_info) of three photos in two files; shift_px moves the principal points."""
    root, scene_info = folder / "train", folder / "index"
    image_paths, depth_paths, intrinsics, poses = [None], [None], [None], [None]
    for i, (camera, rendering) in enumerate(zip(CAMERAS, renderings)):
        image_paths.append(f"Undistorted_SfM/0000/images/{i}.png")
        depth_paths.append(f"phoenix/S6/zl548/MegaDepth_v1/0000/dense0/depths/{i}.h5")
        for name in (image_paths[-1], depth_paths[-1]):
            (root / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(root / image_paths[-1]), rendering.image[..., ::-1])
        with h5py.File(root / depth_paths[-1], "w") as file:
            file["depth"] = np.where(np.isfinite(rendering.depth), rendering.depth, 0)
        intrinsics.append(camera.K + [[0, 0, shift_px], [0, 0, shift_px], [0, 0, 0]])
        poses.append(np.vstack([camera.cam_from_world, [0, 0, 0, 1]]))
    content = {"image_paths": image_paths, "depth_paths": depth_paths, "intrinsics": intrinsics, "poses": poses}
    content = {key: make_objects(values) for key, values in content.items()}
    scene_info.mkdir()
    # LoFTR's own files are pickled dicts in spite of their name; what others make are archives.
    with open(scene_info / "0000_0.1_0.3.npz", "wb") as file:
        pickle.dump(content | {"pair_infos": make_pairs((1, 2, 0.1), (2, 3, 0.05), (1, 3, 0.3))}, file)
    np.savez(scene_info / "0000_0.3_0.7.npz", **content, pair_infos=make_pairs((2, 3, 0.7), (1, 2, 0.71)))
    return root, scene_info


def make_objects(values) -> np.ndarray:
    array = np.empty(len(values), object)
    array[:] = values
    return array


def make_pairs(*pairs) -> np.ndarray:
    return make_objects([(np.array([i, j]), overlap, np.zeros((3, 2), np.float32)) for i, j, overlap in pairs])


@pytest.fixture(scope="module")
def folders(tmp_path_factory, renderings):
    return write_megadepth(tmp_path_factory.mktemp("megadepth"), renderings)


def read_views(folders, pair, size_wh=SIZE_WH):
    root, scene_info = folders
    scene = read_scene(scene_info / "0000_0.1_0.3.npz", ALL)
    return [read_view(root, scene, photo, size_wh) for photo in pair]


def reduce_camera(camera: PinholeView, size_wh=SIZE_WH) -> PinholeView:
    scale = min(size_wh[0] / camera.size_wh[0], size_wh[1] / camera.size_wh[1])
    return PinholeView(
        np.diag([scale, scale, 1]) @ camera.K,
        tuple(round(side * scale) for side in camera.size_wh),
        camera.cam_from_world,
    )


def frame_quad(quad: Quad, camera: PinholeView) -> np.ndarray:
    """(3, 3): (u, v, 1) of a quad -> z-depth times px (x, y, 1)."""
    rotation, translation = camera.cam_from_world[:, :3], camera.cam_from_world[:, 3:]
    points = np.column_stack([quad.edge_u, quad.edge_v, quad.origin])
    return camera.K @ (rotation @ points + translation * [0, 0, 1])


def find_shown(camera: PinholeView) -> np.ndarray:
    """(h, w): the quad at each pixel centre, -1 where there is none."""
    width, height = camera.size_wh
    rows, columns = np.indices((height, width)) + 0.5
    inverse_depth = np.zeros((len(QUADS), height, width))
    for nearness, quad in zip(inverse_depth, QUADS):
        rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(frame_quad(quad, camera)).T
        u, v = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
        hit = (rays[..., 2] > 0) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
        nearness[hit] = rays[hit, 2]
    return np.where(inverse_depth.any(axis=0), inverse_depth.argmax(axis=0), -1)


def find_ground_truth(pair, size_wh=SIZE_WH):
    """Of the padded view A: mapped (H, W, 2) px of B, visible (H, W) bool, and calm (H, W): no edge in A or B near."""
    camera_a, camera_b = (reduce_camera(CAMERAS[i], size_wh) for i in pair)
    shown_a, shown_b = find_shown(camera_a), find_shown(camera_b)
    b_from_a = np.array([frame_quad(quad, camera_b) @ np.linalg.inv(frame_quad(quad, camera_a)) for quad in QUADS])
    rows, columns = np.indices(shown_a.shape) + 0.5
    rays = np.einsum("hwij,hwj->hwi", b_from_a[shown_a], np.stack([columns, rows, np.ones_like(rows)], axis=-1))
    mapped = rays[..., :2] / rays[..., 2:]
    inside = (rays[..., 2] > 0) & np.all((mapped >= 0) & (mapped < camera_b.size_wh), axis=-1)
    x, y = np.where(inside[..., None], mapped, 0).astype(int).transpose(2, 0, 1)
    visible = inside & (shown_a >= 0) & (shown_b[y, x] == shown_a)
    to_border = np.minimum(mapped, np.array(camera_b.size_wh) - mapped).min(axis=-1)
    calm = is_calm(shown_a, 6) & is_calm(shown_b, 2)[y, x] & (np.abs(to_border) > 1)

    def pad(field):
        width, height = size_wh
        missing = ((0, height - field.shape[0]), (0, width - field.shape[1]))
        return np.pad(field, missing + ((0, 0),) * (field.ndim - 2))

    return pad(mapped), pad(visible), pad(calm)


def is_calm(shown, radius):
    kernel = np.ones((2 * radius + 1, 2 * radius + 1))
    shown = shown.astype(np.float32)
    return cv2.erode(shown, kernel) == cv2.dilate(shown, kernel)


def map_pixels(b_from_a, surface):
    """(H, W, 2) px of B of all pixel centres of A, NaN where there is no surface."""
    rows, columns = np.indices(surface.shape) + 0.5
    rays = np.einsum("hwij,hwj->hwi", b_from_a[surface].astype(float), np.stack([columns, rows, columns**0], axis=-1))
    return np.where(surface[..., None] >= 0, rays[..., :2] / rays[..., 2:], np.nan)


def measure_errors(folders, pair, size_wh=SIZE_WH):
    """(H, W) px, NaN without a surface; and the masks visible and calm of find_ground_truth."""
    mapped, visible, calm = find_ground_truth(pair, size_wh)
    actual = map_pixels(*relate_depths(*read_views(folders, pair, size_wh), size_wh))
    return np.linalg.norm(actual - mapped, axis=-1), visible, calm


@pytest.mark.parametrize("pair", ALL_PAIRS)
def test_blocks_transfer_points_as_the_scene_does(folders, pair):
    errors, visible, calm = measure_errors(folders, pair)
    related = np.isfinite(errors)
    assert (visible & calm).sum() > 2000
    assert related[visible & calm].mean() > 0.9
    assert errors[related & calm].max() < 0.1
    assert np.median(errors[related & calm]) < 1e-3
    # At an edge, the depth nearest to a pixel's centre may be that of the other side.
    assert (errors[related] < 0.1).mean() > 0.99


@pytest.mark.parametrize("pair", ALL_PAIRS)
def test_what_b_does_not_show_has_no_surface(folders, pair):
    errors, visible, calm = measure_errors(folders, pair)
    assert (~visible & calm).sum() > 200
    assert not np.isfinite(errors[~visible & calm]).any()


def test_half_a_pixel_would_be_noticed(tmp_path, renderings, folders, monkeypatch):
    """By the limits of the test above: of the principal points, and of the depth map alone, which matters less."""
    shifted = write_megadepth(tmp_path, renderings, shift_px=0.5)
    errors, _, calm = measure_errors(shifted, (0, 1))
    assert np.nanmedian(errors[calm]) > 0.2
    exact = megadepth.sample_depth
    monkeypatch.setattr(megadepth, "sample_depth", lambda *args: (exact(*args)[0] - 0.5, exact(*args)[1]))
    errors, _, calm = measure_errors(folders, (0, 1))
    assert np.nanmedian(errors[calm]) > 5e-3


def test_hidden_points_are_found_by_depth_alone(folders):
    """The wall behind the board, projected into B, falls onto the board."""
    view_a, view_b = read_views(folders, (0, 2))
    _, surface = relate_depths(view_a, view_b, SIZE_WH)
    wall_only = render_view(QUADS[:1], CAMERAS[2]).depth
    through = dataclasses.replace(view_b, depth=np.where(np.isfinite(wall_only), wall_only, 0))
    _, unhidden = relate_depths(view_a, through, SIZE_WH)
    assert ((unhidden >= 0) & (surface < 0)).sum() > 300
    shown = np.pad(find_shown(view_a.camera), ((0, 16), (0, 0)), constant_values=-1)
    assert (surface >= 0)[shown == 1].mean() > 0.5 and (unhidden >= 0)[shown == 1].mean() < 0.01


@pytest.mark.parametrize(("factor", "kept"), [(1.005, True), (0.97, False), (1.03, False), (0.0, False)])
def test_depths_must_agree(folders, factor, kept):
    view_a, view_b = read_views(folders, (0, 0))
    _, surface = relate_depths(view_a, dataclasses.replace(view_b, depth=view_b.depth * np.float32(factor)), SIZE_WH)
    assert (surface >= 0).any() == kept


@pytest.mark.parametrize(("baseline", "kept"), [(0.5, True), (2.0, False)])
def test_the_same_error_of_depth_counts_more_where_there_is_more_parallax(baseline, kept):
    """At 5 m and 290 px, an error of 1.5 % moves a point by 0.43 px over half a metre, by 1.7 px over two."""
    depth, grey = np.full((240, 320), 5, np.float32), np.zeros((240, 320), np.float32)
    aside = PinholeView(CAMERAS[0].K, (320, 240), np.column_stack([np.eye(3), [-baseline, 0, 0]]))
    _, surface = relate_depths(
        DepthView(grey, CAMERAS[0], depth), DepthView(grey, aside, depth * np.float32(1.015)), (320, 240)
    )
    assert (surface >= 0).any() == kept


def test_blocks_without_plane_or_depth_have_no_surface(folders):
    view_a, view_b = read_views(folders, (0, 1))
    _, surface = relate_depths(view_a, view_b, SIZE_WH)
    holes = view_a.depth.copy()
    holes[:, :160] = 0
    rough = view_a.depth * np.random.default_rng(0).uniform(0.9, 1.1, view_a.depth.shape).astype(np.float32)
    _, beside_holes = relate_depths(dataclasses.replace(view_a, depth=holes), view_b, SIZE_WH)
    assert (surface[:, :96] >= 0).sum() > 1000
    assert (beside_holes[:, :96] == -1).all()
    assert np.array_equal(beside_holes[:, 104:], surface[:, 104:])
    b_from_a, on_noise = relate_depths(dataclasses.replace(view_a, depth=rough), view_b, SIZE_WH)
    assert (on_noise >= 0).sum() < 0.05 * (surface >= 0).sum()
    assert np.isfinite(b_from_a).all()


def test_views_without_any_depth_are_related_nowhere(folders):
    view_a, view_b = read_views(folders, (0, 1))
    b_from_a, surface = relate_depths(dataclasses.replace(view_a, depth=0 * view_a.depth), view_b, SIZE_WH)
    assert (surface == -1).all()
    assert np.array_equal(b_from_a, np.tile(np.eye(3, dtype=np.float32), (24 * 20, 1, 1)))


def test_photos_agree_where_they_show_the_same(folders):
    """The photos themselves say whether they and their depth maps are in one frame."""
    view_a, view_b = read_views(folders, (0, 1))
    mapped = map_pixels(*relate_depths(view_a, view_b, SIZE_WH))[: view_a.grey.shape[0], : view_a.grey.shape[1]]
    related = np.isfinite(mapped[..., 0])

    def measure_difference(shift):
        index = (mapped[related] + shift - 0.5).astype(np.float32)[None]
        return np.abs(cv2.remap(view_b.grey, index, None, cv2.INTER_LINEAR)[0] - view_a.grey[related]).mean()

    exact = measure_difference((0, 0))
    for shift in ((0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)):
        assert exact < measure_difference(shift)


def test_items_have_the_common_form(folders):
    pairs = MegaDepthPairs(*folders, SIZE_WH, seed=3, count=20)
    width, height = SIZE_WH
    assert len(pairs) == 20
    sizes = set()
    for index in range(4):
        item = pairs[index]
        assert item["images"].shape == (2, height, width) and item["images"].dtype == np.uint8
        assert item["b_from_a"].shape == (24 * 20, 3, 3) and item["b_from_a"].dtype == np.float32
        assert item["surface"].shape == (height, width) and item["surface"].dtype == np.int64
        rows, columns = np.nonzero(item["surface"] >= 0)
        assert len(rows) > 1000
        assert np.array_equal(item["surface"][rows, columns], rows // 8 * 24 + columns // 8)
        assert item["points"].shape == (POINTS, 4) and item["points"].dtype == np.float32
        assert np.isnan(item["points"]).all()
        for image, surface in zip(item["images"], (item["surface"], None)):
            landscape = not image[144:].any()
            sizes.add("landscape" if landscape else "portrait")
            assert landscape or not image[:, 120:].any()
            if surface is not None:
                assert (surface[144:] == -1).all() if landscape else (surface[:, 120:] == -1).all()
    assert sizes == {"landscape", "portrait"}


def test_items_depend_on_seed_and_index_alone(folders):
    pairs, again = (MegaDepthPairs(*folders, SIZE_WH, seed=3, count=20) for _ in range(2))
    pairs[0]
    for key, value in again[5].items():
        assert np.array_equal(value, pairs[5][key], equal_nan=key == "points")
    assert not np.array_equal(pairs[5]["images"], pairs[6]["images"])
    other = MegaDepthPairs(*folders, SIZE_WH, seed=4, count=20)
    assert not np.array_equal(pairs[5]["images"], other[5]["images"])


def test_patches_are_supervised_by_the_blocks(folders):
    size_wh = (160, 160)
    b_from_a, surface = relate_depths(*read_views(folders, (0, 1), size_wh), size_wh)
    mapped, _, calm = find_ground_truth((0, 1), size_wh)
    fine = LightBackbone.fine_grid
    supervision = draw_patches(
        torch.tensor(b_from_a)[None],
        torch.tensor(surface)[None],
        torch.ones(1, 2, 1, 20, 20),
        400,
        LightBackbone.coarse_grid,
        fine,
        4.0,
        torch.Generator().manual_seed(0),
    )
    centre0, centre1 = (fine.to_px(cell.double()).numpy() for cell in (supervision.cell0, supervision.cell1))
    moved = supervision.homography[:, :2, 2] / supervision.homography[:, 2:, 2]
    actual = centre1 + 2 * moved.numpy()
    checked = 0
    for i in supervision.correct.nonzero().flatten().tolist():
        # A patch's centre is a corner of four pixels.
        x, y = centre0[i].astype(int)
        if calm[y - 1 : y + 1, x - 1 : x + 1].all():
            np.testing.assert_allclose(actual[i], mapped[y - 1 : y + 1, x - 1 : x + 1].mean(axis=(0, 1)), atol=0.1)
            checked += 1
    assert checked > 20


# Files


@pytest.mark.parametrize(
    ("overlap", "expected"),
    [
        (OverlapRange(), [{(0, 1), (0, 2)}, {(1, 2)}]),
        (OverlapRange(0.0, 1.0), [{(0, 1), (1, 2), (0, 2)}, {(1, 2), (0, 1)}]),
        (OverlapRange(0.2, 0.5), [{(0, 2)}]),
    ],
)
def test_pairs_are_chosen_by_overlap(folders, overlap, expected):
    def number(path):
        return int(Path(path).stem)

    actual = [
        {tuple(number(scene.image_paths[i]) for i in pair) for pair in scene.pairs}
        for scene in load_scenes(*folders, overlap)
    ]
    assert actual == expected


def test_photos_that_no_pair_names_are_left_out(folders):
    scene = read_scene(folders[1] / "0000_0.1_0.3.npz", OverlapRange(0.2, 0.5))
    assert [Path(path).name for path in scene.depth_paths] == ["0.h5", "2.h5"]
    np.testing.assert_array_equal(scene.K, [CAMERAS[0].K, CAMERAS[2].K])
    np.testing.assert_array_equal(scene.cam_from_world, [CAMERAS[0].cam_from_world, CAMERAS[2].cam_from_world])


@pytest.fixture
def damaged(tmp_path, renderings):
    return write_megadepth(tmp_path, renderings)


def change_info(path: Path, **changes) -> None:
    with open(path, "rb") as file:
        content = dict(np.load(file, allow_pickle=True))
    content |= changes
    with open(path, "wb") as file:
        pickle.dump({key: value for key, value in content.items() if value is not None}, file)


def put_nan(poses):
    poses[1] = np.full((4, 4), np.nan)
    return poses


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.write_bytes(b"no archive"), "cannot read the scene_info file .*0000_0.1_0.3.npz"),
        (lambda path: path.write_bytes(b""), "cannot read the scene_info file .*0000_0.1_0.3.npz"),
        (lambda path: np.save(path.open("wb"), np.zeros(3)), "0000_0.1_0.3.npz lacks image_paths"),
        (lambda path: change_info(path, pair_infos=None), "0000_0.1_0.3.npz lacks pair_infos"),
        (lambda path: change_info(path, pair_infos=make_pairs((0, 1, 0.5))), "0000_0.1_0.3.npz holds a pair without"),
        (lambda path: change_info(path, pair_infos=make_pairs((1, 9, 0.5))), "0000_0.1_0.3.npz holds a pair without"),
        (lambda path: change_info(path, pair_infos=np.zeros(3)), "0000_0.1_0.3.npz holds a pair without"),
        (
            lambda path: change_info(path, poses=put_nan(make_objects([None] + [np.eye(4)] * 3))),
            "0000_0.1_0.3.npz holds intrinsics or poses that are not finite",
        ),
    ],
)
def test_unusable_scene_info_is_named(damaged, damage, message):
    damage(damaged[1] / "0000_0.1_0.3.npz")
    with pytest.raises(InputError, match=message):
        load_scenes(*damaged, OverlapRange())


def test_missing_files_are_noticed_at_once(damaged, tmp_path):
    root, scene_info = damaged
    with pytest.raises(InputError, match="the MegaDepth folder .*nowhere is missing"):
        MegaDepthPairs(tmp_path / "nowhere", scene_info, SIZE_WH, 0, 1)
    with pytest.raises(InputError, match="the MegaDepth folder .*0000_0.1_0.3.npz is not a folder"):
        MegaDepthPairs(root, scene_info / "0000_0.1_0.3.npz", SIZE_WH, 0, 1)
    with pytest.raises(InputError, match=r"holds no scene_info file \(\*.npz\)"):
        MegaDepthPairs(root, root, SIZE_WH, 0, 1)
    with pytest.raises(InputError, match="no pair in .*index has an overlap between 0.8 and 0.9"):
        MegaDepthPairs(root, scene_info, SIZE_WH, 0, 1, OverlapRange(0.8, 0.9))
    with pytest.raises(ConfigError, match=r"multiples of 8 px, found \(100, 96\)"):
        MegaDepthPairs(root, scene_info, (100, 96), 0, 1)
    for path in (next(root.rglob("2.h5")), next(root.rglob("0.png"))):
        path.unlink()
        with pytest.raises(InputError, match=f"{path.name} is missing, which .*npz names"):
            MegaDepthPairs(root, scene_info, SIZE_WH, 0, 1)


def write_depth(path: Path, name: str, value) -> None:
    with h5py.File(path, "w") as file:
        file[name] = value


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("1.h5", lambda path: path.write_bytes(path.read_bytes()[:500]), "cannot read the depth map .*1.h5"),
        ("1.h5", lambda path: write_depth(path, "other", np.ones((240, 320))), "cannot read the depth map .*1.h5"),
        ("1.h5", lambda path: write_depth(path, "depth", np.ones(5)), r"1.h5 must have 2 dimensions, .* \(5,\)"),
        ("1.h5", lambda path: write_depth(path, "depth", np.ones((120, 160))), "found 160 x 120 and 320 x 240 px"),
        ("1.png", lambda path: path.write_bytes(b"no photo"), "cannot read the photo .*1.png"),
    ],
)
def test_damaged_photos_and_depth_maps_are_named_by_their_item(damaged, name, damage, message):
    pairs = MegaDepthPairs(*damaged, SIZE_WH, seed=0, count=10, overlap=OverlapRange(0.5, 0.7))
    damage(next(damaged[0].rglob(name)))
    with pytest.raises(InputError, match=message):
        pairs[0]
