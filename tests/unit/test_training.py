"""Training: pairs made of photos, supervision, and a loop that can be interrupted at any step."""

import csv
import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from hm_sfm.config import NetworkConfig, load_config
from hm_sfm.errors import ConfigError, HmSfmError, InputError, WeightsError
from hm_sfm.network.backbone import LightBackbone, XFeatTrunk, load_xfeat
from hm_sfm.network.fine import FineEstimate
from hm_sfm.network.homography import apply_homography, homography_from_corners, make_corners
from hm_sfm.network.model import load_weights
from hm_sfm.training import loop
from hm_sfm.training.loop import TrainConfig, learning_rate_at, train
from hm_sfm.training.losses import measure_errors, measure_loss
from hm_sfm.training.photos import (
    WarpedPhotos,
    WarpRange,
    disturb_view,
    draw_views,
    load_photos,
    render_view,
    split_photos,
)
from hm_sfm.training.supervision import PatchSupervision, draw_patches

COARSE, FINE = LightBackbone.coarse_grid, LightBackbone.fine_grid
HALF = 4.0


def make_photo(width: int, height: int, seed: int = 0) -> np.ndarray:
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(height, width)), (0, 0), 2.5)
    return np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)


def write_photos(folder: Path, count: int = 4) -> Path:
    folder.mkdir()
    for i in range(count):
        cv2.imwrite(str(folder / f"{i}.png"), make_photo(160, 144, i))
    return folder


def write_xfeat(path: Path) -> Path:
    """A file with the names of XFeat's, including its heads, and random values."""
    torch.manual_seed(5)
    trunk = XFeatTrunk()
    content = {"keypoint_head.0.layer.0.weight": torch.zeros(64, 64, 1, 1)}
    for name, value in trunk.state_dict().items():
        parts = name.split(".")
        if len(parts) == 4:
            parts.insert(2, "layer")
        content[".".join(parts)] = value
    torch.save(content, path)
    return path


# Pairs


def wave(xy: np.ndarray) -> np.ndarray:
    """A smooth image that is known everywhere: (..., 2) px -> (...)."""
    x, y = xy[..., 0], xy[..., 1]
    return 128 + 50 * np.sin(x / 13 + y / 31) + 40 * np.cos(y / 11 - x / 23) + 20 * np.sin((x + y) / 9)


def make_pixel_centres(width: int, height: int) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)


def map_points(homography: np.ndarray, xy: np.ndarray) -> np.ndarray:
    mapped = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1) @ homography.T
    return mapped[..., :2] / mapped[..., 2:]


@pytest.mark.parametrize("seed", range(6))
def test_views_show_the_photo_where_their_homography_says(seed):
    """To a tenth of a pixel: the wave changes by up to 9 grey values a pixel of the photo."""
    width, height, size = 400, 300, 128
    photo = np.round(wave(make_pixel_centres(width, height))).astype(np.uint8)
    rng = np.random.default_rng(seed)
    for view_from_photo in draw_views(photo.shape, size, WarpRange(), rng):
        view = render_view(photo, view_from_photo, size)
        source = map_points(np.linalg.inv(view_from_photo), make_pixel_centres(size, size))
        inside = np.all((source > 4) & (source < (width - 4, height - 4)), axis=-1)
        error = (view - wave(source))[inside]
        slope = np.abs(np.gradient(view)[0])[inside].mean()
        assert inside.mean() > 0.2
        # A shift of half a pixel would show as a mean error of about half the slope.
        assert np.abs(error).mean() < 0.15 * slope + 1.0
        shift = fit_shift(view, error, inside)
        assert np.abs(shift).max() < 0.1


