"""How fast are we, as ratios within one run: bare physics, environments, whole training iterations, memory.

    python -m experiments.bench [--quick]

Absolute numbers depend on the machine and on what else it does; ratios within one run hardly do. One thread unless the
row says otherwise.
"""

import argparse
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

from experiments import bench_environments, bench_peers, bench_scaling, bench_sweeps
from experiments.bench_environments import physics_and_environment
from experiments.config import Run, algorithm, compose_run
from hippo.core.checkpoint import Checkpoint
from hippo.core.log import RunLog
from hippo.envs import make
from hippo.envs.vector import RobotTaskEnv

NUM_ENVS = {"ant_gather": 20, "snake_gather": 13, "block_hopper": 50, "block_half_cheetah": 50}  # of the paper's batch
# (what, environment) -> the least ratio to bare stepping that we aim at
TARGETS = {
    ("HiPPO random p", "ant_gather"): 0.65,
    ("HiPPO random p", "snake_gather"): 0.9,
    ("HiPPO random p", "block_hopper"): 0.6,
    ("HiPPO random p", "block_half_cheetah"): 0.65,
}


def training(run: Run, iterations: int) -> float:
    """Environment steps per second of whole iterations, collection and update, after a first one."""
    speeds: list[float] = []

    def make_envs(num_envs: int, purpose: str) -> RobotTaskEnv:
        return make(run.env, num_envs, 0, horizon=run.config.horizon, **run.options)

    with tempfile.TemporaryDirectory() as folder:
        log = RunLog(Path(folder), lambda _, timing: speeds.append(float(timing["steps_per_second"])))
        algorithm(run.algo).train(run.config, make_envs, log, 0, Checkpoint(Path(folder)))
    return statistics.median(speeds[1:]) if iterations > 1 else speeds[0]


def peak_memory(overrides: list[str]) -> float:
    """Peak resident memory in MB of a fresh process that trains one iteration."""
    code = (
        "import sys, tempfile; from experiments.train import main; from experiments.bench import own_peak; "
        "main([*sys.argv[1:], 'runs_dir=' + tempfile.mkdtemp()]); print(own_peak())"
    )
    command = [sys.executable, "-c", code, *overrides]
    return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()[-1])


def own_peak() -> float:
    """This process's peak resident memory in MB; getrusage's would include that of the process that started it."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


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
    for name in NUM_ENVS:
        bare, environment = physics_and_environment(name, NUM_ENVS[name], seconds)
        print(line("bare Batch.step", name, bare, bare))
        print(line("environment", name, environment, bare), flush=True)
        for algo, what in (("hippo", "HiPPO random p"), ("ppo", "PPO")):
            run = compose_run([f"env={name}", f"algo={algo}", "scale=paper", f"iterations={iterations}"])
            before, _ = physics_and_environment(name, NUM_ENVS[name], seconds / 2, rounds=3)
            speed = training(run, iterations)
            after, _ = physics_and_environment(name, NUM_ENVS[name], seconds / 2, rounds=3)
            print(line(what, name, speed, (before + after) / 2), flush=True)
    for part in (bench_environments, bench_scaling, bench_peers):
        print()
        for row in part.lines(options.quick):
            print(row, flush=True)
    faster, overhead = bench_sweeps.throughput_and_overhead(3 if options.quick else 20)
    print(f"\ntwo workers: {faster:.2f} times the throughput of one (target >= 1.8, needs two idle cores)")
    print(f"launcher: {overhead:.2f} s per run beyond training, after a worker's first (target < 0.5)")
    if not options.quick:
        memory = peak_memory(["env=ant_gather", "algo=hippo", "scale=paper", "iterations=1"])
        print(f"peak memory, HiPPO on Ant Gather at the paper's batch: {memory:,.0f} MB (target <= 1,000)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
