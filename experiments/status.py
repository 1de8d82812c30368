"""status.json of a run: how it is doing, in a file that cannot lie for long."""

import contextlib
import errno
import json
import multiprocessing
import os
import signal
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from filelock import FileLock, SoftFileLock, Timeout

from experiments.config import Run, committed_skills

HEARTBEAT_SECONDS = 5.0
LOST_AFTER_SECONDS = 6 * HEARTBEAT_SECONDS
DONE = ("finished", "committed")
SOFT_LOCKS = "HIPPO_SOFT_LOCKS"  # environment variable
NOT_SUPPORTED = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)  # flock's answers of a file system without locks


class NoLocks(OSError):
    """The folder's file system has no locks, so that two processes could train the same run."""

    def __init__(self, folder: Path, error: OSError) -> None:
        super().__init__(
            f"{folder}: its file system has no file locks ({error.strerror}); choose another with runs_dir=FOLDER "
            f"(--runs-dir FOLDER), or take the risk of {SOFT_LOCKS}=1 (docs/cluster.md)"
        )


@contextlib.contextmanager
def locked(path: Path, timeout: float = 0.0) -> Iterator[None]:
    """Hold the lock at `path`; with HIPPO_SOFT_LOCKS=1 one that stands for itself, as path.soft.

    Raises:
        Timeout: somebody else holds it for longer than `timeout` seconds (negative: for ever).
        NoLocks: the file system has none.
    """
    if os.environ.get(SOFT_LOCKS) == "1":
        lock: Any = SoftFileLock(path.with_name(f"{path.name}.soft"), timeout=timeout)
    else:
        lock = FileLock(path, timeout=timeout, fallback_to_soft=False)
    try:
        lock.acquire()
    except OSError as error:
        raise NoLocks(path.parent, error) if error.errno in NOT_SUPPORTED else error from None
    try:
        yield
    finally:
        lock.release()


def check_locks(folder: Path) -> None:
    """Raise NoLocks where runs in `folder` could not be locked."""
    with tempfile.TemporaryDirectory(dir=folder) as place, locked(Path(place) / ".lock"):
        pass


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
            "attempts": read_status(run.folder).get("attempts", 0) + 1,
            "host": socket.gethostname(),
            "pid": os.getpid(),
            "started": time.time(),
            "message": "",
        }
        self.stopped_by = ""  # the signal that ended the run

    def update(self, **changes: Any) -> None:
        """Change some entries and write the file."""
        with self.lock:
            self.content |= {**changes, "heartbeat": time.time()}
            write_atomically(self.path, json.dumps(self.content, indent=1))

    def end(self, state: str, message: str = "", **changes: Any) -> None:
        """The last word about the run; where even that cannot be written, the silence will read as "lost"."""
        try:
            self.update(state=state, message=message, **changes)
        except OSError as error:
            print(f"warning: {self.path} not written: {error}", file=sys.stderr, flush=True)

    @contextlib.contextmanager
    def heartbeat(self) -> Iterator[None]:
        """Keep the file fresh from a thread; a sweep's worker also ends itself when the sweep is gone."""
        stop, sweep = threading.Event(), multiprocessing.parent_process()

        def beat() -> None:
            while not stop.wait(HEARTBEAT_SECONDS):
                with contextlib.suppress(OSError):  # a full disk; training itself will say so where it matters
                    self.update()
                if sweep is not None and not sweep.is_alive():
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


def remove_abandoned(folder: Path) -> None:
    """Delete what a process that was killed in `write_atomically` left in `folder`."""
    for path in folder.glob("*.tmp"):
        pid = path.suffixes[-2][1:] if len(path.suffixes) > 1 else ""
        if pid.isdigit() and not Path(f"/proc/{pid}").exists():
            path.unlink(missing_ok=True)


def read_status(folder: Path) -> dict[str, Any]:
    """A run's status; state "missing" where it never started, "lost" where its heartbeat stopped or it is damaged."""
    try:
        status = json.loads((folder / "status.json").read_text())
    except FileNotFoundError:
        return {"state": "missing", "iteration": -1, "message": ""}
    except json.JSONDecodeError:  # a power cut; the checkpoint has its own digest
        return {"state": "lost", "iteration": -1, "message": "status.json is damaged"}
    if status["state"] == "running" and time.time() - status["heartbeat"] > LOST_AFTER_SECONDS:
        status |= {"state": "lost", "message": status.get("message") or "its heartbeat stopped"}
    return status


def is_there(run: Run, fresh: bool = False) -> bool:
    """Whether what dependents need of `run` exists: its finished folder or, unless `fresh`, committed skills."""
    return read_status(run.folder)["state"] == "finished" or (not fresh and committed_skills(run) is not None)


def mark_lost(run: Run, message: str) -> None:
    """Say in its status.json that the process that trained `run` is gone, unless another has taken the run over."""
    with contextlib.suppress(Timeout, NoLocks), locked(run.folder / ".lock"):
        status = read_status(run.folder)
        if status["state"] not in ("finished", "diverged"):
            write_atomically(run.folder / "status.json", json.dumps(status | {"state": "lost", "message": message}))
