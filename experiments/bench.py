"""How fast are we, as ratios within one run: bare physics, environments, whole training iterations, memory.

    python -m experiments.bench [--quick]

Absolute numbers depend on the machine and on what else it does; ratios within one run hardly do. One thread throughout.
"""

import argparse
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from mujoco.batch import Batch

from experiments.config import Run, algorithm, compose_run
from hippo.core.checkpoint import Checkpoint
from hippo.core.log import RunLog
from hippo.envs import ENVIRONMENTS, make
from hippo.envs.gather import lidar
from hippo.envs.vector import RobotTaskEnv

NUM_ENVS = {"ant_gather": 20, "snake_gather": 13, "block_hopper": 50, "block_half_cheetah": 50}  # of the paper's batch
# (what, environment) -> the least ratio to bare stepping that we aim at
TARGETS = {
    ("environment", "ant_gather"): 0.85,
    ("environment", "block_half_cheetah"): 0.8,
    ("HiPPO random p", "ant_gather"): 0.65,
    ("HiPPO random p", "snake_gather"): 0.9,
    ("HiPPO random p", "block_hopper"): 0.6,
    ("HiPPO random p", "block_half_cheetah"): 0.65,
}


def rate(step: Callable[[], object], steps_per_call: int, seconds: float) -> float:
    """Steps per second of repeated calls."""
    calls, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        step()
        calls += 1
    return calls * steps_per_call / (time.perf_counter() - start)


def physics_and_environment(name: str, num_envs: int, seconds: float, rounds: int = 7) -> tuple[float, float]:
    """Steps per second of bare `Batch.step` and of our vector environment, interleaved, median of `rounds`.

    Both take the same random actions; bare stepping computes no stage at the new state.
    """
    env = make(name, num_envs, 0)
    env.reset(seed=0)
    bare = Batch(env.physics.model, num_envs, 1)
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

    bare_rates, environment_rates = [], []
    for _ in range(rounds):
        bare_rates.append(rate(step_bare, num_envs, seconds))
        environment_rates.append(rate(step_environment, num_envs, seconds))
    return statistics.median(bare_rates), statistics.median(environment_rates)


def training(run: Run, iterations: int) -> float:
    """Environment steps per second of whole iterations, collection and update, after a first one."""
    speeds: list[float] = []

    def make_envs(num_envs: int, purpose: str) -> RobotTaskEnv:
        return make(run.env, num_envs, 0, horizon=run.config.horizon, **run.options)

    with tempfile.TemporaryDirectory() as folder:
        log = RunLog(Path(folder), lambda _, timing: speeds.append(float(timing["steps_per_second"])))
        algorithm(run.algo).train(run.config, make_envs, log, 0, Checkpoint(Path(folder)))
    return statistics.median(speeds[1:]) if iterations > 1 else speeds[0]


def lidar_microseconds(num_envs: int = 64) -> float:
    """Cost of the lidar for all environments, per step."""
    rng = np.random.default_rng(0)
    com, yaw = rng.uniform(-6, 6, (num_envs, 2)), rng.uniform(-3, 3, num_envs)
    objects, present = rng.uniform(-6, 6, (num_envs, 16, 2)), np.ones((num_envs, 16), bool)
    return 1e6 / rate(lambda: lidar(com, yaw, objects, present), 1, 0.5)


def peak_memory(overrides: list[str]) -> float:
    """Peak resident memory in MB of a fresh process that trains one iteration."""
    code = (
        "import sys, tempfile; from experiments.train import main; from experiments.bench import own_peak; "
        "main([*sys.argv[1:], 'runs_dir=' + tempfile.mkdtemp()]); print(own_peak())"
    )
    command = [sys.executable, "-c", code, *overrides]
    return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()[-1])


def own_peak() -> float:
    """This process's peak resident memory in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def line(what: str, name: str, speed: float, bare: float) -> str:
    """One row of the table."""
    target = TARGETS.get((what, name))
    aim = "" if target is None else f">= {target}" + ("" if speed / bare >= target else "  MISSED")
    return f"{name:20} {what:22} {speed:12,.0f} {speed / bare:8.2f}   {aim}"


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="experiments.bench", description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a few seconds per row and no memory")
    options = parser.parse_args()
    torch.set_num_threads(1)
    seconds, iterations = (0.2, 2) if options.quick else (1.0, 4)
    print(f"{'environment':20} {'what':22} {'steps/s':>12} {'of bare':>8}   target", flush=True)
    for name in ENVIRONMENTS:
        bare, environment = physics_and_environment(name, NUM_ENVS[name], seconds)
        print(line("bare Batch.step", name, bare, bare))
        print(line("environment", name, environment, bare), flush=True)
        for algo, what in (("hippo", "HiPPO random p"), ("ppo", "PPO")):
            run = compose_run([f"env={name}", f"algo={algo}", "scale=paper", f"iterations={iterations}"])
            before, _ = physics_and_environment(name, NUM_ENVS[name], seconds / 2, rounds=3)
            speed = training(run, iterations)
            after, _ = physics_and_environment(name, NUM_ENVS[name], seconds / 2, rounds=3)
            print(line(what, name, speed, (before + after) / 2), flush=True)
    print(f"lidar, 64 environments: {lidar_microseconds():.0f} microseconds a step (target <= 150)")
    if not options.quick:
        memory = peak_memory(["env=ant_gather", "algo=hippo", "scale=paper", "iterations=1"])
        print(f"peak memory, HiPPO on Ant Gather at the paper's batch: {memory:,.0f} MB (target <= 1,000)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
