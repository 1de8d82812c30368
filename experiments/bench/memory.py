"""Peak resident memory of a training run; part of `make bench`."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from experiments.bench.iterations import ENVIRONMENTS
from experiments.bench.measure import Row


def peak_memory(overrides: list[str]) -> float:
    """Peak resident memory in MB of a fresh process that trains as `overrides` say."""
    code = (
        "import sys, tempfile; from experiments.train import main; from experiments.bench.memory import own_peak\n"
        "with tempfile.TemporaryDirectory() as folder: main([*sys.argv[1:], 'runs_dir=' + folder])\n"
        "print(own_peak())"
    )
    command = [sys.executable, "-c", code, *overrides]
    return float(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.split()[-1])


def own_peak() -> float:
    """This process's peak resident memory in MB; getrusage's would include that of the process that started it."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("VmHWM"))


def rows(quick: bool) -> Iterator[Row]:
    """Two iterations at the paper's batch, as the second has fitted baselines; Ant Gather only if `quick`."""
    for name in ENVIRONMENTS[:1] if quick else ENVIRONMENTS:
        peak = peak_memory([f"env={name}", "algo=hippo", "scale=paper", "iterations=2"])
        yield Row(name, "HiPPO, peak memory at paper batch", peak, "MB", key="memory" if name == "ant_gather" else "")
