"""Checkpoints that survive a kill at any moment: tensors only, written atomically, verified by digest when read.

File format: the 8 bytes of MAGIC, the SHA-256 of the rest (32 bytes), then what `torch.save` wrote. Reading uses
`weights_only=True`, so a checkpoint cannot run code; the digest catches the bit flips that torch would load silently.
"""

import hashlib
import io
import pickle
import sys
from pathlib import Path
from typing import Any

import torch

from hippo.core.files import sync_folder, write_synced
from hippo.core.log import RunLog

MAGIC = b"HIPPO\x00\x01\n"
DIGEST_BYTES = 32


class CheckpointError(RuntimeError):
    """A checkpoint is damaged or is no checkpoint."""


def save(path: Path, state: dict[str, Any], previous: Path | None = None) -> None:
    """Write `state` (nested dicts, lists, tensors, numbers, strings) to `path` so that it is either old or new, whole.

    Args:
        previous: where the file that `path` held before is kept.

    Raises:
        OSError: the disk is full or not writable; `path` is then what it was and no temporary file is left.
    """
    buffer = io.BytesIO()
    torch.save(state, buffer)
    payload = buffer.getvalue()
    temporary = path.with_name(path.name + ".tmp")  # what a kill leaves behind the next save overwrites
    try:
        write_synced(temporary, MAGIC + hashlib.sha256(payload).digest() + payload)
        if previous is not None and path.exists():
            path.replace(previous)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    sync_folder(path.parent)


def load(path: Path) -> dict[str, Any]:
    """Read what `save` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        CheckpointError: the file is not a checkpoint, is truncated or has been altered, or holds more than data.
    """
    data = path.read_bytes()
    start = len(MAGIC) + DIGEST_BYTES
    if len(data) < start or not data.startswith(MAGIC):
        raise CheckpointError(f"{path}: not a checkpoint of this project, or cut short")
    payload = data[start:]
    if hashlib.sha256(payload).digest() != data[len(MAGIC) : start]:
        raise CheckpointError(f"{path}: the content does not match its digest; the file is damaged")
    try:
        content = torch.load(io.BytesIO(payload), weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, ValueError, EOFError, KeyError, AttributeError) as error:
        raise CheckpointError(f"{path}: is no checkpoint ({' '.join(str(error).split())[:100]})") from None
    if not isinstance(content, dict):
        raise CheckpointError(f"{path}: is no checkpoint (it holds a {type(content).__name__})")
    return _interned(content)


def _interned(content: Any) -> Any:
    """The same with the keys that the code itself uses: of equal strings pickle writes what is one object once, so that
    an optimiser's loaded state beside a new one's would be saved as other bytes than two new ones'.
    """
    if type(content) is dict:
        return {sys.intern(key) if type(key) is str else key: _interned(value) for key, value in content.items()}
    return [_interned(value) for value in content] if type(content) is list else content


class Checkpoint:
    """The two newest checkpoints of one run, `checkpoint.pt` and `checkpoint.prev.pt`, in its folder.

    Args:
        run_id: whose they are, noted in every checkpoint that is saved; one of another run is refused. "" asks nothing.
        log: the run's log, whose digest is noted too; a checkpoint whose rows are not in it is not gone on from.
    """

    def __init__(self, folder: Path, run_id: str = "", log: RunLog | None = None) -> None:
        self.current = Path(folder) / "checkpoint.pt"
        self.previous = Path(folder) / "checkpoint.prev.pt"
        self.run_id, self.log = run_id, log

    def save(self, state: dict[str, Any]) -> None:
        """Make `state` the newest checkpoint and keep the one before it."""
        save(self.current, state, self.previous)

    def load(self) -> dict[str, Any] | None:
        """The newest intact checkpoint that the log covers, None where there is none; those passed over are named.

        Raises:
            CheckpointError: checkpoints exist and none of them is intact, or one is of another run.
        """
        found = [path for path in (self.current, self.previous) if path.exists()]
        intact = False
        for path in found:
            try:
                state = load(path)
            except CheckpointError as error:
                _warn(f"{error}; trying the checkpoint before it")
                continue
            intact = True
            if self.run_id and state.get("run_id", self.run_id) != self.run_id:
                raise CheckpointError(
                    f"{path}: is of run {state['run_id']}, not of {self.run_id}; delete or replace it"
                )
            if self.log is None or self.log.covers(state.get("iteration"), state.get("log")):
                return state
            _warn(f"{path}: {self.log.path} does not hold the rows up to its iteration {state.get('iteration')}")
        if found and not intact:
            raise CheckpointError(f"{self.current.parent}: no intact checkpoint; delete the folder to start again")
        if found:
            _warn(f"{self.current.parent}: training starts again at iteration 0")
        return None

    def record(self, iteration: int, **parts: Any) -> None:
        """Save the `state_dict` of every part (network, optimiser) as of the end of `iteration`."""
        state: dict[str, Any] = {"iteration": iteration}
        if self.run_id:
            state["run_id"] = self.run_id
        if self.log is not None:
            state["log"] = self.log.digest
        self.save(state | {name: part.state_dict() for name, part in parts.items()})

    def restore(self, **parts: Any) -> int:
        """Load what `record` saved into `parts`; returns the iteration to go on with, 0 for a fresh start.

        Raises:
            CheckpointError: the checkpoint is of another run, or of other networks or settings than `parts`.
        """
        state = self.load()
        if state is None:
            return 0
        for name, part in parts.items():
            try:
                part.load_state_dict(state[name])
            except (KeyError, IndexError, AttributeError, TypeError, RuntimeError, ValueError) as error:
                what = " ".join(str(error).split())[:200]
                raise CheckpointError(f"{self.current}: not of this run's settings: {name}: {what}") from error
        if not isinstance(state.get("iteration"), int):
            raise CheckpointError(f"{self.current}: does not say its iteration")
        return state["iteration"] + 1


def _warn(message: str) -> None:
    print(f"warning: {message}", file=sys.stderr, flush=True)
