"""The configuration: YAML into nested frozen dataclasses, and fingerprints of what made a result.

The defaults are defined here and nowhere else. `configs/light.yaml` spells them out; a test keeps the two equal.
"""

import dataclasses
import difflib
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints

import yaml

from hm_sfm.errors import ConfigError


@dataclass(frozen=True)
class NetworkConfig:
    """The architecture. A weights file holds its own; a configuration that disagrees with it is refused."""

    backbone: Literal["light", "loftr"] = "light"
    """Where the features come from: `light` (XFeat's trunk with a fine branch) or `loftr` (LoFTR's ResNet)."""
    coarse: Literal["context", "cosine", "attention", "aspan"] = "context"
    """`context` (keypoints matched by LightGlue, each seeing its surroundings and the other image), `cosine` (mutual
    nearest neighbours of plain cells), `attention` (LoFTR's transformer and dual softmax) or `aspan` (ASpanFormer's,
    which attends around a flow)."""
    head: Literal["homography", "expectation"] = "homography"
    """`homography` (the paper) or `expectation` (LoFTR's point-to-patch baseline)."""
    window: int = 9
    """w: side of a fine patch, cells of the 1/2 grid."""
    radius: int = 1
    """r: radius of the correlation window sampled in each iteration."""
    iterations: int = 2
    """K: homography updates. The paper and training use 3; trained weights work with any number."""
    margin: int = 2
    """Cells by which the patch searched in image 1 is larger than that of image 0, on each side (the paper: 0)."""
    spacing: int = 2
    """Cells between the points of image 0's patch that are looked up in image 1, in each direction (the paper: 1)."""

    def __post_init__(self) -> None:
        check_words(self, "network")


@dataclass(frozen=True)
class ImageConfig:
    long_edge_px: int = 1024
    """The matching resolution: photos are reduced to this, never enlarged; of panoramas of more than 3:1, the shorter
    side is reduced to a third of it or less. Keypoints are px of the stored photo."""


@dataclass(frozen=True)
class MaskConfig:
    """Photos are not matched where their masks are black."""

    folder: str = ""
    """Folder of masks: that of a/b.jpg is a/b.jpg.png and has the same size."""
    camera: str = ""
    """A mask for all photos of its size."""


@dataclass(frozen=True)
class PairConfig:
    mode: str = "auto"
    """auto | exhaustive | sequential | retrieval | spatial | a pairs file."""
    exhaustive_limit: int = 60
    """auto: all pairs of up to this many images; for more, the pairs of retrieval, spatial and a sequence's window."""
    window: int = 5
    """sequential: pair each image with this many followers, and with those at distances of powers of two."""
    loop_top: int = 0
    """sequential: also pair it with this many of the most similar images far from it in the sequence."""
    retrieval_top: int = 20
    """retrieval: pair each image with this many of the most similar ones."""
    spatial_top: int = 20
    """spatial: pair each image with this many of the nearest ones, by the GPS positions in EXIF ..."""
    spatial_distance_m: float = 100.0
    """... but with none farther away than this."""


