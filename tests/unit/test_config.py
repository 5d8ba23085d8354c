"""The configuration: what is accepted, what is refused and how it says so, fingerprints."""

import dataclasses
import re
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

import pytest

from hm_sfm.config import (
    RENAMED,
    Config,
    KeypointConfig,
    NetworkConfig,
    fingerprint,
    load_config,
    parse_config,
)
from hm_sfm.errors import ConfigError
from hm_sfm.training.config import TrainConfig

CONFIGS = Path(__file__).parents[2] / "configs"


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def leaves(config, prefix: str = "") -> list[tuple[str, object]]:
    """All values of a configuration by their dotted keys."""
    values = []
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        name = prefix + field.name
        values += leaves(value, name + ".") if dataclasses.is_dataclass(value) else [(name, value)]
    return values


def test_the_default_file_spells_out_the_defaults():
    path = CONFIGS / "light.yaml"
    assert load_config(path) == Config()
    text = path.read_text()
    missing = [name for name, _ in leaves(Config()) if f"{name.split('.')[-1]}:" not in text]
    assert missing == []


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.name)
def test_every_configuration_parses(path):
    cls = TrainConfig if path.name.startswith("train_") else Config
    assert isinstance(load_config(path, cls=cls), cls)


@pytest.mark.parametrize("name", ["loftr", "loftr_homo", "loftr_homo_heavy", "aspan_homo", "aspan_homo_heavy"])
def test_the_papers_configurations_have_what_the_paper_has_and_no_more(name):
    config = load_config(CONFIGS / f"{name}.yaml")
    assert config.network.backbone == "loftr" and (config.network.margin, config.network.spacing) == (0, 1)
    assert config.matching.grow_below == 0 and not config.matching.try_hypotheses
    assert config.keypoints.refine_long_edge_px == 0
    assert (config.images.long_edge_px, config.matching.min_confidence) == (840, 0.2)


def test_keys_that_are_left_out_keep_their_defaults(tmp_path):
    config = load_config(write(tmp_path / "c.yaml", "keypoints: {separation_px: 3}\nnetwork:\n"))
    assert config == dataclasses.replace(Config(), keypoints=KeypointConfig(separation_px=3.0))
    assert isinstance(config.keypoints.separation_px, float)


@pytest.mark.parametrize("text", ["", "# nothing\n", "{}"])
def test_an_empty_file_is_the_default(tmp_path, text):
    assert load_config(write(tmp_path / "c.yaml", text)) == Config()
    assert load_config() == Config()


@pytest.mark.parametrize(
    ("text", "unknown", "near"),
    [
        ("keypoint: {}", "'keypoint'", "'keypoints'"),
        ("keypoints: {seperation_px: 2.0}", "'seperation_px'", "'separation_px'"),
        ("matching: {max_match: 3}", "'max_match'", "'max_matches'"),
        ("3: 4", "3", "did you mean"),
    ],
)
def test_an_unknown_key_is_refused_and_the_nearest_is_named(tmp_path, text, unknown, near):
    path = write(tmp_path / "c.yaml", text)
    with pytest.raises(ConfigError) as error:
        load_config(path)
    assert all(part in str(error.value) for part in (str(path), unknown, near))


@pytest.mark.parametrize(
    "setting",
    [
        "network.window=nine",
        "network.window=9.0",
        "network.window=true",
        "matching.min_cosine=[0.8]",
        "matching.min_cosine=false",
        "matching.model=3",
        "images.long_edge_px=",
        "pairs=exhaustive",
        "pairs=[1, 2]",
    ],
)
def test_a_value_of_another_type_is_refused(setting):
    section, key = setting.partition("=")[0].split(".")[0], setting.partition("=")[0].split(".")[-1]
    with pytest.raises(ConfigError) as error:
        load_config(settings=(setting,))
    assert section in str(error.value) and key in str(error.value)


@pytest.mark.parametrize("setting", ["matching.max_matches=-1", "keypoints.join_radius_px=-0.5", "mapping.seed=-1"])
def test_negative_values_are_refused(setting):
    with pytest.raises(ConfigError, match="must not be negative"):
        load_config(settings=(setting,))


SECTIONS = {item.name: item.default_factory for item in dataclasses.fields(Config)}
WORDS = [
    (name, key, get_args(kind))
    for name, section in SECTIONS.items()
    for key, kind in get_type_hints(section).items()
    if get_origin(kind) is Literal
]


def test_settings_that_are_one_of_a_few_words():
    assert {f"{section}.{key}" for section, key, _ in WORDS} == {
        "network.backbone", "network.coarse", "network.head", "matching.device", "matching.engine", "cameras.mode",
        "mapping.mapper",
    }  # fmt: skip


