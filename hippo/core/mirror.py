"""One-way mirrors of a run, to Weights & Biases and to TensorBoard, each in a process of its own: it may hang or fail,
training goes on.

    with mirrored(folder, wandb=("offline", "project"), tensorboard=True):
        ...  # train; progress.csv and status.json in `folder` are all that a mirror reads

progress.csv stays the truth. A row is mirrored once a checkpoint covers it, that is when a later row or the run's end
has been seen, so no mirror ever holds a row that a resumed run drops. Every resume mirrors into the wandb run of the
same id: online it goes on after the last row there, offline each session leaves a log of its own, whose union by step
is progress.csv (`wandb sync --id`, in order of their start). The key comes from the environment or netrc, which only
wandb reads. For TensorBoard every session writes the run's one event file anew, from the first row on.
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
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import yaml

POLL_SECONDS = 1.0
FLUSH_SECONDS = 5  # that a row may wait before TensorBoard sees it
WAIT_SECONDS = 30.0  # at a run's end for its mirrors to catch up


def log_of(folder: Path, to: str) -> Path:
    """What a mirror of the run in `folder` says."""
    return folder / to / "mirror.log"


def start_mirror(folder: Path, to: str, *how: str) -> subprocess.Popen:
    """A process that mirrors the run in `folder`, and ends when it has mirrored the end.

    Args:
        to: wandb or tensorboard.
        how: of wandb its mode and project.
    """
    log_of(folder, to).parent.mkdir(exist_ok=True)
    with log_of(folder, to).open("a") as log:
        command = [sys.executable, "-m", "hippo.core.mirror", str(folder), to, *how]
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)


@contextlib.contextmanager
def mirrored(folder: Path, wandb: tuple[str, str], tensorboard: bool = False) -> Iterator[None]:
    """Mirror the run in `folder` while the block runs.

    What goes wrong with a mirror is one line on stderr at the end, never an exception and never a long wait.

    Args:
        wandb: its mode, disabled, offline or online, and its project.
    """
    wanted: dict[str, tuple[str, ...]] = {} if wandb[0] == "disabled" else {"wandb": wandb}
    wanted |= {"tensorboard": ()} if tensorboard else {}
    processes = {to: start_mirror(folder, to, *how) for to, how in wanted.items()}
    try:
        yield
    finally:
        deadline = time.monotonic() + WAIT_SECONDS
        for to, process in processes.items():
            try:
                code = process.wait(max(0.0, deadline - time.monotonic()))
                problem = f"ended with exit code {code}" if code else ""
            except subprocess.TimeoutExpired:
                process.kill()
                problem = f"did not finish within {WAIT_SECONDS:.0f} s and was stopped"
            if problem:
                print(
                    f"warning: the {to} mirror {problem}; progress.csv is complete (log: {log_of(folder, to)})",
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


def follow(folder: Path, done: int, write: Callable[[dict[str, float]], None]) -> None:
    """Hand every row from number `done` on to `write`, until the run in `folder` ends, at once if it has, or the
    process that trains it is gone.
    """
    trainer, ended = os.getppid(), False
    while not ended:
        orphan = os.getppid() != trainer
        rows, ended = covered_rows(folder)
        for row in rows[done:]:
            write({name: float(value) for name, value in row.items()})
        done = max(done, len(rows))
        ended = ended or orphan
        if not ended:
            time.sleep(POLL_SECONDS)


def to_wandb(folder: Path, mode: str, project: str) -> None:
    """Mirror to Weights & Biases, by iteration; online after what a run of this id already holds there."""
    run = start(folder, mode, project)
    follow(folder, run.step, lambda row: run.log(row, step=int(row["iteration"])))
    run.finish()


def to_tensorboard(folder: Path) -> None:
    """Mirror to the event file in <run>/tensorboard, by environment step.

    It is written anew: what a killed session left there cannot be told from what a checkpoint covers.
    """
    from torch.utils.tensorboard import SummaryWriter

    place = folder / "tensorboard"
    for old in place.glob("events.out.tfevents.*"):
        old.unlink()

    def write(row: dict[str, float]) -> None:
        for name, value in row.items():
            writer.add_scalar(name, value, int(row["env_steps"]))

    # A TensorBoard that has read the old file forgets it from step 0 on.
    with SummaryWriter(str(place), purge_step=0, flush_secs=FLUSH_SECONDS) as writer:
        follow(folder, 0, write)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run's status says when to end
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    mirrors: dict[str, Callable[..., None]] = {"wandb": to_wandb, "tensorboard": to_tensorboard}
    mirrors[sys.argv[2]](Path(sys.argv[1]), *sys.argv[3:])
