"""OUT/matches.h5: PairMatches on disk, written so that a crash loses at most the last batch.

Batches of pairs are written beside the file, each to a file of its own that appears whole or not at all; at the end
they are merged into matches.h5, which also appears at once. Every pair carries the fingerprint of the two photos and
every file that of the configuration and the weights, so nothing stale is ever used.
"""

import errno
import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from hm_sfm.config import Config
from hm_sfm.errors import InputError, StaleResultError
from hm_sfm.io.arrays import open_group, read_array, read_attributes
from hm_sfm.io.atomic import replace_file
from hm_sfm.types import ImagePair, ImageRef, PairMatches

VERSION = 1
MERGED_AT_ONCE = 500
"""Pairs after which the files are closed and opened again: HDF5 holds on to 20 KB of memory for each until then."""


def digest_image(image: ImageRef) -> str:
    """16 hex digits of the photo's bytes and of its frame of coordinates. Raises InputError where it cannot be read."""
    try:
        with open(image.path, "rb") as file:
            digest = hashlib.file_digest(file, "sha256")
    except OSError as error:
        raise InputError(f"cannot read the image {image.path}: {error.strerror}") from error
    if image.flipped:
        digest.update(b"flipped")
    return digest.hexdigest()[:16]


@contextmanager
def name_disk_errors(path: Path) -> Iterator[None]:
    """Raises InputError where `path` cannot be written, because the disk is full or for another reason."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        # HDF5 hides the reason in a long text, and the first error behind those of closing the file.
        text = " ".join(f"{error} {error.__context__}".split())
        number = re.search(r"errno = ([0-9]+)|\[Errno ([0-9]+)\]", text)
        reason = os.strerror(int(number[1] or number[2])) if number else text
        raise InputError(f"cannot write {path}: {reason}") from error


def require_room(path: Path, size_bytes: int) -> None:
    """Raises OSError where the disk has no room for `path`: where HDF5 finds that out, the process can crash."""
    probe = path.with_name(path.name + ".tmp")
    try:
        with open(probe, "wb") as file:
            os.posix_fallocate(file.fileno(), 0, max(1, size_bytes))
    except AttributeError:  # not all systems can tell
        pass
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise
    finally:
        probe.unlink(missing_ok=True)


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
            data = open_group(h5, group)
            return PairMatches(
                pair=pair,
                xy0=read_array(data, "xy0"),
                xy1=read_array(data, "xy1"),
                score=read_array(data, "score"),
                homography=read_array(data, "homography"),
                patch_radius_px=float(read_attributes(data)["patch_radius_px"]),
            )

    def write(self, batch: Sequence[PairMatches]) -> None:
        """Store a batch of pairs: after a crash either all of them are there or none.

        Raises InputError where the disk is full or refuses; what was stored before stays.
        """
        if not batch:
            return
        self.parts.mkdir(parents=True, exist_ok=True)
        last = max((int(path.stem) for path in self.parts.glob("*.h5")), default=-1)
        path = self.parts / f"{last + 1:06d}.h5"
        # In memory first: HDF5 itself can crash on a full disk.
        with h5py.File(path.name, "w", driver="core", backing_store=False) as h5:
            self._stamp(h5)
            for number, matches in enumerate(batch):
                self._write_pair(h5, f"{number:06d}", matches)
            h5.flush()
            content = h5.id.get_file_image()
        with name_disk_errors(path), replace_file(path) as temporary:
            temporary.write_bytes(content)
        for number, matches in enumerate(batch):
            self._where[matches.pair] = (path, f"{number:06d}")

    def adopt(self, other: "MatchStore") -> None:
        """Take in the pairs of another store that this one lacks; merge copies them."""
        self._where = other._where | self._where

    def merge(self) -> None:
        """Gather everything that is still valid in matches.h5, in the order of the pairs, and remove the batches.

        Raises InputError where the disk is full or refuses; the batches stay then, and nothing is lost.
        """
        adopted = any(file.parent != self.parts and file != self.path for file, _ in self._where.values())
        if self.path.exists() and not self.parts.exists() and not adopted:
            return
        where = {}
        # The same names of groups, whatever was matched first, and where.
        groups = {pair: f"{number:06d}" for number, pair in enumerate(sorted(self._where))}
        by_file: dict[Path, list[ImagePair]] = {}
        for pair, (file, _) in self._where.items():
            by_file.setdefault(file, []).append(pair)
        with name_disk_errors(self.path):
            require_room(self.path, sum(file.stat().st_size for file in by_file))
        with name_disk_errors(self.path), replace_file(self.path) as temporary:
            with h5py.File(temporary, "w") as merged:
                self._stamp(merged)
            for file, pairs in by_file.items():
                for first in range(0, len(pairs), MERGED_AT_ONCE):
                    with h5py.File(file, "r") as h5, h5py.File(temporary, "a") as merged:
                        for pair in pairs[first : first + MERGED_AT_ONCE]:
                            h5.copy(self._where[pair][1], merged, groups[pair])
                            where[pair] = (self.path, groups[pair])
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
                stamp = read_attributes(h5)
                if stamp.get("version") != VERSION:
                    raise StaleResultError(f"{file} is of another version of hm_sfm: name another OUT or delete it")
                self._compare_settings(file, json.loads(stamp["made_by"]))
                if not set(stamp["images"].split()) & set(self.digests.values()):
                    raise StaleResultError(f"{file} was made from other photos: name another OUT or delete it")
                for group, data in h5.items():
                    attrs = read_attributes(data)
                    same = all(self.digests.get(attrs[f"name{i}"]) == attrs[f"digest{i}"] for i in (0, 1))
                    if same:
                        self._where[ImagePair(attrs["name0"], attrs["name1"])] = (file, group)
        except (OSError, KeyError, json.JSONDecodeError) as error:
            raise StaleResultError(f"{file} is damaged or no matches file: delete it ({error})") from error

    def _compare_settings(self, file: Path, made_by: dict[str, Any]) -> None:
        for key in sorted(made_by.keys() | self.made_by.keys()):
            if key not in self.made_by and "." in key and not is_setting(key):
                raise StaleResultError(
                    f"{file} was made by another version of hm_sfm, which had the setting {key}: name another OUT or "
                    "delete it"
                )
            if made_by.get(key) != self.made_by.get(key):
                raise StaleResultError(
                    f"{file} was made with {key} {made_by.get(key)!r}, this run has {self.made_by.get(key)!r}: "
                    "name another OUT or delete it"
                )


def is_setting(key: str) -> bool:
    """Whether the configuration has the key `section.name`."""
    section, _, name = key.partition(".")
    return hasattr(getattr(Config(), section, None), name)
