"""OUT/matches.h5: PairMatches on disk, written so that a crash loses at most the last batch.

Batches of pairs are written beside the file, each to a file of its own that appears whole or not at all; at the end
they are merged into matches.h5, which also appears at once. Every pair carries the fingerprint of the two photos and
every file that of the configuration and the weights, so nothing stale is ever used.
"""

import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from hm_sfm.atomic import replace_file
from hm_sfm.errors import InputError, StaleResultError
from hm_sfm.types import ImagePair, ImageRef, PairMatches

VERSION = 1


def digest_image(image: ImageRef) -> str:
    """16 hex digits of the photo's bytes. Raises InputError where it cannot be read."""
    try:
        with open(image.path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()[:16]
    except OSError as error:
        raise InputError(f"cannot read the image {image.path}: {error.strerror}") from error


class MatchStore:
    """The matches of a run. Open it with what makes them (settings by name) and the digests of the photos by name.

    Raises StaleResultError where the file was made by another configuration, model or version, or from photos of
    which none is among the present ones.
    """

    def __init__(self, path: Path, made_by: Mapping[str, Any], digests: Mapping[str, str]) -> None:
        self.path = Path(path)
        self.parts = self.path.with_name(self.path.name + ".parts")
        self.made_by, self.digests = dict(made_by), digests
        self._where: dict[ImagePair, tuple[Path, str]] = {}
        files = [self.path] if self.path.exists() else []
        for file in files + sorted(self.parts.glob("*.h5")):
            self._index(file)

    def __contains__(self, pair: ImagePair) -> bool:
        return pair in self._where

    def read(self, pair: ImagePair) -> PairMatches:
        """The matches of one pair. Raises KeyError where they were never stored."""
        file, group = self._where[pair]
        with h5py.File(file, "r") as h5:
            data = h5[group]
            return PairMatches(
                pair=pair,
                xy0=data["xy0"][()],
                xy1=data["xy1"][()],
                score=data["score"][()],
                homography=data["homography"][()],
                patch_radius_px=float(data.attrs["patch_radius_px"]),
            )

    def write(self, batch: Sequence[PairMatches]) -> None:
        """Store a batch of pairs: after a crash either all of them are there or none."""
        if not batch:
            return
        self.parts.mkdir(parents=True, exist_ok=True)
        last = max((int(path.stem) for path in self.parts.glob("*.h5")), default=-1)
        path = self.parts / f"{last + 1:06d}.h5"
        with replace_file(path) as temporary, h5py.File(temporary, "w") as h5:
            self._stamp(h5)
            for number, matches in enumerate(batch):
                self._write_pair(h5, f"{number:06d}", matches)
        for number, matches in enumerate(batch):
            self._where[matches.pair] = (path, f"{number:06d}")

    def merge(self) -> None:
        """Gather everything that is still valid in matches.h5 and remove the batches."""
        if not self.parts.exists() and self.path.exists():
            return
        where = {}
        with replace_file(self.path) as temporary, h5py.File(temporary, "w") as merged:
            self._stamp(merged)
            by_file: dict[Path, list[ImagePair]] = {}
            for pair, (file, _) in self._where.items():
                by_file.setdefault(file, []).append(pair)
            for file, pairs in by_file.items():
                with h5py.File(file, "r") as h5:
                    for pair in pairs:
                        group = f"{len(where):06d}"
                        h5.copy(self._where[pair][1], merged, group)
                        where[pair] = (self.path, group)
        self._where = where
        shutil.rmtree(self.parts, ignore_errors=True)

    def _stamp(self, h5: h5py.File) -> None:
        h5.attrs["version"] = VERSION
        h5.attrs["made_by"] = json.dumps(self.made_by, sort_keys=True)
        # One string, not a list: HDF5 holds lists of at most 64 KB, some 4000 photos.
        h5.attrs["images"] = " ".join(sorted(self.digests.values()))

    def _write_pair(self, h5: h5py.File, group: str, matches: PairMatches) -> None:
        data = h5.create_group(group)
        pair = matches.pair
        data.attrs["name0"], data.attrs["name1"] = pair.name0, pair.name1
        data.attrs["digest0"], data.attrs["digest1"] = self.digests[pair.name0], self.digests[pair.name1]
        data.attrs["patch_radius_px"] = matches.patch_radius_px
        for field in ("xy0", "xy1", "score", "homography"):
            data.create_dataset(field, data=np.asarray(getattr(matches, field)))

    def _index(self, file: Path) -> None:
        try:
            with h5py.File(file, "r") as h5:
                if h5.attrs.get("version") != VERSION:
                    raise StaleResultError(f"{file} is of another version of hm_sfm: name another OUT or delete it")
                self._compare_settings(file, json.loads(h5.attrs["made_by"]))
                if not set(h5.attrs["images"].split()) & set(self.digests.values()):
                    raise StaleResultError(f"{file} was made from other photos: name another OUT or delete it")
                for group, data in h5.items():
                    attrs = data.attrs
                    same = all(self.digests.get(attrs[f"name{i}"]) == attrs[f"digest{i}"] for i in (0, 1))
                    if same:
                        self._where[ImagePair(attrs["name0"], attrs["name1"])] = (file, group)
        except (OSError, KeyError, json.JSONDecodeError) as error:
            raise StaleResultError(f"{file} is damaged or no matches file: delete it ({error})") from error

    def _compare_settings(self, file: Path, found: dict[str, Any]) -> None:
        differing = sorted(key for key in found.keys() | self.made_by.keys() if found.get(key) != self.made_by.get(key))
        if differing:
            key = differing[0]
            raise StaleResultError(
                f"{file} was made with {key} {found.get(key)!r}, this run has {self.made_by.get(key)!r}: "
                "name another OUT or delete it"
            )
