"""status.json of a run: how it is doing, in a file that cannot lie for long."""

import contextlib
import errno
import functools
import json
import math
import multiprocessing
import os
import shutil
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
from hippo.core.files import DamagedFile, check_object, read_json, sync_folder, write_synced
from hippo.core.results import damage

HEARTBEAT_SECONDS = 5.0
LOST_AFTER_SECONDS = 6 * HEARTBEAT_SECONDS
TAKE_OVER_SECONDS = 20 * LOST_AFTER_SECONDS  # of silence, after which a soft lock counts for nothing
ABANDONED_SECONDS = 60.0  # after which a temporary file of a process that is not here counts as left behind
DONE = ("finished", "committed")
SOFT_LOCKS = "HIPPO_SOFT_LOCKS"  # environment variable
STATES = ("running", "finished", "preempted", "failed", "diverged", "lost")
NUMBER = (float, type(None))
SCHEMA: dict[str, type | tuple[type, ...]] = {"state": str}
# What else a status may say, and must say in these types.
OPTIONAL: dict[str, type | tuple[type, ...]] = {
    **dict.fromkeys(("iteration", "iterations", "env_steps", "attempts", "pid"), int),
    **dict.fromkeys(("heartbeat", "started"), float),
    **dict.fromkeys(("steps_per_second", "eta", "return_mean"), NUMBER),
    **dict.fromkeys(("message", "host", "cause"), str),
    "results": dict,
}
SILENT = "holds its lock and has been silent: stopped?"  # said of a process whose heartbeat stopped
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
    soft = path.with_name(f"{path.name}.soft")
    if os.environ.get(SOFT_LOCKS) == "1":
        lock: Any = SoftFileLock(soft, timeout=timeout)
        if abandoned(soft):
            print(f"warning: {soft}: its owner has been silent for too long; taken over", file=sys.stderr, flush=True)
            soft.unlink(missing_ok=True)
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


def abandoned(soft: Path) -> bool:
    """Whether the owner of a run's soft lock is gone: its heartbeat, and that of the lock, stopped long ago."""
    return (
        soft.is_file()
        and (soft.parent / "status.json").exists()
        and min(silence(soft), silence(soft.parent / "status.json")) > TAKE_OVER_SECONDS
    )


def is_locked(folder: Path) -> bool:
    """Whether somebody holds the lock of a run's folder, of either kind; nothing is made or taken over."""
    lock, soft = folder / ".lock", folder / ".lock.soft"
    if soft.is_file() and not abandoned(soft):
        return True
    try:
        with FileLock(lock, timeout=0, fallback_to_soft=False) if lock.is_file() else contextlib.nullcontext():
            return False
    except Timeout:
        return True
    except OSError:
        return False


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
        """Change some entries and write the file; what does not change the state need not survive a power cut."""
        with self.lock:
            self.content |= {**changes, "heartbeat": time.time()}
            write_atomically(self.path, json.dumps(self.content, indent=1), synced="state" in changes)

    def end(self, state: str, message: str = "", **changes: Any) -> None:
        """The last word about the run; where even that cannot be written, the silence will read as "lost"."""
        try:
            self.update(state=state, message=message, **changes)
        except OSError as error:
            with contextlib.suppress(OSError), self.path.open("r+") as file:  # a full disk has room for the old file
                file.write(json.dumps(self.content))
                file.truncate()
                return
            print(f"warning: {self.path} not written: {error}", file=sys.stderr, flush=True)

    @contextlib.contextmanager
    def heartbeat(self) -> Iterator[None]:
        """Keep the file fresh from a thread; a sweep's worker also ends itself when the sweep is gone."""
        stop, sweep = threading.Event(), multiprocessing.parent_process()

        def beat() -> None:
            while not stop.wait(HEARTBEAT_SECONDS):
                if self._taken_over():
                    os.kill(os.getpid(), signal.SIGTERM)
                    return
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

    def _taken_over(self) -> bool:
        """Whether another process, to which we looked gone, has taken our soft lock over."""
        if os.environ.get(SOFT_LOCKS) != "1":
            return False
        written = read_status(self.path.parent)
        owner = (self.content["host"], self.content["pid"])
        return "pid" in written and (written.get("host"), written["pid"]) != owner