@pytest.mark.parametrize(("section", "key", "allowed"), WORDS)
def test_a_word_that_is_not_allowed_is_refused_and_the_allowed_ones_named(section, key, allowed, tmp_path):
    words = f"{', '.join(allowed[:-1])} or {allowed[-1]}"
    sentence = f"{section}.{key} must be {words}, found 'heavy'"
    path = write(tmp_path / "c.yaml", f"{section}: {{{key}: heavy}}")
    for arguments in (
        {"path": path},
        {"settings": (f"{section}.{key}=heavy",)},
        {"options": {f"{section}.{key}": "heavy"}},
    ):
        with pytest.raises(ConfigError, match=sentence):
            load_config(**arguments)
    with pytest.raises(ConfigError, match=f"c.yaml: {key} must be {words}, found False"):
        parse_config({key: False}, SECTIONS[section], "c.yaml")
    with pytest.raises(ConfigError, match=f"^{sentence}$"):
        SECTIONS[section](**{key: "heavy"})
    with pytest.raises(ConfigError, match=f"^{sentence}$"):
        dataclasses.replace(SECTIONS[section](), **{key: "heavy"})
    assert {
        getattr(getattr(load_config(settings=(f"{section}.{key}={word}",)), section), key) for word in allowed
    } == set(allowed)


RENAMED_KEYS = [
    (next(name for name, section in SECTIONS.items() if section is cls), old, new)
    for cls, names in RENAMED.items()
    for old, new in names.items()
]


@pytest.mark.parametrize(("section", "old", "new"), RENAMED_KEYS)
def test_a_key_of_the_last_version_is_refused_and_the_new_one_named(section, old, new, tmp_path):
    path = write(tmp_path / "old.yaml", f"{section}: {{{old}: 1}}")
    with pytest.raises(ConfigError, match=f"old.yaml: the key '{section}.{old}' is now called {re.escape(new)}"):
        load_config(path)
    with pytest.raises(ConfigError, match=f"the key '{section}.{old}' is now called {re.escape(new)}"):
        load_config(settings=(f"{section}.{old}=1",))
    with pytest.raises(ConfigError, match=f"light.pt: the key '{old}' is now called {re.escape(new)}"):
        parse_config({old: 1}, SECTIONS[section], "light.pt")
    assert not hasattr(SECTIONS[section](), old)
    for name in new.split(" or "):
        section, key = name.split(" ")[0].split(".")
        assert hasattr(getattr(Config(), section), key)


def test_settings_come_on_top_of_the_file(tmp_path):
    path = write(tmp_path / "c.yaml", "pairs: {window: 7, loop_top: 3}")
    config = load_config(path, ("pairs.window=8", "matching.model=a=b.pt", "cameras.params='900,512,384'"))
    assert (config.pairs.window, config.pairs.loop_top) == (8, 3)
    assert config.matching.model == "a=b.pt"
    assert config.cameras.params == "900,512,384"
    config = load_config(
        path, ("pairs.window=8", "cameras.params=x"), options={"cameras.params": "9,5,3", "masks.folder": "1"}
    )
    assert (config.pairs.window, config.pairs.loop_top) == (8, 3)
    assert (config.cameras.params, config.masks.folder) == ("9,5,3", "1")
    empty = write(tmp_path / "empty.yaml", "pairs:\n")
    assert load_config(empty, ("pairs.window=8",)).pairs.window == 8


@pytest.mark.parametrize(
    "setting", ["pairs.window", "=3", "window=3", "pairs.width=3", "pairs.window.x=3", "pairs.window=[", "pairs..x=1"]
)
def test_malformed_settings_are_refused(setting, tmp_path):
    path = write(tmp_path / "c.yaml", "pairs: {window: 7}")
    with pytest.raises(ConfigError):
        load_config(path, (setting,))


@pytest.mark.parametrize("text", ["- a\n- b", "42", "just text", "a: [", "a: b: c", "\x00"])
def test_files_that_hold_no_configuration_are_refused(tmp_path, text):
    path = write(tmp_path / "c.yaml", text)
    with pytest.raises(ConfigError, match="c.yaml"):
        load_config(path)


def test_unreadable_files_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="absent.yaml"):
        load_config(tmp_path / "absent.yaml")
    with pytest.raises(ConfigError, match=tmp_path.name):
        load_config(tmp_path)
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x81")
    with pytest.raises(ConfigError, match="binary.yaml"):
        load_config(tmp_path / "binary.yaml")


@pytest.mark.parametrize("text", ["", "images: photos\nout: out"])
def test_a_missing_key_without_default_is_named(tmp_path, text):
    path = write(tmp_path / "train.yaml", text)
    with pytest.raises(ConfigError, match="train.yaml lacks the key '(images|start_from)'"):
        load_config(path, cls=TrainConfig)


def test_parsing_a_written_out_configuration_gives_it_back():
    config = dataclasses.replace(Config(), network=NetworkConfig(window=17, radius=3))
    assert parse_config(dataclasses.asdict(config), Config) == config


@pytest.mark.parametrize(("name", "value"), leaves(Config()), ids=lambda part: part if isinstance(part, str) else "")
def test_the_fingerprint_changes_with_any_value(name, value):
    section, key = name.split(".")
    other = {str: "other", int: 4711, float: 0.4711, bool: not value}[type(value)]
    for words in (words for *names, words in WORDS if names == [section, key]):
        other = next(word for word in words if word != value)
    changed = dataclasses.replace(
        Config(), **{section: dataclasses.replace(getattr(Config(), section), **{key: other})}
    )
    assert fingerprint(changed) != fingerprint(Config())


def test_fingerprints_are_stable_and_depend_on_all_parts():
    assert fingerprint(Config()) == fingerprint(Config())
    assert len({fingerprint(), fingerprint(1), fingerprint(1, 2), fingerprint([1, 2]), fingerprint(Path("a"))}) == 5
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1})
    assert len(fingerprint(Config())) == 16
