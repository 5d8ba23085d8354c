"""What C libraries print to stderr, by themselves and without the name of a file."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def catch_native_stderr() -> Iterator[list[str]]:
    """Keep what is printed to stderr in the block from being shown; its lines are in the list when the block ends."""
    lines: list[str] = []
    try:
        shown = os.dup(2)
    except OSError:  # stderr is closed, so nothing is shown
        yield lines
        return
    with tempfile.TemporaryFile() as caught:
        os.dup2(caught.fileno(), 2)
        try:
            yield lines
        finally:
            os.dup2(shown, 2)
            os.close(shown)
        caught.seek(0)
        lines += caught.read().decode(errors="replace").splitlines()
