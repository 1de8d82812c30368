"""The command line of everything that reads the results of one scale and protocol, here and in paper_figures."""

import argparse
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
SCALES, PROTOCOLS = ("smoke", "laptop", "paper"), ("paper", "modern")
BAD_INPUT = 2  # exit code


def parser(prog: str, description: str) -> argparse.ArgumentParser:
    """A parser of scale, protocol, runs_dir, data and out; one that does not exist is refused here, for everything."""
    made = argparse.ArgumentParser(prog, f"%(prog)s [--scale {{{','.join(SCALES)}}}] [option ...]", description)
    made.add_argument("--scale", default="smoke", choices=SCALES)
    made.add_argument("--protocol", default=PROTOCOLS[0], choices=PROTOCOLS)
    made.add_argument("--runs-dir", type=Path, default=Path("runs"))
    made.add_argument("--data", type=Path, default=ROOT / "paper_figures" / "data", help="committed results")
    made.add_argument("--out", type=Path, default=ROOT / "paper_figures" / "out")
    return made


def bad_input(error: Exception) -> int:
    """Say on stderr what was refused; the exit code."""
    print(f"error: {error}", file=sys.stderr)
    return BAD_INPUT
