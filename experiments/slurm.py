"""Sweeps on Slurm: arrays of jobs that survive pre-emption and time limits, submitted through submitit.

submitit carries a job to its node and nothing else. What is true stands in our own files: the run folders (status,
lock, checkpoint) and, for what waits in the queue, `<runs_dir>/slurm/batches/<job name>.json`: a list of run ids for
every array index, written before sbatch is called. One squeue call then says which runs Slurm still means to do, so a
second `run` submits nothing twice, even if the first was killed between sbatch and its bookkeeping.
"""

import contextlib
import getpass
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import submitit

from experiments import costs
from experiments.code_snapshot import snapshot
from experiments.command_line import duration
from experiments.config import Run
from experiments.slurm_profile import Profile
from experiments.status import ABANDONED_SECONDS, locked, read_status, remove_abandoned, write_atomically
from experiments.train import execute
from hippo.core.settings import ConfigError

POLL_SECONDS = 5.0
LIVE = {
    *("PENDING", "RUNNING", "COMPLETING", "CONFIGURING", "SUSPENDED", "REQUEUED", "REQUEUE_HOLD", "REQUEUE_FED"),
    *("RESIZING", "SIGNALING", "STAGE_OUT", "STOPPED", "SPECIAL_EXIT", "RESV_DEL_HOLD"),
}


JOB_NAME = re.compile(r"hippo-(?:[\w+-]+-)?[0-9a-f]{10}")  # the plan's label in the middle
DEFAULT_ARRAY = 1000  # jobs of one array where Slurm cannot be asked
AT_ONCE = 500  # jobs that one scancel names


class Job:
    """What a node does: runs one after another; it is pickled by submitit and holds text and a path only."""

    def __init__(self, runs_dir: Path) -> None:
        self.runs_dir = str(runs_dir)

    def __call__(self, group: Sequence[str]) -> dict[str, str]:
        """Do the runs of `group`, given as their yaml; told to stop, put this job back into the queue.

        Raises:
            RuntimeError: a run failed, so that Slurm shows the job as failed too.
        """
        states: dict[str, str] = {}
        for text in group:
            run = Run.from_yaml(text, Path(self.runs_dir))
            states[run.run_id] = execute(run)
            if states[run.run_id] == "preempted":
                requeue_unless_cancelled(run)
                break
        failed = [run_id for run_id, state in states.items() if state not in ("finished", "running")]
        if failed:
            raise RuntimeError(f"not finished: {', '.join(failed)}")
        return states


def requeue_unless_cancelled(run: Run) -> None:
    """After the warning signal of a time limit or a pre-emption, ask Slurm for this job again and wait for the end.

    SIGTERM alone is scancel's, or a pre-emption after which Slurm requeues by itself. Where Slurm cannot be asked, as
    inside a container without its commands, the job ends and `sweep run` goes on with the run.
    """
    if "SIGUSR" not in read_status(run.folder)["message"]:
        return
    environment = os.environ
    job = environment["SLURM_JOB_ID"]
    if "SLURM_ARRAY_JOB_ID" in environment:
        job = f"{environment['SLURM_ARRAY_JOB_ID']}_{environment['SLURM_ARRAY_TASK_ID']}"
    try:
        subprocess.run(["scontrol", "requeue", job], check=True, timeout=60)
    except (OSError, subprocess.SubprocessError) as error:
        print(
            f"not requeued, which needs scontrol here ({error}): {run.run_id} is preempted, `sweep run` continues it",
            file=sys.stderr,
            flush=True,
        )
        return
    time.sleep(60)  # Slurm ends us; to return now would read as the job's result


# ---------------------------------------------------------------------------------------------------------- submission


def submit(runs: Sequence[Run], runs_dir: Path, profile: Profile, dry_run: bool, label: str = "runs") -> int:
    """Queue `runs`, parents before what depends on them, and return at once; the number of runs submitted.

    Runs that already wait in the queue or are being trained are left alone.

    Args:
        dry_run: only say what would be submitted, for which Slurm need not be here.
        label: of the plan, after which the jobs are called.

    Raises:
        ConfigError: Slurm is not here or refuses.
    """
    folder = runs_dir.absolute() / "slurm"
    here = shutil.which("squeue") is not None
    if dry_run and not here:
        print("Slurm is not here: what is in the queue is not known, and arrays are cut as its default has it")
    with contextlib.nullcontext() if dry_run else _alone(folder):
        live = queued(runs_dir) if here or not dry_run else {}
        todo = [run for run in runs if run.run_id not in live and read_status(run.folder)["state"] != "running"]
        table, size = costs.known(), max_array_size() if here or not dry_run else DEFAULT_ARRAY
        before: list[str] = []
        for wave in waves(todo):
            groups = grouped(wave, profile.group_minutes * 60, table)
            jobs = []
            for start in range(0, len(groups), size):
                part = groups[start : start + size]
                _describe(part, profile, table, before, label)
                if not dry_run:
                    jobs.append(_submit_array(part, folder, runs_dir.absolute(), profile, before, label))
            before = jobs
        done = "to submit" if dry_run else "submitted"
        print(f"{len(runs) - len(todo)} already queued or running, {len(todo)} {done}")
    return len(todo)


