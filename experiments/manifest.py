"""manifest.json of a run: the code, versions, machine and command that it comes from."""

import contextlib
import json
import platform
import shlex
import subprocess
import sys
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from experiments.choices import ROOT
from experiments.config import Run
from experiments.status import read_status
from hippo.core.files import DamagedFile, read_json, set_aside
from hippo.core.settings import ConfigError

UNKNOWN = "unknown"
CODE_SUFFIXES = (".py", ".yaml", ".xml", ".toml", ".lock")  # of files that git does not track yet
# What may differ between the stretches of a run that was interrupted.
OF_A_STRETCH = ("git_commit", "git_difference", "lock", "python", "versions", "cpu", "cpu_flags", "cpu_capability")
SCHEMA: dict[str, type | tuple[type, ...]] = {"git_commit": (str, type(None)), "run_id": str, "identity": dict}


def git(*arguments: str) -> str | None:
    """Output of a git command in this repository; None where git is not installed or cannot say.

    A folder of another owner is read, too: we run the code that lies in it anyway.
    """
    command = ["git", "-c", f"safe.directory={ROOT}", "-C", str(ROOT), *arguments]
    try:
        result = subprocess.run(command, capture_output=True, text=True, errors="surrogateescape", check=False)
    except OSError:
        return None
    return result.stdout.strip() if result.returncode == 0 else None


def code_version() -> dict[str, str | None]:
    """The commit and a digest of what differs from it, new code included; of a copy, what was noted when it was made.

    Where git cannot say, both are UNKNOWN: what is not known does not count as clean.
    """
    if (ROOT / "snapshot.json").exists():
        return read_json(ROOT / "snapshot.json", {"git_commit": (str, type(None))})
    where = (git("rev-parse", "--show-toplevel", "HEAD") or "").splitlines()
    difference, new = git("diff", "HEAD"), git("ls-files", "--others", "--exclude-standard", "-z")
    if len(where) != 2 or Path(where[0]).resolve() != ROOT.resolve() or difference is None or new is None:
        return {"git_commit": UNKNOWN, "git_difference": UNKNOWN}
    digest = sha256(difference.encode(errors="surrogateescape"))
    files = [ROOT / name for name in sorted(new.split("\0")) if name.endswith(CODE_SUFFIXES)]
    for path in files:
        with contextlib.suppress(OSError):
            digest.update(bytes(path.relative_to(ROOT)) + b"\0" + path.read_bytes())
    return {"git_commit": where[1], "git_difference": digest.hexdigest() if difference or files else None}


def manifest(run: Run) -> dict[str, Any]:
    """Where a run comes from: code, versions, machine, command. Holds no host name, user or environment."""
    lock = ROOT / "requirements.lock"
    cpu = dict(line.split("\t", 1) for line in Path("/proc/cpuinfo").read_text().splitlines() if "\t" in line)
    return {
        "schema": 1,
        "run_id": run.run_id,
        "parent": None if run.parent is None else run.parent.run_id,
        "identity": run.identity,
        "config": run.to_yaml(),
        "command": shlex.join(["python", *sys.orig_argv[1:]]),
        **code_version(),
        "lock": sha256(lock.read_bytes()).hexdigest() if lock.exists() else None,
        "python": platform.python_version(),
        "versions": {name: version(name) for name in ("torch", "mujoco", "gymnasium", "numpy", "scipy")},
        "cpu": cpu.get("model name", platform.processor()).strip("\t: "),
        "cpu_flags": cpu.get("flags", "").strip("\t: "),
        "cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "seed": {"root": run.seed, "streams": "SHA-256 of the purpose, then indices; see hippo/core/seeding.py"},
    }


def manifest_with_history(run: Run) -> dict[str, Any]:
    """The manifest; of a resumed run, with a record of each earlier stretch, and a word about what has changed since.

    A manifest that cannot be read is set aside; what it said is then unknown.
    """
    content, path = manifest(run), run.folder / "manifest.json"
    if not (run.folder / "checkpoint.pt").exists():
        return content | {"from_iteration": 0, "earlier": []}
    before: dict[str, Any] = {}
    try:
        before = read_json(path, SCHEMA)
    except FileNotFoundError:
        pass
    except DamagedFile as error:
        set_aside(path, str(error).removeprefix(f"{path}: "))
    last = {key: before.get(key, UNKNOWN) for key in ("from_iteration", *OF_A_STRETCH)}
    changes = differences(last, content)
    print(f"resuming {run.run_id}", flush=True)
    if changes:
        print(
            f"warning: {run.run_id} goes on under other conditions, so its bytes may differ from those of a run "
            f"without a break: {'; '.join(changes)}",
            file=sys.stderr,
            flush=True,
        )
    elif before and UNKNOWN not in last["git_commit"]:  # the same stretch goes on
        return content | {"from_iteration": last["from_iteration"], "earlier": earlier_of(before)}
    start = read_status(run.folder)["iteration"] + 1
    return content | {"from_iteration": start, "earlier": [*earlier_of(before), last]}


def earlier_of(content: dict[str, Any]) -> list[dict[str, Any]]:
    """The records of a run's earlier stretches; older manifests kept their commits only."""
    return content.get("earlier", [{"git_commit": commit} for commit in content.get("earlier_commits", [])])


def differences(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """What decides the bytes of a run and differs between two of its stretches, in words; unknown is a difference."""
    words = []
    for key in OF_A_STRETCH:
        old, new = before.get(key) or None, now.get(key) or None
        if isinstance(old, dict) and isinstance(new, dict):
            words += [f"{name} {old.get(name)} before, {new[name]} now" for name in new if old.get(name) != new[name]]
        elif old != new and key in ("git_difference", "lock", "cpu_flags"):  # digests and lists say nothing
            words.append({"git_difference": "other uncommitted changes", "lock": "another lock file"}.get(key, key))
        elif old != new or (key == "git_commit" and new == UNKNOWN):
            words.append(f"{key.removeprefix('git_')} {str(old)[:40]} before, {str(new)[:40]} now")
    return words


def from_manifest(path: Path, runs_dir: Path) -> Run:
    """The run that a manifest describes, to be trained in `runs_dir`.

    Raises:
        ConfigError: there is no such manifest, or this code and these versions would give the run another id.
    """
    try:
        content = read_json(path, SCHEMA | {"config": str})
        run = Run.from_yaml(content["config"], runs_dir)
    except (OSError, ValueError) as error:
        raise ConfigError("from-manifest", path, f"must be a run's manifest.json ({error})") from error
    if run.run_id != content["run_id"]:
        raise ConfigError(
            "from-manifest",
            path,
            f"is run {content['run_id']}, here it would be {run.run_id}: {changed_identity(content['identity'], run)}",
        )
    return run


def changed_identity(theirs: dict[str, Any], run: Run) -> str:
    """What makes `run` another than the one of the identity `theirs`, in words."""
    ours = json.loads(json.dumps(run.identity))
    changed = sorted(key for key in theirs.keys() | ours.keys() if theirs.get(key) != ours.get(key))
    return ", ".join(f"{key}: {theirs.get(key)} there, {ours.get(key)} here" for key in changed)


def stated(folder: Path) -> dict[str, Any]:
    """The manifest of a run folder, {} where it has none that can be read."""
    try:
        return read_json(folder / "manifest.json", SCHEMA)
    except (DamagedFile, OSError):
        return {}
