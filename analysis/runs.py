"""Runs to one tidy frame: a row per (run, environment step, metric), from run folders and from committed results.

What belongs to a figure stands in its plan, `<runs_dir>/plans/<scale>/<figure>.json`, which experiments.sweep writes;
edition.py says where those of another protocol, and of figures with overrides, lie.
"""

import functools
import hashlib
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from analysis.edition import FIGURE, PAPER, Edition
from hippo.core.files import DamagedFile, check_object, read_json
from hippo.core.results import damage

NAME, LABEL = re.compile(r"\w[\w.-]*"), re.compile(r"[^\x00-\x1f\x7f-\x9f]*")
COLUMN = re.compile(r"\w[\w.:/-]*")  # of progress.csv; nothing that a spreadsheet takes for a formula
# What names in a plan may be: they become names of files, cells of tables and lines on a terminal.
PATTERNS = {"run_id": re.compile(r"[0-9A-Za-z_]{1,64}"), "variant": NAME, "kind": NAME, "physics": NAME}
PATTERNS |= {"env": re.compile(rf"(gym:([\w-]+:)?([\w-]+/)?)?{NAME.pattern}")}  # gym:[package:][namespace/]name
PATTERNS |= dict.fromkeys(("env_label", "variant_label", "state"), LABEL)
PLAN: dict[str, type | tuple[type, ...]] = {"figure": str, "scale": str, "title": str, "runs": list}
PLANNED: dict[str, type | tuple[type, ...]] = {
    **dict.fromkeys(("run_id", "env", "env_label", "variant", "variant_label", "physics", "kind", "state"), str),
    **dict.fromkeys(("seed", "iterations", "batch_size"), int),
}
LATER = {"cycle": int, "env_steps": int}  # what plans written by older code do not say
COLUMNS = ["figure", "scale", "env", "variant", "seed", "run_id", "env_steps", "metric", "value"]


class MissingData(RuntimeError):
    """There is nothing to analyse; the message says what to do."""


class NotAtThisScale(MissingData):
    """There never will be anything: the figure is not trained at this scale; the message names those that have it."""


