"""Draw what is there, without training: one figure or table, or all of them in one process.

    python -m paper_figures.draw all --scale laptop

Plans say what there is to draw; `python -m experiments.sweep write all --scale laptop` writes them, and
`make draw-all SCALE=laptop` does both.
"""

import importlib
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from analysis.command_line import BAD_INPUT
from paper_figures.command_line import NOTHING_YET

SCRIPTS = (path.stem for path in Path(__file__).parent.glob("*.py") if re.fullmatch(r"(fig|table)\d+", path.stem))
ARTEFACTS = sorted(SCRIPTS, key=lambda name: (name.rstrip("0123456789"), int(re.sub(r"\D", "", name))))


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw one or `all`; of all, what has no results yet is named and no error."""
    name, *options = sys.argv[1:] if arguments is None else arguments or [""]
    if name not in (*ARTEFACTS, "all"):
        print(f"error: draw={name}: valid: all, {', '.join(ARTEFACTS)}", file=sys.stderr)
        return BAD_INPUT
    if name != "all":
        return importlib.import_module(f"paper_figures.{name}").main(options)
    codes = [importlib.import_module(f"paper_figures.{each}").main(options) for each in ARTEFACTS]
    return max(code for code in codes if code != NOTHING_YET)


if __name__ == "__main__":
    sys.exit(main())
