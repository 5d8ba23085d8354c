"""Training: pairs made of photos, and a loop that can be interrupted at any step."""

import csv
import dataclasses
import re
import sys
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import torch
from torch.utils.data import Dataset, default_collate

from hm_sfm.config import NetworkConfig, load_config
from hm_sfm.errors import ConfigError, HmSfmError, InputError, WeightsError
from hm_sfm.network.checkpoints import load_weights
from hm_sfm.training import loop
from hm_sfm.training.curves import draw_curves
from hm_sfm.training.loop import MegaDepthSource, MultiviewSource, TrainConfig, learning_rate_at, train
from hm_sfm.training.mixture import MixedPairs, collate_pairs
from hm_sfm.training.multiview import VALIDATION_SCENES
from hm_sfm.training.objectives import measure_objective
from hm_sfm.training.photos import (
    WarpedPhotos,
    WarpRange,
    disturb_view,
    draw_views,
    load_photos,
    render_view,
    split_photos,
)
from hm_sfm.training.processes import Processes


def make_photo(width: int, height: int, seed: int = 0) -> np.ndarray:
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(height, width)), (0, 0), 2.5)
    return np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)


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
    for view_from_photo in draw_views(photo.shape, (size, size), WarpRange(), rng):
        view = render_view(photo, view_from_photo, (size, size))
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
    pairs = WarpedPhotos([photo], (size, size), seed=3, count=4, warp=warp)
    for index in range(4):
        item = pairs[index]
        rng = np.random.default_rng([3, index])
        rng.integers(1)
        a_from_photo, b_from_photo = draw_views(photo.shape, (size, size), warp, rng)
        points = make_pixel_centres(size, size)[8:-8:16, 8:-8:16]
        in_photo = map_points(np.linalg.inv(a_from_photo), points)
        np.testing.assert_allclose(
            map_points(item["b_from_a"][0].astype(float), points), map_points(b_from_photo, in_photo), atol=0.05
        )
        assert item["images"].shape == (2, size, size) and item["images"].dtype == np.uint8
        assert item["b_from_a"].dtype == np.float32 and item["b_from_a"][0, 2, 2] == 1


def test_items_depend_on_seed_and_index_alone():
    photos = [make_photo(200, 160, seed) for seed in range(3)]
    first, again, other = (WarpedPhotos(photos, (64, 64), seed, 10, WarpRange()) for seed in (1, 1, 2))
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
        a_from_photo, b_from_photo = draw_views((300, 400), (128, 128), warp, np.random.default_rng(seed))
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


# Mixtures


class Tagged(Dataset):
    """Items that say where they come from, with so many surfaces."""

    def __init__(self, tag: float, surfaces: int = 2, count: int = 400) -> None:
        self.tag, self.surfaces, self.count = tag, surfaces, count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        b_from_a = np.full((self.surfaces, 3, 3), self.tag, np.float32)
        return {"b_from_a": b_from_a, "tag": np.array(self.tag), "index": np.array(index)}


def draw_tags(kinds: list[tuple[Dataset, float]], seed: int = 1) -> list[float]:
    pairs = MixedPairs(kinds, seed)
    return [float(pairs[i]["tag"]) for i in range(len(pairs))]


def test_a_mixture_has_its_shares():
    tags = draw_tags([(Tagged(0), 0.5), (Tagged(1), 0.2), (Tagged(2), 0.0), (Tagged(3), 0.3)])
    shares = [tags.count(tag) / 400 for tag in range(4)]
    assert shares[2] == 0
    np.testing.assert_allclose(shares, [0.5, 0.2, 0, 0.3], atol=0.08)


def test_a_mixture_is_drawn_by_seed_and_index():
    kinds = [(Tagged(0), 0.5), (Tagged(1), 0.5)]
    assert draw_tags(kinds) == draw_tags(kinds) != draw_tags(kinds, seed=2)
    pairs = MixedPairs(kinds, 1)
    assert len(pairs) == 400 and pairs[17]["index"] == 17
    assert set(draw_tags([(Tagged(0), 0.0), (Tagged(1), 0.1)])) == {1}


