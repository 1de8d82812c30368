"""One run, from its configuration to `status.json: finished`; resumes by itself and never trains twice.

    python -m experiments.train algo=hippo env=ant_gather seed=3 algo.period_min=5
    python -m experiments.train --from-manifest runs/<run_id>/manifest.json [runs_dir=elsewhere]
    python -m experiments.train algo=ppo env=ant_gather --help    # every key of this learner and this environment
    python -m experiments.train algo=ppo env=ant_gather --cfg     # the run as yaml; nothing is trained

A run lives in runs/<run_id>/: config.yaml (what it is), manifest.json (where it came from), status.json (how it is
doing), train.log (what it said), progress.csv and timing.csv (what it measured), checkpoint.pt and checkpoint.prev.pt;
and what it makes: skills.pt of a pre-training run, episodes.csv of an evaluation.
"""

import argparse
import contextlib
import dataclasses
import json
import shlex
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from filelock import Timeout

from experiments import usage
from experiments.command_line import EXIT_DIVERGED, EXIT_FAILED, EXIT_REQUEUE, Parser, bad_input, clock, run_command
from experiments.config import Run, committed_skills, compose_run
from experiments.console import unattended
from experiments.evaluate import as_csv, evaluate_all
from experiments.manifest import from_manifest, manifest_with_history
from experiments.refusals import unquoted
from experiments.schema import PRETRAINED
from experiments.status import (
    HEARTBEAT_SECONDS,
    SILENT,
    Status,
    is_there,
    locked,
    mark_failed,
    read_status,
    remove_abandoned,
    write_atomically,
)
from hippo import gradients
from hippo.core import checkpoint, seeding
from hippo.core.checkpoint import Checkpoint, CheckpointError
from hippo.core.log import Diverged, LogError, Row, RunLog
from hippo.core.mirror import mirrored
from hippo.core.results import digests
from hippo.core.settings import ConfigError
from hippo.core.skills import SkillsError, save_skills
from hippo.envs import make
from hippo.envs.foreign import EnvironmentFault
from hippo.learners import learner_of

EXIT_CODES = {"finished": 0, "running": 0, "failed": EXIT_FAILED, "diverged": EXIT_DIVERGED, "preempted": EXIT_REQUEUE}


class Preempted(BaseException):
    """A signal to stop arrived: the iteration is abandoned; the last checkpoint is complete."""


def execute(run: Run) -> str:
    """Do `run` to its end; returns its state: finished, running (elsewhere), diverged, failed or preempted."""
    if read_status(run.folder)["state"] == "finished":
        print(f"{run.run_id} is finished: {run.folder}\n{what_next(run)}")
        return "finished"
    parent = run.parent
    if parent is not None and not is_there(parent) and (state := _finish_parent(parent)) != "finished":
        return "preempted" if state == "preempted" else "failed"
    try:
        run.folder.mkdir(parents=True, exist_ok=True)
        # Not at once refused: who asks for the state of a silent run holds its lock for a blink.
        with locked(run.folder / ".lock", timeout=0.2), unattended(run.folder / "train.log"):
            return _execute_locked(run)
    except Timeout:
        status = read_status(run.folder)
        soft = run.folder / ".lock.soft"
        heard = status["state"] == "running" and status["message"] != SILENT
        silent = "" if heard else f", which {SILENT}"
        stale = f" If it is gone, delete {soft}" if silent and soft.exists() else ""
        print(f"{run.run_id} is already running (host {status.get('host')}, pid {status.get('pid')}){silent}{stale}")
        return "running"
    except OSError as error:
        print(f"error: {run.run_id} cannot start: {error}", file=sys.stderr)
        return "failed"
    except Exception as error:  # before there was a status to say so
        traceback.print_exc()
        mark_failed(run, f"{type(error).__name__}: {error}".splitlines()[0])
        return "failed"


def what_next(run: Run) -> str:
    """The last line of a finished run: its folder and the commands that take it."""
    folder = shlex.quote(str(run.folder))
    if run.kind != "train":
        return f"finished: {folder}"
    return (
        f"finished: {folder}  evaluate: python -m experiments.evaluate {folder}  video: make video RUN={folder}  "
        f"compare: python -m paper_figures.compare {folder} OTHER_RUN"
    )