def fit_shift(view: np.ndarray, error: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """(2,) px: the shift of the view that explains its error best."""
    gradient_y, gradient_x = np.gradient(view)
    slopes = np.stack([gradient_x[inside], gradient_y[inside]], axis=1)
    return np.linalg.lstsq(slopes, error, rcond=None)[0]


def test_the_homography_between_views_is_that_of_the_item():
    """What view A shows at a point, view B shows where b_from_a puts it."""
    photo = np.round(wave(make_pixel_centres(400, 300))).astype(np.uint8)
    size, warp = 128, WarpRange()
    pairs = WarpedPhotos([photo], size, seed=3, count=4, warp=warp)
    for index in range(4):
        item = pairs[index]
        rng = np.random.default_rng([3, index])
        rng.integers(1)
        a_from_photo, b_from_photo = draw_views(photo.shape, size, warp, rng)
        points = make_pixel_centres(size, size)[8:-8:16, 8:-8:16]
        in_photo = map_points(np.linalg.inv(a_from_photo), points)
        np.testing.assert_allclose(
            map_points(item["b_from_a"][0].astype(float), points), map_points(b_from_photo, in_photo), atol=0.05
        )
        assert item["images"].shape == (2, size, size) and item["images"].dtype == np.uint8
        assert item["b_from_a"].dtype == np.float32 and item["b_from_a"][0, 2, 2] == 1


def test_items_depend_on_seed_and_index_alone():
    photos = [make_photo(200, 160, seed) for seed in range(3)]
    first, again, other = (WarpedPhotos(photos, 64, seed, 10, WarpRange()) for seed in (1, 1, 2))
    assert len(first) == 10
    # Whatever was asked for before does not matter.
    assert len(again[0]["images"]) == len(again[5]["images"]) == 2
    for key in ("images", "b_from_a"):
        assert np.array_equal(first[7][key], again[7][key])
        assert not np.array_equal(first[7][key], first[6][key])
        assert not np.array_equal(first[7][key], other[7][key])


def test_views_are_no_farther_apart_than_asked():
    warp = WarpRange(scale=1.5, rotation_deg=20.0, perspective=0.0)
    scales, turns = [], []
    for seed in range(200):
        a_from_photo, b_from_photo = draw_views((300, 400), 128, warp, np.random.default_rng(seed))
        linear = (b_from_photo @ np.linalg.inv(a_from_photo))[:2, :2]
        scales.append(np.sqrt(np.linalg.det(linear)))
        turns.append(np.degrees(np.arctan2(linear[1, 0], linear[0, 0])))
    assert 1 / 1.5 - 1e-6 <= min(scales) < 0.75 and 1.35 < max(scales) <= 1.5 + 1e-6
    assert -20 - 1e-6 <= min(turns) < -15 and 15 < max(turns) <= 20 + 1e-6


def test_disturbing_a_view_keeps_its_geometry():
    view = make_photo(96, 96).astype(np.float32)
    for seed in range(20):
        disturbed = disturb_view(view, np.random.default_rng(seed))
        assert disturbed.shape == view.shape and disturbed.dtype == np.uint8
        spectrum = np.fft.fft2(view - view.mean()) * np.conj(np.fft.fft2(disturbed - disturbed.mean()))
        peak = np.unravel_index(np.fft.ifft2(spectrum).real.argmax(), view.shape)
        assert peak == (0, 0)


# Photos


def test_photos_are_read_grey_reduced_and_in_order(tmp_path, caplog):
    (tmp_path / "b").mkdir()
    cv2.imwrite(str(tmp_path / "b" / "1.JPG"), make_photo(1280, 900))
    cv2.imwrite(str(tmp_path / "a.png"), np.stack([make_photo(200, 300)] * 3, axis=-1))
    cv2.imwrite(str(tmp_path / "small.png"), make_photo(127, 300))
    (tmp_path / "bad.png").write_bytes(b"no photo")
    (tmp_path / "notes.txt").write_text("no photo either")
    photos = load_photos(tmp_path)
    assert [photo.shape for photo in photos] == [(300, 200), (450, 640)]
    assert all(photo.dtype == np.uint8 for photo in photos)
    assert "small.png" in caplog.text and "bad.png" in caplog.text and "notes" not in caplog.text


def test_folders_without_photos_are_refused(tmp_path):
    with pytest.raises(InputError, match="absent"):
        load_photos(tmp_path / "absent")
    with pytest.raises(InputError, match=tmp_path.name):
        load_photos(tmp_path)
    (tmp_path / "bad.png").write_bytes(b"no photo")
    with pytest.raises(InputError, match="no usable training image"):
        load_photos(tmp_path)
    with pytest.raises(InputError, match="bad.png"):
        load_photos(tmp_path / "bad.png")


def test_validation_photos_are_not_trained_on():
    photos = [np.full((1, 1), i) for i in range(40)]
    training, validation = split_photos(photos)
    assert sorted(int(photo[0, 0]) for photo in training + validation) == list(range(40))
    assert [int(photo[0, 0]) for photo in validation] == [0, 15, 30]
    training, validation = split_photos(photos[:1])
    assert len(training) == len(validation) == 1


# Supervision and loss


def draw(b_from_a: np.ndarray, seed: int = 0, per_pair: int = 400) -> PatchSupervision:
    matrix = torch.tensor(b_from_a, dtype=torch.float32).reshape(-1, 1, 3, 3)
    surface = torch.zeros(len(matrix), 256, 256, dtype=torch.int64)
    return draw_patches(matrix, surface, per_pair, COARSE, FINE, HALF, torch.Generator().manual_seed(seed))


def test_patches_hold_the_truth():
    b_from_a = np.array([[[1.1, -0.1, 9.0], [0.12, 0.95, -14.0], [1e-4, 2e-4, 1.0]], np.eye(3)])
    truth = draw(b_from_a)
    assert 400 < len(truth.cell0) <= 800
    points = torch.tensor([[0.0, 0.0], [-4.0, 4.0], [2.5, 1.0]])
    in_patch = apply_homography(truth.homography, points).double().numpy()
    for matrix in range(2):
        mine = (truth.image_index == matrix).numpy()
        px0 = FINE.to_px(truth.cell0.numpy()[mine][:, None] + points.numpy())
        px1 = FINE.to_px(truth.cell1.numpy()[mine][:, None] + in_patch[mine])
        np.testing.assert_allclose(px1, map_points(b_from_a[matrix], px0), atol=0.01)
    corners = make_corners(HALF)
    moved = apply_homography(homography_from_corners(truth.displacement, HALF), corners)
    correct = truth.correct
    torch.testing.assert_close(
        moved[correct], apply_homography(truth.homography, corners)[correct], atol=1e-3, rtol=1e-3
    )


def test_most_patches_are_within_reach_and_some_are_wrong():
    truth = draw(np.eye(3))
    apart = apply_homography(truth.homography, torch.zeros(1, 2))[:, 0].norm(dim=1)
    assert 0.85 < truth.correct.float().mean() < 0.97
    assert (apart[truth.correct] <= 4 * 2**0.5 + 1e-3).all()
    exact = (apart < 1e-3).float().mean()
    assert 0.6 < exact < 0.8
    assert apart[~truth.correct].median() > 20


def test_patches_without_partner_are_left_out():
    far = np.array([[1, 0, 128.0], [0, 1, 0], [0, 0, 1]])
    truth = draw(far)
    assert len(truth.cell0) > 50
    assert (FINE.to_px(truth.cell0[:, 0]) < 132).all()
    away = draw(np.array([[1, 0, 1000.0], [0, 1, 0], [0, 0, 1]]))
    assert len(away.cell0) == 0


def test_the_same_generator_draws_the_same_patches():
    one, other, third = draw(np.eye(3), 1), draw(np.eye(3), 1), draw(np.eye(3), 2)
    assert torch.equal(one.cell1, other.cell1) and not torch.equal(one.cell1[:100], third.cell1[:100])


def make_truth(count: int = 6) -> PatchSupervision:
    displacement = torch.randn(count, 4, 2, generator=torch.Generator().manual_seed(0)) * 0.5
    cells = torch.zeros(count, 2, dtype=torch.int64)
    return PatchSupervision(
        cells[:, 0], cells, cells, homography_from_corners(displacement, HALF), displacement,
        torch.ones(count, dtype=torch.bool),
    )  # fmt: skip


def make_estimate(displacement: torch.Tensor, log_scale: float = 0.0) -> FineEstimate:
    return FineEstimate(
        displacement, homography_from_corners(displacement, HALF), torch.full((len(displacement),), log_scale)
    )


def test_the_truth_has_no_error():
    truth = make_truth()
    estimate = make_estimate(truth.displacement)
    assert measure_errors(estimate, truth).shape == (6, 81)
    assert measure_errors(estimate, truth).max() < 1e-4
    parts = measure_loss([estimate], truth, HALF)
    assert parts["dense"] < 1e-4 and parts["corner"] < 1e-4


def test_errors_are_distances_in_cells():
    truth = make_truth()
    shifted = dataclasses.replace(make_estimate(truth.displacement), homography=truth.homography.clone())
    shifted.homography[:, 0] += 3 * truth.homography[:, 2]
    shifted.homography[:, 1] += 4 * truth.homography[:, 2]
    torch.testing.assert_close(measure_errors(shifted, truth), torch.full((6, 81), 5.0))


def test_the_loss_prefers_the_better_estimate_and_the_later_iteration():
    truth = make_truth()
    good, bad = make_estimate(truth.displacement + 0.1), make_estimate(truth.displacement + 1.0)
    losses = [measure_loss(estimates, truth, HALF)["loss"] for estimates in ([good], [bad], [bad, good], [good, bad])]
    assert losses[0] < losses[1] and losses[2] < losses[3]


def test_the_error_scale_is_best_at_the_error_itself():
    truth = make_truth()
    # A plain shift of the corners is not quite one of the dense points: the scale is taught their mean distance.
    error = measure_errors(make_estimate(truth.displacement + 0.5), truth).mean()
    scales = [
        measure_loss([make_estimate(truth.displacement + 0.5, float(error.log()) + off)], truth, HALF)["scale"]
        for off in (-1.0, 0.0, 1.0)
    ]
    assert scales[1] < min(scales[0], scales[2])


def test_wrong_and_folded_patches_teach_no_dense_points():
    truth = make_truth()
    folded = truth.displacement.clone()
    folded[0] += torch.tensor([[8.0, 0], [-8.0, 0], [8.0, 0], [-8.0, 0]])
    estimate = make_estimate(folded)
    assert measure_loss([estimate], truth, HALF)["dense"] < 1e-4
    assert measure_loss([estimate], truth, HALF)["corner"] > 0.1
    wrong = dataclasses.replace(truth, correct=torch.zeros(6, dtype=torch.bool))
    parts = measure_loss([make_estimate(truth.displacement + 1)], wrong, HALF)
    assert parts["dense"] == 0 and parts["corner"] == 0 and parts["scale"] > 1


# The loop


@pytest.fixture(autouse=True)
def one_thread():
    """Sums of several threads differ in the last bit from run to run."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def config(tmp_path) -> TrainConfig:
    return TrainConfig(
        images=str(write_photos(tmp_path / "photos")),
        out=str(tmp_path / "out"),
        start_from=str(write_xfeat(tmp_path / "xfeat.pt")),
        network=NetworkConfig(window=5, iterations=2, margin=0),
        steps=6,
        size_px=64,
        pairs_per_step=1,
        patches_per_pair=16,
        warmup_steps=2,
        validate_every=3,
        precision="fp32",
        device="cpu",
        checkpoint_seconds=0.0,
    )


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file, without the time they took."""
    with path.open() as file:
        return [{key: value for key, value in row.items() if key != "seconds"} for row in csv.DictReader(file)]


def interrupt_after(monkeypatch, step: int) -> None:
    """Stop the training in the middle of the step that follows `step`."""

    def stop(state, *rest):
        if state.step == step:
            raise KeyboardInterrupt
        return train_step(state, *rest)

    train_step = loop.train_step
    monkeypatch.setattr(loop, "train_step", stop)


@pytest.mark.parametrize("saved", [3, 2], ids=["with a checkpoint of the last step", "with an earlier checkpoint"])
def test_an_interrupted_training_goes_on_as_if_nothing_had_happened(config, tmp_path, monkeypatch, saved):
    whole = train(config, quiet=True)
    again = dataclasses.replace(config, out=str(tmp_path / "again"))
    with monkeypatch.context() as patch:
        interrupt_after(patch, 3)
        save = loop.save_checkpoint
        patch.setattr(loop, "save_checkpoint", lambda *args: save(*args) if args[2].step <= saved else None)
        with pytest.raises(KeyboardInterrupt):
            train(again, quiet=True)
    assert len(read_rows(tmp_path / "again" / "log.csv")) == 3
    resumed = train(again, resume=True, quiet=True)
    expected, found = load_weights(str(whole)).state_dict(), load_weights(str(resumed)).state_dict()
    assert all(torch.equal(value, found[name]) for name, value in expected.items())
    for name in ("log.csv", "validation.csv"):
        assert read_rows(whole.parent / name) == read_rows(resumed.parent / name)
    assert [row["step"] for row in read_rows(resumed.parent / "log.csv")] == list("123456")
    assert [row["step"] for row in read_rows(resumed.parent / "validation.csv")] == list("36")
    assert sorted(p.name for p in resumed.parent.iterdir()) == [
        "checkpoint.pt", "log.csv", "validation.csv", "weights.pt",
    ]  # fmt: skip


def test_training_learns_the_fine_stage_and_leaves_the_trunk(config):
    path = train(dataclasses.replace(config, steps=2), quiet=True)
    trunk = XFeatTrunk()
    load_xfeat(trunk, Path(config.start_from))
    net = load_weights(str(path))
    assert all(torch.equal(value, net.backbone.trunk.state_dict()[name]) for name, value in trunk.state_dict().items())
    torch.manual_seed(config.seed)
    untrained = loop.HomoNet(config.network)
    for part in ("head", "backbone.fine"):
        before, after = untrained.get_submodule(part), net.get_submodule(part)
        assert any(not torch.equal(a, b) for a, b in zip(before.parameters(), after.parameters()))


def test_a_loss_that_is_not_finite_stops_and_keeps_the_checkpoint(config, monkeypatch):
    def measure(estimates, truth, half):
        parts = measure_loss(estimates, truth, half)
        return parts | {"loss": parts["loss"] * torch.nan} if len(saved) == 3 else parts

    saved = []
    save = loop.save_checkpoint
    monkeypatch.setattr(loop, "save_checkpoint", lambda *args: saved.append(save(*args)))
    monkeypatch.setattr(loop, "measure_loss", measure)
    with pytest.raises(HmSfmError, match="loss is nan at step 3"):
        train(config, quiet=True)
    checkpoint = torch.load(Path(config.out) / "checkpoint.pt", weights_only=True)
    assert checkpoint["step"] == 3
    assert all(value.isfinite().all() for value in checkpoint["net"].values())
    monkeypatch.undo()
    assert train(config, resume=True, quiet=True).exists()


def test_a_folder_with_a_training_is_not_overwritten(config):
    train(dataclasses.replace(config, steps=1), quiet=True)
    before = (Path(config.out) / "checkpoint.pt").read_bytes()
    with pytest.raises(ConfigError, match="--resume"):
        train(dataclasses.replace(config, steps=1), quiet=True)
    with pytest.raises(ConfigError, match="another configuration"):
        train(dataclasses.replace(config, steps=1, learning_rate=1e-4), resume=True, quiet=True)
    assert (Path(config.out) / "checkpoint.pt").read_bytes() == before
    # A finished training has nothing left to do, wherever its folder lies now.
    moved = Path(config.out).rename(Path(config.out).with_name("moved"))
    assert train(dataclasses.replace(config, steps=1, out=str(moved)), resume=True, quiet=True) == moved / "weights.pt"


def test_a_damaged_checkpoint_is_refused(config):
    Path(config.out).mkdir()
    (Path(config.out) / "checkpoint.pt").write_bytes(b"no checkpoint")
    with pytest.raises(WeightsError, match="checkpoint.pt"):
        train(config, resume=True, quiet=True)


def test_unusable_xfeat_files_are_refused(config, tmp_path):
    for name, content in (("absent.pt", None), ("text.pt", b"no weights")):
        if content:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(WeightsError, match=name):
            train(dataclasses.replace(config, start_from=str(tmp_path / name)), quiet=True)
    torch.save({"fc.weight": torch.zeros(3)}, tmp_path / "foreign.pt")
    with pytest.raises(WeightsError, match="foreign.pt is no XFeat weights file"):
        train(dataclasses.replace(config, start_from=str(tmp_path / "foreign.pt")), quiet=True)
    assert not Path(config.out).exists()


@pytest.mark.parametrize("changed", [{"window": 8}, {"head": "heavy"}])
def test_impossible_networks_are_refused(config, changed):
    with pytest.raises(ConfigError, match="network"):
        train(dataclasses.replace(config, network=dataclasses.replace(config.network, **changed)), quiet=True)


def test_the_learning_rate_warms_up_and_falls():
    config = dataclasses.replace(
        load_config(settings=("images=a", "out=b", "start_from=c"), cls=TrainConfig), steps=100, warmup_steps=10
    )
    rates = [learning_rate_at(step, config) for step in range(100)]
    assert rates[0] == pytest.approx(1e-4) and max(rates) == pytest.approx(1e-3) == pytest.approx(rates[10])
    assert (np.diff(rates[:10]) > 0).all() and (np.diff(rates[10:]) < 0).all()
    assert 2e-5 < rates[-1] < 3e-5
