"""Files that one process at a time may hold. The kernel releases them with the process, however that ends."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hm_sfm.errors import InputError

try:
    import fcntl
except ImportError:  # Windows: nothing is locked there
    fcntl = None

_held: dict[Path, int] = {}
"""Path -> the descriptor whose closing releases it."""
_depth = 0


def lock_file(path: Path, refusal: str, shared: bool = False) -> None:
    """Hold a file, which is made if it is not there, until the end of the outermost release_locks, or of the process.

    shared: together with others that share it. Nothing happens where this process holds it already. Raises InputError
    with the text `refusal` where another process holds it, OSError where it cannot be opened.
    """
    path = Path(path).resolve()
    if fcntl is None or path in _held:
        return
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        raise InputError(refusal) from error
    except OSError:  # a file system without locks: better unguarded than not at all
        pass
    _held[path] = descriptor


@contextmanager
def wait_in_line(path: Path) -> Iterator[None]:
    """Hold a file, which is made if it is not there, for the block; wait while another process holds it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        if fcntl is not None:
            with suppress(OSError):  # as above
                fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


@contextmanager
def release_locks() -> Iterator[None]:
    """What lock_file takes in the block is held to its end; in nested blocks, to the end of the outermost."""
    global _depth
    _depth += 1
    try:
        yield
    finally:
        _depth -= 1
        if _depth == 0:
            while _held:
                os.close(_held.popitem()[1])
