"""The runs behind a figure or table: `python -m analysis.explain paper_figures/out/laptop/fig3.pdf`."""

import argparse
import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

STATED = re.compile(rb"(\d+) runs, set [0-9a-f]{12}: ((?:[0-9a-f]{12} ?)+)")


def run_ids(path: Path) -> list[str]:
    """Ids that a PDF's, SVG's or PNG's metadata, a LaTeX table's first line or a csv's run_id column states.

    Raises:
        ValueError: the file does not exist, or states no run.
    """
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    if path.suffix == ".csv":
        header, *rows = path.read_text().splitlines()
        names = header.split(",")
        ids = sorted({row.split(",")[names.index("run_id")] for row in rows}) if "run_id" in names else []
    else:
        found = STATED.search(path.read_bytes())
        ids = found[2].decode().split() if found else []
        if found:
            ids = ids[: int(found[1])]  # whatever bytes follow in the file are no run
    if not ids:
        raise ValueError(f"{path}: states no runs; figures as .pdf, .svg or .png, tables as .tex, both as .csv do")
    return ids


def describe(ids: Sequence[str], runs_dir: Path) -> list[str]:
    """A line per run: what it is, from the plans, and the commit it was trained at, where its folder is here."""
    planned: dict[str, tuple[str, dict[str, Any]]] = {}
    for path in sorted((runs_dir / "plans").glob("*/*.json")):
        plan = json.loads(path.read_text())
        planned |= {run["run_id"]: (plan["scale"], run) for run in plan["runs"]}
    lines = []
    for run_id in ids:
        words = [run_id]
        if run_id in planned:
            scale, run = planned[run_id]
            words += [scale, run["env"], run["variant"], f"seed {run['seed']}", run["state"]]
        manifest = runs_dir / run_id / "manifest.json"
        if manifest.exists():
            words.append(f"commit {json.loads(manifest.read_text())['git_commit']}")
        else:
            words.append("no run folder here")
        lines.append("  ".join(words))
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the runs."""
    parser = argparse.ArgumentParser(prog="analysis.explain", description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("--runs-dir", type=Path, default=Path("runs"))
    options = parser.parse_args(arguments)
    try:
        ids = run_ids(options.file)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{options.file}: {len(ids)} runs")
    print("\n".join(describe(ids, options.runs_dir)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
