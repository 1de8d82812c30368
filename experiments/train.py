"""One run, from its configuration to `status.json: finished`; resumes by itself and never trains twice.

    python -m experiments.train algo=hippo env=ant_gather seed=3 algo.period_min=5

A run lives in runs/<run_id>/: config.yaml (what it is), manifest.json (where it came from), status.json (how it is
doing), progress.csv and timing.csv (what it measured), checkpoint.pt and checkpoint.prev.pt.
"""

import contextlib
import json
import os
import platform
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock, Timeout

from experiments.config import Run, algorithm, compose_run
from hippo import gradients
from hippo.core import checkpoint, seeding
from hippo.core.checkpoint import Checkpoint, CheckpointError
from hippo.core.log import Diverged, Row, RunLog
from hippo.core.settings import ConfigError
from hippo.envs import make

HEARTBEAT_SECONDS = 5.0
EXIT_FAILED, EXIT_BAD_INPUT, EXIT_DIVERGED, EXIT_REQUEUE = 1, 2, 3, 75  # 75 is sysexits' EX_TEMPFAIL
EXIT_CODES = {"finished": 0, "running": 0, "failed": EXIT_FAILED, "diverged": EXIT_DIVERGED, "preempted": EXIT_REQUEUE}
ROOT = Path(__file__).parent.parent


class Preempted(BaseException):
    """SIGTERM or SIGUSR1 arrived: the iteration is abandoned; the last checkpoint is complete."""


class Status:
    """status.json of one run, rewritten atomically at every change and every few seconds."""

    def __init__(self, run: Run) -> None:
        self.path = run.folder / "status.json"
        self.lock = threading.Lock()
        self.content: dict[str, Any] = {
            "state": "running",
            "iteration": -1,
            "iterations": run.config.iterations,
            "env_steps": 0,
            "steps_per_second": None,
            "host": socket.gethostname(),
            "pid": os.getpid(),
            "started": time.time(),
            "message": "",
        }

    def update(self, **changes: Any) -> None:
        """Change some entries and write the file."""
        with self.lock:
            self.content |= {**changes, "heartbeat": time.time()}
            write_atomically(self.path, json.dumps(self.content, indent=1))

    @contextlib.contextmanager
    def heartbeat(self) -> Iterator[None]:
        """Keep the file fresh from a thread, and end this process if the one that started it is gone."""
        stop, parent = threading.Event(), os.getppid()

        def beat() -> None:
            while not stop.wait(HEARTBEAT_SECONDS):
                self.update()
                if os.getppid() != parent:
                    os.kill(os.getpid(), signal.SIGTERM)

        thread = threading.Thread(target=beat, daemon=True)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()


def write_atomically(path: Path, text: str) -> None:
    """Replace `path` so that a reader sees the old or the new text, never a part."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")  # two sweeps may write the same plan
    try:
        temporary.write_text(text)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def read_status(folder: Path) -> dict[str, Any]:
    """A run's status; state "missing" where it never started, "lost" where its heartbeat stopped or it is damaged."""
    try:
        status = json.loads((folder / "status.json").read_text())
    except FileNotFoundError:
        return {"state": "missing", "iteration": -1, "message": ""}
    except json.JSONDecodeError:  # a power cut; the checkpoint has its own digest
        return {"state": "lost", "iteration": -1, "message": "status.json is damaged"}
    if status["state"] == "running" and time.time() - status["heartbeat"] > 6 * HEARTBEAT_SECONDS:
        status["state"] = "lost"
    return status


def mark_lost(run: Run, message: str) -> None:
    """Say in its status.json that the process that trained `run` is gone, unless another has taken the run over."""
    with contextlib.suppress(Timeout), FileLock(run.folder / ".lock", timeout=0):
        status = read_status(run.folder)
        if status["state"] not in ("finished", "diverged"):
            write_atomically(run.folder / "status.json", json.dumps(status | {"state": "lost", "message": message}))


def git(*arguments: str) -> str:
    """Output of a git command in this repository, "" outside one."""
    result = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=False)
    return result.stdout.strip()


def manifest(run: Run) -> dict[str, Any]:
    """Where a run comes from: code, versions, machine, command. Holds no host name, user or environment."""
    lock = ROOT / "requirements.lock"
    difference = git("diff", "HEAD")
    cpu = dict(line.split("\t", 1) for line in Path("/proc/cpuinfo").read_text().splitlines() if "\t" in line)
    return {
        "schema": 1,
        "run_id": run.run_id,
        "identity": run.identity,
        "config": run.to_yaml(),
        "command": shlex.join(["python", *sys.orig_argv[1:]]),
        "git_commit": git("rev-parse", "HEAD"),
        "git_difference": sha256(difference.encode()).hexdigest() if difference else None,
        "lock": sha256(lock.read_bytes()).hexdigest() if lock.exists() else None,
        "python": platform.python_version(),
        "versions": {name: version(name) for name in ("torch", "mujoco", "gymnasium", "numpy", "scipy")},
        "cpu": cpu.get("model name", platform.processor()).strip("\t: "),
        "cpu_flags": cpu.get("flags", "").strip("\t: "),
        "cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "seed": {"root": run.seed, "streams": "SHA-256 of the purpose, then indices; see hippo/core/seeding.py"},
    }


