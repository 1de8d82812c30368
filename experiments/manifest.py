"""manifest.json of a run: the code, versions, machine and command that it comes from."""

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

from experiments.config import Run
from hippo.core.settings import ConfigError

ROOT = Path(__file__).parent.parent


def git(*arguments: str) -> str:
    """Output of a git command in this repository, "" outside one."""
    result = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=False)
    return result.stdout.strip()


def code_version() -> dict[str, str | None]:
    """The commit and a digest of what differs from it; of a copy of the code, what was noted when it was made."""
    if (ROOT / "snapshot.json").exists():
        return json.loads((ROOT / "snapshot.json").read_text())
    difference = git("diff", "HEAD")
    return {
        "git_commit": git("rev-parse", "HEAD"),
        "git_difference": sha256(difference.encode()).hexdigest() if difference else None,
    }


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
    """The manifest; of a resumed run, with the commits of its earlier sessions, and a word about it on stdout."""
    content, path = manifest(run), run.folder / "manifest.json"
    if not (run.folder / "checkpoint.pt").exists() or not path.exists():
        return content | {"earlier_commits": []}
    before = json.loads(path.read_text())
    old, new = before["git_commit"], content["git_commit"]
    where = "" if old == new else f" under commit {new[:10] or 'unknown'}, last under {old[:10] or 'unknown'}"
    print(f"resuming {run.run_id}{where}", flush=True)
    return content | {"earlier_commits": [*before.get("earlier_commits", []), old]}


def from_manifest(path: Path, runs_dir: Path) -> Run:
    """The run that a manifest describes, to be trained in `runs_dir`.

    Raises:
        ConfigError: there is no such manifest, or this code and these versions would give the run another id.
    """
    try:
        content = json.loads(path.read_text())
        run = Run.from_yaml(content["config"], runs_dir)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError("from-manifest", path, f"must be a run's manifest.json ({error})") from error
    if run.run_id != content["run_id"]:
        theirs, ours = content["identity"], json.loads(json.dumps(run.identity))
        changed = sorted(key for key in theirs.keys() | ours.keys() if theirs.get(key) != ours.get(key))
        differences = ", ".join(f"{key}: {theirs.get(key)} there, {ours.get(key)} here" for key in changed)
        raise ConfigError(
            "from-manifest", path, f"is run {content['run_id']}, here it would be {run.run_id}: {differences}"
        )
    return run
