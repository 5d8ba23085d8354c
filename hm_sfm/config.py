"""The configuration: YAML into nested frozen dataclasses, and fingerprints of what made a result.

The defaults stand here and only here; `configs/light.yaml` spells them out and a test keeps the two equal.
"""

import dataclasses
import difflib
import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_type_hints

import yaml

from hm_sfm.errors import ConfigError


@dataclass(frozen=True)
class NetworkConfig:
    """The architecture. A weights file carries its own; a configuration that disagrees is refused."""

    backbone: str = "light"
    coarse: str = "cosine"
    """`attention` (LoFTR's transformer and dual softmax), `aspan` (ASpanFormer's, which attends around a flow) or
    `cosine` (mutual nearest neighbours of plain features)."""
    head: str = "homography"
    """`homography` (the paper) or `expectation` (LoFTR's point-to-patch baseline)."""
    window: int = 9
    """w: side of a fine patch, cells of the 1/2 grid."""
    radius: int = 1
    """r: radius of the correlation window that is sampled at each iteration."""
    iterations: int = 2
    """K: homography updates (the paper: 3, and weights are trained with as many; any number can be made of them)."""
    margin: int = 2
    """Cells by which the patch searched in image 1 is larger on each side (the paper: 0)."""
    spacing: int = 2
    """Cells from one point of image 0's patch that is looked up in image 1 to the next (the paper: 1)."""


@dataclass(frozen=True)
class ImageConfig:
    long_edge_px: int = 1024
    """Photos are reduced to this size for matching (never enlarged); keypoints are in original pixels."""


@dataclass(frozen=True)
class MaskConfig:
    """Black pixels of masks are not matched."""

    folder: str = ""
    """Holds the mask of a/b.jpg as a/b.jpg.png, of the same size."""
    camera: str = ""
    """A mask of all images of its size."""


@dataclass(frozen=True)
class PairConfig:
    mode: str = "auto"
    """auto | exhaustive | sequential | retrieval | spatial | a pairs file."""
    exhaustive_limit: int = 60
    """auto matches all pairs up to this many images; of more, those of retrieval, spatial and a sequence's window."""
    window: int = 5
    """sequential: each image with so many followers, and with those at distances of powers of two."""
    loop_top: int = 0
    """sequential: and with so many that look most like it far from it in the sequence."""
    retrieval_top: int = 20
    """retrieval: each image with so many that look most like it."""
    spatial_top: int = 20
    """spatial: each image with so many that were taken nearest to it, by the positions in EXIF,"""
    spatial_distance_m: float = 100.0
    """and none farther away than this."""


@dataclass(frozen=True)
class MatchingConfig:
    model: str = "light"
    """Name of bundled weights, or a file."""
    coarse: str = "light"
    """What finds the matches to estimate homographies for: light (the network itself) | sift | lightglue | xfeat | a file
    of weights, of LoFTR or made by hm-sfm train, whose coarse stage does."""
    coarse_matches: str = ""
    """A file with the matches of any matcher instead, as hloc or its match_dense write them;"""
    coarse_features: str = ""
    """and with the keypoints that these are of, where they are indices."""
    coarse_threshold: float = 0.8
    """light: least cosine similarity of a coarse match."""
    max_matches: int = 8000
    """Best-scored matches kept per pair."""
    grow_below: int = 300
    """In pairs with fewer good matches, these spread to neighbours that the coarse stage missed; 0 is the paper. Where
    there are enough, grown matches are no gain: they are less exact than those that the coarse stage finds itself."""
    try_hypotheses: bool = True
    """Pairs with few good matches are looked at turned by quarters and reduced to 1/2 and 1/3, and matched again where
    that fits clearly better."""
    feature_cache_mb: int = 1500
    """Per process that matches: two photos at least."""
    device: str = "auto"
    engine: str = "serial"
    """serial, or ray: by the workers of a Ray cluster."""


@dataclass(frozen=True)
class VerificationConfig:
    """Two-view geometry, before anything is carried and again on the final keypoints."""

    min_score: float = 0.5
    """Matches below are not used: they are off by more than a pixel, or wrong altogether."""
    max_error_px: float = 3.0
    """At the matching resolution; scaled to the photo."""
    min_inliers: int = 30
    min_inlier_ratio: float = 0.25
    doubtful_inlier_ratio: float = 0.6
    """What a pair with no more than min_inliers needs instead; it falls to min_inlier_ratio at sure_inliers. Chance
    finds an epipolar line for a third of the matches of two different places."""
    sure_inliers: int = 300


