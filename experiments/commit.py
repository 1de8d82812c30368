"""Take finished runs over into the committed results: `python -m experiments.commit fig3 --scale laptop`.

Rows already committed stay as they are, new ones are added; the same command again changes nothing. Beside
`<figure>.csv`, `<figure>.runs.csv` says where every run comes from: commit, lock file, processor.

Learning curves are thinned to at most 250 rows per run: of k iterations in a row the mean return, at the last one's
environment steps, with the smallest k that is enough (and that divides MLSH's cycle). Means over the last 10 % and over
all iterations stay what they were, but for the one group that k cuts.
"""

import io
import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from analysis.command_line import parser
from analysis.edition import chosen
from analysis.runs import COLUMNS, MissingData, Results, load, read_committed
from experiments.command_line import bad_input, run_command
from experiments.manifest import SCHEMA, earlier_of
from experiments.plan import make_plan
from experiments.status import write_atomically
from hippo.core.files import read_json
from hippo.core.settings import ConfigError

MOST_ROWS = 250
ORIGIN = ("git_commit", "git_difference", "lock", "cpu", "cpu_capability")  # of a manifest
RUN_COLUMNS = ["run_id", *ORIGIN]


def thinned(rows: pd.DataFrame, cycle: int = 1) -> pd.DataFrame:
    """Rows of one run and metric, in order -> at most MOST_ROWS of them, and whole ones per `cycle` iterations."""
    size = -(-len(rows) // MOST_ROWS)
    if size <= cycle:
        size = next(k for k in range(size, cycle + 1) if cycle % k == 0)
    group = pd.Series(range(len(rows)), index=rows.index) // size
    others = {column: "last" for column in rows.columns if column != "value"}
    return rows.groupby(group).agg(others | {"value": "mean"})


def origin(folder: Path) -> dict[str, str]:
    """Where a run comes from, by its manifest; of one that went on under other conditions, all of them in turn."""
    manifest = read_json(folder / "manifest.json", SCHEMA)
    stretches = [*earlier_of(manifest), manifest]
    values = {key: [str(stretch.get(key) or "") for stretch in stretches] for key in ORIGIN}
    return {"run_id": folder.name} | {key: " then ".join(dict.fromkeys(of)) for key, of in values.items()}


def as_csv(table: pd.DataFrame) -> str:
    """The bytes of a committed file: sixteen digits give every double back."""
    text = io.StringIO()
    table.to_csv(text, index=False, lineterminator="\n")
    return text.getvalue()


def commit(results: Results, runs_dir: Path, data: Path) -> tuple[int, int]:
    """Write both files of a figure; returns how many runs they hold and how many of these are new."""
    figure, scale = results.plan["figure"], results.plan["scale"]
    path = data / results.edition.folder / f"{figure}.csv"
    origins = path.with_suffix(".runs.csv")
    old = read_committed(path, scale)
    known = pd.read_csv(origins, dtype=str) if origins.exists() else pd.DataFrame(columns=RUN_COLUMNS)
    cycles = {run["run_id"]: run.get("cycle", 1) for run in results.plan["runs"]}
    kinds = {run["run_id"]: run["kind"] for run in results.plan["runs"] if run["state"] == "finished"}
    incomplete = {run["run_id"] for run in results.missing}
    new = results.frame[results.frame["run_id"].isin(set(kinds) - incomplete - set(old["run_id"]))]
    parts = [old] if len(old) else []
    for run_id, of_run in new.groupby("run_id", sort=False):
        if kinds[str(run_id)] == "train":
            of_run = thinned(of_run[of_run["metric"] == "return_mean"], cycles[str(run_id)])
        parts.append(of_run)
    fresh = list(dict.fromkeys(new["run_id"]))
    if fresh:
        path.parent.mkdir(parents=True, exist_ok=True)
        table_of_origins = pd.concat([known, pd.DataFrame([origin(runs_dir / run_id) for run_id in fresh])])
        write_atomically(origins, as_csv(table_of_origins[RUN_COLUMNS]))
        write_atomically(path, as_csv(pd.concat(parts, ignore_index=True)[COLUMNS]))
    return old["run_id"].nunique() + len(fresh), len(fresh)


def main(arguments: Sequence[str] | None = None) -> int:
    """Commit one figure."""
    options_parser = parser("experiments.commit", __doc__.splitlines()[0])
    options_parser.add_argument("figure")
    options = options_parser.parse_args(arguments)
    try:
        plan = make_plan(options.figure, options.scale, [], False, options.runs_dir, options.protocol)
        plan.write(options.runs_dir)
        results = load(options.figure, options.scale, options.runs_dir, options.data, None, options.protocol)
        total, new = commit(results, options.runs_dir, options.data)
    except ConfigError as error:
        return bad_input(error)
    except (MissingData, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{options.figure} at {chosen(options)}: {total} runs committed, {new} of them new")
    return 0


if __name__ == "__main__":
    run_command(main)
