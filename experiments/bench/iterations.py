"""Whole training iterations against bare stepping, and where their seconds go; part of `make bench`.

An iteration is all of it: collecting, learning, log row and checkpoint. The clocks are put around a few large functions
of the learners in the process that is measured; nothing of this is in hippo/.
"""

import functools
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import baselines.ppo
import hippo.hippo
from experiments.bench.measure import (
    Row,
    beside,
    contestants,
    median_ratio,
    median_reference,
    median_speed,
    one_core,
    rate,
    stepping,
)
from experiments.config import compose_run
from experiments.train import prepare
from hippo.core.advantages import Baselines
from hippo.core.checkpoint import Checkpoint
from hippo.core.log import Row as LogRow
from hippo.core.log import RunLog
from hippo.core.value import ValueFunction
from hippo.learners import learner_of

ROUNDS = {"ant_gather": 3, "snake_gather": 3, "block_hopper": 7, "block_half_cheetah": 7}  # after a warm-up
ENVIRONMENTS = tuple(ROUNDS)
LEARNERS = {"hippo": "HiPPO random p", "ppo": "PPO"}
CLOCKED: dict[str, list[tuple[Any, str]]] = {
    "hippo": [(hippo.hippo, "collect"), (hippo.hippo, "improve"), (Baselines, "fit")],
    "ppo": [(baselines.ppo, "collect"), (baselines.ppo, "improve"), (ValueFunction, "fit")],
}
Span = tuple[float, float]  # start and end, seconds


@dataclass(frozen=True)
class Iteration:
    """What one training iteration took."""

    steps: int  # of environments
    seconds: float
    physics: float  # seconds inside the environments
    spans: dict[str, Span]  # by function of CLOCKED; "fit" from the first fit's start to the last's end

    @property
    def speed(self) -> float:
        """Environment steps per second of everything."""
        return self.steps / self.seconds


def training(overrides: Sequence[str], report: Callable[[Iteration], None]) -> None:
    """Train without end and report every iteration; a contestant's body."""
    run = compose_run([*overrides, "iterations=1000000"])
    steps, spans = run.config.num_envs * run.config.horizon, _clocked(run.algo)
    began = time.perf_counter()

    def on_row(_: LogRow, timing: LogRow) -> None:
        nonlocal began
        seconds = time.perf_counter() - began
        report(Iteration(steps, seconds, float(timing["physics_seconds"]), dict(spans)))
        spans.clear()
        began = time.perf_counter()

    with tempfile.TemporaryDirectory() as folder:
        log, checkpoint = RunLog(Path(folder), on_row), Checkpoint(Path(folder))
        learner_of(run.algo).train(run.config, prepare(run), log, run.seed, checkpoint)


def _clocked(algo: str) -> dict[str, Span]:
    """Put clocks around the functions of CLOCKED; their spans of the current iteration."""
    spans: dict[str, Span] = {}

    def clocked(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            start = time.perf_counter()
            result = function(*arguments, **named)
            spans[name] = (spans.get(name, (start, start))[0], time.perf_counter())
            return result

        return call

    for owner, name in CLOCKED[algo]:
        setattr(owner, name, clocked(name, getattr(owner, name)))
    return spans


def parts(iteration: Iteration, bare: float) -> dict[str, float]:
    """Where the seconds of an iteration went, given the speed of bare stepping at that moment; they sum to `all`."""
    collect, improve, fit = (iteration.spans[name] for name in ("collect", "improve", "fit"))
    assert collect[1] <= improve[0] <= improve[1] <= fit[0]
    stepping_alone = iteration.steps / bare
    named = {
        "bare": stepping_alone,
        "environment": iteration.physics - stepping_alone,
        "acting": collect[1] - collect[0] - iteration.physics,
        "advantages": improve[0] - collect[1],
        "gradients": improve[1] - improve[0],
        "fit": fit[1] - fit[0],
    }
    return {**named, "rest": iteration.seconds - sum(named.values()), "all": iteration.seconds}


def rows(quick: bool) -> Iterator[Row | str]:
    """Bare stepping, environment, collection and whole iteration, then the profile of each learner's."""
    profile = {}
    for name, rounds in ROUNDS.items():
        config = compose_run([f"env={name}"]).config
        overrides = [f"env={name}", "scale=paper"]
        if quick:
            budget = (f"env.horizon={config.horizon // 10}", f"batch_size={config.batch_size // 10}")
            overrides, rounds = [*overrides, *budget], 1
        step, _ = stepping(name, config.num_envs)
        with one_core(), contestants({algo: (training, [*overrides, f"algo={algo}"]) for algo in LEARNERS}) as turns:
            measured = beside(functools.partial(rate, step, config.num_envs, 0.5 if quick else 2.0), turns, rounds)
        bare = median_reference([pair for pairs in measured.values() for pair in pairs])
        yield Row(name, "bare Batch.step", bare, "steps/s", 1.0, "of bare")
        for algo, learner in LEARNERS.items():
            pairs = measured[algo]
            speeds = {
                "environment": [(i.steps / i.physics, bare) for i, bare in pairs],
                "environment and policy": [(i.steps / _length(i.spans["collect"]), bare) for i, bare in pairs],
                "whole iteration": [(i.speed, bare) for i, bare in pairs],
            }
            for what, of in speeds.items():
                key = f"iteration/{name}" if (algo, what) == ("hippo", "whole iteration") else ""
                label = f"{learner}: {what}"
                yield Row(name, label, median_speed(of), "steps/s", median_ratio(of), "of bare", key)
            middle = statistics.median_low([i.speed / bare for i, bare in pairs])
            profile[name, learner] = next(parts(i, bare) for i, bare in pairs if i.speed / bare == middle)
    yield from profile_table(profile)


def _length(span: Span) -> float:
    return span[1] - span[0]


def profile_table(profile: dict[tuple[str, str], dict[str, float]]) -> Iterator[str]:
    """Seconds of the iteration with the median ratio, part by part."""
    yield ""
    yield "Seconds of one iteration: bare stepping, what the environment adds, acting and recording, advantages (with"
    yield "predictions and statistics), ten gradient steps, fit of the baselines, the rest (with log and checkpoint)."
    for number, ((name, learner), seconds) in enumerate(profile.items()):
        if number == 0:
            yield f"{'':35}" + "".join(f"{part:>12}" for part in seconds)
        yield f"{name:20} {learner:14}" + "".join(f"{value:12.2f}" for value in seconds.values())