@dataclass(frozen=True)
class KeypointConfig:
    """Persistence. Distances in px of the matching resolution, scaled to each photo."""

    propagation_min_score: float = 0.7
    """Patches with a lower score carry no points, but for the best ones of pairs that have few. hm-sfm refine does
    without it: it begins with matches that were verified."""
    propagation_radius_px: float = 8.0
    """A patch carries points no farther than this from its centre."""
    join_radius_px: float = 1.0
    separation_px: float = 2.0
    seed_spacing_px: float = 3.0
    """A patch seeds a keypoint where none is nearer than this."""
    adjustment_rounds: int = 15
    """Of the joint adjustment of each track's keypoints; 0 leaves them where they were first predicted."""
    max_keypoints: int = 8000
    """Per image, longest tracks first, spread over the image."""
    refine_long_edge_px: int = 1024
    """Long edge of the photos on which a second fine pass places carried keypoints again, at least images.long_edge_px,
    never enlarged; 0 leaves it out. Networks without homographies do without it."""


@dataclass(frozen=True)
class CameraConfig:
    mode: str = "auto"
    """auto | single | per-folder | per-image."""
    model: str = "SIMPLE_RADIAL"
    params: str = ""
    """Known intrinsics, `f,...` in the order of COLMAP's camera model; they stay fixed."""
    file: str = ""
    """A COLMAP model, or its cameras.txt or cameras.bin, with the known intrinsics of each image; they stay fixed."""
    poses: str = ""
    """As `file`, and the poses are known, too: points are triangulated, nothing is mapped."""
    rig: str = ""
    """A rig configuration as COLMAP has it: which photos were taken together by cameras that are mounted together."""


@dataclass(frozen=True)
class MappingConfig:
    mapper: str = "incremental"
    """incremental | global."""
    min_model_size: int = 2
    seed: int = 0


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


def parse_config(tree: Any, cls: type, where: str = "the configuration") -> Any:
    """Build the dataclass `cls` from a tree of dicts; keys that are left out take their defaults.

    Raises ConfigError on an unknown key (naming the nearest one), a missing one that has no default, and on a value
    of another type.
    """
    tree = {} if tree is None else tree
    if not isinstance(tree, dict):
        raise ConfigError(f"{where} must be a mapping of keys to values, found {tree!r}")
    types = get_type_hints(cls)
    values = {}
    for key, value in tree.items():
        if key not in types:
            near = difflib.get_close_matches(str(key), types, n=1, cutoff=0.0)
            raise ConfigError(f"unknown key {key!r} in {where}: did you mean {near[0]!r}?")
        values[key] = _parse_value(value, types[key], f"{where}: {key}")
    for item in dataclasses.fields(cls):
        required = item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING
        if required and item.name not in values:
            raise ConfigError(f"{where} lacks the key {item.name!r}")
    return cls(**values)


def _parse_value(value: Any, kind: Any, where: str) -> Any:
    if dataclasses.is_dataclass(kind):
        return parse_config(value, kind, where)
    if isinstance(kind, UnionType):
        if value is None and type(None) in get_args(kind):
            return None
        kind = next(arg for arg in get_args(kind) if arg is not type(None))
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        raise ConfigError(f"{where} must be of type {kind.__name__}, found {value!r}")
    if kind in (int, float) and not value >= 0:
        raise ConfigError(f"{where} must not be negative, found {value!r}")
    return value


def read_yaml(path: Path) -> Any:
    """The YAML tree of a file. Raises ConfigError where it cannot be read or parsed."""
    try:
        return yaml.safe_load(Path(path).read_text())
    except OSError as error:
        raise ConfigError(f"cannot read the configuration {path}: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from error


def load_config(path: Path | None = None, settings: tuple[str, ...] = (), cls: type = Config) -> Any:
    """Read a configuration file, then apply `section.key=value` settings (values are YAML).

    Returns an instance of `cls`. Raises ConfigError on anything unknown or malformed.
    """
    tree = (read_yaml(path) or {}) if path else {}
    where = str(path) if path else "the configuration"
    if not isinstance(tree, dict):
        raise ConfigError(f"{where} must be a mapping of sections, found {tree!r}")
    for setting in settings:
        dotted, equals, text = setting.partition("=")
        if not equals:
            raise ConfigError(f"--set needs section.key=value, found {setting!r}")
        *sections, key = dotted.split(".")
        node = tree
        for section in sections:
            node = node.setdefault(section, {})
            if not isinstance(node, dict):
                raise ConfigError(f"--set {setting!r}: {section!r} is a value, not a section")
        try:
            node[key] = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ConfigError(f"--set {setting!r} is not valid YAML") from error
    return parse_config(tree, cls, where)


def fingerprint(*parts: Any) -> str:
    """16 hex digits that change when any of the parts does (dataclasses, JSON values, paths)."""

    def plain(value: Any) -> Any:
        return dataclasses.asdict(value) if dataclasses.is_dataclass(value) else str(value)

    text = json.dumps(parts, default=plain, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