def test_a_batch_fills_up_the_surfaces():
    batch = collate_pairs([Tagged(1, surfaces=2)[0], Tagged(2, surfaces=5)[1]])
    assert batch["b_from_a"].shape == (2, 5, 3, 3) and batch["b_from_a"].dtype == torch.float32
    assert (batch["b_from_a"][0, :2] == 1).all() and (batch["b_from_a"][1] == 2).all()
    assert not batch["b_from_a"][0, 2:].any()
    assert batch["index"].tolist() == [0, 1]
    same = [Tagged(1)[0], Tagged(2)[0]]
    assert torch.equal(collate_pairs(same)["b_from_a"], default_collate(same)["b_from_a"])


# The loop


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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stage", "saved"),
    [
        pytest.param("fine", 3, id="fine, with a checkpoint of the last step"),
        pytest.param("fine", 2, id="fine, with an earlier checkpoint"),
        pytest.param("coarse", 2, id="coarse"),
        pytest.param("joint", 2, id="joint"),
    ],
)
def test_an_interrupted_training_goes_on_as_if_nothing_had_happened(training, tmp_path, monkeypatch, stage, saved):
    training = dataclasses.replace(training, stage=stage, rendered_share=0.3)
    whole = train(training, quiet=True)
    again = dataclasses.replace(training, out=str(tmp_path / "again"))
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
        "checkpoint.pt", "curves.png", "log.csv", "validation.csv", "weights.pt",
    ]  # fmt: skip


COLUMNS = {
    "fine": {"step", "loss", "dense", "corner", "scale", "point", "gradient", "rate"},
    "coarse": {"step", "loss", "coarse", "gradient", "rate"},
    "joint": {"step", "loss", "coarse", "dense", "corner", "scale", "point", "gradient", "rate"},
}
TRAINED = {
    "fine": ("backbone.fine.", "head."),
    "coarse": ("coarse.",),
    "joint": ("backbone.fine.", "coarse.", "head."),
}


@pytest.mark.slow
@pytest.mark.parametrize("stage", loop.STAGES)
def test_a_stage_changes_all_of_its_own_parts_and_nothing_else(training, stage):
    """Of the others, not even the running statistics of batch norms."""
    training = dataclasses.replace(training, stage=stage, steps=3)
    before = loop.make_state(training, torch.device("cpu")).net.state_dict()
    path = train(training, quiet=True)
    checkpoint = torch.load(path.with_name("checkpoint.pt"), weights_only=True)
    for after in (checkpoint["net"], load_weights(str(path)).state_dict()):
        changed = {name for name, value in before.items() if not torch.equal(value, after[name])}
        assert changed == {name for name in before if name.startswith(TRAINED[stage])}
    assert set(read_rows(path.with_name("log.csv"))[0]) == COLUMNS[stage]


def test_the_coarse_stage_alone_gets_gradients_in_its_stage(training):
    state = loop.make_state(dataclasses.replace(training, stage="coarse"), torch.device("cpu"))
    state.net.requires_grad_(True)
    torch.nn.init.normal_(state.net.coarse.leave.weight, std=0.1)
    pairs = WarpedPhotos([make_photo(160, 144)], (64, 64), 0, 2, WarpRange())
    batch = collate_pairs([pairs[0], pairs[1]])
    cpu = torch.device("cpu")
    parts = measure_objective(state.net, batch, "coarse", 16, "fp32", cpu, torch.Generator())
    assert set(parts) == {"loss", "coarse"} and parts["loss"] == parts["coarse"] > 0
    state.net.backbone.requires_grad_(False)
    parts["loss"].backward()
    with_gradient = {name for name, p in state.net.named_parameters() if p.grad is not None and p.grad.any()}
    assert with_gradient == {name for name, _ in state.net.named_parameters() if name.startswith("coarse.")}


def write_multiview(folder: Path) -> MultiviewSource:
    """A scene to train on and one to validate on, two photos each, with points all over."""
    for name in ("house", VALIDATION_SCENES[0]):
        (folder / "photos" / name).mkdir(parents=True)
        (folder / "tracks" / name).mkdir(parents=True)
        with h5py.File(folder / "tracks" / name / "tracks.h5", "w") as file:
            for photo in ("a.png", "b.png"):
                cv2.imwrite(str(folder / "photos" / name / photo), make_photo(160, 144, len(name)))
                file[f"{photo}/point"] = np.arange(100)
                file[f"{photo}/xy"] = np.random.default_rng(0).uniform(0, 144, (100, 2)).astype(np.float32)
    return MultiviewSource(str(folder / "photos"), str(folder / "tracks"))


