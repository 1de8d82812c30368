"""Our vector environments against bare physics and against Gymnasium's own vectorisation; part of `make bench`."""

import functools
import statistics
import time
from collections.abc import Callable, Sequence

import gymnasium as gym
import numpy as np
from mujoco.batch import Batch

from hippo.envs import gymnasium_id, make
from hippo.envs.gather import lidar

# (environment, simulations) -> the least fraction of bare stepping that we aim at, on one thread
CASES = {("ant_gather", 20): 0.85, ("ant_gather", 64): 0.85, ("block_half_cheetah", 50): 0.8}
LIDAR_TARGET = 150  # microseconds for 64 environments


def rate(step: Callable[[], object], steps_per_call: int, seconds: float) -> float:
    """Steps per second of repeated calls."""
    calls, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        step()
        calls += 1
    return calls * steps_per_call / (time.perf_counter() - start)


def interleaved(steps: Sequence[Callable[[], object]], num_envs: int, seconds: float, rounds: int) -> list[float]:
    """Steps per second of each of `steps`, taken in turns so that a busy moment hits all alike: medians of `rounds`."""
    rates = [[rate(step, num_envs, seconds) for step in steps] for _ in range(rounds)]
    return [statistics.median(column) for column in zip(*rates, strict=True)]


def physics_and_environment(
    name: str, num_envs: int, seconds: float, rounds: int = 7, num_threads: int = 1
) -> tuple[float, float]:
    """Steps per second of bare `Batch.step` and of our vector environment.

    Both take the same random actions; bare stepping computes no stage at the new state.
    """
    env = make(name, num_envs, 0, num_threads)
    env.reset(seed=0)
    bare = Batch(env.physics.model, num_envs, num_threads)
    bare.state[:] = env.physics.get_state()
    ctrl, rng = bare.bind("ctrl"), np.random.default_rng(0)
    control_range = np.asarray(env.physics.model.actuator_ctrlrange)
    low, high = control_range[:, 0], control_range[:, 1]
    actions = rng.uniform(-1, 1, (256, *(env.action_space.shape or ())))
    controls = low + (actions + 1) / 2 * (high - low)
    clock = {"bare": 0, "environment": 0}

    def step_bare() -> None:
        ctrl[:] = controls[clock["bare"] % 256]
        bare.step(nstep=env.physics.frame_skip)
        clock["bare"] += 1

    def step_environment() -> None:
        env.step(actions[clock["environment"] % 256])
        clock["environment"] += 1

    first, second = interleaved([step_bare, step_environment], num_envs, seconds, rounds)
    return first, second


def vectorised_by_gymnasium(env_id: str, num_envs: int, seconds: float, processes: bool) -> float:
    """Steps per second of Gymnasium's SyncVectorEnv or AsyncVectorEnv over a registered single environment."""
    vector = gym.vector.AsyncVectorEnv if processes else gym.vector.SyncVectorEnv
    envs = vector([functools.partial(_registered, env_id)] * num_envs)
    envs.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (64, *(envs.action_space.shape or ()))).astype(np.float32)
    count = 0

    def step() -> None:
        nonlocal count
        envs.step(actions[count % 64])
        count += 1

    speed = rate(step, num_envs, seconds)
    envs.close()
    return speed


def _registered(env_id: str) -> gym.Env:
    import hippo.envs  # noqa: F401  registers the ids in a process of AsyncVectorEnv

    return gym.make(env_id)


def lidar_microseconds(num_envs: int = 64) -> float:
    """Cost of the lidar for all environments, per step."""
    rng = np.random.default_rng(0)
    com, yaw = rng.uniform(-6, 6, (num_envs, 2)), rng.uniform(-3, 3, num_envs)
    objects, present = rng.uniform(-6, 6, (num_envs, 16, 2)), np.ones((num_envs, 16), bool)
    return 1e6 / rate(lambda: lidar(com, yaw, objects, present), 1, 0.5)


def lines(quick: bool) -> list[str]:
    """Rows of the table: environment, what, steps per second, fraction of bare stepping on as many threads."""
    seconds, rounds = (0.1, 3) if quick else (0.5, 7)
    table = []
    for (name, num_envs), target in CASES.items():
        label = f"{name} x {num_envs}"
        for threads in (1, 2):
            bare, ours = physics_and_environment(name, num_envs, seconds, rounds, threads)
            what = f"{threads} thread{'s' * (threads > 1)}"
            aim = "" if threads > 1 else f">= {target}" + ("" if ours / bare >= target else "  MISSED")
            table.append(_line(label, f"bare physics, {what}", bare, 1.0, ""))
            table.append(_line(label, f"environment, {what}", ours, ours / bare, aim))
            if threads == 1:
                one = bare
        for processes, how in ((False, "SyncVectorEnv"), (True, "AsyncVectorEnv")):
            speed = vectorised_by_gymnasium(gymnasium_id(name), num_envs, 2 * seconds, processes)
            table.append(_line(label, f"Gymnasium's {how}", speed, speed / one, ""))
    # Its Ant-v5 takes 5 steps of 0.01 s for one of its own; ours one. The basis is physics steps.
    speed = 5 * vectorised_by_gymnasium("Ant-v5", 20, 2 * seconds, processes=False)
    table.append(_line("Ant-v5 x 20", "SyncVectorEnv, physics steps", speed, float("nan"), ""))
    cost = lidar_microseconds()
    missed = "" if cost <= LIDAR_TARGET else "  MISSED"
    table.append(f"lidar, 64 environments: {cost:.0f} microseconds a step (target <= {LIDAR_TARGET}){missed}")
    return table


def _line(label: str, what: str, speed: float, ratio: float, aim: str) -> str:
    shown = f"{ratio:8.2f}" if ratio == ratio else " " * 8
    return f"{label:24} {what:30} {speed:12,.0f} {shown}   {aim}".rstrip()
