"""How the cost of an environment step changes with environments, skills and batch; part of `make bench`."""

import statistics
import tempfile
from pathlib import Path

from experiments.config import algorithm, compose_run
from hippo.core.checkpoint import Checkpoint
from hippo.core.log import RunLog
from hippo.envs import make

ENV = "block_hopper"
STEPS = 20_000  # of an iteration, unless it is the batch that changes
NUM_ENVS, SKILLS, BATCHES = (1, 5, 20, 64, 256), (1, 6, 24), (10_000, 50_000, 100_000, 400_000)
TARGET = 1.1  # 256 environments against 20


def microseconds(num_envs: int, batch_size: int, iterations: int, *settings: str) -> float:
    """Cost of one environment step in whole HiPPO iterations: median over iterations after the first."""
    budget = [f"batch_size={batch_size}", f"env.horizon={batch_size // num_envs}", f"iterations={iterations + 1}"]
    run = compose_run([f"env={ENV}", "algo=hippo", "scale=paper", *budget, *settings])
    speeds: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        log = RunLog(Path(folder), lambda _, timing: speeds.append(float(timing["steps_per_second"])))

        def make_envs(count: int, purpose: str) -> object:
            return make(ENV, count, 0, horizon=run.config.horizon)

        algorithm("hippo").train(run.config, make_envs, log, 0, Checkpoint(Path(folder)))
    return 1e6 / statistics.median(speeds[1:])


def lines(quick: bool) -> list[str]:
    """Rows of the table: microseconds per environment step, and how many times the reference's."""
    iterations = 1 if quick else 5
    table = []
    by_envs = {n: microseconds(n, STEPS // n * n, iterations) for n in NUM_ENVS}
    for n, cost in by_envs.items():
        ratio = cost / by_envs[20]
        aim = f"<= {TARGET}{'' if ratio <= TARGET else '  MISSED'}" if n == 256 else ""
        table.append(_line(f"{n} environments", cost, ratio, "of 20", aim))
    by_skills = {n: microseconds(20, STEPS, iterations, f"algo.num_skills={n}") for n in SKILLS}
    table += [_line(f"{n} skills", cost, cost / by_skills[6], "of 6") for n, cost in by_skills.items()]
    chosen = BATCHES[:2] if quick else BATCHES
    by_batch = {n: microseconds(50, n, 1 if n > 100_000 else min(iterations, 3)) for n in chosen}
    table += [_line(f"batch {n:,}", cost, cost / by_batch[50_000], "of 50,000") for n, cost in by_batch.items()]
    return table


def _line(what: str, cost: float, ratio: float, of: str, aim: str = "") -> str:
    return f"{ENV:20} {what:22} {cost:9.1f} us/step {ratio:8.2f} {of:10} {aim}".rstrip()