def _finish_parent(parent: Run) -> str:
    """Do what a run depends on, or wait for whoever does; its final state."""
    while (state := execute(parent)) == "running":
        time.sleep(HEARTBEAT_SECONDS)
    if state != "finished":
        print(f"{parent.run_id}, which this run depends on, is {state}: {parent.folder}", file=sys.stderr)
    return state


def _execute_locked(run: Run) -> str:
    if read_status(run.folder)["state"] == "finished":  # by whoever held the lock before
        return "finished"
    remove_abandoned(run.folder)
    write_atomically(run.folder / "config.yaml", run.to_yaml())
    write_atomically(run.folder / "manifest.json", json.dumps(manifest_with_history(run), indent=1))
    status = Status(run)
    status.update()
    try:
        mirrors = mirrored(run.folder, (run.wandb_mode, run.wandb_project), run.tensorboard)
        with _preemption(status), status.heartbeat(), mirrors:
            _work(run, status)
    except Preempted:  # between the lines of `_work`, or while it ended
        _stopped(status)
    return status.content["state"]


def _work(run: Run, status: Status) -> None:
    """Do the run; its last status and line say how that ended."""
    try:
        WORK[run.kind](run, status)
        status.update(state="finished", message="", results=digests(run.folder))
        print(what_next(run), flush=True)
    except Diverged as error:
        checkpoint.save(run.folder / "diverged.pt", error.dump)
        status.end("diverged", str(error))
        print(f"diverged: {error}", file=sys.stderr)
    except Preempted:
        _stopped(status)
    except (OSError, MemoryError) as error:  # the machine's fault, so `retry` may try again
        message = f"{error or type(error).__name__}; start it again to continue from the last checkpoint"
        status.end("failed", message, cause="infrastructure")
        print(f"error: {message}", file=sys.stderr)
    except LogError as error:
        status.end("failed", str(error), cause="infrastructure")
        print(f"error: {error}", file=sys.stderr)
    except (CheckpointError, SkillsError, EnvironmentFault) as error:
        status.end("failed", str(error), cause="error")
        print(f"error: {error}", file=sys.stderr)
    except Exception as error:
        status.end("failed", f"{type(error).__name__}: {error}".splitlines()[0], cause="error")
        traceback.print_exc()


def _stopped(status: Status) -> None:
    """Say which signal stopped the run, if it had not ended by itself."""
    if status.content["state"] == "running":
        message = f"stopped by {status.stopped_by}; start it again to continue"
        status.end("preempted", message)
        print(f"preempted: {message}", file=sys.stderr)


@contextlib.contextmanager
def _preemption(status: Status) -> Iterator[None]:
    """Turn the first of Ctrl-C, SIGTERM, SIGUSR1 and SIGUSR2 (submitit's) into Preempted while the block runs.

    Those that follow must not interrupt the end of the run. A worker of a sweep and a job in the background of a shell
    ignore Ctrl-C already, and go on to.
    """

    def stop(number: int, frame: object) -> None:
        if not status.stopped_by:
            status.stopped_by = signal.Signals(number).name
            raise Preempted

    numbers = [signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2]
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        numbers.append(signal.SIGINT)
    before = {number: signal.signal(number, stop) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def prepare(run: Run) -> Callable[[int, str], Any]:
    """Set torch up and return what makes the run's environments, each purpose with its own random stream."""
    torch.set_num_threads(1)
    # Of two functions that refuse what is not deterministic, the one that does not import the compiler.
    torch.set_deterministic_debug_mode("error")
    # Filling fresh memory would be in vain: nothing is read before it is written (tests/hippo/test_golden.py).
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]

    def make_envs(num_envs: int, purpose: str) -> Any:
        seed = seeding.integer(run.seed, "environments", *purpose.encode())
        return make(run.env, num_envs, seed, horizon=run.config.horizon, **run.options)

    return make_envs


def with_skills(run: Run) -> Any:
    """The algorithm's config, with the file in place of `skills=pretrained`."""
    if run.skills != PRETRAINED:
        return run.config
    parent = run.parent
    assert parent is not None
    made_here, committed = parent.folder / "skills.pt", committed_skills(parent)
    path = made_here if read_status(parent.folder)["state"] == "finished" or committed is None else committed
    return dataclasses.replace(run.config, skills=str(path))