@dataclass(frozen=True)
class MatchingConfig:
    model: str = "light"
    """Name of bundled weights, or a file."""
    coarse: str = "light"
    """Where the coarse matches come from, for which homographies are estimated: light (the network itself) | sift |
    lightglue | xfeat | a file of weights, LoFTR's or made by hm-sfm train, whose coarse stage is used."""
    coarse_matches: str = ""
    """A file with coarse matches of any other matcher instead, in the format of hloc or of its match_dense."""
    coarse_features: str = ""
    """A file with the keypoints, in hloc's format, if coarse_matches holds indices of keypoints."""
    context_keypoints: int = 2048
    """network.coarse context: keypoints per image that the coarse stage matches."""
    min_cosine: float = 0.8
    """Least cosine similarity of a coarse match where cells are matched by plain features (network.coarse cosine)."""
    min_confidence: float = 0.2
    """Least confidence of a coarse match where cells are matched by a dual softmax (theta_c of LoFTR's section 3.3)."""
    max_matches: int = 8000
    """The matches with the best scores that are kept per pair."""
    grow_below: int = 300
    """In pairs with fewer good matches than this, these grow to neighbours that the coarse stage missed. Matches of
    keypoints (network.coarse context) are sparse and always grow. 0, as in the paper, grows none."""
    try_hypotheses: bool = True
    """Pairs with few good matches are tried with one photo rotated in steps of 45 degrees and reduced to 1/2 and 1/3,
    and are matched again where that fits clearly better."""
    feature_cache_mb: int = 1500
    """Memory for the features of photos in each process that matches. It must hold two photos."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """auto takes the GPU if there is one."""
    engine: Literal["serial", "ray"] = "serial"
    """serial matches in this process, ray on the workers of a Ray cluster."""

    def __post_init__(self) -> None:
        check_words(self, "matching")


GOOD_SCORE = 0.5
"""A match with at least this score is good: it is more probably off by less than 1 px than not. Matching counts good
matches, and only these grow; it goes by this number and not by verification.min_score, whose default it is, so that
stored matches stay when that setting changes."""


@dataclass(frozen=True)
class VerificationConfig:
    """Two-view geometry, before keypoints are propagated and again with the final keypoints."""

    min_score: float = GOOD_SCORE
    """Matches with a lower score are not used: they are probably off by more than 1 px of the matching resolution."""
    max_error_px: float = 3.0
    """Largest error of an inlier, px of the matching resolution; it is scaled to the photo."""
    min_inliers: int = 30
    min_inlier_ratio: float = 0.25
    doubtful_inlier_ratio: float = 0.6
    """The ratio that a pair with only min_inliers needs. With more inliers, the ratio needed falls, to min_inlier_ratio
    at sure_inliers. By chance, a third of the matches of two different places agree with an epipolar geometry."""
    sure_inliers: int = 300
    judge: bool = True
    """Pairs and matches that loops through third photos contradict are given up: twins of facades, rooms and doors."""


@dataclass(frozen=True)
class KeypointConfig:
    """Persistent keypoints. Distances are px of the matching resolution; they are scaled to each photo."""

    propagation_min_score: float = 0.8
    """Patches with a lower score propagate no keypoints, except for the best patches of pairs that have few. hm-sfm
    refine ignores this setting, because it starts from verified matches."""
    propagation_radius_px: float = 8.0
    """A patch propagates keypoints up to this distance from its centre."""
    join_radius_px: float = 1.0
    """A propagated keypoint joins an existing one up to this distance from it ..."""
    separation_px: float = 1.6
    """... and becomes a new one only if all others are farther away than this."""
    seed_spacing_px: float = 2.0
    """A patch seeds a keypoint if there is none up to this distance."""
    adjustment_rounds: int = 15
    """Rounds of the joint adjustment of each track's keypoints; 0 leaves them where they were first predicted."""
    max_keypoints: int = 8000
    """Keypoints kept per image: the longest tracks first, spread over the image."""
    refine_long_edge_px: int = 1024
    """Long edge of the photos used for keypoint refinement. Photos are never enlarged, and at least images.long_edge_px
    is used. 0 turns refinement off; networks without a homography head have none."""


@dataclass(frozen=True)
class CameraConfig:
    mode: Literal["auto", "single", "per-folder", "per-image"] = "auto"
    """Which photos share a camera; auto goes by size and EXIF."""
    model: str = "SIMPLE_RADIAL"
    params: str = ""
    """Known intrinsics, `f,...` in the order of the camera model's parameters; they stay fixed."""
    file: str = ""
    """A COLMAP model, or its cameras.txt or cameras.bin, with the known intrinsics of each image; they stay fixed."""
    poses: str = ""
    """A COLMAP model with known intrinsics and poses; both stay fixed, and only points are triangulated."""
    rig: str = ""
    """A rig configuration in COLMAP's format, for cameras that are mounted together."""

    def __post_init__(self) -> None:
        check_words(self, "cameras")


@dataclass(frozen=True)
class MappingConfig:
    mapper: Literal["incremental", "global"] = "incremental"
    """COLMAP's incremental mapper adds one image after another, its global mapper takes all at once."""
    min_model_size: int = 2
    """Fewest images of a model."""
    seed: int = 0
    """Seed of the random numbers in mapping."""

    def __post_init__(self) -> None:
        check_words(self, "mapping")


@dataclass(frozen=True)
class Config:
    network: NetworkConfig = field(default_factory=NetworkConfig)
    images: ImageConfig = field(default_factory=ImageConfig)
    masks: MaskConfig = field(default_factory=MaskConfig)
    pairs: PairConfig = field(default_factory=PairConfig)
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    verification: VerificationConfig = field(default_factory=VerificationConfig)
    keypoints: KeypointConfig = field(default_factory=KeypointConfig)
    cameras: CameraConfig = field(default_factory=CameraConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)


RENAMED: dict[type, dict[str, str]] = {
    MatchingConfig: {
        "retry_turned": "matching.try_hypotheses",
        "coarse_threshold": "matching.min_cosine (coarse stage cosine) or matching.min_confidence (attention, aspan)",
    },
    KeypointConfig: {
        "carry_score": "keypoints.propagation_min_score",
        "carry_radius_px": "keypoints.propagation_radius_px",
        "native_px": "keypoints.refine_long_edge_px",
    },
}
"""Keys of version 0.1.0 by the section that they stood in, and what each is called now."""


