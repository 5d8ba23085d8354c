"""The training loop, which can be interrupted at any step."""

import csv
import dataclasses
import re
import sys
from pathlib import Path
from typing import get_args

import cv2
import h5py
import numpy as np
import pytest
import torch

from hm_sfm.config import NetworkConfig, load_config
from hm_sfm.errors import ConfigError, HmSfmError, InputError, WeightsError
from hm_sfm.network.checkpoints import load_weights
from hm_sfm.training import loop
from hm_sfm.training.config import MegaDepthSource, MultiviewSource, Stage, TrainConfig
from hm_sfm.training.curves import draw_curves
from hm_sfm.training.loop import learning_rate_at, train
from hm_sfm.training.mixture import collate_pairs
from hm_sfm.training.multiview import VALIDATION_SCENES
from hm_sfm.training.objectives import measure_objective
from hm_sfm.training.photos import (
    WarpedPhotos,
    WarpRange,
)
from hm_sfm.training.processes import Processes


def make_photo(width: int, height: int, seed: int = 0) -> np.ndarray:
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(height, width)), (0, 0), 2.5)
    return np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)


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
    expected, actual = load_weights(str(whole)).state_dict(), load_weights(str(resumed)).state_dict()
    assert all(torch.equal(value, actual[name]) for name, value in expected.items())
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
@pytest.mark.parametrize("stage", get_args(Stage))
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


def test_the_learning_rate_warms_up_and_falls():
    config = dataclasses.replace(
        load_config(settings=("images=a", "out=b", "start_from=c"), cls=TrainConfig), steps=100, warmup_steps=10
    )
    rates = [learning_rate_at(step, config) for step in range(100)]
    assert rates[0] == pytest.approx(1e-4) and max(rates) == pytest.approx(1e-3) == pytest.approx(rates[10])
    assert (np.diff(rates[:10]) > 0).all() and (np.diff(rates[10:]) < 0).all()
    assert 2e-5 < rates[-1] < 3e-5