def train(run: Run, status: Status) -> None:
    """Hand the run to its algorithm."""
    make_envs = prepare(run)
    started, first = time.monotonic(), None

    def on_row(metrics: Row, timing: Row) -> None:
        nonlocal first
        if status.stopped_by:  # an exception raised inside a finaliser is lost; the word is not
            raise Preempted
        done = int(metrics["iteration"]) + 1
        first = done - 1 if first is None else first
        eta = (time.monotonic() - started) / (done - first) * (run.config.iterations - done)
        speed = timing["steps_per_second"]
        print(
            f"{run.run_id} {run.algo} {run.env} seed {run.seed}  iteration {done}/{run.config.iterations}  "
            f"return {metrics['return_mean']:.3f}  {speed:,.0f} steps/s  ETA {clock(eta)}",
            flush=True,
        )
        status.update(
            iteration=done - 1,
            env_steps=metrics["env_steps"],
            return_mean=float(metrics["return_mean"]),
            steps_per_second=speed,
            eta=round(eta),
        )

    log = RunLog(run.folder, on_row)
    saved = Checkpoint(run.folder, run.run_id, log)
    learner_of(run.algo).train(with_skills(run), make_envs, log, run.seed, saved)
    log.check_whole(run.config.iterations)


def pretrain(run: Run, status: Status) -> None:
    """Train skills and write them to skills.pt."""
    train(run, status)
    policy, metadata = learner_of(run.algo).skills(run.config, prepare(run), Checkpoint(run.folder, run.run_id))
    save_skills(run.folder / "skills.pt", policy, metadata | {"run_id": run.run_id})


def evaluate(run: Run, status: Status) -> None:
    """Episodes of the parent run's policy in the original and in changed environments, as episodes.csv."""
    parent, evaluation = run.parent, run.evaluation
    assert parent is not None
    assert evaluation is not None
    torch.set_num_threads(1)
    rows = evaluate_all(parent, **evaluation)
    write_atomically(run.folder / "episodes.csv", as_csv(rows))
    status.update(iteration=run.config.iterations - 1, env_steps=run.env_steps)


def measure(run: Run, status: Status) -> None:
    """Table 2's quantities of the parent run, as the single row of progress.csv."""
    assert run.parent is not None
    make_envs, start = prepare(run), time.perf_counter()
    trained = Checkpoint(run.parent.folder, run.parent.run_id)
    metrics = gradients.measure(run.restored_config, make_envs, run.seed, trained)
    log = RunLog(run.folder)
    log.resume(0)
    log.row(metrics, {"seconds": time.perf_counter() - start})
    status.update(iteration=run.config.iterations - 1, env_steps=metrics["env_steps"])


WORK = {"train": train, "pretrain": pretrain, "evaluate": evaluate, "measure": measure}


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The command line: settings and a few flags, some of them Hydra's."""
    parser = Parser(prog="experiments.train", add_help=False, allow_abbrev=False)
    parser.add_argument("settings", nargs="*")
    parser.add_argument("-h", "--help", action="store_true")
    parser.add_argument("-c", "--cfg", action="store_true")
    parser.add_argument("-m", "--multirun", action="store_true")
    parser.add_argument("--from-manifest", type=Path)
    options = parser.parse_intermixed_args(arguments)
    if options.multirun:
        parser.error("--multirun: one command, one run; several: experiments.sweep run --name NAME --over key=a,b")
    if options.cfg and "job" in options.settings:  # Hydra's way to say it
        options.settings.remove("job")
    return options


def main(arguments: list[str] | None = None) -> int:
    """Train one run, or say what it would be; the exit code says how it ended."""
    options = parse(arguments)
    try:
        run = _from_manifest(options) if options.from_manifest else compose_run(options.settings)
    except ConfigError as error:
        return bad_input(error)
    if options.help:
        print(__doc__, usage.text(run), sep="")
        return 0
    if options.cfg:
        print(f"# {run.folder}\n{run.to_yaml()}", end="")
        return 0
    return EXIT_CODES[execute(run)]


def _from_manifest(options: argparse.Namespace) -> Run:
    """The run of `--from-manifest FILE [runs_dir=FOLDER]`."""
    key, _, folder = (options.settings or ["runs_dir=runs"])[0].partition("=")
    if len(options.settings) > 1 or key != "runs_dir" or not unquoted(folder):
        taken = shlex.join([str(options.from_manifest), *options.settings])
        raise ConfigError("from-manifest", taken, "takes a manifest.json and at most runs_dir=FOLDER")
    return from_manifest(options.from_manifest, Path(unquoted(folder)))


if __name__ == "__main__":
    run_command(main)
