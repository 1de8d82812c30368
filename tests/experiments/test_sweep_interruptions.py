"""Sweeps and runs that meet each other, are stopped, diverge or find damage."""

import dataclasses
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from experiments import launchers, sweep, train
from experiments.command_line import EXIT_FAILED, EXIT_REQUEUE
from experiments.config import compose_run
from experiments.plan import FIXED, make_plan
from experiments.refusals import ONE_VALUE
from experiments.status import Status, mark_lost, read_status
from tests import ROOT

TINY = ["env=block_hopper", "scale=smoke", "iterations=2", "batch_size=400"]
FIGURE = {
    "title": "tiny",
    "environments": ["block_hopper"],
    "variants": {"hippo": {"label": "HiPPO", "algo": "hippo"}, "ppo": {"label": "PPO", "algo": "ppo"}},
}
EIGHT = FIGURE | {
    "variants": {
        f"{algo}_{gamma}": {"label": algo, "algo": algo, "settings": [f"algo.gamma={gamma}"]}
        for algo in ("hippo", "ppo")
        for gamma in (0.9, 0.99)
    }
}
SCRIPT = """
if __name__ == "__main__":  # workers import this file again
    import sys
    from experiments import plan, sweep
    plan.load_figure = lambda name: FIGURE
    sys.exit(sweep.main(sys.argv[1:]))
"""