def write_atomically(path: Path, text: str, synced: bool = True) -> None:
    """Replace `path` so that a reader sees the old or the new text, never a part, after a power cut neither."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")  # two sweeps may write the same plan
    try:
        if synced:
            write_synced(temporary, text.encode())
        else:
            temporary.write_text(text)
        temporary.replace(path)
        if synced:
            sync_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def remove_abandoned(folder: Path, older_than: float = 0.0) -> None:
    """Delete what a process that was killed while it wrote left in `folder`, its files and folders <name>.<pid>.tmp.

    Args:
        older_than: seconds; where processes of other hosts write, too, whose ids say nothing here.
    """
    for path in folder.glob("*.tmp"):
        pid = path.suffixes[-2][1:] if len(path.suffixes) > 1 else ""
        if pid.isdigit() and not Path(f"/proc/{pid}").exists() and silence(path) >= older_than:
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


def read_status(folder: Path) -> dict[str, Any]:
    """A run's status.

    State "missing" where it never started; "lost" where nobody holds its lock and its heartbeat stopped, status.json is
    damaged, or the results of a finished run are no longer what it wrote.
    """
    path = folder / "status.json"
    try:
        status = read_json(path, SCHEMA)
        for key, kinds in OPTIONAL.items():
            if key in status:
                check_object(path, status, {key: kinds})
        if status["state"] not in STATES:
            raise DamagedFile(f"{path}: state {status['state']!r:.60} is none of {', '.join(STATES)}")
    except (FileNotFoundError, NotADirectoryError):
        return {"state": "missing", "iteration": -1, "message": ""}
    except (DamagedFile, OSError):  # a power cut; the checkpoint has its own digest
        return {"iteration": -1, **_lost(folder, "status.json is damaged")}
    defaults: dict[str, Any] = {"iteration": -1, "message": ""}
    status = defaults | status
    if status["state"] == "running" and silence(path) > LOST_AFTER_SECONDS:
        status |= _lost(folder, status["message"] or "its heartbeat stopped")
    if status["state"] == "finished" and (wrong := damage(folder, status.get("iterations", 0), status.get("results"))):
        status |= _lost(folder, f"{wrong}; the same command trains what is missing")
    return status


def _lost(folder: Path, message: str) -> dict[str, str]:
    """State and message of a run that looks lost: while its lock is held it is not."""
    return {"state": "running", "message": SILENT} if is_locked(folder) else {"state": "lost", "message": message}


def silence(path: Path) -> float:
    """Seconds since a file was written, by the clock of its file system: that of a host may be wrong."""
    try:
        return time.time() + _clock_ahead(path.parent.parent) - path.stat().st_mtime
    except OSError:
        return math.inf


@functools.cache
def _clock_ahead(folder: Path) -> float:
    """Seconds by which the clock of a folder's file system is ahead of this host's; 0 where nothing can be written."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"now")
            file.flush()
            ahead = os.fstat(file.fileno()).st_mtime - time.time()
    except OSError:
        return 0.0
    return ahead if abs(ahead) > HEARTBEAT_SECONDS else 0.0


def is_there(run: Run, fresh: bool = False) -> bool:
    """Whether what dependents need of `run` exists: its finished folder or, unless `fresh`, committed skills."""
    return read_status(run.folder)["state"] == "finished" or (not fresh and committed_skills(run) is not None)


def mark_lost(run: Run, message: str) -> None:
    """Say in its status.json that the process that trained `run` is gone, unless another has taken the run over."""
    _mark(run, "lost", message)


def mark_failed(run: Run, message: str) -> None:
    """Say in its status.json why `run` did not even start."""
    _mark(run, "failed", message)


def _mark(run: Run, state: str, message: str) -> None:
    with contextlib.suppress(Timeout, OSError), locked(run.folder / ".lock"):
        status = read_status(run.folder)
        if status["state"] not in ("finished", "diverged"):
            write_atomically(run.folder / "status.json", json.dumps(status | {"state": state, "message": message}))
