"""The runs behind a figure or table, or what one run is.

python -m analysis.explain paper_figures/out/laptop/fig3.pdf
python -m analysis.explain runs/<run_id>
"""

import argparse
import csv
import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from analysis.edition import Edition
from analysis.runs import code_of, read_plan, stretches
from hippo.core.files import printable, read_json

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


def plans(runs_dir: Path) -> list[dict[str, Any]]:
    """Every plan that was written in `runs_dir`."""
    return [read_plan(path) for path in sorted((runs_dir / "plans").rglob("*.json"))]


def describe_run(folder: Path) -> list[str]:
    """What the run in `folder` is, how it is doing, the code it comes from and the figures that show it.

    Raises:
        ValueError: it is no run's folder.
    """
    try:
        manifest = json.loads((folder / "manifest.json").read_text())
        identity, run = manifest["identity"], yaml.safe_load(manifest["config"])
        parts = (f"{run['kind']} {identity['env']} {identity['algo']}", f"seed {identity['seed']}")
        size = f"{identity['iterations']} iterations of {identity['batch_size']} steps"
    except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError) as error:
        raise ValueError(f"{folder}: is no run folder: it has no readable manifest.json") from error
    changed = identity["settings"] | identity["options"]
    lines = [
        "  ".join(
            [manifest["run_id"], *parts, f"scale {run['scale']}", f"protocol {run.get('protocol', 'paper')}", size]
        ),
        f"settings: {'  '.join(f'{key}={value}' for key, value in changed.items()) or 'all at their default'}",
    ]
    if manifest.get("parent"):
        lines.append(f"needs: {folder.parent / manifest['parent']}")
    if (folder / "status.json").exists():
        status = read_json(folder / "status.json", {"state": str, "iteration": int, "message": str})
        lines.append(f"{status['state']} at iteration {status['iteration'] + 1}  {status['message']}".rstrip())
    if (folder / "progress.csv").exists():
        rows = list(csv.DictReader((folder / "progress.csv").read_text().splitlines()))
        if rows and "return_mean" in rows[-1]:
            lines.append(f"return of the last iteration: {float(rows[-1]['return_mean']):.3f}")
    lines += [stretch_line(each) for each in stretches(manifest)]
    shown = [
        f"{plan['figure']} at {Edition.planned(plan)} as {of['variant']}"
        for plan in plans(folder.parent)
        for of in plan["runs"]
        if of["run_id"] == manifest["run_id"]
    ]
    lines.append(f"in {', '.join(shown)}" if shown else f"in no plan of {folder.parent}")
    return lines


def stretch_line(stretch: dict[str, Any]) -> str:
    """The code, the versions and the machine of one stretch of a run, as far as they are stated."""
    versions = stretch.get("versions")
    words = [f"Python {stretch['python']}"] if "python" in stretch else []
    words += [f"{name} {version}" for name, version in versions.items()] if isinstance(versions, dict) else []
    words += [str(stretch["cpu"])] if "cpu" in stretch else []
    start = f"from iteration {stretch['from_iteration']}: " if stretch.get("from_iteration") else ""
    return ", ".join([f"{start}commit {code_of(stretch)}", *words])


def describe(ids: Sequence[str], runs_dir: Path) -> list[str]:
    """A line per run: what it is, from the plans, and the commit it was trained at, where its folder is here."""
    planned: dict[str, tuple[str, dict[str, Any]]] = {}
    for plan in plans(runs_dir):
        what = ", ".join([plan["scale"], *Edition.planned(plan).marks])
        planned |= {run["run_id"]: (what, run) for run in plan["runs"]}
    lines = []
    for run_id in ids:
        words = [run_id]
        if run_id in planned:
            scale, run = planned[run_id]
            words += [scale, run["env"], run["variant"], f"seed {run['seed']}", run["state"]]
        manifest = runs_dir / run_id / "manifest.json"
        if manifest.exists():
            words.append(f"commit {', then '.join(map(code_of, stretches(read_json(manifest, {}))))}")
        else:
            words.append("no run folder here")
        lines.append("  ".join(words))
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the runs."""
    parser = argparse.ArgumentParser(prog="analysis.explain", description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, help="a figure, a table or their csv; or a run folder")
    parser.add_argument("--runs-dir", type=Path, default=Path("runs"))
    options = parser.parse_args(arguments)
    try:
        if options.file.is_dir():
            lines = describe_run(options.file)
        else:
            ids = run_ids(options.file)
            lines = [f"{options.file}: {len(ids)} runs", *describe(ids, options.runs_dir)]
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(*map(printable, lines), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
