"""OUT, the folder of a run: whose it is, and the settings that the matches in it depend on."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from hm_sfm.config import Config
from hm_sfm.errors import InputError
from hm_sfm.io.locks import lock_file
from hm_sfm.io.markers import RUN_MARKER
from hm_sfm.matching.providers.choice import describe_coarse
from hm_sfm.matching.store import MatchStore, digest_image
from hm_sfm.network.checkpoints import digest_weights
from hm_sfm.types import ImageRef

MATCHES_FILE = "matches.h5"
UNDESCRIBED = {
    ("matching", key)
    for key in ("device", "feature_cache_mb", "model", "engine", "coarse", "coarse_matches", "coarse_features")
}
"""Settings that the matches do not depend on, and those that are described by the files that they name."""


def claim_folder(out: Path, shared: bool = False) -> None:
    """Make OUT, or check that it is empty or an earlier run's, and lock it, see hm_sfm.io.locks.

    shared: with other processes that share it. Raises InputError where OUT is not a run, not writable, or in use.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        foreign = any(out.iterdir()) and not (out / RUN_MARKER).exists()
        if not foreign:
            (out / RUN_MARKER).touch()
            in_use = f"the output folder {out} is in use by another hm-sfm process: wait for it, or name another OUT"
            lock_file(out / RUN_MARKER, in_use, shared)
    except OSError as error:
        raise InputError(f"cannot write to the output folder {out}: {error.strerror}") from error
    if foreign:
        raise InputError(f"the output folder {out} is not empty and holds no run of hm_sfm: name a new one")


def describe_matching(config: Config) -> dict[str, object]:
    """Every setting that the stored matches depend on, by name."""
    described: dict[str, object] = {"weights": digest_weights(config.matching.model)}
    for section in ("network", "images", "matching"):
        for key, value in dataclasses.asdict(getattr(config, section)).items():
            if (section, key) not in UNDESCRIBED:
                described[f"{section}.{key}"] = value
    return described | describe_coarse(config.matching)


def open_store(path: Path, images: Sequence[ImageRef], config: Config) -> MatchStore:
    """The matches of a run, for these photos and settings. Raises what MatchStore and digest_image raise."""
    return MatchStore(path, describe_matching(config), {image.name: digest_image(image) for image in images})