def cancel(label: str, runs_dir: Path) -> int:
    """Take the jobs of a plan in `runs_dir` out of the queue, those that run too; their number.

    Their runs stay resumable. Other plans' jobs go on, also those that do runs which this plan shares.

    Raises:
        ConfigError: Slurm is not here or refuses.
    """
    if not (runs_dir / "slurm" / "batches").exists():
        return 0
    with _alone(runs_dir.absolute() / "slurm"):
        ours = re.compile(rf"hippo-{re.escape(label)}-[0-9a-f]{{10}}")
        live = [(job, index) for job, index, name in _live(runs_dir) if ours.fullmatch(name)]
        jobs = [f"{job}_{index}" if index.isdigit() else job for job, index in live]
        for start in range(0, len(jobs), AT_ONCE):
            _ask("scancel", *jobs[start : start + AT_ONCE])
    return len(jobs)


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """While nobody else submits or cancels here."""
    with _private(folder), locked(folder / "submit.lock", timeout=-1):
        for place in (folder, folder / "batches"):
            remove_abandoned(place, ABANDONED_SECONDS)
        yield


@contextlib.contextmanager
def _private(folder: Path) -> Iterator[None]:
    """Job folders hold pickles that the nodes will execute, so nobody else may write or read there."""
    before = os.umask(0o077)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        folder.chmod(0o700)
        yield
    finally:
        os.umask(before)


def waves(runs: Sequence[Run]) -> list[list[Run]]:
    """Runs by how many of their ancestors are among `runs`: what a wave needs is in the waves before it."""
    chosen = {run.run_id for run in runs}
    depth = {run.run_id: sum(a.run_id in chosen for a in run.ancestors) for run in runs}
    return [[run for run in runs if depth[run.run_id] == d] for d in sorted(set(depth.values()))]


def grouped(runs: Sequence[Run], seconds: float, table: dict[str, Any]) -> list[list[Run]]:
    """Runs packed in order into jobs of at most about `seconds`, or of one longer run."""
    groups: list[list[Run]] = []
    filled = float("inf")
    for run in sorted(runs, key=lambda run: -costs.seconds(run, table)):
        cost = costs.seconds(run, table)
        if filled + cost > seconds:
            groups.append([])
            filled = 0.0
        groups[-1].append(run)
        filled += cost
    return groups


def _describe(groups: list[list[Run]], profile: Profile, table: dict[str, Any], before: list[str], label: str) -> None:
    longest = max(sum(costs.seconds(run, table) for run in group) for group in groups)
    behind = f", after {', '.join(before)}" if before else ""
    size = f"array of {len(groups)} jobs, {sum(map(len, groups))} runs"
    print(f"hippo-{label}: {size}, the longest {duration(longest)}{behind}: {profile}")


def _submit_array(
    groups: list[list[Run]], folder: Path, runs_dir: Path, profile: Profile, before: list[str], label: str
) -> str:
    """One sbatch; returns the id of the array."""
    name = f"hippo-{label}-{uuid.uuid4().hex[:10]}"
    code = snapshot(folder)
    batches = folder / "batches"
    batches.mkdir(exist_ok=True)
    write_atomically(batches / f"{name}.json", json.dumps([[run.run_id for run in group] for group in groups]))
    python = {} if profile.python is None else {"slurm_python": profile.python}
    log = folder / "log" / "%j"
    executor = submitit.AutoExecutor(folder=log, cluster="slurm", slurm_max_num_timeout=10_000, **python)
    executor.update_parameters(
        name=name,
        timeout_min=profile.time_minutes,
        mem_gb=profile.memory_gb,
        cpus_per_task=profile.cpus,
        tasks_per_node=1,  # said, since of a whole node (--exclusive) srun would take every CPU for a task
        slurm_signal_delay_s=profile.signal_seconds,
        slurm_array_parallelism=profile.parallel,
        slurm_setup=[
            *(profile.setup or ()),
            f"export PYTHONPATH={shlex.quote(str(code))}",
            f"cd {shlex.quote(str(code))}",
            "export SRUN_CPUS_PER_TASK=$SLURM_CPUS_PER_TASK",  # srun no longer inherits it
        ],
        slurm_additional_parameters={"requeue": True} | profile.extra_options | _dependency(before),
        **profile.options,
    )
    try:
        jobs = executor.map_array(Job(runs_dir), [[run.to_yaml() for run in group] for group in groups])
    except submitit.core.utils.FailedJobError as error:
        raise ConfigError("launcher", "slurm", f"sbatch refused: {' '.join(str(error).split())}") from error
    return jobs[0].job_id.split("_")[0]


