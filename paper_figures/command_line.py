"""The command line that every figure and table shares."""

import argparse
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).parent


def parse(artefact: str, arguments: Sequence[str] | None) -> argparse.Namespace:
    """scale, runs_dir, data and out of one figure or table."""
    parser = argparse.ArgumentParser(prog=f"paper_figures.{artefact}", description=f"Make {artefact}.")
    parser.add_argument("--scale", default="smoke", help="smoke, laptop or paper")
    parser.add_argument("--runs-dir", type=Path, default=Path("runs"))
    parser.add_argument("--data", type=Path, default=HERE / "data", help="committed results")
    parser.add_argument("--out", type=Path, default=HERE / "out")
    return parser.parse_args(arguments)
