"""What the local pool of workers gains and costs; part of `make bench`."""

import csv
import dataclasses
import itertools
import json
import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from experiments.config import Run, compose_run
from experiments.launchers import run_locally

RUNS = 4
SETTINGS = ("env=block_hopper", "scale=smoke", "env.horizon=1000", "batch_size=10000")


def throughput_and_overhead(iterations: int) -> tuple[float, float]:
    """How many times faster two workers are than one, and the seconds per run that are not training.

    The overhead is that of one worker, from the end of a run to the end of the next less what its iterations took; a
    worker's first run, which imports torch, is not among them. Both need two idle cores.
    """
    with tempfile.TemporaryDirectory() as folder:
        runs = [
            compose_run([*SETTINGS, f"iterations={iterations}", f"seed={seed}", f"runs_dir={folder}/one"])
            for seed in range(RUNS)
        ]
        alone = _seconds(runs, 1)
        ends = sorted((json.loads((r.folder / "status.json").read_text())["heartbeat"], _training(r)) for r in runs)
        overhead = [end - before - training for (before, _), (end, training) in itertools.pairwise(ends)]
        together = _seconds([dataclasses.replace(run, runs_dir=Path(folder) / "two") for run in runs], 2)
    return alone / together, statistics.median(overhead)


def _seconds(runs: Sequence[Run], workers: int) -> float:
    start = time.perf_counter()
    states = run_locally(runs, workers, lambda *_: None)
    assert set(states.values()) == {"finished"}
    return time.perf_counter() - start


def _training(run: Run) -> float:
    with (run.folder / "timing.csv").open() as file:
        return sum(float(row["seconds"]) for row in csv.DictReader(file))
