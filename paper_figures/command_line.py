"""The command line that every figure and table shares."""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from analysis.command_line import bad_input, parser
from analysis.runs import MissingData, NotAtThisScale, Results, load

HERE = Path(__file__).parent
SMOOTH = 0.05  # share of a method's iterations that the moving mean of a learning curve takes
NOTHING_YET = 3  # exit code


def parse(artefact: str, arguments: Sequence[str] | None) -> argparse.Namespace:
    """scale, protocol, set, runs_dir, data, out and smooth of one figure or table."""
    made = parser(f"paper_figures.{artefact}", f"Make {artefact}.")
    made.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="what was overridden in every run"
    )
    made.add_argument("--smooth", type=share, default=SMOOTH, help="learning curves: moving mean over this share")
    return made.parse_args(arguments)


def share(text: str) -> float:
    """A number from 0, which smooths nothing, to below 1."""
    value = float(text)
    if not 0 <= value < 1:
        raise argparse.ArgumentTypeError(f"{text} is no share; valid: 0 (no smoothing) to below 1")
    return value


def make(
    artefact: str,
    arguments: Sequence[str] | None,
    metrics: Sequence[str] | None,
    write: Callable[[Results, argparse.Namespace], str],
) -> int:
    """Load the results of a figure or table and `write` it, which returns what to print; the exit code.

    Args:
        metrics: columns of progress.csv to read, None for all.
    """
    options = parse(artefact, arguments)
    try:
        results = load(artefact, options.scale, options.runs_dir, options.data, metrics, options.protocol, options.set)
    except NotAtThisScale as nothing:
        print(nothing)
        return 0
    except MissingData as missing:
        print(f"not drawn: {missing}", file=sys.stderr)
        return NOTHING_YET
    except ValueError as error:
        return bad_input(error)
    for what in results.missing_lines():
        print(f"{artefact}: missing or incomplete: {what}")
    print(write(results, options))
    return 0
