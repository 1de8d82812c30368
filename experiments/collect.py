"""Finished runs of several machines together: `python -m experiments.sweep collect FOLDER ... [--runs-dir runs]`.

FOLDER is a runs folder, or the folder of one run. A run that both have counts once, if its results are the same bytes;
where they are not, the one that is here stays, and both are named: another processor, or another version of the code.
"""

import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from filelock import Timeout

from experiments.command_line import EXIT_FAILED
from experiments.status import locked, read_status, remove_abandoned
from hippo.core.files import DamagedFile, read_json
from hippo.core.results import digests
from hippo.core.settings import ConfigError

LEFT_BEHIND = (".lock", "*.soft", "*.tmp")
MANIFEST: dict[str, type | tuple[type, ...]] = {"run_id": str, "identity": dict}


def check(folders: Sequence[str]) -> None:
    """Raise ConfigError unless runs can be taken from `folders`."""
    if not folders:
        raise ConfigError("collect", "", "name the runs folders to take finished runs from")
    for folder in folders:
        if not Path(folder).is_dir():
            raise ConfigError("collect", folder, "must be a folder")
        if not runs_in(Path(folder)):
            raise ConfigError("collect", folder, "holds no run")


def runs_in(folder: Path) -> list[Path]:
    """The run folders in a runs folder, or itself."""
    if (folder / "status.json").is_file():
        return [folder]
    return sorted(path.parent for path in folder.glob("*/status.json") if not path.parent.is_symlink())


def collect(folders: Sequence[Path], runs_dir: Path) -> int:
    """Copy what is finished; exit code 1 if a run was refused."""
    counts = {"copied": 0, "here already": 0, "not finished": 0, "refused": 0}
    for source in (source for folder in folders for source in runs_in(folder)):
        try:
            counts[take(source, runs_dir)] += 1
        except (DamagedFile, OSError, Refused) as error:
            counts["refused"] += 1
            print(f"refused: {error}", file=sys.stderr)
    print(", ".join(f"{number} {what}" for what, number in counts.items()))
    return EXIT_FAILED if counts["refused"] else 0


class Refused(RuntimeError):
    """A run that is not taken; the message says which and why."""


def take(source: Path, runs_dir: Path) -> str:
    """Copy one run; what became of it, in words.

    Raises:
        Refused: its name is not its own, its results differ from those here, or it is being trained here.
    """
    status = read_status(source)
    if status["state"] != "finished":
        if read_json(source / "status.json", {}).get("state") == "finished":
            raise Refused(f"{source}: {status['message'].partition(';')[0]}")
        return "not finished"
    run_id = read_json(source / "manifest.json", MANIFEST)["run_id"]
    if not (run_id.isalnum() and run_id.isascii()):
        raise Refused(f"{source}: its manifest.json names no run")
    target = runs_dir / run_id
    if target.exists() and target.samefile(source):
        return "here already"
    if any(path.is_symlink() for path in source.rglob("*")):
        raise Refused(f"{source}: holds a link, which may lead anywhere")
    target.mkdir(parents=True, exist_ok=True)
    try:
        with locked(target / ".lock"):
            if read_status(target)["state"] == "finished":
                if differ := [name for name, digest in digests(source).items() if digests(target).get(name) != digest]:
                    raise Refused(f"{source}: {', '.join(differ)} differs from {target} ({trained_on(source, target)})")
                return "here already"
            remove_abandoned(target)
            copy(source, target)
    except Timeout:
        raise Refused(f"{source}: {target} is being trained; try again when it has ended") from None
    return "copied"


def copy(source: Path, target: Path) -> None:
    """Put a run's files into `target`, whose lock is held, status.json last: until then the run is not finished."""
    temporary = target / f"collected.{os.getpid()}.tmp"
    try:
        shutil.copytree(source, temporary, ignore=shutil.ignore_patterns(*LEFT_BEHIND))
        for path in sorted(temporary.iterdir(), key=lambda path: path.name == "status.json"):
            there = target / path.name
            if there.is_dir():
                shutil.rmtree(there)
            path.replace(there)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def trained_on(*folders: Path) -> str:
    """Processors and commits of runs, in words."""
    manifests = [read_json(folder / "manifest.json", {}) for folder in folders]
    there, here = (f"{m.get('cpu', 'unknown')}, commit {str(m.get('git_commit', 'unknown'))[:10]}" for m in manifests)
    return f"trained there on {there}; here on {here}"