def execute(run: Run) -> str:
    """Train `run` to its end; returns its state: finished, running (elsewhere), diverged, failed or preempted."""
    if read_status(run.folder)["state"] == "finished":
        print(f"{run.run_id} is finished: {run.folder}")
        return "finished"
    if run.parent is not None and (state := _finish_parent(run.parent)) != "finished":
        return "preempted" if state == "preempted" else "failed"
    run.folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(run.folder / ".lock", timeout=0):
            return _execute_locked(run)
    except Timeout:
        status = read_status(run.folder)
        print(f"{run.run_id} is already running (host {status.get('host')}, pid {status.get('pid')})")
        return "running"


def _finish_parent(parent: Run) -> str:
    """Train what a run depends on, or wait for whoever does; its final state."""
    while (state := execute(parent)) == "running":
        time.sleep(HEARTBEAT_SECONDS)
    if state != "finished":
        print(f"{parent.run_id}, which this run depends on, is {state}: {parent.folder}", file=sys.stderr)
    return state


def _execute_locked(run: Run) -> str:
    if read_status(run.folder)["state"] == "finished":  # by whoever held the lock before
        return "finished"
    write_atomically(run.folder / "config.yaml", run.to_yaml())
    write_atomically(run.folder / "manifest.json", json.dumps(_manifest_with_history(run), indent=1))
    status = Status(run)
    status.update()
    with _preemption(), status.heartbeat():
        try:
            WORK[run.kind](run, status)
            status.update(state="finished", message="")
        except Diverged as error:
            checkpoint.save(run.folder / "diverged.pt", error.dump)
            status.update(state="diverged", message=str(error))
            print(f"diverged: {error}", file=sys.stderr)
        except (Preempted, KeyboardInterrupt) as error:
            status.update(state="preempted", message=f"stopped by {error or 'Ctrl-C'}; start it again to continue")
        except CheckpointError as error:
            status.update(state="failed", message=str(error))
            print(f"error: {error}", file=sys.stderr)
        except Exception as error:
            status.update(state="failed", message=f"{type(error).__name__}: {error}".splitlines()[0])
            traceback.print_exc()
    return status.content["state"]


def _manifest_with_history(run: Run) -> dict[str, Any]:
    """The manifest; of a resumed run, with the commits of its earlier sessions, and a word about it on stdout."""
    content, path = manifest(run), run.folder / "manifest.json"
    if not (run.folder / "checkpoint.pt").exists() or not path.exists():
        return content | {"earlier_commits": []}
    before = json.loads(path.read_text())
    old, new = before["git_commit"], content["git_commit"]
    where = "" if old == new else f" under commit {new[:10] or 'unknown'}, last under {old[:10] or 'unknown'}"
    print(f"resuming {run.run_id}{where}", flush=True)
    return content | {"earlier_commits": [*before.get("earlier_commits", []), old]}


@contextlib.contextmanager
def _preemption() -> Iterator[None]:
    """Turn SIGTERM and SIGUSR1 into Preempted while the block runs."""

    def stop(number: int, frame: object) -> None:
        raise Preempted(signal.Signals(number).name)

    before = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGUSR1)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def prepare(run: Run) -> Callable[[int, str], Any]:
    """Set torch up and return what makes the run's environments, each purpose with its own random stream."""
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)

    def make_envs(num_envs: int, purpose: str) -> Any:
        seed = seeding.integer(run.seed, "environments", *purpose.encode())
        return make(run.env, num_envs, seed, horizon=run.config.horizon, **run.options)

    return make_envs


def train(run: Run, status: Status) -> None:
    """Hand the run to its algorithm."""
    make_envs = prepare(run)
    started, first = time.monotonic(), None

    def on_row(metrics: Row, timing: Row) -> None:
        nonlocal first
        done = int(metrics["iteration"]) + 1
        first = done - 1 if first is None else first
        eta = (time.monotonic() - started) / (done - first) * (run.config.iterations - done)
        speed = timing["steps_per_second"]
        print(
            f"{run.run_id} {run.algo} {run.env} seed {run.seed}  iteration {done}/{run.config.iterations}  "
            f"return {metrics['return_mean']:.3f}  {speed:,.0f} steps/s  ETA {clock(eta)}",
            flush=True,
        )
        status.update(iteration=done - 1, env_steps=metrics["env_steps"], steps_per_second=speed)

    algorithm(run.algo).train(run.config, make_envs, RunLog(run.folder, on_row), run.seed, Checkpoint(run.folder))


def measure(run: Run, status: Status) -> None:
    """Table 2's quantities of the parent run, as the single row of progress.csv."""
    assert run.parent is not None
    make_envs, start = prepare(run), time.perf_counter()
    metrics = gradients.measure(run.config, make_envs, run.seed, Checkpoint(run.parent.folder))
    log = RunLog(run.folder)
    log.resume(0)
    log.row(metrics, {"seconds": time.perf_counter() - start})
    status.update(iteration=run.config.iterations - 1, env_steps=metrics["env_steps"])


WORK = {"train": train, "measure": measure}


def clock(seconds: float) -> str:
    """Seconds as h:mm:ss."""
    whole = round(seconds)
    return f"{whole // 3600}:{whole % 3600 // 60:02d}:{whole % 60:02d}"


def bad_input(error: Exception) -> int:
    """One line about what was wrong with the input."""
    print(f"error: {error}", file=sys.stderr)
    return EXIT_BAD_INPUT


def main(arguments: list[str] | None = None) -> int:
    """Train one run; the exit code says how it ended."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if {"-h", "--help"} & set(arguments):
        print(__doc__)
        return 0
    try:
        run = compose_run(arguments)
    except ConfigError as error:
        return bad_input(error)
    return EXIT_CODES[execute(run)]


if __name__ == "__main__":
    sys.exit(main())
