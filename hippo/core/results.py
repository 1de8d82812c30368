"""Whether the result files of a run are still what it wrote; no torch, since drawing asks, too."""

import functools
import hashlib
from pathlib import Path
from typing import Any

RESULT_FILES = ("progress.csv", "episodes.csv", "skills.pt")  # of a run; each kind of run writes some of them


def rows_of(path: Path) -> list[bytes]:
    """The header and the leading rows 0, 1, ... of a log, as lines; what follows them, as a torn row, is left out.

    Line ends that an editor has changed to CRLF are read as what they were.
    """
    if not path.is_file():
        return []
    lines = path.read_bytes().replace(b"\r\n", b"\n").split(b"\n")[:-1]
    if not lines or lines[0].split(b",")[0] != b"iteration":
        return []
    cells = lines[0].count(b",")
    kept = lines[:1]
    for i, line in enumerate(lines[1:]):
        if line.split(b",", 1)[0] != str(i).encode() or line.count(b",") != cells:
            break
        kept.append(line)
    return [line + b"\n" for line in kept]


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of the result files that a finished run's folder holds, by name."""
    return {name: digest for name in RESULT_FILES if (digest := _digest(folder / name))}


def damage(folder: Path, iterations: int, stated: Any) -> str:
    """What is wrong with the result files of a finished run, in words, "" where nothing is.

    Args:
        stated: their `digests` as they were when it finished; None of a run by older code, of which only the rows of
            progress.csv are counted: `iterations` (0: any number), or the one of a measurement.
    """
    if isinstance(stated, dict):
        wrong = [name for name, digest in stated.items() if name in RESULT_FILES and _digest(folder / name) != digest]
        return f"{', '.join(wrong)}: not what the run wrote" if wrong else ""
    path = folder / "progress.csv"
    if not path.exists():
        return "" if (folder / "episodes.csv").exists() else "progress.csv is not there"
    rows = len(rows_of(path)) - 1
    lines = path.read_bytes().count(b"\n") - 1
    wanted = {iterations or rows, iterations if (folder / "checkpoint.pt").exists() else 1}
    return "" if rows == lines and rows in wanted else f"progress.csv holds {rows} rows of {iterations}"


def _digest(path: Path) -> str:
    """SHA-256 of a file, "" where there is none."""
    try:
        found = path.stat()
    except OSError:
        return ""
    return _digest_of(path, found.st_size, found.st_mtime_ns, found.st_ino)


@functools.cache  # whoever watches a sweep asks every second
def _digest_of(path: Path, *_as_it_is: int) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""
