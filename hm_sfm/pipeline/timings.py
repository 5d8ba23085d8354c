"""How long the stages of a run take."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager


class Timings:
    """Seconds by stage, and since the run began, which is when this is made."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._started = time.monotonic()

    @property
    def total(self) -> float:
        """Seconds since the run began."""
        return time.monotonic() - self._started

    def add(self, seconds: Mapping[str, float]) -> None:
        """Add to the seconds of stages, which may be new."""
        for stage, spent in seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + spent

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Add the time of the block to a stage, also where the block raises."""
        started = time.monotonic()
        try:
            yield
        finally:
            self.add({stage: time.monotonic() - started})
