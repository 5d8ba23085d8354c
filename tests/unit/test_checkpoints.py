"""Weights files, and the device that a network is on."""

import dataclasses
import shutil
from pathlib import Path

import pytest
import torch

from hm_sfm import HomoMatcher
from hm_sfm.config import NetworkConfig
from hm_sfm.errors import ConfigError, WeightsError
from hm_sfm.network import checkpoints
from hm_sfm.network.checkpoints import digest_weights, load_parts, load_weights, save_weights
from hm_sfm.network.device import pick_device
from hm_sfm.network.homonet import HomoNet


@pytest.fixture
def small_net() -> HomoNet:
    torch.manual_seed(0)
    return HomoNet(NetworkConfig(window=5, iterations=1, margin=0))


def test_weights_survive_writing_and_reading(tmp_path, small_net):
    path = tmp_path / "weights.pt"
    save_weights(path, small_net)
    read = load_weights(str(path))
    assert read.config == small_net.config
    assert all(torch.equal(value, read.state_dict()[name]) for name, value in small_net.state_dict().items())
    assert [p.name for p in tmp_path.iterdir()] == ["weights.pt"]


def test_unknown_names_are_refused_and_the_bundled_ones_named():
    with pytest.raises(WeightsError, match="'lihgt'.*light"):
        HomoMatcher.from_pretrained("lihgt")


def test_a_folder_is_no_weights_file(tmp_path):
    with pytest.raises(WeightsError, match="neither a file"):
        HomoMatcher.from_pretrained(str(tmp_path))


@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(lambda data: b"", id="empty"),
        pytest.param(lambda data: b"no weights at all", id="text"),
        pytest.param(lambda data: data[: len(data) // 2], id="cut short"),
        pytest.param(lambda data: data[:-20], id="end missing"),
    ],
)
def test_damaged_files_are_refused(tmp_path, small_net, spoil):
    path = tmp_path / "weights.pt"
    save_weights(path, small_net)
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(WeightsError, match="weights.pt is damaged or no hm_sfm weights file"):
        HomoMatcher.from_pretrained(str(path))


@pytest.mark.parametrize(
    "content",
    [
        pytest.param({}, id="nothing in it"),
        pytest.param([1, 2], id="a list"),
        pytest.param({"conv.weight": torch.zeros(3)}, id="another network's"),
        pytest.param({"network": {"depth": 3}, "state_dict": {}}, id="an unknown configuration"),
        pytest.param({"network": {}, "state_dict": {}}, id="no tensors"),
        pytest.param({"network": {}, "state_dict": [1]}, id="tensors are no dict"),
        pytest.param({"network": {}, "state_dict": {"head.corners.weight": torch.zeros(1)}}, id="other tensors"),
    ],
)
def test_foreign_files_are_refused(tmp_path, content):
    path = tmp_path / "foreign.pt"
    torch.save(content, path)
    with pytest.raises(WeightsError, match="foreign.pt"):
        HomoMatcher.from_pretrained(str(path))


def test_files_with_code_are_not_run(tmp_path):
    path = tmp_path / "code.pt"
    torch.save({"network": print}, path)
    with pytest.raises(WeightsError, match="code.pt"):
        load_weights(str(path))


@pytest.mark.parametrize(
    ("field", "value"), [("window", 17), ("radius", 3), ("margin", 0), ("head", "expectation"), ("backbone", "loftr")]
)
def test_weights_of_another_network_are_refused_and_the_field_is_named(field, value):
    network = NetworkConfig(**{field: value})
    with pytest.raises(WeightsError, match=f"network.{field} .*{value!r}"):
        HomoMatcher.from_pretrained("light", network=network)


def test_the_number_of_iterations_may_differ_from_the_training():
    assert load_weights("light", NetworkConfig(iterations=1)).head.iterations == 1
    with pytest.raises(ConfigError, match="network.iterations"):
        load_weights("light", NetworkConfig(iterations=0))


