"""Results of a long loop, stored in batches: what a crash can lose is bounded, and so is the number of files."""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

BATCH_SECONDS = 20.0
"""Results are stored at least this often, whenever new ones come: what a crash can lose."""

Result = TypeVar("Result")


@contextmanager
def store_in_batches(write: Callable[[list[Result]], None]) -> Iterator[Callable[[Iterable[Result]], None]]:
    """Gives a function that takes results, to be written some at a time, and the last ones however the loop ends.

    write: stores a batch, which can be empty; what it raises goes through.
    """
    batch: list[Result] = []
    stored_at = time.monotonic()

    def add(results: Iterable[Result]) -> None:
        nonlocal batch, stored_at
        batch.extend(results)
        if time.monotonic() - stored_at > BATCH_SECONDS:
            write(batch)
            batch, stored_at = [], time.monotonic()

    try:
        yield add
    finally:
        write(batch)
