"""The code that a job runs: a copy named by its digest, made once and checked before it is used."""

import hashlib
import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from experiments.choices import ROOT
from experiments.manifest import code_version, git
from hippo.core.settings import ConfigError

# What a job runs; a snapshot never holds runs, data, environments or earlier snapshots.
CODE = (
    "hippo",
    "baselines",
    "experiments",
    "analysis",
    "paper_figures/*.py",
    "paper_figures/data/skills",
    "*.toml",
    "*.lock",
)
CODE_SUFFIXES = (".py", ".yaml", ".xml", ".json", ".pt", ".toml", ".lock", ".typed")
MOST_CODE = 50_000_000  # bytes of a snapshot


def code_files() -> list[Path]:
    """The files that a job runs: of CODE, those that git tracks or would, or all where git cannot say."""
    known = git("ls-files", "--cached", "--others", "--exclude-standard", "-z")
    names = None if known is None else {ROOT / name for name in known.split("\0")}
    found = [
        path
        for pattern in CODE
        for place in ROOT.glob(pattern)
        for path in ([place] if place.is_file() else place.rglob("*"))
        if path.is_file() and path.suffix in CODE_SUFFIXES and (names is None or path in names)
    ]
    return sorted(set(found))


def digest_of(files: Sequence[Path], root: Path) -> str:
    """The digest that a snapshot is named by, of the names under `root` and the contents of files."""
    digest = hashlib.sha256()
    for path in files:
        digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


def snapshot(folder: Path) -> Path:
    """A copy of the code as it is now, which queued jobs run whatever happens to the working tree meanwhile.

    One that is there already is taken only if it is what its name says.

    Raises:
        ConfigError: it is not, or the code is too large to be code.
    """
    files = code_files()
    size = sum(path.stat().st_size for path in files)
    if size > MOST_CODE:
        largest = max(files, key=lambda path: path.stat().st_size)
        valid = f"at most {MOST_CODE:,} bytes of code are copied for jobs; the largest is {largest.relative_to(ROOT)}"
        raise ConfigError("code", f"{size:,} bytes", valid)
    digest = digest_of(files, ROOT)
    target = folder / f"code-{digest}"
    if target.exists():
        check_snapshot(target, digest)
        return target
    temporary = folder / f"{target.name}.{os.getpid()}.tmp"
    shutil.rmtree(temporary, ignore_errors=True)
    compiled = ROOT.glob("hippo/**/__pycache__/*.nb?")  # numba's kernels: 15 seconds that no job need spend
    for path in [*files, *compiled]:
        copy = temporary / path.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, copy)  # with its time: a kernel is as good as new while its source's is the same
    (temporary / "snapshot.json").write_text(json.dumps(code_version()))
    temporary.rename(target)
    return target


def check_snapshot(target: Path, digest: str) -> None:
    """Raise ConfigError unless a snapshot holds the code that its name says, and nothing else but compiled kernels.

    Bytecode is not trusted: it is deleted, and made again by the next job.
    """
    there = sorted(path for path in target.rglob("*") if not path.is_dir() or path.is_symlink())
    for path in [path for path in there if path.suffix == ".pyc"]:
        path.unlink(missing_ok=True)
    files = [path for path in there if "__pycache__" not in path.parts and path != target / "snapshot.json"]
    if any(path.is_symlink() for path in there) or digest_of(files, target) != digest:
        raise ConfigError("snapshot", target, "is not the code that its name says; delete it")
    for path in there:
        if path.suffix in (".nbi", ".nbc"):
            ours = ROOT / path.relative_to(target)
            if not ours.exists() or ours.read_bytes() != path.read_bytes():
                path.unlink(missing_ok=True)
