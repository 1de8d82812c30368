"""The Slurm launcher on a real one-node cluster: time limits, kills, cancellation, a restarted daemon, resubmission."""

import dataclasses
import json
import os
import signal
import stat
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest
import yaml

from experiments import code_snapshot, slurm, slurm_profile, sweep
from experiments.config import compose_run
from experiments.launchers import run_locally
from experiments.plan import make_plan
from experiments.status import read_status
from tests import ROOT
from tests.slurm.cluster import Cluster, missing

pytestmark = [
    pytest.mark.slurm,
    pytest.mark.skipif(bool(missing()), reason=f"not installed: {', '.join(missing())} (make test-slurm)"),
]
FIGURE = {
    "title": "tiny",
    "environments": ["block_hopper"],
    "variants": {"hippo": {"label": "HiPPO", "algo": "hippo"}, "ppo": {"label": "PPO", "algo": "ppo"}},
}
SETTINGS = ["--set", "iterations=200", "--set", "batch_size=400"]
LONG = ["env=block_hopper", "scale=smoke", "env.horizon=1000", "batch_size=10000", "iterations=60", "seed=7"]


@pytest.fixture(scope="module")
def cluster():
    """A cluster, whose commands this process finds."""
    with tempfile.TemporaryDirectory(prefix="slab", dir="/tmp") as folder, pytest.MonkeyPatch.context() as patch:
        cluster = Cluster(Path(folder))
        try:
            cluster.start()
            patch.setenv("SLURM_CONF", str(cluster.configuration))
            patch.setenv("PATH", cluster.environment["PATH"])
            yield cluster
        finally:
            cluster.stop()


@pytest.fixture(scope="module")
def long_run(cluster, tmp_path_factory):
    """A run whose job is told to stop 20 to 80 seconds after every start; submitted before anything else."""
    runs_dir = tmp_path_factory.mktemp("long")
    run = compose_run([*LONG, f"runs_dir={runs_dir}"])
    profile = slurm_profile.Profile(time_minutes=2, signal_seconds=100, memory_gb=1.0)
    assert slurm.submit([run], runs_dir, profile, dry_run=False) == 1
    return run


@pytest.fixture(autouse=True)
def figure(monkeypatch):
    monkeypatch.setattr("experiments.plan.load_figure", lambda name: FIGURE)


def until(condition, seconds):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.3)


def state(run):
    return read_status(run.folder)["state"]


@pytest.mark.timeout(600)  # every job compiles the kernels of its copy of the code
def test_a_sweep_survives_a_kill_a_cancellation_and_a_restarted_node(long_run, cluster, tmp_path, capsys):
    profile = tmp_path / "profile.yaml"
    profile.write_text(yaml.safe_dump({"time_minutes": 30, "memory_gb": 1.0, "group_minutes": 0}))
    runs_dir = tmp_path / "runs"
    arguments = ["tiny", "--runs-dir", str(runs_dir), *SETTINGS]
    on_slurm = [*arguments, "--launcher", "slurm", "--profile", str(profile)]
    runs = [e.run for e in make_plan("tiny", "smoke", SETTINGS[1::2], False, runs_dir).entries]

    assert sweep.main(["run", *on_slurm, "--dry-run"]) == 0
    assert "array of 4 jobs, 4 runs" in capsys.readouterr().out
    assert not slurm.queued(runs_dir)
    assert sweep.main(["run", *on_slurm]) == 0  # returns at once
    assert set(slurm.queued(runs_dir)) == {run.run_id for run in runs}
    assert sweep.main(["run", *on_slurm]) == 0
    assert "4 already queued or running, 0 submitted" in capsys.readouterr().out
    assert stat.S_IMODE((runs_dir / "slurm").stat().st_mode) == 0o700

    # One worker is killed, one job is cancelled, the node's daemon is restarted under the others.
    killed, cancelled, *others = runs
    until(lambda: read_status(killed.folder)["iteration"] >= 2, 90)
    os.kill(read_status(killed.folder)["pid"], signal.SIGKILL)
    until(lambda: read_status(cancelled.folder)["iteration"] >= 2, 90)
    cluster.run("scancel", slurm.queued(runs_dir)[cancelled.run_id])
    cluster.stop_node()
    cluster.start_node()
    until(lambda: state(cancelled) == "preempted", 60)
    until(lambda: state(killed) == "lost" and killed.run_id not in slurm.queued(runs_dir), 90)
    until(lambda: {state(run) for run in others} == {"finished"}, 120)
    capsys.readouterr()
    assert sweep.main(["status", *arguments]) == 0
    table = capsys.readouterr().out
    assert "2 to try again" in table
    assert table.count(" finished ") == 2
    assert sweep.main(["retry", *on_slurm]) == 0
    assert set(slurm.queued(runs_dir)) >= {killed.run_id, cancelled.run_id}
    assert sweep.main(["run", *on_slurm, "--wait"]) == 0
    (path,) = (runs_dir / "plans/smoke/overridden").glob("tiny+*.json")
    plan = json.loads(path.read_text())
    assert {run["state"] for run in plan["runs"]} == {"finished"}

    local = [dataclasses.replace(run, runs_dir=tmp_path / "local") for run in runs]
    assert set(run_locally(local, 2, lambda *_: None).values()) == {"finished"}
    for here, there in zip(local, runs, strict=True):
        for name in ("progress.csv", "checkpoint.pt"):
            assert (here.folder / name).read_bytes() == (there.folder / name).read_bytes()


