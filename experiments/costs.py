"""What runs cost on this machine: seconds and bytes, measured once by a short training of each kind and remembered."""

import dataclasses
import functools
import hashlib
import itertools
import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch

from experiments.config import Run, installed
from experiments.status import write_atomically
from experiments.train import prepare
from hippo.core.checkpoint import Checkpoint
from hippo.core.files import DamagedFile, read_json
from hippo.core.log import RunLog
from hippo.learners import learner_of

REFERENCE = Path(__file__).with_name("reference_costs.json")  # experiments.artefacts.cost_table --measure writes it
STEPS, ITERATIONS = 200, 3  # of the short training, per environment; its first iteration warms up and does not count


@dataclasses.dataclass(frozen=True)
class Cost:
    """What one environment step of a run takes, and what the run leaves on disk."""

    seconds_per_step: float
    checkpoint_bytes: int
    row_bytes: int  # of progress.csv and timing.csv, per iteration
    measured: str  # day of the measurement, "" for a guess


def cache_file() -> Path:
    """Where measurements are kept."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "hippo-suite" / "costs.json"


def key(run: Run) -> str:
    """What the cost of a step depends on."""
    cpu = hashlib.sha256(cpu_name().encode()).hexdigest()[:8]
    revision = learner_of(run.algo).REVISION
    versions = f"torch-{installed('torch')} mujoco-{installed('mujoco')} cpu-{cpu}"
    return kind(run).replace(run.algo, f"{run.algo}-{revision}", 1) + f" {versions}"


@functools.cache
def cpu_name() -> str:
    """The CPU's model and how many of them we may use."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown")
    return f"{len(os.sched_getaffinity(0))} x {model}"


def known() -> dict[str, Any]:
    """The remembered measurements; none where the file or its place cannot be read, without what is none."""
    try:
        found = read_json(cache_file(), {})
    except (OSError, DamagedFile):
        return {}
    return {name: entry for name, entry in found.items() if _is_cost(entry)}


def _is_cost(entry: Any) -> bool:
    """Whether an entry of the file is a `Cost`."""
    kinds: dict[str, Any] = {
        "seconds_per_step": (float, int),
        "checkpoint_bytes": int,
        "row_bytes": int,
        "measured": str,
    }
    return (
        isinstance(entry, dict)
        and entry.keys() == kinds.keys()
        and all(isinstance(entry[name], kind) for name, kind in kinds.items())
        and 0 < entry["seconds_per_step"] < math.inf
    )


def cost(run: Run, table: dict[str, Any] | None = None) -> Cost:
    """Measured where `calibrate` has been here, else the rough guess of conf/env."""
    found = (known() if table is None else table).get(key(run))
    return Cost(**found) if found else Cost(run.seconds_per_step, 200_000, 600, "")


def seconds(run: Run, table: dict[str, Any] | None = None) -> float:
    """Core-seconds of a whole run."""
    return run.env_steps * cost(run, table).seconds_per_step


def kind(run: Run) -> str:
    """What the committed cost of a step depends on."""
    protocol = "" if run.protocol == Run.protocol else f" {run.protocol}"
    return f"{run.algo} {run.env} {run.options.get('physics', 'paper')}{protocol}"


@functools.cache
def reference() -> dict[str, Any]:
    """The committed costs: `cpu`, `day` and `seconds_per_step` by kind of run."""
    return json.loads(REFERENCE.read_text())


def reference_source() -> str:
    """Where the committed costs were measured, in words."""
    return f"one core of {reference()['cpu']}, {reference()['day']}"


def reference_seconds(run: Run) -> float:
    """Core-seconds of a whole run by the committed costs, which are the same on every machine."""
    return run.env_steps * reference()["seconds_per_step"].get(kind(run), run.seconds_per_step)


def disk(run: Run, table: dict[str, Any] | None = None) -> int:
    """Bytes that a finished run leaves."""
    if run.is_about_another:
        return 20_000
    here = cost(run, table)
    return 2 * here.checkpoint_bytes + run.config.iterations * here.row_bytes


def calibrate(runs: Iterable[Run]) -> dict[str, Any]:
    """Measure what is not known yet about `runs`; returns all that is known."""
    table, wanted = known(), {}
    for run in runs:
        trained = run.parent if run.is_about_another else run
        assert trained is not None
        if key(trained) not in table:
            wanted[key(trained)] = trained
    for i, (name, run) in enumerate(wanted.items()):
        print(f"measuring the cost of {run.algo} on {run.env} ({i + 1}/{len(wanted)})", flush=True)
        table[name] = dataclasses.asdict(measure(run))
    if wanted:
        try:
            cache_file().parent.mkdir(parents=True, exist_ok=True)
            write_atomically(cache_file(), json.dumps(known() | table, indent=1))
        except OSError as error:  # HOME may be anything
            print(f"warning: what was measured is not remembered: {error}", file=sys.stderr)
    return table


def measure(run: Run) -> Cost:
    """Train `run` for a moment, with its own number of environments, and look at the clock and the folder."""
    budget = {"iterations": ITERATIONS, "horizon": STEPS, "batch_size": STEPS * run.config.num_envs}
    settings: dict[str, Any] = {"skills": ""} if run.skills else {}
    if hasattr(run.config, "warmup_steps"):  # steps without updates say nothing about those with them
        settings["warmup_steps"] = 0
    short = dataclasses.replace(run, config=dataclasses.replace(run.config, **budget, **settings))
    ends = []
    threads = torch.get_num_threads()
    with tempfile.TemporaryDirectory() as folder:
        log = RunLog(Path(folder), lambda metrics, timing: ends.append(time.perf_counter()))
        learner_of(run.algo).train(short.config, prepare(short), log, run.seed, Checkpoint(Path(folder)))
        sizes = {path.name: path.stat().st_size for path in Path(folder).iterdir()}
    torch.set_num_threads(threads)
    fastest = min(b - a for a, b in itertools.pairwise(ends))
    rows = (sizes["progress.csv"] + sizes["timing.csv"]) // ITERATIONS
    return Cost(fastest / budget["batch_size"], sizes["checkpoint.pt"], rows, time.strftime("%Y-%m-%d"))
