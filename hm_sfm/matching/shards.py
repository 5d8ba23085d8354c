"""Matching in parts, on machines that share a folder: each takes a shard of the pairs, and one gathers them."""

import os
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hm_sfm.errors import InputError
from hm_sfm.formats.pairs_files import write_pairs
from hm_sfm.io.locks import lock_file
from hm_sfm.matching.order import order_pairs
from hm_sfm.matching.store import MatchStore
from hm_sfm.types import ImagePair

CACHED_IMAGES = 32
"""Before pairs are divided they are ordered for processes that hold the features of so many photos."""
SHARD_NAME = re.compile(r"matches\.shard-([0-9]+)-of-([0-9]+)\.h5(\.parts)?")


@dataclass(frozen=True)
class Shard:
    """Part `number` of `count`, counted from 1."""

    number: int
    count: int

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.count:
            raise InputError(f"a shard is one of 1/N to N/N, found {self}")

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """From `number/count`. Raises InputError on anything else."""
        parts = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
        if not parts:
            raise InputError(f"a shard is given as number/count, for example 2/8, found {text!r}")
        return cls(int(parts[1]), int(parts[2]))

    def take(self, pairs: Sequence[ImagePair]) -> tuple[ImagePair, ...]:
        """Its pairs, which share photos. All shards together take each pair once."""
        ordered = order_pairs(pairs, CACHED_IMAGES)
        first, end = (len(pairs) * k // self.count for k in (self.number - 1, self.number))
        return ordered[first:end]

    def locate(self, out: Path) -> Path:
        """Its file of matches in OUT."""
        return out / f"matches.shard-{self.number}-of-{self.count}.h5"

    def lock(self, out: Path) -> None:
        """Hold it, see lock_file. Raises InputError where another process does."""
        refusal = f"shard {self} of the output folder {out} is being matched by another hm-sfm process: wait for it"
        lock_file(_find_lock(self.locate(out)), refusal)

    def write_pairs(self, out: Path, pairs: Sequence[ImagePair]) -> None:
        """OUT/pairs.txt, all pairs of all shards: by a name of its own, since other shards write the same file."""
        own = self.locate(out).with_suffix(".pairs.txt")
        write_pairs(own, pairs)
        os.replace(own, out / "pairs.txt")


def find_shards(out: Path) -> tuple[Shard, ...]:
    """The shards that OUT holds matches of, finished or not. Raises InputError where they are of different counts."""
    names = filter(None, (SHARD_NAME.fullmatch(path.name) for path in out.glob("matches.shard-*")))
    shards = sorted({(int(match[2]), int(match[1])) for match in names})
    counts = sorted({count for count, _ in shards})
    if len(counts) > 1:
        raise InputError(
            f"{out} holds shards of {' and of '.join(map(str, counts))}: delete the matches.shard-* files of one kind"
        )
    return tuple(Shard(number, count) for count, number in shards)


def refuse_shards(out: Path) -> None:
    """Raises InputError where OUT holds shards: who would match them again has forgotten to merge them."""
    shards = find_shards(out)
    if shards:
        raise InputError(
            f"{out} holds shards of matches, for example {shards[0].locate(out).name}: gather them by hm-sfm merge "
            "first, or delete them"
        )


def merge_shards(store: MatchStore, pairs: Sequence[ImagePair], out: Path) -> None:
    """Gather the shards of OUT in `store`, that of OUT/matches.h5, and remove them.

    pairs: all pairs of all shards, in the order that the shards were cut from. Does nothing where the store holds them
    all already. Raises InputError where a shard is missing or unfinished, StaleResultError where one was made by
    other settings or of other photos; nothing is changed then.
    """
    shards = find_shards(out)
    if not shards and all(pair in store for pair in pairs):
        return
    if not shards:
        raise InputError(f"{out} holds no shard to merge: hm-sfm match IMAGES OUT --shard 1/N makes them")
    parts = {shard: MatchStore(shard.locate(out), store.made_by, store.digests) for shard in shards}
    wanted = [Shard(number, shards[0].count) for number in range(1, shards[0].count + 1)]
    lacking = {
        str(shard): sum(pair not in store and pair not in parts.get(shard, ()) for pair in shard.take(pairs))
        for shard in wanted
    }
    lacking = {shard: count for shard, count in lacking.items() if count}
    if lacking:
        some = "shard" if len(lacking) == 1 else "shards"
        raise InputError(
            f"{out} lacks {sum(lacking.values())} of {len(pairs)} pairs, of {some} {', '.join(lacking)}: run "
            f"hm-sfm match with --shard {next(iter(lacking))} (again), then merge"
        )
    for part in parts.values():
        store.adopt(part)
    store.merge()
    for part in parts.values():
        shutil.rmtree(part.parts, ignore_errors=True)
        for file in (part.path, part.path.with_name(part.path.name + ".tmp"), _find_lock(part.path)):
            file.unlink(missing_ok=True)


def _find_lock(path: Path) -> Path:
    return path.with_name(f".{path.name}.lock")
