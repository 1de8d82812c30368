"""What every command line here shares: exit codes, one-line errors and how times are written."""

import argparse
import sys
from typing import Any

EXIT_FAILED, EXIT_BAD_INPUT, EXIT_DIVERGED, EXIT_NOT_AGREED = 1, 2, 3, 4
EXIT_REQUEUE = 75  # sysexits' EX_TEMPFAIL


class Parser(argparse.ArgumentParser):
    """Reports bad arguments in one line, as every other bad input."""

    def error(self, message: str) -> Any:
        """Print the one line and exit."""
        print(f"error: {message}", file=sys.stderr)
        sys.exit(EXIT_BAD_INPUT)


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
