"""The provider of coarse matches that the configuration names.

A provider describes each image once and makes PointPairs of the descriptions of two images; the fine stage estimates a
homography around each of them.
"""

import hashlib
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from hm_sfm.config import MatchingConfig
from hm_sfm.errors import ConfigError, InputError
from hm_sfm.formats.hloc import check_names, open_h5
from hm_sfm.matching.cells import CoarseCells
from hm_sfm.matching.encoder import Encoder
from hm_sfm.matching.interfaces import CoarseProvider
from hm_sfm.matching.providers.context import ContextCoarse
from hm_sfm.matching.providers.lightglue import LightGlueCoarse
from hm_sfm.matching.providers.match_file import MatchFile, locate_pairs
from hm_sfm.matching.providers.network import NetworkCoarse
from hm_sfm.matching.providers.packages import PACKAGES, require_package
from hm_sfm.matching.providers.sift import SiftCoarse
from hm_sfm.matching.providers.weights import load_coarse
from hm_sfm.matching.providers.xfeat import XfeatCoarse
from hm_sfm.types import ImagePair

NAMES = ("light", "sift", *PACKAGES)


def check_coarse(config: MatchingConfig, pairs: Sequence[ImagePair] = ()) -> None:
    """Raises what make_provider does, and InputError where the file of matches lacks some of the pairs.

    Nothing is loaded, so that bad input is found before anything is computed.
    """
    if config.coarse not in NAMES and not Path(config.coarse).is_file():
        raise ConfigError(
            f"matching.coarse must be {', '.join(NAMES)} or a file of weights, found {config.coarse!r}: matches in a "
            "file are named with --coarse-matches"
        )
    if config.coarse_features and not config.coarse_matches:
        raise ConfigError("matching.coarse_features needs matching.coarse_matches: hloc keeps one run in two files")
    if config.coarse_matches and config.coarse != "light":
        raise ConfigError(f"matching.coarse is {config.coarse}, but matching.coarse_matches names a file: choose one")
    if config.coarse_matches:
        check_names(sorted({name for pair in pairs for name in (pair.name0, pair.name1)}))
        with open_h5(Path(config.coarse_matches)) as h5:
            locate_pairs(h5, Path(config.coarse_matches), pairs)
    if config.coarse_features:
        with open_h5(Path(config.coarse_features)):
            pass
    if config.coarse in PACKAGES:
        require_package(config.coarse)


def make_provider(config: MatchingConfig, encoder: Encoder) -> CoarseProvider:
    """The provider of the configuration, on the device of the encoder, whose network may be the provider itself.

    Raises ConfigError on an unknown name, MissingPackageError where its package is not installed, InputError where a
    file is missing or damaged, and WeightsError where one of weights is.
    """
    check_coarse(config)
    if config.coarse_matches:
        return MatchFile(Path(config.coarse_matches), Path(config.coarse_features) if config.coarse_features else None)
    if config.coarse not in NAMES:
        return load_coarse(Path(config.coarse), config, encoder.device)
    if config.coarse == "sift":
        return SiftCoarse()
    if config.coarse == "lightglue":
        return LightGlueCoarse(encoder.device)
    if config.coarse == "xfeat":
        return XfeatCoarse(encoder.device)
    if encoder.net.config.coarse == "context":
        return ContextCoarse(encoder.net.context)
    return NetworkCoarse(CoarseCells(encoder, config))


def describe_coarse(config: MatchingConfig) -> dict[str, str]:
    """What the coarse matches depend on beyond the network, by name: versions of packages, or digests of files."""
    if config.coarse_matches:
        files = {"coarse_matches": config.coarse_matches, "coarse_features": config.coarse_features}
        return {f"matching.{key}": digest_file(Path(path)) for key, path in files.items() if path}
    if config.coarse == "light":
        return {}
    if config.coarse not in NAMES:
        return {"matching.coarse": digest_file(Path(config.coarse))}
    package = PACKAGES.get(config.coarse, "pycolmap").replace("_", "-")
    return {"matching.coarse": f"{config.coarse} ({package} {version(package)})"}


def digest_file(path: Path) -> str:
    """sha256, 64 hex digits. Raises InputError where the file cannot be read."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