def test_real_pairs_train_both_stages_by_their_points(training, tmp_path):
    """They have no surfaces: a batch of them alone says nothing of dense points."""
    source = write_multiview(tmp_path)
    training = dataclasses.replace(training, stage="joint", steps=3, multiview=source, real_share=1.0)
    path = train(training, quiet=True)
    for row in read_rows(path.with_name("log.csv")):
        assert float(row["coarse"]) > 0 and float(row["point"]) > 0
        assert float(row["loss"]) == pytest.approx(float(row["coarse"]) + float(row["point"]), rel=1e-5)
        assert float(row["dense"]) == float(row["corner"]) == float(row["scale"]) == 0
    scores = read_rows(path.with_name("validation.csv"))[0]
    assert {"real_recall", "real_precision"} <= set(scores) and "rendered_recall" not in scores


def test_megadepth_is_one_of_the_kinds_of_pairs(training, monkeypatch):
    made = []

    def make(root, scene_info, size_wh, seed, count):
        made.append((root.name, scene_info.name, size_wh, seed, count))
        return Tagged(7, count=count)

    monkeypatch.setattr(loop, "MegaDepthPairs", make)
    source = MegaDepthSource(root="root", scene_info="index", validation_info="held_out")
    training = dataclasses.replace(training, megadepth=source, rendered_share=0.3, megadepth_share=0.7)
    photos = [make_photo(160, 144)]
    pairs = loop.make_pairs(photos, training, 5, 40, held_out=False)
    loop.make_pairs(photos, training, 6, 8, held_out=True)
    assert made == [("root", "index", (64, 64), 5, 40), ("root", "held_out", (64, 64), 6, 8)]
    # 1 - 0.3 - 0.7 is not quite 0 in floating point, but no share of warped photos.
    assert len(pairs.kinds) == 2
    assert 15 < sum("tag" in pairs[i] for i in range(40)) < 40


@pytest.mark.slow
def test_a_loss_that_is_not_finite_stops_and_keeps_the_checkpoint(training, monkeypatch):
    def measure(*arguments):
        parts = measure_objective(*arguments)
        return parts | {"loss": parts["loss"] * torch.nan} if len(saved) == 3 else parts

    saved = []
    save = loop.save_checkpoint
    with monkeypatch.context() as patch:
        patch.setattr(loop, "save_checkpoint", lambda *args: saved.append(save(*args)))
        patch.setattr(loop, "measure_objective", measure)
        with pytest.raises(HmSfmError, match="loss is nan at step 3; the last checkpoint in .*out is kept"):
            train(training, quiet=True)
    checkpoint = torch.load(Path(training.out) / "checkpoint.pt", weights_only=True)
    assert checkpoint["step"] == 3
    assert all(value.isfinite().all() for value in checkpoint["net"].values())
    assert train(training, resume=True, quiet=True).exists()


def test_a_gradient_that_is_not_finite_changes_no_weights(training):
    """A loss can be finite where its gradient is not: the weights would be lost before the next loss says so."""
    state = loop.make_state(dataclasses.replace(training, stage="coarse"), torch.device("cpu"))
    before = {name: value.clone() for name, value in state.net.state_dict().items()}
    state.net.coarse.leave.weight.register_hook(lambda gradient: gradient * torch.inf)
    pairs = WarpedPhotos([make_photo(160, 144)], (64, 64), 0, 1, WarpRange())
    batch = collate_pairs([pairs[0]])
    training = dataclasses.replace(training, stage="coarse")
    with pytest.raises(HmSfmError, match="gradient is (nan|inf) at step 0"):
        loop.train_step(state, batch, training, torch.device("cpu"), Processes())
    assert all(torch.equal(value, before[name]) for name, value in state.net.state_dict().items())


@pytest.mark.slow
def test_the_coarse_stage_learns_a_pair_by_heart(training):
    """From plain features of random convolutions, which say little."""
    training = dataclasses.replace(training, stage="coarse", learning_rate=3e-3, steps=90, warmup_steps=5)
    cpu = torch.device("cpu")
    state = loop.make_state(training, cpu)
    pairs = WarpedPhotos([make_photo(160, 144)], (64, 64), 3, 1, WarpRange(scale=1.2, rotation_deg=10, perspective=0.1))
    batch = collate_pairs([pairs[0]])
    losses = [loop.train_step(state, batch, training, cpu, Processes())["loss"] for _ in range(90)]
    assert losses[-1] < 0.3 * losses[0]


