"""Stable-Baselines3's PPO to stand beside ours: its learning curves on the Block tasks or any gym:<id>, seed by seed.

    python -m experiments.artefacts.peer_curves --seeds 10   trains what is missing, 1 M steps each (5 minutes)
    python -m experiments.artefacts.peer_curves --seeds 3 --env gym:Hopper-v5 --env gym:HalfCheetah-v5

It is the learner of `make bench ONLY=learning`: 8 environments x 1024 steps, VecNormalize, otherwise its defaults. Its
runs are not resumable within a seed, and no run of ours depends on them. On the Block tasks a row of
docs/environments/calibration.md is printed of every policy, 100 fresh episodes.
"""

import argparse
import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.artefacts.calibration import Policy, measure, trained_line
from experiments.bench.learning import BUDGET, GOALS, Point, peer, train_peer
from experiments.command_line import Parser, bad_input, run_command
from experiments.commit import as_csv
from experiments.peer_rows import COLUMNS, LABEL, ROWS, read
from experiments.status import write_atomically
from hippo.core.settings import ConfigError
from hippo.envs.registration import environment

EPISODES = 100


class _Enough(Exception):
    """Ends a training that has no end of its own."""


def train(learner: Any, env: str, seed: int, budget: int) -> pd.DataFrame:
    """Train for `budget` environment steps; a row of COLUMNS per iteration."""
    points: list[Point] = []

    def report(point: Point) -> None:
        points.append(point)
        if point.steps >= budget:
            raise _Enough

    with contextlib.suppress(_Enough):
        train_peer(learner, report)
    rows = [[env, seed, p.steps, round(p.seconds, 3), p.walls] for p in points]
    return pd.DataFrame(rows, columns=COLUMNS)


def sampled(learner: Any) -> Policy:
    """The policy at work, with the statistics of its training."""
    learner.set_random_seed(0)
    return lambda step, obs: learner.predict(learner.env.normalize_obs(obs))[0]


def calibrated(learner: Any, env: str, seed: int) -> str:
    """Its row of the calibration table: fresh episodes, and the same with walls blanked."""
    rows, seen = measure(env, lambda *_: sampled(learner), EPISODES, 0)
    blanked, _ = measure(env, lambda *_: sampled(learner), EPISODES, 0, walls_as=seen)
    return trained_line(env, f"{LABEL}, seed {seed}", rows, blanked)


def main(arguments: Sequence[str] | None = None) -> int:
    """Train the seeds that are missing, seed by seed in every task."""
    parser = Parser(
        prog="experiments.artefacts.peer_curves", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=10, help="0, 1, ... below this number")
    parser.add_argument("--env", action="append", help="a task; again for another (the Block tasks)")
    parser.add_argument("--budget", type=int, default=BUDGET, help="environment steps per seed")
    parser.add_argument("--rows", type=Path, default=ROWS)
    options = parser.parse_args(arguments)
    try:
        for key in ("seeds", "budget"):
            if getattr(options, key) < 1:
                raise ConfigError(key, getattr(options, key), "must be at least 1")
        tasks = options.env or list(GOALS)
        for env in tasks:
            environment(env)
    except ValueError as error:
        return bad_input(error)
    for seed in range(options.seeds):
        for env in tasks:
            kept = read(options.rows)
            if ((kept["env"] == env) & (kept["seed"] == seed)).any():
                continue
            learner = peer(env, seed)
            new = train(learner, env, seed, options.budget)
            options.rows.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(options.rows, as_csv(pd.concat([kept, new]) if len(kept) else new))
            last, seconds = np.nanmean(new["return_mean"].tail(len(new) // 10 or 1)), new["seconds"].iloc[-1]
            print(f"{env} seed {seed}: {last:.2f} over the last tenth, {seconds:.0f} s", flush=True)
            if env in GOALS:
                print(calibrated(learner, env, seed), flush=True)
    return 0


if __name__ == "__main__":
    run_command(main)
