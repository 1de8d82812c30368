"""What every command line here shares: exit codes, one-line errors and how times are written."""

import argparse
import errno
import signal
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from experiments.console import discard
from hippo.core.settings import ConfigError

EXIT_FAILED, EXIT_BAD_INPUT, EXIT_DIVERGED, EXIT_NOT_AGREED = 1, 2, 3, 4
EXIT_REQUEUE = 75  # sysexits' EX_TEMPFAIL


class Parser(argparse.ArgumentParser):
    """Reports bad arguments in one line, as every other bad input."""

    def error(self, message: str) -> Any:
        """Print the one line and exit."""
        print(f"error: {message}", file=sys.stderr)
        sys.exit(EXIT_BAD_INPUT)


def run_command(main: Callable[[], int | None]) -> NoReturn:
    """Exit with the code of `main`: quietly, too, where nobody reads what it prints (`| head -1`), and at Ctrl-C."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:  # experiments/__init__.py; "ignored" stays as it is
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        try:
            code: Any = main()
        except SystemExit as end:
            code = end.code
        if sys.stdout is not None:  # closed by the caller
            sys.stdout.flush()
    except BrokenPipeError:
        discard(sys.stdout)
        code = 128 + signal.SIGPIPE
    except KeyboardInterrupt:
        code = 128 + signal.SIGINT
    sys.exit(code)


def check_writable(key: str, path: Path) -> None:
    """Raise ConfigError unless a file can be written at `path`, before any work is done for it."""
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, "is a folder")
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise ConfigError(key, path, f"must be a file that can be written ({error.strerror})") from None


def bad_input(error: Exception) -> int:
    """One line about what was wrong with the input; the exit code that says so."""
    print(f"error: {error}", file=sys.stderr)
    return EXIT_BAD_INPUT


def clock(seconds: float) -> str:
    """Seconds as h:mm:ss."""
    whole = round(seconds)
    return f"{whole // 3600}:{whole % 3600 // 60:02d}:{whole % 60:02d}"


def duration(seconds: float) -> str:
    """Seconds in the unit that reads best."""
    return f"{seconds / 60:.1f} minutes" if seconds < 3600 else f"{seconds / 3600:,.1f} hours"
