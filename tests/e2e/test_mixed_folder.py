"""A folder as people have it: two cameras, photos on their side, equal names, masks, a damaged file."""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image, ImageOps

from hm_sfm.colmap.database import open_database, read_verified_matches
from hm_sfm.evaluation.poses import score_model
from hm_sfm.photos.exif import write_jpeg
from hm_sfm.synthetic.demo import COLMAP_DIAGONAL_35MM, make_demo_scene, make_demo_views
from hm_sfm.synthetic.rendering import render_view
from hm_sfm.types import PinholeView

pytestmark = pytest.mark.slow

LENSES = {"camera": ((384, 256), 35), "phone": ((320, 240), 28)}
"""Folder -> stored size, 35 mm equivalent focal length."""
ORIENTATIONS = {"camera": (1, 8, 1), "phone": (1, 6, 8)}
"""Folder -> EXIF orientation of 0.jpg, 1.jpg ...; places alternate between the folders."""
STORED_FROM_UPRIGHT = {
    1: np.eye(3),
    6: np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]]),
    8: np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]),
}
"""EXIF orientation -> how the frame of the camera is turned about its axis against the upright one."""
HIDDEN = {"phone/1.jpg": np.s_[:, :110], "camera/1.jpg": np.s_[170:, :]}
"""What the masks of two photos on their side hide, in stored pixels."""


@dataclass(frozen=True)
class Mixed:
    images: Path
    masks: Path
    views: dict[str, PinholeView]
    """Image name -> the camera of the stored pixels."""
    depths: dict[str, np.ndarray]
    """Image name -> (H, W) z-depth of the stored pixels."""


@pytest.fixture(scope="module")
def mixed(tmp_path_factory) -> Mixed:
    folder = tmp_path_factory.mktemp("mixed")
    quads = make_demo_scene()
    views, depths = {}, {}
    for index, upright in enumerate(make_demo_views(6)):
        place, number = sorted(LENSES)[index % 2], index // 2
        size_wh, focal_35mm = LENSES[place]
        orientation = ORIENTATIONS[place][number]
        focal_px = focal_35mm * np.hypot(*size_wh) / COLMAP_DIAGONAL_35MM
        k = np.array([[focal_px, 0, size_wh[0] / 2], [0, focal_px, size_wh[1] / 2], [0, 0, 1]])
        view = PinholeView(k, size_wh, STORED_FROM_UPRIGHT[orientation] @ upright.cam_from_world)
        rendering = render_view(quads, view)
        name = f"{place}/{number}.jpg"
        views[name], depths[name] = view, rendering.depth
        (folder / "images" / place).mkdir(parents=True, exist_ok=True)
        write_jpeg(folder / "images" / name, rendering.image, focal_35mm, orientation)
    whole = (folder / "images" / "phone" / "0.jpg").read_bytes()
    (folder / "images" / "phone" / "broken.jpg").write_bytes(whole[: len(whole) // 2])
    for name, hidden in HIDDEN.items():
        mask = np.full(depths[name].shape, 255, np.uint8)
        mask[hidden] = 0
        (folder / "masks" / name).parent.mkdir(parents=True)
        cv2.imwrite(str(folder / "masks" / f"{name}.png"), mask)
    return Mixed(folder / "images", folder / "masks", views, depths)


def is_hidden(name: str, xy: np.ndarray, mixed: Mixed) -> np.ndarray:
    """(N,) bool, for (N, 2) px of the stored photo."""
    hidden = np.zeros(mixed.depths[name].shape, bool)
    hidden[HIDDEN[name]] = True
    column, row = np.floor(xy).astype(int).T
    return hidden[row, column]


def transfer_truly(xy: np.ndarray, name: str, other: str, mixed: Mixed) -> np.ndarray:
    """Where points of one stored photo are in another one, (N, 2) px, by the depth of their pixels; the sky is far."""
    view, (column, row) = mixed.views[name], np.floor(xy).astype(int).T
    rays = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(view.K).T
    in_camera = rays * np.minimum(mixed.depths[name][row, column], 1000)[:, None]
    world = (in_camera - view.cam_from_world[:, 3]) @ view.cam_from_world[:, :3]
    return mixed.views[other].project(world)[0]


def test_a_mixed_folder_becomes_one_model_in_stored_pixels(mixed, tmp_path, run, read_matches, caplog):
    out = tmp_path / "out"
    finished = run("reconstruct", mixed.images, out, "--masks", mixed.masks)
    assert finished.code == 0, finished.err
    assert finished.out.startswith("6 of 6 images registered")
    skipped, unmasked = caplog.messages
    assert str(mixed.images / "phone" / "broken.jpg") in skipped and unmasked.startswith("4 of 6 images have no mask")
    assert json.loads((out / "summary.json").read_text())["skipped_images"] == 1

    # Two cameras, each that of its folder and in stored size, though names are equal and photos lie on their side.
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    assert {image.name for image in model.images.values() if image.has_pose} == mixed.views.keys()
    assert model.num_cameras() == 2
    for image in model.images.values():
        size_wh, focal_35mm = LENSES[image.name.split("/")[0]]
        assert (image.camera.width, image.camera.height) == size_wh
        focal_px = focal_35mm * np.hypot(*size_wh) / COLMAP_DIAGONAL_35MM
        assert image.camera.focal_length == pytest.approx(focal_px, rel=0.03)
        assert image.num_points3D > 100
    assert score_model(model, mixed.views).auc_percent[3] > 80

    # Matching keypoints are the same point of the scene.
    with open_database(out / "database.db") as database:
        xy_of = {row.name: database.read_keypoints(row.image_id)[:, :2] for row in database.read_all_images()}
    errors = []
    for pair, matches in read_verified_matches(out / "database.db").items():
        xy0, xy1 = xy_of[pair.name0][matches[:, 0]], xy_of[pair.name1][matches[:, 1]]
        errors.append(np.linalg.norm(transfer_truly(xy0, pair.name0, pair.name1, mixed) - xy1, axis=1))
    assert len(errors) > 8
    errors_px = np.concatenate(errors)
    assert np.median(errors_px) < 0.5
    assert np.quantile(errors_px, 0.8) < 1.5

    # Nothing masked is matched, though the network sees matches there.
    stored = read_matches(out / "matches.h5")
    for name in HIDDEN:
        xy = [data[f"xy{names.index(name)}"] for names, data in stored.items() if name in names]
        assert is_hidden(name, np.concatenate(xy), mixed).sum() > 50
        assert not is_hidden(name, xy_of[name], mixed).any()
        assert len(xy_of[name]) > 100

    # Converted photos lie as the model sees them, with their masks.
    assert run("convert", out, "--to", "nerfstudio", tmp_path / "converted").code == 0
    for frame in json.loads((tmp_path / "converted" / "transforms.json").read_text())["frames"]:
        name = frame["file_path"].removeprefix("images/")
        with Image.open(tmp_path / "converted" / frame["file_path"]) as photo:
            assert ImageOps.exif_transpose(photo).size == photo.size == (frame["w"], frame["h"])
        mask = cv2.imread(str(tmp_path / "converted" / frame["mask_path"]), cv2.IMREAD_GRAYSCALE)
        assert mask.shape == (frame["h"], frame["w"]) and (0 in mask) == (name in HIDDEN)
