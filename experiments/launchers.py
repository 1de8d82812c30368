"""Where runs are trained: a pool of worker processes on this machine."""

import errno
import multiprocessing
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from experiments import costs
from experiments.config import Run
from experiments.status import mark_lost, read_status
from experiments.train import execute

POLL_SECONDS = 1.0
ROOM = 100_000  # bytes, without which no run can go on


@dataclass
class Worker:
    """One process that trains runs one after another, so that importing torch is paid for once."""

    process: Any
    connection: Connection
    run: Run | None = None


def _work(connection: Connection) -> None:
    """Body of a worker process: train what arrives, answer with its final state and, where its folder cannot be
    written, why, until the pipe closes.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the parent, which sends SIGTERM
    while True:
        try:
            text, runs_dir = connection.recv()
        except EOFError:
            return
        run = Run.from_yaml(text, Path(runs_dir))
        try:
            run.folder.mkdir(parents=True, exist_ok=True)
            with (run.folder / "train.log").open("a") as log:
                os.dup2(log.fileno(), 1)
                os.dup2(log.fileno(), 2)
        except OSError as error:
            connection.send(("failed", f"cannot be written: {error}"))
        else:
            connection.send((execute(run), ""))


def cause(exit_code: int) -> str:
    """Why a process ended, in words: the signal's name for a negative code."""
    return signal.Signals(-exit_code).name if exit_code < 0 else f"exit code {exit_code}"


def is_full(folder: Path) -> bool:
    """Whether a small file cannot be written in `folder` for want of space."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(ROOM))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return error.errno in (errno.ENOSPC, errno.EDQUOT)
    return False


def queue_of(runs: Sequence[Run], in_order: bool) -> list[Run]:
    """`runs` as they are given, or those that others need first, then the longest, so that the pool ends together."""
    if in_order:
        return list(runs)
    table, needed = costs.known(), {a.run_id for run in runs for a in run.ancestors}
    return sorted(runs, key=lambda run: (run.run_id not in needed, -costs.seconds(run, table)))


def run_locally(
    runs: Sequence[Run], workers: int, on_change: Callable[[dict[str, Run], int], None], in_order: bool = False
) -> dict[str, str]:
    """Train `runs` in a pool, parents before what depends on them, the longest first.

    A worker that dies fails its own run only, and is replaced. On Ctrl-C every worker abandons its iteration and the
    runs stay resumable.

    Args:
        on_change: called about once a second with the runs in progress, by id, and the number of those that ended.
        in_order: as they are given instead, as far as parents allow.

    Where the disk is full nothing more is started: what is left keeps the state that its folder says.

    Returns:
        Run id -> final state.
    """
    context = multiprocessing.get_context("spawn")
    chosen = {run.run_id for run in runs}
    queue = queue_of(runs, in_order)
    states: dict[str, str] = {}
    pool: list[Worker] = []

    def start() -> Worker:
        ours, theirs = context.Pipe()
        process = context.Process(target=_work, args=(theirs,), daemon=True)
        process.start()
        theirs.close()
        return Worker(process, ours)

    def next_run() -> Run | None:
        """The first run whose parent is not still being trained; those whose parent failed fail with it."""
        for run in list(queue):
            before = [a.run_id for a in run.ancestors if a.run_id in chosen]
            if all(i in states for i in before):
                queue.remove(run)
                if all(states[i] in ("finished", "running") for i in before):
                    return run
                states[run.run_id] = "failed"
        return None

    def give_all() -> None:
        """Hand every idle worker a run, and start workers while there are runs and room for them."""
        for worker in pool:
            if worker.run is None and (run := next_run()) is not None:
                give(worker, run)
        while len(pool) < workers and (run := next_run()) is not None:
            pool.append(start())
            give(pool[-1], run)

    def give(worker: Worker, run: Run) -> None:
        worker.run = run
        worker.connection.send((run.to_yaml(), str(run.runs_dir)))

    try:
        give_all()
        while busy := [worker for worker in pool if worker.run is not None]:
            ready = wait([worker.connection for worker in busy], timeout=POLL_SECONDS)
            for worker in busy:
                if worker.connection not in ready:
                    continue
                assert worker.run is not None
                run, worker.run = worker.run, None
                try:
                    states[run.run_id], message = worker.connection.recv()
                    if message:
                        print(f"error: {run.run_id} cannot start: {run.folder} {message}", file=sys.stderr)
                except (EOFError, ConnectionResetError):
                    worker.process.join()
                    states[run.run_id] = "lost"
                    mark_lost(run, f"its process ended: {cause(worker.process.exitcode)}")
                    pool.remove(worker)
            if queue and any(states.get(i) in ("failed", "lost") for i in chosen) and is_full(runs[0].runs_dir):
                print(
                    f"error: no space left on the disk of {runs[0].runs_dir}: {len(queue)} runs are not started; free "
                    "some, then the same command goes on",
                    file=sys.stderr,
                )
                states |= {run.run_id: read_status(run.folder)["state"] for run in queue}
                queue.clear()
            give_all()
            on_change({w.run.run_id: w.run for w in pool if w.run is not None}, len(states))
    finally:
        for worker in pool:
            worker.connection.close()
            if worker.run is not None:
                worker.process.terminate()
        deadline = time.monotonic() + 30
        for worker in pool:
            worker.process.join(max(0.0, deadline - time.monotonic()))
            if worker.process.is_alive():
                print(f"worker {worker.process.pid} did not stop; killing it", file=sys.stderr)
                worker.process.kill()
    return states
