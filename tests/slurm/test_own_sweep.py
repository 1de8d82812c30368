"""A sweep of one's own on a real one-node Slurm: planned, killed, resumed, cancelled, compared."""

import csv
import os
import shlex
import signal
import sys

import pytest
import yaml

from experiments import slurm, sweep
from experiments.own_sweep import stored
from experiments.status import read_status
from tests.slurm.test_slurm import cluster, pytestmark, until  # noqa: F401

SETTINGS = ["--set", "iterations=20", "--set", "batch_size=400"]


@pytest.mark.timeout(600)
def test_a_sweep_is_planned_killed_resumed_cancelled_and_compared(cluster, tmp_path, capsys):  # noqa: F811
    runs_dir = tmp_path / "runs"
    profile = {
        "time_minutes": 30,
        "memory_gb": 1.0,
        "setup": ["export FROM_SETUP=yes"],
        "python": f"env FROM_PYTHON=yes {shlex.quote(sys.executable)}",
        "extra": ["--comment=mine", "--exclusive"],
    }
    (tmp_path / "profile.yaml").write_text(yaml.safe_dump(profile))
    described = ["--name", "lr", "--over", "algo=hippo,ppo", "--over", "algo.learning_rate=1e-4,3e-4,1e-3", *SETTINGS]
    on_slurm = ["--launcher", "slurm", "--profile", str(tmp_path / "profile.yaml"), "--runs-dir", str(runs_dir)]
    assert sweep.main(["run", *described, *on_slurm, "--dry-run"]) == 0
    assert "hippo-lr-smoke: array of 1 jobs, 12 runs" in capsys.readouterr().out
    assert not runs_dir.exists()

    assert sweep.main(["run", *described, *on_slurm]) == 0
    runs = stored("lr", runs_dir).plan([], False, runs_dir).runs()
    assert set(slurm.queued(runs_dir)) == {run.run_id for run in runs}
    assert cluster.run("squeue", "-h", "-o", "%j %k").startswith("hippo-lr-smoke-")
    assert cluster.run("squeue", "-h", "-o", "%k").strip() == "mine"

    def states():
        return [read_status(run.folder)["state"] for run in runs]

    until(lambda: states().count("finished") >= 2 and "running" in states(), 120)
    assert states().count("running") == 1  # one task, also of a whole node
    (running,) = [run for run in runs if read_status(run.folder)["state"] == "running"]
    pid = read_status(running.folder)["pid"]
    environment = open(f"/proc/{pid}/environ").read()  # noqa: SIM115
    assert "FROM_SETUP=yes" in environment
    assert "FROM_PYTHON=yes" in environment
    os.kill(pid, signal.SIGKILL)
    until(lambda: not slurm.queued(runs_dir), 90)
    until(lambda: "running" not in states(), 60)
    done = states().count("finished")
    assert done < 12

    assert sweep.main(["run", "lr", *on_slurm]) == 0  # the name is enough
    assert f"{12 - done} submitted" in capsys.readouterr().out
    until(lambda: states().count("finished") > done and "running" in states(), 120)
    assert sweep.main(["cancel", "fig3", "--runs-dir", str(runs_dir)]) == 0
    assert slurm.queued(runs_dir)
    assert sweep.main(["cancel", "lr", "--runs-dir", str(runs_dir)]) == 0
    assert "lr: 1 jobs cancelled" in capsys.readouterr().out
    until(lambda: not slurm.queued(runs_dir), 60)
    until(lambda: "running" not in states(), 60)
    assert "preempted" in states()

    assert sweep.main(["run", "lr", *on_slurm, "--wait"]) == 0
    assert set(states()) == {"finished"}
    assert sweep.main(["compare", "lr", "--runs-dir", str(runs_dir), "--out", str(tmp_path / "out")]) == 0
    with (tmp_path / "out/smoke/lr.table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["seeds"] for row in rows] == 6 * ["2"]
