"""Learning curves of Stable-Baselines3's PPO on the Block tasks, to stand beside ours: kept rows, seed by seed.

    python -m experiments.peer_curves --seeds 10    trains what is missing, 1 M environment steps each (5 minutes)

It is the learner of `make bench ONLY=learning`: 8 environments x 1024 steps, VecNormalize, otherwise its defaults. Its
runs are not resumable within a seed, and no run of ours depends on them.
"""

import argparse
import contextlib
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from experiments.bench_learning import BUDGET, GOALS, Point, stable_baselines
from experiments.command_line import Parser, bad_input, run_command
from experiments.commit import as_csv
from experiments.config import COMMITTED
from experiments.status import write_atomically
from hippo.core.settings import ConfigError

ROWS = COMMITTED / "studies" / "stable_baselines3.csv"
COLUMNS = ["env", "seed", "env_steps", "seconds", "return_mean"]


class _Enough(Exception):
    """Ends a training that has no end of its own."""


def curve(env: str, seed: int, budget: int) -> pd.DataFrame:
    """Train for `budget` environment steps; a row per iteration."""
    points: list[Point] = []

    def report(point: Point) -> None:
        points.append(point)
        if point.steps >= budget:
            raise _Enough

    with contextlib.suppress(_Enough):
        stable_baselines(env, seed, report)
    rows = [[env, seed, p.steps, round(p.seconds, 3), p.walls] for p in points]
    return pd.DataFrame(rows, columns=COLUMNS)


def read(path: Path) -> pd.DataFrame:
    """The kept rows, none where there is no file."""
    return pd.read_csv(path) if path.exists() else pd.DataFrame(columns=COLUMNS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Train the seeds that are missing, seed by seed in both tasks."""
    parser = Parser(prog="experiments.peer_curves", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, help="0, 1, ... below this number")
    parser.add_argument("--budget", type=int, default=BUDGET, help="environment steps per seed")
    parser.add_argument("--rows", type=Path, default=ROWS)
    options = parser.parse_args(arguments)
    for key in ("seeds", "budget"):
        if getattr(options, key) < 1:
            return bad_input(ConfigError(key, getattr(options, key), "must be at least 1"))
    for seed in range(options.seeds):
        for env in GOALS:
            kept = read(options.rows)
            if ((kept["env"] == env) & (kept["seed"] == seed)).any():
                continue
            new = curve(env, seed, options.budget)
            options.rows.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(options.rows, as_csv(pd.concat([kept, new]) if len(kept) else new))
            print(
                f"{env} seed {seed}: {new['return_mean'].iloc[-1]:.2f} in {new['seconds'].iloc[-1]:.0f} s", flush=True
            )
    return 0


if __name__ == "__main__":
    run_command(main)
