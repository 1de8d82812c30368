"""The log of one run: progress.csv is the truth, timing.csv holds the clocks, everything else mirrors them.

progress.csv holds deterministic columns only, so two runs of the same configuration are compared with `cmp`. A row of
it is on the disk before the checkpoint of its iteration is written, and the checkpoint knows the digest of all rows.
"""

import csv
import hashlib
import io
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hippo.core.files import sync_folder, write_synced
from hippo.core.results import rows_of

DUMPED = 1000  # indices of bad entries kept in a dump
Row = Mapping[str, float | int]


class Diverged(RuntimeError):
    """Training produced a number that is not finite; the run stops with this one-line cause.

    `dump` says where: the iteration, the tensor's name and shape, and the indices of its first bad entries. With the
    checkpoint of the iteration before, which repeats it exactly, that is all a diagnosis needs.
    """

    def __init__(self, message: str, dump: dict[str, Any] | None = None) -> None:
        super().__init__(message)
        self.dump = dump or {}


def check_finite(iteration: int, **tensors: Tensor) -> None:
    """Raise Diverged naming the first of `tensors` that holds a NaN or an infinity."""
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            bad = (~torch.isfinite(tensor)).nonzero()
            dump = {"iteration": iteration, "name": name, "shape": list(tensor.shape), "indices": bad[:DUMPED]}
            raise Diverged(f"iteration {iteration}: {name} has {len(bad)} non-finite of {tensor.numel()} entries", dump)


class LogError(RuntimeError):
    """progress.csv does not hold what this run wrote into it."""


class RunLog:
    """Appends one row per iteration to progress.csv and timing.csv in `folder`.

    Args:
        folder: the run's folder; created if missing.
        on_row: called after every row with (metrics, timing), e.g. to update a status or print a line.
    """

    def __init__(self, folder: Path, on_row: Callable[[Row, Row], None] | None = None) -> None:
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.path = self.folder / "progress.csv"
        self.on_row = on_row
        self._written = hashlib.sha256(self.path.read_bytes() if self.path.is_file() else b"")

    @property
    def digest(self) -> str:
        """SHA-256 of progress.csv as this run wrote it."""
        return self._written.hexdigest()

    def covers(self, iteration: Any, digest: str | None) -> bool:
        """Whether progress.csv begins with rows 0 to `iteration`, with that digest where one is known."""
        rows = rows_of(self.path)
        if not isinstance(iteration, int) or len(rows) < iteration + 2:
            return False
        return digest is None or hashlib.sha256(b"".join(rows[: iteration + 2])).hexdigest() == digest

    def resume(self, iteration: int) -> None:
        """Drop the rows of `iteration` and later, and a torn last line: what a checkpoint does not cover is redone.

        Raises:
            LogError: rows before `iteration` are not there.
        """
        rows = rows_of(self.path) if iteration else []
        if len(rows) < iteration + 1 and iteration:
            raise LogError(f"{self.path}: holds {max(0, len(rows) - 1)} rows of the {iteration} that were written")
        kept = b"".join(rows[: iteration + 1])
        self._written = hashlib.sha256(kept)
        self._keep(self.path, kept)
        timing = self.folder / "timing.csv"
        if timing.is_file():  # clocks, of which a power cut may lose some
            lines = [line + b"\n" for line in timing.read_bytes().split(b"\n")[:-1]]
            head = [line for line in lines[:1] if line.startswith(b"iteration")]
            body = [line for line in lines[1:] if (i := line.split(b",", 1)[0]).isdigit() and int(i) < iteration]
            self._keep(timing, b"".join(head + body) if head and iteration else b"")

    def _keep(self, path: Path, content: bytes) -> None:
        """Leave `content` in a file, whose beginning it is as a rule, and no file for nothing."""
        if not path.exists():
            return
        if not content:
            path.unlink()
        elif (old := path.read_bytes()).startswith(content):
            if len(old) > len(content):
                os.truncate(path, len(content))
            return
        else:
            temporary = path.with_name(path.name + ".tmp")
            write_synced(temporary, content)
            temporary.replace(path)
        sync_folder(self.folder)

    def row(self, metrics: Row, timing: Row) -> None:
        """Record one iteration; `metrics` starts with the key "iteration" and has the same keys every time."""
        self._append(self.path, metrics)
        self._append(self.folder / "timing.csv", {"iteration": metrics["iteration"], **timing})
        if self.on_row is not None:
            self.on_row(metrics, timing)

    def _append(self, path: Path, row: Row) -> None:
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        new = not path.exists()
        if new:
            writer.writerow(row)
        writer.writerow(row.values())
        written = text.getvalue().encode()
        with path.open("ab") as file:
            file.write(written)
            if path == self.path:
                self._written.update(written)
                file.flush()
                os.fsync(file.fileno())
        if path == self.path and new:
            sync_folder(self.folder)

    def check_whole(self, rows: int) -> None:
        """Raise LogError unless progress.csv holds what was written, `rows` rows."""
        there = self.path.read_bytes() if self.path.is_file() else b""
        if len(rows_of(self.path)) != rows + 1 or hashlib.sha256(there).hexdigest() != self.digest:
            raise LogError(f"{self.path}: does not hold the {rows} rows that were written; somebody else changed it")
