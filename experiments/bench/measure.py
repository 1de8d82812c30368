"""How speeds are compared on a machine that is busy one moment and idle the next; part of `make bench`.

What is compared takes turns: the reference (bare stepping, say) is measured just before and just after every iteration
of everything else, each iteration is divided by the mean of the two, and the median of these ratios counts. A machine
that is twice as slow for a minute is so for both.
"""

import contextlib
import multiprocessing
import os
import signal
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from mujoco.batch import Batch

from hippo.envs import make

CORES = os.sched_getaffinity(0)  # that this process may use
Body = tuple[Any, ...]  # a function and its arguments but the last, which is called with the result of every iteration
Pair = tuple[float, float]  # a speed, and the mean of the reference's just before and after it


@dataclass(frozen=True)
class Row:
    """One line of the benchmark; where `key` names a target, its value is the ratio, or the figure if there is none."""

    where: str  # the environment
    what: str
    figure: float
    unit: str
    ratio: float | None = None
    of: str = ""  # what the ratio is to
    key: str = ""  # in targets.TARGETS

    @property
    def value(self) -> float:
        """What a target is compared with."""
        return self.figure if self.ratio is None else self.ratio

    def __str__(self) -> str:
        figure = f"{self.figure:,.0f}" if self.figure >= 100 else f"{self.figure:.2f}"
        ratio = "" if self.ratio is None else f"{self.ratio:8.2f} {self.of}"
        return f"{self.where:24} {self.what:40} {figure:>10} {self.unit:8} {ratio}".rstrip()


@contextlib.contextmanager
def one_core() -> Iterator[None]:
    """Keep this process and those it starts to one core: on a machine with neighbours no two are equally fast."""
    os.sched_setaffinity(0, {max(CORES)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, CORES)


def beside(
    reference: Callable[[], float], turns: Mapping[str, Callable[[], Any]], rounds: int
) -> dict[str, list[tuple[Any, float]]]:
    """What every one of `turns` returns in each round, with the mean of the reference just before and just after it."""
    results: dict[str, list[tuple[Any, float]]] = {name: [] for name in turns}
    before = reference()
    for _ in range(rounds):
        for name, turn in turns.items():
            result, after = turn(), reference()
            results[name].append((result, (before + after) / 2))
            before = after
    return results


def median_ratio(pairs: Sequence[Pair]) -> float:
    """Median over the rounds of speed over reference."""
    return statistics.median(speed / reference for speed, reference in pairs)


def median_speed(pairs: Sequence[Pair]) -> float:
    """Median speed itself."""
    return statistics.median(speed for speed, _ in pairs)


def median_reference(pairs: Sequence[tuple[Any, float]]) -> float:
    """Median speed of the reference."""
    return statistics.median(reference for _, reference in pairs)


def rate(step: Callable[[], object], steps_per_call: int, seconds: float) -> float:
    """Steps per second of repeated calls."""
    calls, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        step()
        calls += 1
    return calls * steps_per_call / (time.perf_counter() - start)


def stepping(name: str, num_envs: int, num_threads: int = 1) -> tuple[Callable[[], None], Callable[[], object]]:
    """One step of bare `Batch.step`, which computes no stage at the new state, and one of our vector environment.

    Both start from the same states, again and again after every horizon, and take the actions of an untrained policy:
    standard normal, clipped. On the states of a real training bare stepping is as fast within 3 %.
    """
    env = make(name, num_envs, 0, num_threads)
    env.reset(seed=0)
    bare, start = Batch(env.physics.model, num_envs, num_threads), env.physics.get_state()
    ctrl, clock = bare.bind("ctrl"), {"bare": 0, "environment": 0}
    low, high = np.asarray(env.physics.model.actuator_ctrlrange).T
    actions = np.random.default_rng(0).standard_normal((256, *(env.action_space.shape or ()))).clip(-1, 1)
    controls = low + (actions + 1) / 2 * (high - low)

    def step_bare() -> None:
        if clock["bare"] % env.horizon == 0:
            bare.state[:] = start
        ctrl[:] = controls[clock["bare"] % 256]
        bare.step(nstep=env.physics.frame_skip)
        clock["bare"] += 1

    def step_environment() -> None:
        env.step(actions[clock["environment"] % 256])
        clock["environment"] += 1

    return step_bare, step_environment


def _take_turns(function: Callable[..., None], arguments: Sequence[Any], pipe: Any, parent: int, folder: str) -> None:
    """Body of a contestant's process."""
    tempfile.tempdir = folder

    def report(result: Any) -> None:
        pipe.send(result)
        while not pipe.poll(1):
            if os.getppid() != parent:  # which is gone
                os.killpg(0, signal.SIGKILL)
        pipe.recv()

    function(*arguments, report)


@contextlib.contextmanager
def contestant(function: Callable[..., None], *arguments: Any) -> Iterator[Callable[[], Any]]:
    """A process that runs `function` and waits wherever that reports an iteration: call what this gives for the next.

    A process each, as a real run has; only one works at a time. The first iteration warms up and is dropped. In the end
    it is killed with all that it started, and its temporary files are removed, so `function` need not tidy up.
    """
    context = multiprocessing.get_context("fork")
    pipe, theirs = context.Pipe()

    def received() -> Any:
        try:
            return pipe.recv()
        except EOFError:
            raise RuntimeError(f"{function.__name__}{arguments} ended early; why is above") from None

    def turn() -> Any:
        pipe.send(True)
        return received()

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        process = context.Process(target=_take_turns, args=(function, arguments, theirs, os.getpid(), folder))
        process.start()
        assert process.pid is not None
        os.setpgid(process.pid, process.pid)  # a group of its own: Ctrl-C is ours alone
        theirs.close()
        try:
            received()
            yield turn
        finally:
            os.killpg(process.pid, signal.SIGKILL)
            process.join()


@contextlib.contextmanager
def contestants(bodies: Mapping[str, Body]) -> Iterator[dict[str, Callable[[], Any]]]:
    """Several of them by name, each already warm."""
    with contextlib.ExitStack() as stack:
        yield {name: stack.enter_context(contestant(*body)) for name, body in bodies.items()}
