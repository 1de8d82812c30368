"""A one-way mirror of a run to Weights & Biases, in a process of its own: it may hang or fail, training goes on.

    with mirrored(folder, mode="offline", project="hippo"):
        ...  # train; progress.csv and status.json in `folder` are all that the mirror reads

progress.csv stays the truth. A row is mirrored once a checkpoint covers it, that is when a later row or the run's end
has been seen, so wandb never holds a row that a resumed run drops. Every resume mirrors into the wandb run of the same
id: online it goes on after the last row there, offline each session leaves a log of its own, whose union by step is
progress.csv (`wandb sync --id`, in order of their start). The key comes from the environment or netrc, which only
wandb reads.
"""

import contextlib
import csv
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

POLL_SECONDS = 1.0
LOG = Path("wandb") / "mirror.log"  # in the run's folder
WAIT_SECONDS = 30.0  # at a run's end for the mirror to catch up


def start_mirror(folder: Path, mode: str, project: str) -> subprocess.Popen:
    """A process that mirrors the run in `folder`, and ends when it has mirrored the end; what it says goes to LOG."""
    (folder / LOG).parent.mkdir(exist_ok=True)
    with (folder / LOG).open("a") as log:
        command = [sys.executable, "-m", "hippo.core.mirror", str(folder), mode, project]
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)


@contextlib.contextmanager
def mirrored(folder: Path, mode: str, project: str) -> Iterator[None]:
    """Mirror the run in `folder` while the block runs; `mode` is disabled, offline or online.

    What goes wrong with the mirror is one line on stderr at the end, never an exception and never a long wait.
    """
    if mode == "disabled":
        yield
        return
    process = start_mirror(folder, mode, project)
    try:
        yield
    finally:
        try:
            problem = f"ended with exit code {code}" if (code := process.wait(WAIT_SECONDS)) else ""
        except subprocess.TimeoutExpired:
            process.kill()
            problem = f"did not finish within {WAIT_SECONDS:.0f} s and was stopped"
        if problem:
            print(
                f"warning: the wandb mirror {problem}; progress.csv is complete (log: {folder / LOG})",
                file=sys.stderr,
                flush=True,
            )


def covered_rows(folder: Path) -> tuple[list[dict[str, str]], bool]:
    """Rows of progress.csv that a checkpoint covers, and whether the run has ended."""
    state = json.loads((folder / "status.json").read_text())["state"]  # before the rows: an end covers them all
    path = folder / "progress.csv"
    if not path.exists():
        return [], state != "running"
    text = path.read_text()
    rows = list(csv.DictReader(text[: text.rfind("\n") + 1].splitlines()))
    return rows if state in ("finished", "diverged") else rows[:-1], state != "running"


def labels(folder: Path) -> tuple[str, list[str]]:
    """How wandb finds the run in `folder`: the group of those that differ in their seed only, and its tags.

    The figures are those whose plans, written beside the run by sweeps, name it.
    """
    manifest = json.loads((folder / "manifest.json").read_text())
    identity, run = manifest["identity"], yaml.safe_load(manifest["config"])
    of_all_seeds = json.dumps({key: value for key, value in identity.items() if key != "seed"}, sort_keys=True)
    group = f"{identity['env']} {identity['algo']} {hashlib.sha256(of_all_seeds.encode()).hexdigest()[:8]}"
    tags = [f"{key}:{identity[key]}" for key in ("env", "algo", "seed")]
    tags += [f"scale:{run['scale']}", f"protocol:{run.get('protocol', 'paper')}"]  # older runs do not say
    plans = (json.loads(path.read_text()) for path in (folder.parent / "plans").glob("*/*.json"))
    figures = {plan["figure"] for plan in plans if manifest["run_id"] in (run["run_id"] for run in plan["runs"])}
    return group, [*tags, *(f"figure:{figure}" for figure in sorted(figures))]


def start(folder: Path, mode: Any, project: str) -> Any:
    """The wandb run with this run's id; nothing of the machine, the code or the console is sent along."""
    import wandb

    manifest = json.loads((folder / "manifest.json").read_text())
    identity = manifest["identity"]
    group, tags = labels(folder)
    settings = wandb.Settings(
        console="off",
        disable_code=True,
        disable_git=True,
        disable_job_creation=True,
        save_code=False,
        x_disable_meta=True,
        x_disable_stats=True,
        x_disable_machine_info=True,
    )
    return wandb.init(
        project=project,
        id=manifest["run_id"],
        name=f"{identity['env']} {identity['algo']} seed {identity['seed']}",
        group=group,
        tags=tags,
        config=identity,
        dir=folder,
        mode=mode,
        resume="allow",
        settings=settings,
    )


def mirror(folder: Path, mode: str, project: str) -> None:
    """Follow the run in `folder` until it ends, at once if it has, or the process that trains it is gone."""
    trainer, run = os.getppid(), start(folder, mode, project)
    mirrored_steps = run.step  # 0, or what an online run of this id already holds
    ended = False
    while not ended:
        orphan = os.getppid() != trainer
        rows, ended = covered_rows(folder)
        for row in rows[mirrored_steps:]:
            run.log({name: float(value) for name, value in row.items()}, step=int(row["iteration"]))
        mirrored_steps = max(mirrored_steps, len(rows))
        ended = ended or orphan
        if not ended:
            time.sleep(POLL_SECONDS)
    run.finish()


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run's status says when to end
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    mirror(Path(sys.argv[1]), sys.argv[2], sys.argv[3])