def start_sweep(tmp_path, iterations, figure=FIGURE, workers=2):
    """A sweep in a process of its own, of four runs unless `figure` has more."""
    script = tmp_path / "tiny_sweep.py"
    script.write_text(SCRIPT.replace("FIGURE", repr(figure)))
    arguments = ["run", "tiny", "--runs-dir", str(tmp_path / "runs"), "--workers", str(workers)]
    settings = ["--set", f"iterations={iterations}", "--set", "batch_size=400"]
    return subprocess.Popen(
        [sys.executable, str(script), *arguments, *settings],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.fixture
def tiny_run(tmp_path):
    return compose_run([*TINY, f"runs_dir={tmp_path}"])


@pytest.fixture
def tiny_figure(monkeypatch):
    monkeypatch.setattr("experiments.plan.load_figure", lambda name: FIGURE)


def test_two_sweeps_started_together_train_every_run_once_and_both_succeed(tmp_path):
    both = [start_sweep(tmp_path, 3, workers=1) for _ in range(2)]
    errors = [process.communicate(timeout=100)[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], errors
    folders = [path.parent for path in (tmp_path / "runs").glob("*/status.json")]
    assert len(folders) == 4
    for folder in folders:
        assert json.loads((folder / "status.json").read_text())["state"] == "finished"
        assert (folder / "train.log").read_text().count("iteration 3/3") == 1
        assert (folder / "progress.csv").read_text().count("\n") == 4
    assert not list((tmp_path / "runs").rglob("*.tmp"))


def finished(tmp_path):
    return {p.parent.name for p in (tmp_path / "runs").glob("*/status.json") if '"finished"' in p.read_text()}


def is_worker(process):
    try:
        return "spawn_main" in " ".join(process.cmdline())
    except psutil.NoSuchProcess:  # it has just ended
        return False


@pytest.mark.slow
def test_workers_killed_at_random_leave_no_trace_once_the_command_was_typed_again(tmp_path, monkeypatch):
    settings = ["iterations=25", "batch_size=400"]
    monkeypatch.setattr("experiments.plan.load_figure", lambda name: EIGHT)
    runs = make_plan("tiny", "smoke", settings, False, tmp_path / "a/runs").todo()
    assert {train.execute(run) for run in runs} == {"finished"}
    (tmp_path / "b").mkdir()
    rng, killed, typed, process = random.Random(0), 0, 0, None
    deadline = time.monotonic() + 200
    while len(finished(tmp_path / "b")) < len(runs) or killed < 6:
        assert time.monotonic() < deadline
        if process is None or process.poll() is not None:
            process, typed = start_sweep(tmp_path / "b", 25, EIGHT), typed + 1
        time.sleep(rng.uniform(0.02, 0.2))
        workers = [child for child in psutil.Process(process.pid).children() if is_worker(child)]
        folders = [path.parent for path in (tmp_path / "b/runs").glob("*/status.json")]
        training = {status["pid"] for status in map(read_status, folders) if status["state"] == "running"}
        if killed < 6 and (chosen := [w for w in workers if w.pid in training]):
            rng.choice(chosen).kill()
            killed += 1
    assert process.wait(60) == 0 or start_sweep(tmp_path / "b", 25, EIGHT).wait(60) == 0
    assert typed >= 2
    for run in runs:
        for name in ("progress.csv", "checkpoint.pt"):
            other = tmp_path / "b/runs" / run.run_id / name
            assert other.read_bytes() == (run.folder / name).read_bytes()


def test_a_terminated_sweep_leaves_every_run_resumable_and_no_orphan(tmp_path):
    process = start_sweep(tmp_path, 2000)
    deadline = time.monotonic() + 60
    while not list((tmp_path / "runs").glob("*/checkpoint.pt")) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    _, error = process.communicate(timeout=40)
    assert process.returncode == EXIT_REQUEUE
    assert "the same command continues" in error
    states = [json.loads(path.read_text()) for path in (tmp_path / "runs").glob("*/status.json")]
    assert {status["state"] for status in states} == {"preempted"}
    assert not any(Path(f"/proc/{status['pid']}").exists() for status in states)


def test_a_diverged_run_is_reported_and_not_trained_again(tiny_figure, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sweep, "run_locally", lambda runs, *_: {run.run_id: "finished" for run in runs})
    arguments = ["tiny", "--runs-dir", str(tmp_path)]
    run = make_plan("tiny", "smoke", [], False, tmp_path).entries[0].run
    run.folder.mkdir()
    (run.folder / "status.json").write_text(json.dumps({"state": "diverged", "message": "iteration 1: a NaN"}))
    assert sweep.main(["run", *arguments]) == EXIT_FAILED
    captured = capsys.readouterr()
    assert "to train: 3 runs" in captured.out
    assert captured.err.startswith("diverged: block_hopper hippo seed 0: iteration 1: a NaN")


@pytest.mark.parametrize("key", FIXED)
def test_what_the_plan_decides_cannot_be_set(key, tiny_figure, tmp_path, capsys):
    assert sweep.main(["run", "tiny", "--runs-dir", str(tmp_path / "runs"), "--set", f"{key}=1"]) == 2
    assert f"set {key}=1" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("override", "message"),
    [("runs_dir=", "runs_dir=: must name a folder"), ("=3", "=3: settings are"), ("budget=3", "valid: ")],
)
def test_overrides_that_name_nothing_are_refused(override, message, capsys):
    assert train.main([*TINY, override]) == 2
    assert message in capsys.readouterr().err


def test_several_values_in_one_override_are_refused_with_what_works_for_a_run_and_for_a_sweep(tmp_path, capsys):
    several = "algo.learning_rate=1e-3,3e-3"
    assert train.main([*TINY, several]) == 2
    assert sweep.main(["run", "fig3", "--runs-dir", str(tmp_path / "runs"), "--set", several]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines == [f"error: {several}: {ONE_VALUE}"] * 2
    assert not (tmp_path / "runs").exists()


def test_a_lost_process_leaves_its_cause_unless_the_run_was_taken_over_or_is_done(tiny_run):
    def state():
        return read_status(tiny_run.folder)["state"]

    tiny_run.folder.mkdir(exist_ok=True)
    Status(tiny_run).update()
    with train.locked(tiny_run.folder / ".lock"):  # another process trains it
        mark_lost(tiny_run, "killed")
    assert state() == "running"
    mark_lost(tiny_run, f"its process ended: {launchers.cause(-signal.SIGKILL)}")
    assert state() == "lost"
    assert read_status(tiny_run.folder)["message"] == "its process ended: SIGKILL"
    Status(tiny_run).update(state="finished", results={})
    mark_lost(tiny_run, "killed")
    assert state() == "finished"


def test_a_process_that_ends_before_its_run_began_leaves_its_cause(tiny_run):
    mark_lost(tiny_run, launchers.cause(1))
    status = read_status(tiny_run.folder)
    assert (status["state"], status["message"]) == ("lost", "exit code 1")


def test_a_damaged_status_is_lost_and_the_run_trains_all_the_same(tiny_run):
    tiny_run.folder.mkdir(exist_ok=True)
    (tiny_run.folder / "status.json").write_text("")
    assert read_status(tiny_run.folder)["state"] == "lost"
    assert train.execute(tiny_run) == "finished"


def test_damaged_checkpoints_end_the_run_with_one_line_and_no_traceback(tiny_run, capsys):
    assert train.execute(tiny_run) == "finished"
    Status(tiny_run).update(state="running")
    for name in ("checkpoint.pt", "checkpoint.prev.pt"):
        (tiny_run.folder / name).write_bytes(b"no checkpoint")
    assert train.execute(tiny_run) == "failed"
    error = capsys.readouterr().err
    assert "no intact checkpoint" in error
    assert "Traceback" not in error
    assert "no intact checkpoint" in read_status(tiny_run.folder)["message"]


def test_a_run_whose_parent_was_preempted_is_preempted_too(tiny_run, monkeypatch):
    child = dataclasses.replace(tiny_run, kind="measure")
    monkeypatch.setattr(train, "_finish_parent", lambda parent: "preempted")
    assert child.parent is not None
    assert train.execute(child) == "preempted"
    monkeypatch.setattr(train, "_finish_parent", lambda parent: "diverged")
    assert train.execute(child) == "failed"
