"""Console output that training never depends on: it goes to a log and, while somebody takes it, to the terminal."""

import contextlib
import io
import os
import select
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO


class Console(io.TextIOBase):
    """Writes to `log` and to `stream`; a stream whose reader has gone is given up, for one that is full lines are lost.

    Where `stream` already goes to the log, as a sweep worker's does, there is one copy.
    """

    def __init__(self, stream: TextIO | None, log: TextIO) -> None:
        self._stream = None if stream is None or same_file(stream, log) else stream  # None: closed by the caller
        self._log, self._pending = log, ""

    def write(self, text: str) -> int:
        """Take `text`, and hand on what ends a line."""
        self._pending += text
        if text.endswith("\n"):
            self.flush()
        return len(text)

    def flush(self) -> None:
        """Hand on everything."""
        text, self._pending = self._pending, ""
        with contextlib.suppress(OSError):  # a full disk: what training itself must write says so
            self._log.write(text)
            self._log.flush()
        if self._stream is None or not takes(self._stream):
            return
        try:
            self._stream.write(text)
            self._stream.flush()
        except OSError:
            discard(self._stream)
            self._stream = None


def same_file(one: TextIO, other: TextIO) -> bool:
    """Whether two streams write to the same file."""
    try:
        return os.path.sameopenfile(one.fileno(), other.fileno())
    except io.UnsupportedOperation:  # no file at all
        return False


def takes(stream: TextIO) -> bool:
    """Whether a line can be written without waiting: a stopped terminal and a reader that is behind take none."""
    try:
        poll = select.poll()
        poll.register(stream.fileno(), select.POLLOUT)
    except io.UnsupportedOperation:
        return True
    return bool(poll.poll(0))


def discard(stream: TextIO) -> None:
    """Let what is written to `stream` from now on vanish, also what the interpreter flushes as it ends."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, stream.fileno())
    os.close(null)


@contextlib.contextmanager
def unattended(log: Path = Path(os.devnull)) -> Iterator[None]:
    """While the block runs, the terminal may close (SIGHUP) or stop reading; what is printed also goes to `log`."""
    hangup = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with (
            log.open("a") as file,
            contextlib.redirect_stdout(Console(sys.stdout, file)),
            contextlib.redirect_stderr(Console(sys.stderr, file)),
        ):
            yield
    finally:
        signal.signal(signal.SIGHUP, hangup)
