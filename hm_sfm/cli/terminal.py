"""The terminal of a command: streams that may be closed, progress bars that share them, signals that end it."""

import io
import logging
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from tqdm import tqdm

STREAMS = ("stdin", "stdout", "stderr")
"""By their descriptors."""


class Terminated(KeyboardInterrupt):
    """SIGTERM, which stops a command as Ctrl-C does."""


class LogHandler(logging.StreamHandler):
    """Writes to stderr, each message in a line of its own, above the progress bars that stand there."""

    def emit(self, record: logging.LogRecord) -> None:
        with tqdm.external_write_mode(file=self.stream):
            super().emit(record)


def open_streams() -> None:
    """Open the standard streams that are closed, and make those of text take all characters.

    What is not in the encoding of a stream is written as an escape. A closed stream leads nowhere: otherwise the next
    file that is opened, such as a database, would take its number, and libraries would print into it.
    """
    for descriptor, name in enumerate(STREAMS):
        try:
            os.fstat(descriptor)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # gets the lowest number that is free: this one
        if getattr(sys, name) is None:
            nowhere = os.open(os.devnull, os.O_RDWR)
            setattr(sys, name, os.fdopen(nowhere, "r" if name == "stdin" else "w", encoding="utf-8"))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def say_last(text: str) -> None:
    """Print what a command has to say as it fails, as the last line on stderr: progress bars end above it."""
    for bar in list(getattr(tqdm, "_instances", ())):
        bar.close()
    print(f"hm-sfm: {' '.join(line.strip() for line in text.splitlines())}", file=sys.stderr)


@contextmanager
def stop_on_terminate() -> Iterator[None]:
    """Raise Terminated in the block where the process gets SIGTERM: what is being written is then cleaned up."""
    own_id = os.getpid()

    def stop(signum: int, frame: FrameType | None) -> None:
        if os.getpid() == own_id:
            raise Terminated
        signal.signal(signum, signal.SIG_DFL)  # a worker that was forked ends at once, as its parent expects
        os.kill(os.getpid(), signum)

    try:
        before = signal.signal(signal.SIGTERM, stop)
    except ValueError:  # not in the main thread, where signals are none of ours
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def leave_broken_pipe() -> None:
    """Send stdout nowhere, after its reader has gone: Python would complain again when it flushes it at the end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), STREAMS.index("stdout"))
