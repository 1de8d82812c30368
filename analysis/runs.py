"""Runs to one tidy frame: a row per (run, environment step, metric), from run folders and from committed results.

What belongs to a figure stands in its plan, `<runs_dir>/plans/<scale>/<figure>.json`, which experiments.sweep writes;
edition.py says where those of another protocol, and of figures with overrides, lie.
"""

import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from analysis.edition import PAPER, Edition

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
    commits: list[str] = field(default_factory=list)  # at which the runs whose folders are here were trained

    @property
    def edition(self) -> Edition:
        """Its scale, protocol and overrides."""
        return Edition.planned(self.plan)

    def stem(self, out: Path) -> Path:
        """Where under `out` its files go, without a suffix."""
        return out / self.edition.folder / self.plan["figure"]

    def provenance(self) -> str:
        """The runs behind the data and the commits they were trained at, as one line."""
        ids = sorted(set(self.frame["run_id"]))
        digest = hashlib.sha256(" ".join(ids).encode()).hexdigest()[:12]
        commits = " ".join(commit[:10] or "unknown" for commit in self.commits) or "those of the committed results"
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
    plan = json.loads(path.read_text())
    check_edition(path, plan, edition)
    if not plan["runs"]:
        raise NotAtThisScale(f"{figure}: not trained at {edition}, only at {', '.join(plan['scales'])}")
    physics = pd.DataFrame(plan["runs"]).groupby("env")["physics"].nunique()
    if (physics > 1).any():
        raise ValueError(f"{figure}: {physics.idxmax()} mixes two kinds of physics")
    committed = read_committed(data_dir / edition.folder / f"{name}.csv", scale)
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
        command = train if edition.overrides else f"make {figure} {edition.variables}"
        raise MissingData(
            f"{figure}: none of its {len(plan['runs'])} runs at {edition} has a result yet; `{command}` trains them"
        )
    return Results(plan, frame, missing, read_commits(runs_dir, sorted(set(frame["run_id"]))))


def check_edition(path: Path, plan: dict[str, Any], edition: Edition) -> None:
    """Raise ValueError if the plan that was read from `path` says that it is of another edition."""
    if (other := Edition.planned(plan)) != edition:
        raise ValueError(f"{path}: is a plan of {other}, not of {edition}")


def read_commits(runs_dir: Path, ids: Sequence[str]) -> list[str]:
    """The commits that the manifests of runs state, each once; runs without a folder here state none."""
    manifests = [runs_dir / run_id / "manifest.json" for run_id in ids]
    return sorted({json.loads(path.read_text())["git_commit"] or "" for path in manifests if path.exists()})


def read_progress(path: Path, metrics: Sequence[str] | None) -> pd.DataFrame:
    """env_steps, metric, value of one run's progress.csv; a last line torn by a kill is left out."""
    if not path.exists():
        return pd.DataFrame(columns=["env_steps", "metric", "value"])
    text = path.read_text()
    whole = text[: text.rfind("\n") + 1]
    if not whole:
        return pd.DataFrame(columns=["env_steps", "metric", "value"])
    table = pd.read_csv(io.StringIO(whole))
    columns = [c for c in table.columns if c not in ("iteration", "env_steps") and (metrics is None or c in metrics)]
    return table.melt(id_vars="env_steps", value_vars=columns, var_name="metric")


def read_episodes(path: Path) -> pd.DataFrame:
    """env_steps (here the episode's number), metric "return:<perturbation>:<strength>", value of one evaluation."""
    if not path.exists():
        return pd.DataFrame(columns=["env_steps", "metric", "value"])
    table = pd.read_csv(path, keep_default_na=False)
    metric = "return:" + table["perturbation"] + ":" + table["strength"]
    return pd.DataFrame({"env_steps": table["episode"], "metric": metric, "value": table["return"]})


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
    table = chosen.pivot_table(index="env_steps", columns="seed", values="value", dropna=False).sort_index()
    return list(table.columns), list(table.index), table
