"""Bad input ends in one clear line on stderr and the right exit code, and nothing that was computed is lost."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from hm_sfm.network import checkpoints
from hm_sfm.photos.images import list_images, prepare_image
from hm_sfm.synthetic.textures import make_texture


def assert_refused(finished, *parts: object, code: int = 2) -> None:
    """One line, `hm-sfm: ...`, that holds all `parts`; nothing on stdout."""
    assert finished.code == code
    assert finished.err.startswith("hm-sfm: ") and finished.err.count("\n") == 1, finished.err
    for part in parts:
        assert str(part) in finished.err
    assert finished.out == ""


def copy_photos(scene, folder: Path, count: int = 5) -> Path:
    folder.mkdir()
    for name in list(scene.views)[:count]:
        shutil.copy(scene.images / name, folder)
    return folder


def write_unrelated_photos(folder: Path) -> Path:
    """Three photos of different things."""
    folder.mkdir()
    for seed, material in enumerate(("bricks", "mural", "planks")):
        texture = make_texture(np.random.default_rng(seed), material, (3.2, 2.4), 100)
        cv2.imwrite(str(folder / f"{material}.jpg"), texture)
    return folder


# Photos


def test_no_image_folder(tmp_path, run):
    assert_refused(run("reconstruct", tmp_path / "none", tmp_path / "out"), tmp_path / "none", "does not exist")
    (tmp_path / "file").touch()
    assert_refused(run("reconstruct", tmp_path / "file", tmp_path / "out"), tmp_path / "file", "is not a folder")
    assert not (tmp_path / "out").exists()


def test_no_images(tmp_path, run):
    (tmp_path / "photos").mkdir()
    assert_refused(run("reconstruct", tmp_path / "photos", tmp_path / "out"), tmp_path / "photos", "no image")
    assert not (tmp_path / "out").exists()


def test_one_image(scene, tmp_path, run):
    photos = copy_photos(scene, tmp_path / "photos", count=1)
    assert_refused(run("reconstruct", photos, tmp_path / "out"), "at least 2 images", "found 1")
    assert not (tmp_path / "out").exists()


def test_a_folder_of_text_files(tmp_path, run):
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("notes.txt", "list.csv"):
        (photos / name).write_text("no photo")
    assert_refused(run("match", photos, tmp_path / "out"), photos, "2 files but no image")


def test_text_files_named_like_photos(tmp_path, run):
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("a.jpg", "b.png"):
        (photos / name).write_text("no photo")
    finished = run("match", photos, tmp_path / "out", "--quiet")
    assert_refused(finished, photos, "2 images but none can be used", photos / "a.jpg")


@pytest.mark.slow
def test_a_truncated_photo_among_good_ones(scene, tmp_path, run, caplog):
    photos = copy_photos(scene, tmp_path / "photos")
    data = (photos / "view_02.jpg").read_bytes()
    (photos / "view_02.jpg").write_bytes(data[: len(data) // 2])
    finished = run("reconstruct", photos, tmp_path / "out", "--quiet")
    assert (finished.code, finished.err) == (0, "")
    assert caplog.messages == [f"skipped: {photos / 'view_02.jpg'} is cut short or cannot be decoded"]
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["num_images"], summary["skipped_images"], summary["registered"]) == (4, 1, 4)


@pytest.mark.slow
def test_photos_of_16_bits_grey_rgba_and_cmyk(scene, tmp_path, run):
    photos = tmp_path / "photos"
    photos.mkdir()
    first, second, third, fourth, fifth = (scene.images / name for name in scene.views)
    colours = cv2.imread(str(first))
    cv2.imwrite(str(photos / "0_16_bits.png"), colours.astype(np.uint16) * 257)
    cv2.imwrite(str(photos / "1_grey.jpg"), cv2.imread(str(second), cv2.IMREAD_GRAYSCALE))
    colours = cv2.imread(str(third))
    alpha = np.full((*colours.shape[:2], 1), 255, np.uint8)
    alpha[:100] = 0
    cv2.imwrite(str(photos / "2_rgba.png"), np.concatenate([colours, alpha], axis=2))
    Image.open(fourth).convert("CMYK").save(photos / "3_cmyk.jpg", quality=95)
    shutil.copy(fifth, photos / "4_colour.jpg")

    # Four of these files have lost their EXIF.
    finished = run("reconstruct", photos, tmp_path / "out", "--camera-mode", "single")
    assert finished.code == 0, finished.err
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["num_images"], summary["skipped_images"], summary["registered"]) == (5, 0, 5)


def test_a_tiny_photo_is_skipped(scene, tmp_path, run, caplog):
    photos = copy_photos(scene, tmp_path / "photos", count=2)
    cv2.imwrite(str(photos / "tiny.png"), np.zeros((20, 20, 3), np.uint8))
    finished = run("match", photos, tmp_path / "out")
    assert finished.code == 0
    assert finished.out.startswith("1 pairs of 2 images matched")
    assert caplog.messages == [f"skipped: {photos / 'tiny.png'} is 20 x 20 px, at least 32 px a side are needed"]


@pytest.mark.slow
def test_a_huge_photo_is_listed_and_reduced(tmp_path):
    cells = np.random.default_rng(0).integers(0, 255, (90, 120), np.uint8)
    huge = np.kron(cells, np.ones((100, 100), np.uint8))
    assert huge.shape == (9000, 12000)
    cv2.imwrite(str(tmp_path / "huge.jpg"), huge)
    (image,) = list_images(tmp_path).images
    assert image.size_wh == (12000, 9000)
    prepared = prepare_image(image, 1024)
    assert prepared.scaled_wh == (1024, 768)
    np.testing.assert_allclose(prepared.stored_from_scaled[:2, :2], np.diag([12000 / 1024, 9000 / 768]))


@pytest.mark.slow
def test_two_identical_photos_make_no_model(scene, tmp_path, run):
    photos = copy_photos(scene, tmp_path / "photos", count=1)
    shutil.copy(photos / "view_00.jpg", photos / "view_01.jpg")
    finished = run("reconstruct", photos, tmp_path / "out", "--quiet")
    assert_refused(finished, "no model could be built from 2 images", tmp_path / "out", code=3)


@pytest.mark.slow
def test_photos_with_nothing_in_common_keep_database_and_matches(tmp_path, run, read_matches):
    photos = write_unrelated_photos(tmp_path / "photos")
    out = tmp_path / "out"
    finished = run("reconstruct", photos, out, "--quiet")
    assert_refused(finished, "no model could be built from 3 images", out, code=3)
    assert len(read_matches(out / "matches.h5")) == 3
    with pycolmap.Database.open(out / "database.db") as database:
        assert database.num_images() == 3
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["num_images"], summary["registered"], summary["models"], summary["points"]) == (3, 0, 0, 0)
    assert not (out / "sparse").exists()


# Pairs


@pytest.mark.parametrize(
    ("lines", "parts"),
    [
        (
            "view_00.jpg view_09.jpg\nnone.jpg view_01.jpg\nview_00.jpg view_01.jpg\n",
            ["'view_09.jpg' (line 1)", "'none.jpg' (line 2)"],
        ),
        ("view_00.jpg view_01.jpg\nview_02.jpg view_02.jpg\n", ["line 2", "paired with itself"]),
        ("view_00.jpg\n", ["line 1", "expected two names"]),
        ("", ["holds no pair"]),
    ],
    ids=["unknown", "self", "one name", "empty"],
)
def test_a_bad_pairs_file(lines, parts, scene, tmp_path, run):
    pairs = tmp_path / "pairs.txt"
    pairs.write_text(lines)
    assert_refused(run("match", scene.images, tmp_path / "out", "--pairs", pairs), pairs, *parts)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("mode", ["nearest", "sequental"])
def test_a_pairs_mode_that_does_not_exist(mode, scene, tmp_path, run):
    assert_refused(run("match", scene.images, tmp_path / "out", "--pairs", mode), repr(mode))


# OUT


def test_out_of_other_photos(out, tmp_path, run, digest_files):
    photos = write_unrelated_photos(tmp_path / "photos")
    before = digest_files(out)
    assert_refused(run("reconstruct", photos, out), out / "matches.h5", "made from other photos", "name another OUT")
    assert digest_files(out) == before


@pytest.mark.parametrize("setting", ["images.long_edge_px=256", "matching.min_cosine=0.7"])
def test_out_of_another_configuration(setting, scene, out, run, digest_files):
    before = digest_files(out)
    key, value = setting.split("=")
    assert_refused(run("reconstruct", scene.images, out, "--set", setting), out / "matches.h5", key, value)
    assert digest_files(out) == before


def test_out_that_somebody_else_filled(scene, tmp_path, run, digest_files):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter_1.tex").write_text("not to be touched")
    before = digest_files(tmp_path)
    for command in (["reconstruct", scene.images], ["demo"]):
        assert_refused(run(*command, tmp_path / "thesis"), tmp_path / "thesis", "is not empty")
    assert digest_files(tmp_path) == before


def test_out_that_cannot_be_made(scene, tmp_path, run):
    (tmp_path / "file").touch()
    assert_refused(run("match", scene.images, tmp_path / "file" / "out"), tmp_path / "file" / "out", "Not a directory")
    assert_refused(run("match", scene.images, tmp_path / "file"), tmp_path / "file", "File exists")


def test_out_that_is_read_only(scene, out, run, monkeypatch, digest_files):
    """Simulated, since root, whom containers run tests as, may write everywhere."""

    def refuse(path, *_, **__):
        raise PermissionError(13, "Permission denied", str(path))

    before = digest_files(out)
    monkeypatch.setattr(Path, "touch", refuse)
    assert_refused(run("reconstruct", scene.images, out), out, "Permission denied")
    assert digest_files(out) == before


def test_a_full_disk_keeps_the_model_that_was_there(scene, out, run, monkeypatch, digest_files):
    """Simulated where the database is written, after matching."""

    def refuse(path, *_, **__):
        raise OSError(28, "No space left on device", str(path))

    before = digest_files(out)
    monkeypatch.setattr("hm_sfm.pipeline.run.write_database", refuse)
    finished = run("reconstruct", scene.images, out, "--quiet")
    assert_refused(finished, out / "database.db", "No space left on device")
    assert digest_files(out) == before


@pytest.mark.parametrize("content", [b"", b"no HDF5"], ids=["empty", "foreign"])
def test_a_damaged_matches_file(content, scene, out, run):
    (out / "matches.h5").write_bytes(content)
    assert_refused(run("match", scene.images, out), out / "matches.h5", "damaged")
    assert (out / "matches.h5").read_bytes() == content


# Configuration and weights


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--set", "images.long_edge=640"], ["'long_edge'", "did you mean 'long_edge_px'"]),
        (["--set", "pictures.long_edge_px=640"], ["'pictures'"]),
        (["--set", "images.long_edge_px=large"], ["images.long_edge_px must be of type int", "'large'"]),
        (["--set", "images.long_edge_px"], ["section.key=value"]),
        (["--set", "images.long_edge_px=16"], ["images.long_edge_px must be at least 32", "16"]),
        (
            ["--set", "keypoints.carry_score=0.5"],
            ["the key 'keypoints.carry_score' is now called keypoints.propagation_min_score"],
        ),
        (["--set", "network.head=magic"], ["network.head must be homography or expectation, found 'magic'"]),
        (["--config", "none.yaml"], ["none.yaml", "No such file"]),
        (["--camera-mode", "triple"], ["cameras.mode must be auto, single", "'triple'"]),
        (["--camera-model", "PINHOL"], ["'PINHOL'", "did you mean 'PINHOLE'"]),
        (["--camera-params", "500,oops"], ["'500,oops'", "SIMPLE_RADIAL expects 4 numbers"]),
        (["--device", "abacus"], ["matching.device must be auto, cpu or cuda", "'abacus'"]),
        (["--model", "none.pt"], ["'none.pt'", "light"]),
    ],
    ids=lambda value: " ".join(value) if value[0].startswith("--") else "",
)
def test_a_bad_setting(arguments, parts, scene, tmp_path, run):
    assert_refused(run("match", scene.images, tmp_path / "out", *arguments, "--quiet"), *parts)


def test_an_unknown_key_in_a_configuration_file(scene, tmp_path, run):
    config = tmp_path / "mine.yaml"
    config.write_text("keypoints: {max_keypoint: 10}\n")
    finished = run("match", scene.images, tmp_path / "out", "--config", config)
    assert_refused(finished, config, "'max_keypoint'", "did you mean 'max_keypoints'")
    config.write_text("matching: {retry_turned: false}\n")
    finished = run("match", scene.images, tmp_path / "out", "--config", config)
    assert_refused(finished, f"{config}: the key 'matching.retry_turned' is now called matching.try_hypotheses")
    config.write_text("keypoints: {max")
    assert_refused(run("match", scene.images, tmp_path / "out", "--config", config), config, "not valid YAML")


@pytest.mark.parametrize("damage", ["cut", "text", "empty"])
def test_a_damaged_weights_file(damage, scene, tmp_path, run):
    weights = tmp_path / "mine.pt"
    whole = checkpoints.find_weights("light").read_bytes()
    weights.write_bytes({"cut": whole[: len(whole) // 2], "text": b"no weights", "empty": b""}[damage])
    finished = run("match", scene.images, tmp_path / "out", "--model", weights)
    assert_refused(finished, weights, "is damaged or no hm_sfm weights file")


def test_damaged_bundled_weights(scene, out, tmp_path, run, monkeypatch, digest_files):
    bundled = Path(shutil.copytree(checkpoints.WEIGHTS_FOLDER, tmp_path / "weights"))
    data = bytearray((bundled / "light.pt").read_bytes())
    data[len(data) // 2] ^= 1
    (bundled / "light.pt").write_bytes(data)
    monkeypatch.setattr(checkpoints, "WEIGHTS_FOLDER", bundled)
    before = digest_files(out)
    assert_refused(run("match", scene.images, out), bundled / "light.pt", "is damaged: its sha256 is")
    assert digest_files(out) == before


# The command line


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ([], "COMMAND"),
        (["rebuild"], "'rebuild'"),
        (["match", "photos"], "OUT"),
        (["match", "photos", "out", "--fast"], "--fast"),
        (["train"], "--config"),
    ],
    ids=str,
)
def test_bad_arguments(arguments, part, run):
    assert_refused(run(*arguments), part, "--help")