@dataclass
class Results:
    """The runs of one figure."""

    plan: dict[str, Any]
    frame: pd.DataFrame  # COLUMNS
    missing: list[dict[str, Any]]  # planned runs without a single row, or cut short, as they stand in the plan
    commits: list[str] = field(default_factory=list)  # `code_of` the runs whose folders are here

    @property
    def edition(self) -> Edition:
        """Its scale, protocol and overrides."""
        return Edition.planned(self.plan)

    def stem(self, out: Path) -> Path:
        """Where under `out` its files go, without a suffix."""
        return out / self.edition.folder / self.plan["figure"]

    def provenance(self) -> str:
        """The runs behind the data and the commits they were trained at, as one line."""
        ids = sorted(self.frame["run_id"].unique())
        digest = hashlib.sha256(" ".join(ids).encode()).hexdigest()[:12]
        commits = ", ".join(self.commits) or "those of the committed results"
        return f"{len(ids)} runs, set {digest}: {' '.join(ids)}; commits: {commits}"

    def origin(self) -> str:
        """How many rows and runs are committed results and how many were trained here, in words."""
        committed = {run["run_id"] for run in self.plan["runs"] if run["state"] == "committed"}
        of = self.frame["run_id"].isin(committed)
        parts = {"committed as results": self.frame[of], "trained here": self.frame[~of]}
        return ", ".join(
            f"{len(rows):,} rows of {rows['run_id'].nunique()} runs {where}" if len(rows) else f"nothing {where}"
            for where, rows in parts.items()
        )

    @functools.cached_property
    def seeds_with_return(self) -> dict[tuple[str, str], int]:
        """Number of seeds that have a learning curve, by environment and method."""
        rows = self.frame[self.frame["metric"] == "return_mean"]
        counts = rows.groupby(["env", "variant"])["seed"].nunique().reset_index()
        return {(env, variant): int(n) for env, variant, n in counts.itertuples(index=False)}

    def rows_per_cycle(self, env: str, variant: str, first_steps: float) -> int:
        """Rows of a learning curve in which a method starts over once, 1 for one that never does (analysis/stats.py).

        Args:
            first_steps: environment steps at the curve's first row, by which a thinned curve is told.
        """
        same = (run for run in self.plan.get("runs", []) if (run["env"], run["variant"]) == (env, variant))
        run = next((run for run in same if run.get("cycle", 1) > 1), None)
        if run is None:
            return 1
        iterations_per_row = round(first_steps * run["iterations"] / run["env_steps"])
        return max(1, run["cycle"] // max(1, iterations_per_row))

    def missing_lines(self) -> list[str]:
        """`missing` in words: a line per environment, and per seeds and state where these differ."""
        lines = []
        for env in dict.fromkeys(run["env"] for run in self.missing):
            here = [run for run in self.missing if run["env"] == env]
            states = {run["state"] for run in here}
            if len(here) == sum(run["env"] == env for run in self.plan["runs"]) and len(states) == 1:
                lines.append(f"{env}, every run ({states.pop()})")
                continue
            seeds: dict[tuple[str, str], list[str]] = {}
            for run in here:
                seeds.setdefault((run["variant"], run["state"]), []).append(str(run["seed"]))
            alike: dict[str, list[str]] = {}
            for (variant, state), which in seeds.items():
                alike.setdefault(f"seed {', '.join(which)} ({state})", []).append(variant)
            lines += [f"{env} {', '.join(variants)} {what}" for what, variants in alike.items()]
        return lines


def load(
    figure: str,
    scale: str,
    runs_dir: Path,
    data_dir: Path,
    metrics: Sequence[str] | None = ("return_mean",),
    protocol: str = PAPER,
    settings: Sequence[str] = (),
) -> Results:
    """Read every run of a figure: the rows of its folder, or the committed ones where the plan says `committed`.

    Args:
        metrics: columns of progress.csv to read, None for all.
        settings: what is overridden in every run.

    Raises:
        MissingData: no plan, or not one row. NotAtThisScale: there will never be one.
        ValueError: rows of two editions, or of two kinds of physics for one environment, which must not be drawn
            together; a plan that is no JSON; `figure` is none, or one with overrides.
    """
    edition = Edition.of(scale, protocol, settings)
    name = edition.name(figure)
    path = runs_dir / "plans" / edition.folder / f"{name}.json"
    if not path.exists():
        write = f"python -m experiments.sweep write {figure} {edition.options}"
        command = write if edition.overrides else f"make draw-{figure} {edition.variables}"
        raise MissingData(f"{figure}: no plan at {edition} in {runs_dir}; run `{command}`")
    plan = read_plan(path)
    check_edition(path, plan, edition)
    if not plan["runs"]:
        raise NotAtThisScale(f"{figure}: not trained at {edition}, only at {', '.join(plan['scales'])}")
    physics = pd.DataFrame(plan["runs"]).groupby("env")["physics"].nunique()
    if (physics > 1).any():
        raise ValueError(f"{figure}: {physics.idxmax()} mixes two kinds of physics")
    committed = read_committed(data_dir / edition.folder / f"{name}.csv", scale)
    if "committed_in" in plan:  # a sweep of one's own, some of whose runs figures may hold
        tables = [read_committed(data_dir / edition.folder / f"{other}.csv", scale) for other in plan["committed_in"]]
        whole = pd.concat([table for table in tables if len(table)] or [committed])
        committed = whole.drop_duplicates(["run_id", "env_steps", "metric"])
    if metrics is not None:
        committed = committed[committed["metric"].isin(metrics)]
    parts, missing = [], []
    for run in plan["runs"]:
        # Not "whatever is there": a run folder may be half trained, and FRESH=1 means that committed rows do not count.
        if run["state"] == "committed":
            rows = committed.loc[committed["run_id"] == run["run_id"], ["env_steps", "metric", "value"]]
        elif run["kind"] == "evaluate":
            rows = read_episodes(runs_dir / run["run_id"] / "episodes.csv")
        else:
            rows = read_progress(runs_dir / run["run_id"] / "progress.csv", metrics)
        if run["state"] != "committed" and (wrong := altered(runs_dir / run["run_id"])):
            rows, run = rows[:0], run | {"state": wrong}
        # Only whole runs are ever committed, and perhaps thinned.
        expected = run["iterations"] if run["kind"] == "train" and run["state"] != "committed" else 1
        if rows.empty or rows.groupby("metric").size().min() < expected:
            missing.append(run)
        if not rows.empty:  # an empty part would turn numbers into objects
            labels = {key: run[key] for key in ("env", "variant", "seed", "run_id")}
            parts.append(rows.assign(figure=name, scale=scale, **labels))
    frame = pd.concat(parts, ignore_index=True)[COLUMNS] if parts else pd.DataFrame(columns=COLUMNS)
    if frame.empty:
        train = f"python -m experiments.sweep run {figure} {edition.options}"
        command = train if edition.overrides or "committed_in" in plan else f"make {figure} {edition.variables}"
        raise MissingData(
            f"{figure}: none of its {len(plan['runs'])} runs at {edition} has a result yet; `{command}` trains them"
        )
    return Results(plan, frame, missing, read_commits(runs_dir, sorted(frame["run_id"].unique())))


def read_plan(path: Path) -> dict[str, Any]:
    """A plan as experiments.sweep wrote it.

    Raises:
        DamagedFile: it is none; names the file and what is wrong.
    """
    plan = read_json(path, PLAN)
    check_figure(path, plan)
    if not plan["title"].isprintable():
        raise DamagedFile(f"{path}: title must be one line of text")
    figures = plan.get("committed_in", [])
    if not isinstance(figures, list) or not all(isinstance(f, str) and FIGURE.fullmatch(f) for f in figures):
        raise DamagedFile(f"{path}: committed_in must be names of figures")
    for i, run in enumerate(plan["runs"]):
        check_object(path, run, PLANNED, f"runs[{i}]: ")
        check_object(path, run, {key: kind for key, kind in LATER.items() if key in run}, f"runs[{i}]: ")
        for key, pattern in PATTERNS.items():
            if not pattern.fullmatch(run[key]):
                raise DamagedFile(f"{path}: runs[{i}]: {key} {run[key]!r:.60} must match {pattern.pattern}")
    return plan


def check_figure(path: Path, plan: dict[str, Any]) -> None:
    """Raise DamagedFile unless a plan is of the figure that its file is named by, as the files drawn of it will be."""
    if plan["figure"] != path.stem:
        raise DamagedFile(f"{path}: figure must be {path.stem}, is {plan['figure']!r:.60}")


def altered(folder: Path) -> str:
    """How the results of a finished run differ from what it wrote, in words; "" where they do not."""
    try:
        status = read_json(folder / "status.json", {"state": str, "results": dict, "iterations": int})
    except (OSError, DamagedFile):  # never finished, or by older code
        return ""
    return damage(folder, status["iterations"], status["results"]) if status["state"] == "finished" else ""


def check_edition(path: Path, plan: dict[str, Any], edition: Edition) -> None:
    """Raise ValueError if the plan that was read from `path` says that it is of another edition."""
    if (other := Edition.planned(plan)) != edition:
        raise ValueError(f"{path}: is a plan of {other}, not of {edition}")


def read_commits(runs_dir: Path, ids: Sequence[str]) -> list[str]:
    """`code_of` every stretch of runs, each once; runs without a folder here state none."""
    manifests = [runs_dir / run_id / "manifest.json" for run_id in ids]
    return sorted({code_of(part) for path in manifests if path.exists() for part in stretches(read_json(path, {}))})


def stretches(manifest: dict[str, Any]) -> list[dict[str, Any]]:
    """What a manifest says about each stretch of a run that was interrupted, the last one last."""
    earlier = manifest.get("earlier", [{"git_commit": commit} for commit in manifest.get("earlier_commits", [])])
    return [*(each for each in earlier if isinstance(each, dict)), manifest]


def code_of(stretch: dict[str, Any]) -> str:
    """The code of a stretch in words: a commit, perhaps with changes; what is not known is never clean."""
    commit, difference = str(stretch.get("git_commit")), stretch.get("git_difference", "unknown")
    if not re.fullmatch("[0-9a-f]{6,64}", commit):
        return "unknown"
    commit = commit[:10]
    if difference is None:
        return commit
    return f"{commit} + {'perhaps ' if difference == 'unknown' else ''}changes"


def read_progress(path: Path, metrics: Sequence[str] | None) -> pd.DataFrame:
    """env_steps, metric, value of one run's progress.csv; a last line torn by a kill is left out.

    Raises:
        DamagedFile: it is no progress.csv, or has something else than numbers in a column.
    """
    nothing = pd.DataFrame(columns=["env_steps", "metric", "value"])
    if not path.exists():
        return nothing
    data = path.read_bytes()
    whole = data[: data.rfind(b"\n") + 1]
    if not whole:
        return nothing
    try:
        names = whole[: whole.find(b"\n")].decode().strip().split(",")
        columns = [c for c in names if c not in ("iteration", "env_steps") and (metrics is None or c in metrics)]
        table = pd.read_csv(io.BytesIO(whole), usecols=["env_steps", *columns])
    except (ValueError, KeyError) as error:  # pandas' parser errors are of this kind
        raise DamagedFile(f"{path}: is no progress.csv ({' '.join(str(error).split())[:100]})") from None
    if strange := [name for name in columns if not COLUMN.fullmatch(name)]:
        raise DamagedFile(f"{path}: is no progress.csv (a column {strange[0]!r:.60})")
    if words := [name for name in table if len(table) and not pd.api.types.is_numeric_dtype(table[name])]:
        raise DamagedFile(f"{path}: is no progress.csv ({', '.join(map(str, words))}: not only numbers)")
    return table.melt(id_vars="env_steps", value_vars=columns, var_name="metric")


def read_episodes(path: Path) -> pd.DataFrame:
    """env_steps (here the episode's number), metric "return:<perturbation>:<strength>", value of one evaluation."""
    if not path.exists():
        return pd.DataFrame(columns=["env_steps", "metric", "value"])
    try:
        table = pd.read_csv(path, keep_default_na=False)
        metric = "return:" + table["perturbation"] + ":" + table["strength"]
        parts = {"env_steps": table["episode"], "metric": metric, "value": table["return"].astype(float)}
    except (ValueError, KeyError, TypeError) as error:
        raise DamagedFile(f"{path}: is no episodes.csv ({' '.join(str(error).split())[:100]})") from None
    return pd.DataFrame(parts)


def read_committed(path: Path, scale: str) -> pd.DataFrame:
    """Committed rows of a figure, empty where there are none.

    Raises:
        ValueError: a row is of another scale, or of another figure, such as one with overrides.
    """
    if not path.exists():
        return pd.DataFrame(columns=COLUMNS)
    table = pd.read_csv(path, dtype={"run_id": str})
    others = set(table["scale"]) - {scale}
    if others:
        raise ValueError(f"{path}: holds rows of scale {', '.join(sorted(others))}, not only of {scale}")
    if strangers := set(table["figure"]) - {path.stem}:
        raise ValueError(f"{path}: holds rows of {', '.join(sorted(strangers))}, not only of {path.stem}")
    return table


def scores(
    frame: pd.DataFrame, env: str, variant: str, metric: str = "return_mean"
) -> tuple[list[Any], list[Any], pd.DataFrame]:
    """One curve bundle: its seeds, its environment steps and a (steps x seeds) table, NaN where a run stopped."""
    chosen = frame[(frame["env"] == env) & (frame["variant"] == variant) & (frame["metric"] == metric)]
    chosen = chosen.assign(value=chosen["value"].where(np.isfinite(chosen["value"])))
    table = chosen.pivot_table(index="env_steps", columns="seed", values="value", dropna=False).sort_index()
    return list(table.columns), list(table.index), table


def write_rows(frame: pd.DataFrame, path: Path) -> None:
    """Write the rows of a figure as `frame.to_csv` does, but in half of its time: their words need no quotes."""
    columns = [frame[name].to_numpy().tolist() for name in COLUMNS]
    columns[-1] = ["" if math.isnan(value) else value for value in columns[-1]]
    with path.open("w", newline="\n") as file:
        file.write(",".join(COLUMNS) + "\n")
        file.writelines(
            f"{a},{b},{c},{d},{e},{f},{g},{h},{i}\n" for a, b, c, d, e, f, g, h, i in zip(*columns, strict=True)
        )
