"""The log of one run: progress.csv is the truth, timing.csv holds the clocks, everything else mirrors them.

progress.csv holds deterministic columns only, so two runs of the same configuration are compared with `cmp`.
"""

import csv
import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

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


class RunLog:
    """Appends one row per iteration to progress.csv and timing.csv in `folder`.

    Args:
        folder: the run's folder; created if missing.
        on_row: called after every row with (metrics, timing), e.g. to update a status or print a line.
    """

    def __init__(self, folder: Path, on_row: Callable[[Row, Row], None] | None = None) -> None:
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.on_row = on_row

    def resume(self, iteration: int) -> None:
        """Drop the rows of `iteration` and later, and a torn last line: what a checkpoint does not cover is redone."""
        for name in ("progress.csv", "timing.csv"):
            path = self.folder / name
            if not path.exists():
                continue
            lines = path.read_text().splitlines(keepends=True)
            complete = [line for line in lines if line.endswith("\n")]
            kept = complete[:1] + [line for line in complete[1:] if int(line.split(",", 1)[0]) < iteration]
            if iteration == 0 or not kept:
                path.unlink()
            elif kept != lines:
                temporary = path.with_name(name + ".tmp")
                temporary.write_text("".join(kept))
                temporary.replace(path)

    def row(self, metrics: Row, timing: Row) -> None:
        """Record one iteration; `metrics` starts with the key "iteration" and has the same keys every time."""
        self._append("progress.csv", metrics)
        self._append("timing.csv", {"iteration": metrics["iteration"], **timing})
        if self.on_row is not None:
            self.on_row(metrics, timing)

    def _append(self, name: str, row: Row) -> None:
        path = self.folder / name
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        if not path.exists():
            writer.writerow(row)
        writer.writerow(row.values())
        with path.open("a") as file:
            file.write(text.getvalue())
