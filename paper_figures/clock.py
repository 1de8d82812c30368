"""The same learning curves by wall-clock: a method that learns more from a step may need more time for it.

Only where the clocks of all runs drawn are there, which committed rows have not. A run's clock is the sum of its
timing.csv's seconds, on the machine that trained it and beside whatever else ran there.
"""

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd

from analysis.runs import Results

UNITS = {"hours of training": 1.0, "minutes of training": 1 / 60}  # of the axis, where two of them were trained
SHORTEST = ("seconds of training", 1 / 3600)
CAPTION = (
    "clock.png: the same curves by wall-clock, each run's own hours (physics, policy and updates) on the machine that "
    "trained it, where other runs may have shared the processor."
)


def by_clock(results: Results, runs_dir: Path) -> Results | None:
    """`results` with hours of training in place of environment steps; None unless every run has all of its clocks."""
    frame = results.frame[results.frame["metric"] == "return_mean"]
    parts = []
    for run_id, rows in frame.groupby("run_id"):
        hours = clocks(runs_dir / str(run_id) / "timing.csv")
        if len(hours) != len(rows):
            return None
        parts.append(rows.sort_values("env_steps").assign(env_steps=hours))
    if not parts:
        return None
    clocked = pd.concat(parts, ignore_index=True)
    longest = clocked.groupby(["env", "variant"])["env_steps"].max().to_dict()
    runs = [run | {"env_steps": longest.get((run["env"], run["variant"]), 0.0)} for run in results.plan["runs"]]
    return dataclasses.replace(results, plan=results.plan | {"runs": runs, "by_clock": True}, frame=clocked)


def clocks(path: Path) -> np.ndarray:
    """Hours of training after each iteration (T,), none where the file is not there or is damaged."""
    try:
        return pd.read_csv(path, usecols=["seconds"])["seconds"].to_numpy(float).cumsum() / 3600
    except (OSError, ValueError, TypeError):
        return np.array([])
