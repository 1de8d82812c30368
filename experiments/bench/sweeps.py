"""What the local pool of workers gains and costs, and the front door's own minutes; parts of `make bench`."""

import csv
import itertools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from experiments.bench.measure import Row, beside
from experiments.config import Run, compose_run
from experiments.launchers import run_locally

SETTINGS = ("env=block_hopper", "scale=smoke", "env.horizon=1000", "batch_size=10000")


def pool(workers: int, runs: int, iterations: int) -> tuple[float, float]:
    """Runs per second of a pool, and the median seconds per run that are not training where one worker does them all.

    The latter is from the end of a run to the end of the next less what its iterations took; a worker's first run,
    which imports torch, is not among them.
    """
    with tempfile.TemporaryDirectory() as folder:
        settings = [*SETTINGS, f"iterations={iterations}"]
        chosen = [compose_run([*settings, f"seed={seed}"], Path(folder)) for seed in range(runs)]
        start = time.perf_counter()
        states = run_locally(chosen, workers, lambda *_: None)
        seconds = time.perf_counter() - start
        assert set(states.values()) == {"finished"}
        return runs / seconds, _overhead(chosen)


def _overhead(runs: Sequence[Run]) -> float:
    ends = sorted((json.loads((run.folder / "status.json").read_text())["heartbeat"], _training(run)) for run in runs)
    return statistics.median(end - before - training for (before, _), (end, training) in itertools.pairwise(ends))


def _training(run: Run) -> float:
    with (run.folder / "timing.csv").open() as file:
        return sum(float(row["seconds"]) for row in csv.DictReader(file))


def rows(quick: bool) -> Iterator[Row]:
    """Throughput of 2, 4, ... workers over that of one, which is measured before and after; needs idle cores."""
    cores, iterations = len(os.sched_getaffinity(0)), 2 if quick else 20
    overheads = []

    def one() -> float:
        speed, overhead = pool(1, 4, iterations)
        overheads.append(overhead)
        return speed

    for workers in (2**n for n in range(1, cores.bit_length())):
        runs = max(4, workers)
        [(speed, alone)] = beside(one, {"": lambda n=workers, runs=runs: pool(n, runs, iterations)[0]}, 1)[""]  # type: ignore[misc]
        key = "workers" if workers == 2 else ""
        yield Row("block_hopper", f"{workers} workers", 60 * speed, "runs/min", speed / alone, "of one", key)
    if overheads:
        yield Row(
            "block_hopper", "launcher, per run beyond training", statistics.median(overheads), "s", key="launcher"
        )


def front_door(quick: bool) -> Iterator[Row]:
    """Minutes of `make fig3 SCALE=smoke` with 2 workers, nothing trained or remembered before; none if `quick`."""
    if quick:
        return
    with tempfile.TemporaryDirectory() as folder:
        where = ["--scale", "smoke", "--runs-dir", f"{folder}/runs"]
        start = time.perf_counter()
        for command in (
            ["experiments.sweep", "run", "fig3", *where, "--fresh", "--workers", "2"],
            ["paper_figures.fig3", *where, "--out", f"{folder}/out"],
        ):
            environment = os.environ | {"XDG_CACHE_HOME": folder}
            subprocess.run([sys.executable, "-m", *command], env=environment, stdout=subprocess.DEVNULL, check=True)
        yield Row("", "make fig3 SCALE=smoke, 2 workers", (time.perf_counter() - start) / 60, "minutes", key="fig3")
