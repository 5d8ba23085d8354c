"""OUT, the folder of a run: whose it is, and the settings that the matches in it depend on."""

import dataclasses
import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import h5py

from hm_sfm.config import Config
from hm_sfm.errors import InputError
from hm_sfm.io.arrays import read_attributes
from hm_sfm.io.locks import lock_file
from hm_sfm.io.markers import RUN_MARKER
from hm_sfm.matching.providers.choice import describe_coarse
from hm_sfm.matching.store import MatchStore, digest_image
from hm_sfm.network.checkpoints import digest_weights
from hm_sfm.types import ImageRef

MATCHES_FILE = "matches.h5"
REPLACED_FILES = {
    MATCHES_FILE, f"{MATCHES_FILE}.parts", "pairs.txt", "refined.h5", "verified.h5", "database.db", "summary.json",
    "report.html", "compare.json", "compare.png", "hloc", "retrieval",
}  # fmt: skip
"""What runs write and replace; they take care of what others put into OUT/sparse and OUT/snapshots."""
UNDESCRIBED = {
    ("matching", key)
    for key in ("device", "feature_cache_mb", "model", "engine", "coarse", "coarse_matches", "coarse_features")
}
"""Settings that the matches do not depend on, and those that are described by the files that they name."""


def claim_folder(out: Path, shared: bool = False, photos: Path | None = None) -> None:
    """Make OUT, or check that it is empty or an earlier run's, and lock it, see hm_sfm.io.locks.

    A folder around that of the photos, `photos`, may be OUT as well: COLMAP's projects are laid out like that. So may a
    run that was copied without its hidden files. shared: with other processes that share it. Raises InputError where
    OUT is something else, holds files of others in the place of a run's, is not writable, or in use.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        refusal = None if (out / RUN_MARKER).exists() else find_foreign(out, photos)
        if not refusal:
            (out / RUN_MARKER).touch()
            in_use = f"the output folder {out} is in use by another hm-sfm process: wait for it, or name another OUT"
            lock_file(out / RUN_MARKER, in_use, shared)
    except OSError as error:
        raise InputError(f"cannot write to the output folder {out}: {error.strerror}") from error
    if refusal:
        raise InputError(f"the output folder {out} {refusal}")


def find_foreign(out: Path, photos: Path | None) -> str | None:
    """Why a folder without the marker of a run cannot be OUT; None where it can. photos: as in claim_folder."""
    names = {path.name for path in out.iterdir()}
    if not names or is_run(out):
        return None
    if photos is None or out.resolve() not in photos.resolve().parents:
        return "is not empty and holds no run of hm_sfm: name a new one"
    replaced = sorted(names & REPLACED_FILES)
    return f"holds {replaced[0]}, which hm_sfm did not write and would replace: name another OUT" if replaced else None


def is_run(out: Path) -> bool:
    """Whether a folder holds results of a run, as their own content says."""
    for path in (out / MATCHES_FILE, *sorted((out / f"{MATCHES_FILE}.parts").glob("*.h5"))[:1]):
        with suppress(OSError), h5py.File(path, "r") as h5:
            if {"made_by", "version"} <= read_attributes(h5).keys():
                return True
    for path in (out / "summary.json", out / "compare.json"):
        with suppress(OSError, ValueError):
            content = json.loads(path.read_text())
            if isinstance(content, dict) and "config_fingerprint" in content:
                return True
    return False


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
