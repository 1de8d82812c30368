"""A learning race: our learners under protocol=modern against Stable-Baselines3's PPO on the same registered tasks.

Part of `make bench ONLY=learning`, never of the whole benchmark: it takes most of an hour. Each learner is a process of
its own on one core; they take an iteration in turn, and each has a clock that runs in its own turns only, so all meet
the same neighbours. Stable-Baselines3 has the settings that conf/protocol/modern.yaml takes over, and VecNormalize.
"""

import functools
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from experiments.bench.environments import registered
from experiments.bench.measure import Row, contestants, one_core
from experiments.config import compose_run
from experiments.crossings import CEILING
from experiments.train import prepare
from hippo.core.checkpoint import Checkpoint
from hippo.core.log import Row as LogRow
from hippo.core.log import RunLog
from hippo.envs import gymnasium_id
from hippo.envs.foreign import PREFIX, is_foreign
from hippo.learners import learner_of

GOALS = {"block_hopper": 5.0, "block_half_cheetah": 2.0}  # walls, whose time is taken
BUDGET, MARKS = 1_000_000, (300_000, 500_000, 1_000_000)  # environment steps
NUM_ENVS, STEPS, SEEDS = 8, 1024, 3  # of Stable-Baselines3, per iteration
OURS = {"PPO, ours": ["algo=ppo"], "HiPPO random p, ours": ["algo=hippo"]}
WINDOW = 100_000  # environment steps that a return is averaged over


@dataclass(frozen=True)
class Point:
    """Where a learner stands after an iteration."""

    steps: int  # environment steps so far
    seconds: float  # of its own turns so far
    walls: float  # undiscounted return of the episodes that ended in this iteration, on other tasks, too; NaN for none


Report = Callable[[Point], None]


def ours(overrides: Sequence[str], report: Report) -> None:
    """Train one of our learners without end."""
    run = compose_run([*overrides, "scale=laptop", "protocol=modern", "iterations=1000000"])
    clock, began = 0.0, time.perf_counter()

    def on_row(metrics: LogRow, _: LogRow) -> None:
        nonlocal clock, began
        clock += time.perf_counter() - began
        report(Point(int(metrics["env_steps"]), clock, float(metrics["return_mean_all"])))
        began = time.perf_counter()

    with tempfile.TemporaryDirectory() as folder:
        log, checkpoint = RunLog(Path(folder), on_row), Checkpoint(Path(folder))
        learner_of(run.algo).train(run.config, prepare(run), log, run.seed, checkpoint)


def peer(name: str, seed: int) -> Any:
    """Stable-Baselines3's PPO with VecNormalize on one of our tasks or on gym:<id>, untrained."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

    torch.set_num_threads(1)
    env_id = name.removeprefix(PREFIX) if is_foreign(name) else gymnasium_id(name)
    envs = VecMonitor(DummyVecEnv([functools.partial(registered, env_id)] * NUM_ENVS))
    settings: dict[str, Any] = {"n_steps": STEPS, "batch_size": 256, "gamma": 0.999}  # the others are its defaults
    return PPO("MlpPolicy", VecNormalize(envs, gamma=0.999), **settings, device="cpu", seed=seed)


def train_peer(learner: Any, report: Report) -> None:
    """Train it without end."""
    clock, steps = 0.0, 0
    while True:
        began = time.perf_counter()
        learner.learn(NUM_ENVS * STEPS, reset_num_timesteps=False)
        clock, steps = clock + time.perf_counter() - began, steps + NUM_ENVS * STEPS
        ended = [episode["r"] for episode in learner.ep_info_buffer or ()]
        report(Point(steps, clock, float(np.mean(ended)) if ended else float("nan")))
        learner.ep_info_buffer.clear()


def stable_baselines(name: str, seed: int, report: Report) -> None:
    """Train Stable-Baselines3's PPO with VecNormalize without end."""
    train_peer(peer(name, seed), report)


def race(name: str, seed: int, budget: int) -> dict[str, list[Point]]:
    """All learners for `budget` environment steps each, by name."""
    bodies = {what: (ours, [*overrides, f"env={name}", f"seed={seed}"]) for what, overrides in OURS.items()} | {
        "PPO, Stable-Baselines3": (stable_baselines, name, seed)
    }
    curves: dict[str, list[Point]] = {what: [] for what in bodies}
    with one_core(), contestants(bodies) as turns:
        while any(not curve or curve[-1].steps < budget for curve in curves.values()):
            for what, turn in turns.items():
                if not curves[what] or curves[what][-1].steps < budget:
                    curves[what].append(turn())
    return curves


def walls_at(curve: Sequence[Point], steps: int) -> float:
    """Mean return over the WINDOW environment steps up to `steps`."""
    inside = [p.walls for p in curve if steps - WINDOW < p.steps <= steps]
    return float(np.nanmean(inside))


def seconds_to(curve: Sequence[Point], goal: float) -> float:
    """Seconds until the mean over WINDOW first reaches `goal`; infinite if it never does."""
    return next((p.seconds for p in curve if p.steps >= WINDOW and walls_at(curve, p.steps) >= goal), float("inf"))


def rows(quick: bool) -> Iterator[Row | str]:
    """Returns at MARKS and the time to the goal, of every seed."""
    marks = [m // 20 for m in MARKS] if quick else list(MARKS)
    for name, goal in GOALS.items():
        header = "".join(f"{f'at {mark / 1e6:g} M':>12}" for mark in marks)
        yield f"{f'{name}, walls':44} {'seed':>6} {header} {f's to {goal:g}':>10} {'steps/s':>9}"
        table: dict[str, list[float]] = {}
        for seed in range(1 if quick else SEEDS):
            for what, curve in race(name, seed, marks[-1]).items():
                walls = [walls_at(curve, mark) for mark in marks]
                last = curve[-1]
                yield line(what, seed, walls, seconds_to(curve, goal), last.steps / last.seconds)
                table.setdefault(what, []).append(walls[-1])
        yield from totals(name, table)


def line(what: str, seed: int, walls: Sequence[float], seconds: float, speed: float) -> str:
    """A row of the table."""
    numbers = "".join(f"{value:12.2f}" for value in walls)
    return f"{what:44} {seed:6} {numbers} {seconds:10,.0f} {speed:9,.0f}"


def totals(name: str, table: Mapping[str, Sequence[float]]) -> Iterator[Row]:
    """The mean over seeds of every learner's last mark, and how much that is of Stable-Baselines3's and of the ceiling.

    The ceiling is the return of a blind gait (docs/environments/calibration.md); it can be passed.
    """
    peer = float(np.mean(table["PPO, Stable-Baselines3"]))
    for what, walls in table.items():
        mean = float(np.mean(walls))
        of_all = f"{what}, mean of {len(walls)} seeds"
        yield Row(name, of_all, mean, "walls", mean / peer if peer else None, "of SB3's")
        yield Row(name, of_all, mean, "walls", mean / CEILING[name], "of the blind gait's")
