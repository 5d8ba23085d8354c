"""Photos with the same logo in all of them."""

import cv2
import numpy as np

from hm_sfm.colmap.database import read_verified_matches
from hm_sfm.photos.exif import write_jpeg


def make_texture(width: int, height: int, seed: int) -> np.ndarray:
    """(H, W, 3) uint8: smoothed noise."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(height, width)), (0, 0), 2)
    return np.repeat(np.clip(128 + 50 * noise / noise.std(), 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)


def test_a_logo_joins_no_places(scene, tmp_path, run, caplog):
    """Two places, a courtyard and a wall, each seen by two photos."""
    courtyard = [cv2.imread(str(scene.images / name))[:, :, ::-1] for name in ("view_00.jpg", "view_01.jpg")]
    wall = make_texture(360, 260, 1)
    photos = {"a0": courtyard[0], "a1": courtyard[1], "b0": wall[:240, :320], "b1": wall[20:, 40:]}
    (tmp_path / "photos").mkdir()
    for name, photo in photos.items():
        with_logo = photo.copy()
        with_logo[10:110, 180:310] = make_texture(130, 100, 2)
        write_jpeg(tmp_path / "photos" / f"{name}.jpg", with_logo, 28)
    finished = run("export", tmp_path / "photos", tmp_path / "out")
    assert finished.code == 0, finished.err
    assert any("stays in its place while the scene moves" in message for message in caplog.messages)
    verified = read_verified_matches(tmp_path / "out" / "database.db")
    assert {(pair.name0, pair.name1) for pair in verified} == {("a0.jpg", "a1.jpg"), ("b0.jpg", "b1.jpg")}
    assert min(map(len, verified.values())) > 50
