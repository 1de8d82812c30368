"""Checkpoints that survive a kill at any moment: tensors only, written atomically, verified by digest when read.

File format: the 8 bytes of MAGIC, the SHA-256 of the rest (32 bytes), then what `torch.save` wrote. Reading uses
`weights_only=True`, so a checkpoint cannot run code; the digest catches the bit flips that torch would load silently.
"""

import hashlib
import io
import os
import sys
from pathlib import Path
from typing import Any

import torch

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
        with temporary.open("wb") as file:
            file.write(MAGIC + hashlib.sha256(payload).digest() + payload)
            file.flush()
            os.fsync(file.fileno())
        if previous is not None and path.exists():
            path.replace(previous)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def load(path: Path) -> dict[str, Any]:
    """Read what `save` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        CheckpointError: the file is not a checkpoint, is truncated or has been altered.
    """
    data = path.read_bytes()
    start = len(MAGIC) + DIGEST_BYTES
    if len(data) < start or not data.startswith(MAGIC):
        raise CheckpointError(f"{path}: not a checkpoint of this project, or cut short")
    payload = data[start:]
    if hashlib.sha256(payload).digest() != data[len(MAGIC) : start]:
        raise CheckpointError(f"{path}: the content does not match its digest; the file is damaged")
    return torch.load(io.BytesIO(payload), weights_only=True)


class Checkpoint:
    """The two newest checkpoints of one run, `checkpoint.pt` and `checkpoint.prev.pt`, in its folder."""

    def __init__(self, folder: Path) -> None:
        self.current = Path(folder) / "checkpoint.pt"
        self.previous = Path(folder) / "checkpoint.prev.pt"

    def save(self, state: dict[str, Any]) -> None:
        """Make `state` the newest checkpoint and keep the one before it."""
        save(self.current, state, self.previous)

    def load(self) -> dict[str, Any] | None:
        """The newest intact checkpoint, None where there is none; a damaged one is named on stderr.

        Raises:
            CheckpointError: checkpoints exist and none of them is intact.
        """
        found = [path for path in (self.current, self.previous) if path.exists()]
        for path in found:
            try:
                return load(path)
            except CheckpointError as error:
                print(f"warning: {error}; trying the checkpoint before it", file=sys.stderr, flush=True)
        if found:
            raise CheckpointError(f"{self.current.parent}: no intact checkpoint; delete the folder to start again")
        return None

    def record(self, iteration: int, **parts: Any) -> None:
        """Save the `state_dict` of every part (network, optimiser) as of the end of `iteration`."""
        self.save({"iteration": iteration, **{name: part.state_dict() for name, part in parts.items()}})

    def restore(self, **parts: Any) -> int:
        """Load what `record` saved into `parts`; returns the iteration to go on with, 0 for a fresh start.

        Raises:
            CheckpointError: the checkpoint is of other networks or settings than `parts`.
        """
        state = self.load()
        if state is None:
            return 0
        for name, part in parts.items():
            try:
                part.load_state_dict(state[name])
            except (KeyError, RuntimeError, ValueError) as error:
                what = " ".join(str(error).split())[:200]
                raise CheckpointError(f"{self.current}: not of this run's settings: {name}: {what}") from error
        return state["iteration"] + 1