def test_what_does_not_fit_is_named_by_its_keys(tmp_path, small_net):
    state = small_net.state_dict()
    names = [name for name in state if name.startswith("head.")]
    shape = " x ".join(map(str, state[names[0]].shape))
    changed = {name: value for name, value in state.items() if name not in names[1:6]}
    changed |= {names[0]: torch.zeros(7), "head.hidden": torch.zeros(1)}
    path = tmp_path / "changed.pt"
    torch.save({"network": dataclasses.asdict(small_net.config), "state_dict": changed}, path)
    with pytest.raises(WeightsError) as error:
        load_weights(str(path))
    assert str(error.value) == (
        f"{path} does not fit the network: missing: {', '.join(names[1:4])} and 2 more; unexpected: head.hidden; "
        f"of another shape: {names[0]} (7, expected {shape})"
    )


@pytest.mark.parametrize("coarse", ["attention", "cosine"])
def test_parts_that_do_not_fit_start_new(tmp_path, small_net, coarse):
    """From a network with another window to one with or without attention: the trunk, and what else fits, is kept."""
    source = HomoNet(NetworkConfig(coarse="attention", window=5, iterations=1, margin=0))
    state = source.state_dict()
    del state["backbone.fine.local.0.weight"]
    state["head.extra"] = torch.zeros(2)
    net = HomoNet(NetworkConfig(coarse=coarse, window=5, iterations=1, margin=0))
    before = {name: value.clone() for name, value in net.state_dict().items()}
    assert load_parts(net, {"state_dict": state}, tmp_path / "a.pt") == ["fine", "head"]
    for name, value in net.state_dict().items():
        kept = name.startswith(("backbone.trunk.", "coarse."))
        assert torch.equal(value, state[name] if kept else before[name])


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({}, "fits no part of the network: missing: backbone.trunk"),
        ({"fc.weight": torch.zeros(3)}, "missing: .* more; unexpected: fc.weight$"),
        ({"backbone.trunk.skip1.1.weight": 5}, r"of another shape: .*skip1.1.weight \(int, expected 24 x 1 x 1 x 1\)"),
        ([1], "it has no state_dict"),
    ],
)
def test_weights_of_which_nothing_fits_are_refused(tmp_path, small_net, state, message):
    with pytest.raises(WeightsError, match=f"a.pt.*{message}"):
        load_parts(small_net, {"state_dict": state}, tmp_path / "a.pt")


def test_one_flipped_byte_in_the_bundled_weights_is_noticed(tmp_path, monkeypatch):
    folder = tmp_path / "weights"
    shutil.copytree(checkpoints.WEIGHTS_FOLDER, folder)
    monkeypatch.setattr(checkpoints, "WEIGHTS_FOLDER", folder)
    load_weights("light")
    data = bytearray((folder / "light.pt").read_bytes())
    data[len(data) // 2] ^= 1
    (folder / "light.pt").write_bytes(data)
    with pytest.raises(WeightsError, match="light.pt is damaged: its sha256"):
        load_weights("light")


def test_the_digest_is_that_of_the_file(tmp_path):
    path = tmp_path / "a.pt"
    path.write_bytes(b"abc")
    assert digest_weights(str(path)) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_weights_without_counters_of_batches_load():
    """Older PyTorch did not count them, and nothing uses them."""
    net = load_weights("light")
    state = {key: value for key, value in net.state_dict().items() if not key.endswith("num_batches_tracked")}
    assert len(state) < len(net.state_dict())
    checkpoints.fit_state(net, state, Path("old.pt"))
    with pytest.raises(WeightsError, match="missing: head.corners.weight"):
        checkpoints.fit_state(net, {k: v for k, v in state.items() if k != "head.corners.weight"}, Path("short.pt"))


def test_an_absent_device_is_refused(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(ConfigError, match="cuda"):
        pick_device("cuda")