def test_a_folder_with_a_training_is_not_overwritten(training):
    train(dataclasses.replace(training, steps=1), quiet=True)
    before = (Path(training.out) / "checkpoint.pt").read_bytes()
    with pytest.raises(ConfigError, match="--resume"):
        train(dataclasses.replace(training, steps=1), quiet=True)
    with pytest.raises(ConfigError, match="another configuration"):
        train(dataclasses.replace(training, steps=1, learning_rate=1e-4), resume=True, quiet=True)
    assert (Path(training.out) / "checkpoint.pt").read_bytes() == before
    # A finished training has nothing left to do, wherever its folder lies now.
    moved = Path(training.out).rename(Path(training.out).with_name("moved"))
    again = dataclasses.replace(training, steps=1, out=str(moved))
    assert train(again, resume=True, quiet=True) == moved / "weights.pt"


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        pytest.param(lambda content: None, "is damaged", id="text"),
        pytest.param(
            lambda content: {"state_dict": {}}, "lacks fingerprint, step, net, average, optimizer", id="weights"
        ),
        pytest.param(
            lambda content: content | {"net": {"head.x": torch.zeros(2)} | dict(list(content["net"].items())[1:])},
            "missing: backbone.trunk.skip1.1.weight; unexpected: head.x$",
            id="other tensors",
        ),
    ],
)  # fmt: skip
def test_a_damaged_checkpoint_is_refused(training, spoil, message):
    training = dataclasses.replace(training, steps=1)
    train(training, quiet=True)
    path = Path(training.out) / "checkpoint.pt"
    content = spoil(torch.load(path, weights_only=True))
    torch.save(content, path) if content else path.write_bytes(b"no checkpoint")
    with pytest.raises(WeightsError, match=f"checkpoint.pt .*{message}"):
        train(training, resume=True, quiet=True)


def test_unusable_xfeat_files_are_refused(training, tmp_path):
    for name, content in (("absent.pt", None), ("text.pt", b"no weights")):
        if content:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(WeightsError, match=name):
            train(dataclasses.replace(training, start_from=str(tmp_path / name)), quiet=True)
    torch.save({"fc.weight": torch.zeros(3)}, tmp_path / "foreign.pt")
    with pytest.raises(WeightsError, match="foreign.pt is no XFeat weights file"):
        train(dataclasses.replace(training, start_from=str(tmp_path / "foreign.pt")), quiet=True)
    source = torch.load(training.start_from, weights_only=True)
    torch.save(source | {"skip1.1.weight": torch.zeros(3)}, tmp_path / "misshapen.pt")
    with pytest.raises(WeightsError, match="misshapen.pt .* skip1.1.weight is of another shape"):
        train(dataclasses.replace(training, start_from=str(tmp_path / "misshapen.pt")), quiet=True)
    assert not Path(training.out).exists()


@pytest.mark.slow
def test_a_stage_goes_on_from_the_weights_of_another(training, tmp_path, caplog):
    """Their parts are taken over; a coarse stage that they lack starts new, and says so."""
    plain = dataclasses.replace(training.network, coarse="cosine")
    first = train(dataclasses.replace(training, network=plain, steps=1), quiet=True)
    second = dataclasses.replace(training, stage="coarse", start_from=str(first), out=str(tmp_path / "second"))
    state = loop.make_state(second, torch.device("cpu"))
    assert f"{first} has no fitting weights for coarse: they start new" in caplog.text
    given = load_weights(str(first)).state_dict()
    assert all(torch.equal(value, state.net.state_dict()[name]) for name, value in given.items())
    caplog.clear()
    path = train(dataclasses.replace(second, steps=1), quiet=True)
    third = loop.make_state(dataclasses.replace(second, stage="joint", start_from=str(path)), torch.device("cpu"))
    assert "start new" in caplog.text and caplog.text.count("start new") == 1
    given = load_weights(str(path)).state_dict()
    assert all(torch.equal(value, third.net.state_dict()[name]) for name, value in given.items())