def _dependency(before: list[str]) -> dict[str, str]:
    """Behind jobs that ended in any way: a run whose parent is not there does it first, or fails with its message."""
    return {"dependency": f"afterany:{':'.join(before)}"} if before else {}


# --------------------------------------------------------------------------------------------------------------- queue


def _ask(*command: str) -> str:
    """Output of a Slurm command.

    Raises:
        ConfigError: it is not installed, or the controller does not answer.
    """
    try:
        return subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout
    except FileNotFoundError as error:
        raise ConfigError(
            "launcher", "slurm", f"needs Slurm's {command[0]} on this machine; valid here: local"
        ) from error
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
        message = getattr(error, "stderr", None) or str(error)
        raise ConfigError("launcher", "slurm", f"{command[0]} failed: {' '.join(message.split())}") from error


def check_installed() -> None:
    """Raise ConfigError where Slurm's commands are not here, before anything is written."""
    for command in ("sbatch", "squeue", "scontrol"):
        if shutil.which(command) is None:
            raise ConfigError("launcher", "slurm", f"needs Slurm's {command} on this machine; valid here: local")


def max_array_size() -> int:
    """How many jobs one array may have."""
    found = re.search(r"^MaxArraySize\s*=\s*(\d+)", _ask("scontrol", "show", "config"), re.MULTILINE)
    if found is None:
        raise ConfigError("launcher", "slurm", "scontrol show config does not say MaxArraySize")
    return int(found[1]) - 1


def queued(runs_dir: Path) -> dict[str, str]:
    """Run id -> job of every run that Slurm still means to do."""
    live: dict[str, str] = {}
    for job, index, name in _live(runs_dir):
        path = runs_dir / "slurm" / "batches" / f"{name}.json"
        live |= dict.fromkeys(_batch(path, int(index) if index.isdigit() else 0), f"{job}_{index}")
    return live


def _live(runs_dir: Path) -> list[tuple[str, str, str]]:
    """Array, index and name of every job of `runs_dir` that has not ended."""
    batches = runs_dir / "slurm" / "batches"
    if not batches.exists():
        return []
    found = []
    # The name last: a job of somebody else's making may have anything in it.
    for line in _ask("squeue", "-h", "-r", "-u", getpass.getuser(), "-o", "%K|%F|%T|%j").splitlines():
        index, job, state, name = [*line.split("|", 3), "", "", ""][:4]
        if state in LIVE and JOB_NAME.fullmatch(name) and (batches / f"{name}.json").exists():
            found.append((job, index, name))
    return found


def _batch(path: Path, index: int) -> list[str]:
    """The run ids behind one index of an array; none, and a word about it, where the file is damaged."""
    try:
        groups = json.loads(path.read_bytes())
        group = groups[index]
        if not isinstance(group, list) or not all(isinstance(run_id, str) for run_id in group):
            raise ValueError("no list of run ids")
    except (OSError, ValueError, LookupError, TypeError) as error:
        print(f"warning: {path}: cannot be read ({error}); its jobs may be submitted again", file=sys.stderr)
        return []
    return group


def wait(runs: Sequence[Run], runs_dir: Path, report: Callable[[Sequence[Run], int], None]) -> dict[str, str]:
    """Watch the run folders until Slurm has nothing more to do with `runs`; the final state of each.

    Args:
        report: called at every look with the runs in progress and the number of those that ended.
    """
    gone: set[str] = set()
    while True:
        live = queued(runs_dir)
        states = {run.run_id: read_status(run.folder)["state"] for run in runs}
        ended = {i for i, state in states.items() if state in ("finished", "diverged") or i not in live}
        report([run for run in runs if states[run.run_id] == "running"], len(ended))
        if ended <= gone and len(ended) == len(states):  # seen twice: a job between two states is in no list
            return {i: "lost" if state in ("running", "missing") else state for i, state in states.items()}
        gone = ended
        time.sleep(POLL_SECONDS)
