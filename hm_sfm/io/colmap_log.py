"""COLMAP's messages, which go to stderr."""

from collections.abc import Iterator
from contextlib import contextmanager

import pycolmap


@contextmanager
def quiet_colmap(level: pycolmap.logging.Level = pycolmap.logging.WARNING) -> Iterator[None]:
    """Keep COLMAP's messages below `level` off stderr."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = max(before, int(level))
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before