@pytest.mark.parametrize("changed", [{"window": 8}, {"head": "heavy"}, {"coarse": "cosmic"}])
def test_impossible_networks_are_refused(training, changed):
    with pytest.raises(ConfigError, match="network"):
        train(dataclasses.replace(training, network=dataclasses.replace(training.network, **changed)), quiet=True)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"stage": "middle"}, "stage must be fine, coarse or joint, found 'middle'"),
        ({"precision": "fp16"}, "precision .*'fp16'"),
        ({"stage": "coarse", "network": NetworkConfig(coarse="cosine")}, "cosine has nothing to train"),
        ({"rendered_share": 0.6, "real_share": 0.6}, "one whole, found 0.6, 0.6, 0.0"),
        ({"real_share": 0.5}, "multiview needs multiview.photos, multiview.tracks"),
        ({"megadepth_share": 0.5, "megadepth": MegaDepthSource("root", "index")}, "megadepth.validation_info"),
        ({"size_px": 100}, "size_px must be a multiple of 32, found 100"),
        ({"steps": 0}, "steps must be at least 1"),
        ({"validate_every": 0}, "validate_every must be at least 1"),
    ],
)
def test_impossible_settings_are_refused(training, changed, message):
    with pytest.raises(ConfigError, match=message):
        train(dataclasses.replace(training, **changed), quiet=True)
    assert not Path(training.out).exists()


def test_a_photo_that_is_damaged_later_is_named_in_one_line(training, tmp_path):
    """Photos of scenes are read while training, in another process."""
    source = write_multiview(tmp_path)
    for photo in (tmp_path / "photos" / "house").iterdir():
        photo.write_bytes(b"no photo")
    with pytest.raises(InputError) as error:
        train(dataclasses.replace(training, multiview=source, stage="coarse", real_share=1.0), quiet=True)
    assert re.fullmatch(r".*house/[ab]\.png cannot be read as an image", str(error.value))


@pytest.mark.slow
def test_a_training_draws_its_curves(training, monkeypatch):
    monkeypatch.setattr(loop, "draw_curves", draw_curves)
    path = train(dataclasses.replace(training, steps=1), quiet=True)
    assert cv2.imread(str(path.with_name("curves.png"))).shape[1] == 1500


def test_a_training_without_matplotlib_has_no_picture_and_says_so_once(training, monkeypatch, caplog):
    monkeypatch.setattr(loop, "draw_curves", draw_curves)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    path = train(training, quiet=True)
    assert path.exists() and not path.with_name("curves.png").exists()
    assert [record.message for record in caplog.records if "matplotlib" in record.message] == [
        f"{path.with_name('curves.png')} is not drawn: it needs the package matplotlib, pip install matplotlib"
    ]


def test_rows_that_are_cut_short_or_too_late_are_dropped(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("step,loss\n1,0.5\n2,0.25\n3,0.125\n10,0.5\n")
    loop.drop_rows_after(path, 2)
    assert path.read_text() == "step,loss\n1,0.5\n2,0.25\n"
    # The machine went down in the middle of "25,0.75": neither its beginning nor one without an end is a row.
    for rest in ("2", "2,0.7"):
        path.write_text("step,loss\n1,0.5\n" + rest)
        loop.drop_rows_after(path, 20)
        assert path.read_text() == "step,loss\n1,0.5\n"
    path.write_text("")
    loop.drop_rows_after(path, 20)
    loop.append_row(path, {"step": 1, "loss": 0.5})
    assert path.read_text().split() == ["step,loss", "1,0.5"]
    loop.drop_rows_after(tmp_path / "absent.csv", 1)
    assert not (tmp_path / "absent.csv").exists()


def test_the_learning_rate_warms_up_and_falls():
    config = dataclasses.replace(
        load_config(settings=("images=a", "out=b", "start_from=c"), cls=TrainConfig), steps=100, warmup_steps=10
    )
    rates = [learning_rate_at(step, config) for step in range(100)]
    assert rates[0] == pytest.approx(1e-4) and max(rates) == pytest.approx(1e-3) == pytest.approx(rates[10])
    assert (np.diff(rates[:10]) > 0).all() and (np.diff(rates[10:]) < 0).all()
    assert 2e-5 < rates[-1] < 3e-5
