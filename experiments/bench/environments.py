"""Our vector environments against bare physics and against Gymnasium's own vectorisation; part of `make bench`."""

import functools
from collections.abc import Callable, Iterator

import gymnasium as gym
import numpy as np

from experiments.bench.measure import (
    Row,
    beside,
    contestants,
    median_ratio,
    median_reference,
    median_speed,
    rate,
    stepping,
)
from hippo.envs import gymnasium_id
from hippo.envs.gather import lidar

CASES = (("ant_gather", 20), ("ant_gather", 64), ("block_half_cheetah", 50))  # environment, simulations


def vectorised_by_gymnasium(
    env_id: str, num_envs: int, seconds: float, processes: bool, report: Callable[[float], None]
) -> None:
    """Report steps per second of SyncVectorEnv or AsyncVectorEnv over a registered single environment, without end."""
    vector = gym.vector.AsyncVectorEnv if processes else gym.vector.SyncVectorEnv
    envs = vector([functools.partial(registered, env_id)] * num_envs)
    envs.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, envs.action_space.shape or ()).astype(np.float32)
    while True:
        report(rate(lambda: envs.step(actions), num_envs, seconds))


def registered(env_id: str) -> gym.Env:
    """One environment by its Gymnasium id."""
    import hippo.envs  # noqa: F401  registers the ids, also in a process of its own

    return gym.make(env_id)


def lidar_microseconds(num_envs: int = 64) -> float:
    """Cost of the lidar for all environments, per step."""
    rng = np.random.default_rng(0)
    com, yaw = rng.uniform(-6, 6, (num_envs, 2)), rng.uniform(-3, 3, num_envs)
    objects, present = rng.uniform(-6, 6, (num_envs, 16, 2)), np.ones((num_envs, 16), bool)
    return 1e6 / rate(lambda: lidar(com, yaw, objects, present), 1, 0.5)


def rows(quick: bool) -> Iterator[Row]:
    """Steps per second, and as a fraction of bare stepping on one thread."""
    seconds, rounds = (0.1, 1) if quick else (0.4, 5)
    for name, num_envs in CASES:
        where = f"{name} x {num_envs}"
        (bare, env), (bare_2, env_2) = stepping(name, num_envs), stepping(name, num_envs, 2)
        ours = {"environment": env, "bare Batch.step, 2 threads": bare_2, "environment, 2 threads": env_2}
        turns: dict[str, Callable[[], float]] = {
            what: functools.partial(rate, step, num_envs, seconds) for what, step in ours.items()
        }
        peers = {"Gymnasium's SyncVectorEnv": False, "Gymnasium's AsyncVectorEnv": True}
        bodies = {
            what: (vectorised_by_gymnasium, gymnasium_id(name), num_envs, seconds, processes)
            for what, processes in peers.items()
        }
        with contestants(bodies) as theirs:
            measured = beside(functools.partial(rate, bare, num_envs, seconds), turns | theirs, rounds)
        yield Row(where, "bare Batch.step", median_reference(measured["environment"]), "steps/s", 1.0, "of bare")
        for what, pairs in measured.items():
            key = f"environment/{where}" if what == "environment" else ""
            yield Row(where, what, median_speed(pairs), "steps/s", median_ratio(pairs), "of bare", key)
    with contestants({"": (vectorised_by_gymnasium, "Ant-v5", 20, 2 * seconds, False)}) as turns:
        # Its Ant-v5 takes 5 steps of 0.01 s for one of its own; ours one. The basis is physics steps.
        yield Row("Ant-v5 x 20", "SyncVectorEnv, physics steps", 5 * turns[""](), "steps/s")
    yield Row("", "lidar of 64 environments", lidar_microseconds(), "us/step", key="lidar")