def parse_config(tree: Any, cls: type, where: str = "", section: str = "") -> Any:
    """Build the dataclass `cls` from a tree of dicts; keys that are left out take their defaults.

    `where` is the file that messages name, `section` the keys that lead to the tree, with dots between them. Raises
    ConfigError on an unknown key (naming the nearest one), a renamed one (naming the new one), a missing one that has
    no default, and on a value of another type or a word that is not among those allowed.
    """
    tree = {} if tree is None else tree
    if not isinstance(tree, dict):
        raise ConfigError(f"{_describe(where, section)} must be a mapping of keys to values, found {tree!r}")
    types = get_type_hints(cls)
    values = {}
    for key, value in tree.items():
        dotted = f"{section}.{key}" if section else str(key)
        if key not in types and key in RENAMED.get(cls, {}):
            raise ConfigError(f"{_prefix(where)}the key {dotted!r} is now called {RENAMED[cls][key]}")
        if key not in types:
            near = difflib.get_close_matches(str(key), types, n=1, cutoff=0.0)
            raise ConfigError(f"unknown key {str(key)!r} in {_describe(where, section)}: did you mean {near[0]!r}?")
        values[key] = _parse_value(value, types[key], where, dotted)
    for item in dataclasses.fields(cls):
        required = item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING
        if required and item.name not in values:
            raise ConfigError(f"{_describe(where, section)} lacks the key {item.name!r}")
    return cls(**values)


def _describe(where: str, section: str) -> str:
    if not section:
        return where or "the configuration"
    return f"{_prefix(where)}{section}"


def _prefix(where: str) -> str:
    return f"{where}: " if where else ""


def _parse_value(value: Any, kind: Any, where: str, dotted: str) -> Any:
    name = f"{_prefix(where)}{dotted}"
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        return parse_config(value, kind, where, dotted)
    if get_origin(kind) is Literal:
        check_word(value, get_args(kind), name)
        return value
    if isinstance(kind, UnionType):
        if value is None and type(None) in get_args(kind):
            return None
        kind = next(arg for arg in get_args(kind) if arg is not type(None))
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        raise ConfigError(f"{name} must be of type {kind.__name__}, found {value!r}")
    if isinstance(value, int | float) and not value >= 0:
        raise ConfigError(f"{name} must not be negative, found {value!r}")
    return value


def check_words(config: Any, section: str) -> None:
    """Raises ConfigError where a field of the dataclass `config` that is a Literal holds none of its words."""
    for key, kind in get_type_hints(type(config)).items():
        if get_origin(kind) is Literal:
            check_word(getattr(config, key), get_args(kind), f"{section}.{key}" if section else key)


def check_word(value: Any, allowed: tuple[str, ...], name: str) -> None:
    """Raises ConfigError where `value` is none of the words `allowed`."""
    if value not in allowed:
        raise ConfigError(f"{name} must be {', '.join(allowed[:-1])} or {allowed[-1]}, found {value!r}")


def read_yaml(path: Path) -> Any:
    """The YAML tree of a file. Raises ConfigError if it cannot be read or parsed."""
    try:
        return yaml.safe_load(Path(path).read_text())
    except OSError as error:
        raise ConfigError(f"cannot read the configuration {path}: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from error


def load_config(
    path: Path | None = None,
    settings: tuple[str, ...] = (),
    cls: type = Config,
    options: Mapping[str, Any] | None = None,
) -> Any:
    """Read a configuration file, then apply `section.key=value` settings (values are YAML), then `options`.

    `options` are values by their dotted keys, taken as they are. Returns an instance of `cls`. Raises ConfigError on
    anything unknown or malformed.
    """
    tree = (read_yaml(path) or {}) if path else {}
    where = str(path) if path else ""
    if not isinstance(tree, dict):
        raise ConfigError(f"{where} must be a mapping of sections, found {tree!r}")
    for setting in settings:
        dotted, equals, text = setting.partition("=")
        if not equals:
            raise ConfigError(f"--set needs section.key=value, found {setting!r}")
        try:
            _set_value(tree, dotted, yaml.safe_load(text))
        except yaml.YAMLError as error:
            raise ConfigError(f"--set {setting!r} is not valid YAML") from error
    for dotted, value in (options or {}).items():
        _set_value(tree, dotted, value)
    if path and (settings or options):
        where = f"{where} with the options given"
    return parse_config(tree, cls, where)


def _set_value(tree: dict, dotted: str, value: Any) -> None:
    """Put `value` into nested dicts at `section.key`. Raises ConfigError where a section is a value."""
    *sections, key = dotted.split(".")
    for section in sections:
        if tree.get(section) is None:
            tree[section] = {}
        tree = tree[section]
        if not isinstance(tree, dict):
            raise ConfigError(f"cannot set {dotted!r}: {section!r} is a value, not a section")
    tree[key] = value


def fingerprint(*parts: Any) -> str:
    """16 hex digits that change when any of the parts does (dataclasses, JSON values, paths)."""

    def plain(value: Any) -> Any:
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            return dataclasses.asdict(value)
        return str(value)

    text = json.dumps(parts, default=plain, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
