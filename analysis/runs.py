"""Runs to one tidy frame: a row per (run, environment step, metric), from run folders and from committed results.

What belongs to a figure stands in its plan, `<runs_dir>/plans/<scale>/<figure>.json`, which experiments.sweep writes.
"""

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

COLUMNS = ["figure", "scale", "env", "variant", "seed", "run_id", "env_steps", "metric", "value"]


class MissingData(RuntimeError):
    """There is nothing to analyse; the message says what to do."""


@dataclass
class Results:
    """The runs of one figure."""

    plan: dict[str, Any]
    frame: pd.DataFrame  # COLUMNS
    missing: list[dict[str, Any]]  # planned runs without a single row, or cut short, as they stand in the plan


def load(
    figure: str, scale: str, runs_dir: Path, data_dir: Path, metrics: Sequence[str] | None = ("return_mean",)
) -> Results:
    """Read every run of a figure; rows of a run folder win over committed rows of the same run.

    Args:
        metrics: columns of progress.csv to read, None for all.

    Raises:
        MissingData: no plan, or not one row.
        ValueError: rows of two kinds of physics for one environment, which must not be drawn together.
    """
    path = runs_dir / "plans" / scale / f"{figure}.json"
    if not path.exists():
        raise MissingData(f"{figure}: no plan at scale {scale} in {runs_dir}; run `make {figure} SCALE={scale}`")
    plan = json.loads(path.read_text())
    committed = read_committed(data_dir / scale / f"{figure}.csv")
    parts, missing = [], []
    for run in plan["runs"]:
        rows = read_progress(runs_dir / run["run_id"] / "progress.csv", metrics)
        if rows.empty:
            rows = committed.loc[committed["run_id"] == run["run_id"], ["env_steps", "metric", "value"]]
        expected = run["iterations"] if run["kind"] == "train" else 1
        if rows.empty or rows.groupby("metric").size().min() < expected:
            missing.append(run)
        if not rows.empty:  # an empty part would turn numbers into objects
            labels = {key: run[key] for key in ("env", "variant", "seed", "run_id")}
            parts.append(rows.assign(figure=figure, scale=scale, **labels))
    frame = pd.concat(parts, ignore_index=True)[COLUMNS] if parts else pd.DataFrame(columns=COLUMNS)
    if frame.empty:
        raise MissingData(f"{figure}: none of its {len(plan['runs'])} runs at scale {scale} has a result yet")
    physics = pd.DataFrame(plan["runs"]).groupby("env")["physics"].nunique()
    if (physics > 1).any():
        raise ValueError(f"{figure}: {physics.idxmax()} mixes two kinds of physics")
    return Results(plan, frame, missing)


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


def read_committed(path: Path) -> pd.DataFrame:
    """Committed rows of a figure, empty where there are none."""
    if not path.exists():
        return pd.DataFrame(columns=COLUMNS)
    return pd.read_csv(path, dtype={"run_id": str})


def scores(
    frame: pd.DataFrame, env: str, variant: str, metric: str = "return_mean"
) -> tuple[list[Any], list[Any], pd.DataFrame]:
    """One curve bundle: its seeds, its environment steps and a (steps x seeds) table, NaN where a run stopped."""
    chosen = frame[(frame["env"] == env) & (frame["variant"] == variant) & (frame["metric"] == metric)]
    table = chosen.pivot_table(index="env_steps", columns="seed", values="value", dropna=False).sort_index()
    return list(table.columns), list(table.index), table
