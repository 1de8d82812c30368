"""Table 3: every setting of every algorithm - the paper's value, the authors' code's and ours, from the ledger."""

import csv
import sys
from collections.abc import Sequence
from pathlib import Path

from analysis.edition import chosen
from paper_figures import command_line, tabular

LEDGER = Path(__file__).parent.parent / "docs" / "hyperparameters.csv"
NOTE = (
    "From docs/hyperparameters.csv, which is generated from the settings in the code. An empty default is the scale's."
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write table3.csv, .md and .tex; the same at every scale."""
    options = command_line.parse("table3", arguments)
    with LEDGER.open() as file:
        table = [{key: row[key] for key in row if key != "meaning"} for row in csv.DictReader(file)]
    stem = options.out / chosen(options).folder / "table3"
    tabular.write(stem, "Hyper-parameters", NOTE, table, "from docs/hyperparameters.csv; no runs")
    stem.with_suffix(".csv").write_text(LEDGER.read_text())
    print(f"{len(table)} settings; wrote {stem}.csv {stem}.md {stem}.tex")
    return 0


if __name__ == "__main__":
    sys.exit(main())