def test_what_depends_on_another_run_waits_for_it(cluster, tmp_path):
    train = compose_run(["env=snake_gather", "scale=smoke", "iterations=2", "batch_size=400", f"runs_dir={tmp_path}"])
    measure = dataclasses.replace(train, kind="measure")
    profile = slurm_profile.Profile(time_minutes=10, memory_gb=1.0)
    assert slurm.submit([train, measure], tmp_path, profile, dry_run=False) == 2
    assert slurm.wait([train, measure], tmp_path, lambda *_: None) == {
        train.run_id: "finished",
        measure.run_id: "finished",
    }


def test_the_code_that_jobs_run_is_a_copy(tmp_path):
    copy = code_snapshot.snapshot(tmp_path)
    assert (copy / "experiments/train.py").read_bytes() == Path(slurm.__file__).with_name("train.py").read_bytes()
    assert "git_commit" in json.loads((copy / "snapshot.json").read_text())
    assert code_snapshot.snapshot(tmp_path) == copy


def test_jobs_find_the_kernels_that_were_compiled_before(tmp_path):
    code = """
import numpy as np
from hippo.core import policies
policies.sample_categorical(np.zeros((1, 2)), np.zeros(1))
print(policies.__file__, sum(policies._sample_categorical.stats.cache_misses.values()))"""

    def compiled_in(folder):
        output = subprocess.run([sys.executable, "-c", code], cwd=folder, check=True, capture_output=True, text=True)
        path, misses = output.stdout.split()
        assert Path(path).is_relative_to(folder)
        return int(misses)

    compiled_in(ROOT)
    assert compiled_in(code_snapshot.snapshot(tmp_path)) == 0


def test_a_cluster_that_does_not_answer_is_one_clear_error(cluster, tmp_path, monkeypatch, capsys):
    (tmp_path / "slurm.conf").write_text("nonsense\n")
    monkeypatch.setenv("SLURM_CONF", str(tmp_path / "slurm.conf"))
    arguments = ["run", "tiny", "--runs-dir", str(tmp_path / "runs"), *SETTINGS, "--launcher", "slurm"]
    assert sweep.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: launcher=slurm: scontrol failed")
    assert error.count("\n") == 1


def test_a_job_at_its_time_limit_is_requeued_and_continues_to_the_same_bytes(long_run, tmp_path):
    alone = dataclasses.replace(long_run, runs_dir=tmp_path)
    assert run_locally([alone], 1, lambda *_: None) == {alone.run_id: "finished"}
    assert slurm.wait([long_run], long_run.runs_dir, lambda *_: None) == {long_run.run_id: "finished"}
    assert read_status(long_run.folder)["attempts"] >= 2
    for name in ("progress.csv", "checkpoint.pt"):
        assert (alone.folder / name).read_bytes() == (long_run.folder / name).read_bytes()
