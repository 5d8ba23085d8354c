"""Files and folders that appear whole or not at all."""

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hm_sfm.errors import InputError
from hm_sfm.io.names import cut_name


@contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Give a temporary path beside `path` to write to; it takes the place of `path` when the block ends well.

    A block that fails leaves `path` as it was and no temporary file; a killed process may leave `path`.tmp, which the
    next writer overwrites. When the block has ended, the file outlasts a power failure.
    """
    path = Path(path)
    temporary = path.with_name(path.name + ".tmp")
    try:
        yield temporary
        # A rename can reach the disk before the content does.
        _flush(temporary, os.O_RDWR)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    with suppress(OSError):  # not all file systems let a folder be flushed
        _flush(path.parent, os.O_RDONLY)


def write_json(path: Path, content: object) -> None:
    """Write a JSON file for people to read, atomically."""
    with replace_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n")


@contextmanager
def make_folder(target: Path) -> Iterator[Path]:
    """Give a temporary folder beside `target`; it takes the place of `target` when the block ends well.

    Raises InputError where `target` is there already, unless it is an empty folder.
    """
    if target.exists() and not (target.is_dir() and not any(target.iterdir())):
        raise InputError(f"{target} is there already and not empty: name a new folder")
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{cut_name(target.name, 200)}.") as temporary:
        folder = Path(temporary) / "made"
        folder.mkdir()
        yield folder
        os.replace(folder, target)


def move_folder(folder: Path, target: Path) -> None:
    """Rename a folder of files, on the same disk; after a power failure it is whole, or not at `target`."""
    for path in folder.iterdir():
        _flush(path, os.O_RDWR)
    os.replace(folder, target)
    with suppress(OSError):  # as above
        _flush(target.parent, os.O_RDONLY)


def _flush(path: Path, flags: int) -> None:
    """Make the disk hold what was written to a file, or which names stand in a folder."""
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
