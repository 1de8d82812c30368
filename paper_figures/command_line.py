"""The command line that every figure and table shares."""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from analysis.runs import MissingData, NotAtThisScale, Results, load

HERE = Path(__file__).parent
SMOOTH = 0.05  # share of a method's iterations that the moving mean of a learning curve takes
BAD_INPUT, NOTHING_YET = 2, 3  # exit codes


def parse(artefact: str, arguments: Sequence[str] | None) -> argparse.Namespace:
    """scale, runs_dir, data, out and smooth of one figure or table."""
    parser = argparse.ArgumentParser(prog=f"paper_figures.{artefact}", description=f"Make {artefact}.")
    parser.add_argument("--scale", default="smoke", help="smoke, laptop or paper")
    parser.add_argument("--runs-dir", type=Path, default=Path("runs"))
    parser.add_argument("--data", type=Path, default=HERE / "data", help="committed results")
    parser.add_argument("--out", type=Path, default=HERE / "out")
    parser.add_argument("--smooth", type=share, default=SMOOTH, help="learning curves: moving mean over this share")
    return parser.parse_args(arguments)


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
        results = load(artefact, options.scale, options.runs_dir, options.data, metrics)
    except NotAtThisScale as nothing:
        print(nothing)
        return 0
    except MissingData as missing:
        print(f"not drawn: {missing}", file=sys.stderr)
        return NOTHING_YET
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_INPUT
    for what in results.missing_lines():
        print(f"{artefact}: missing or incomplete: {what}")
    print(write(results, options))
    return 0
