"""The mirrors to Weights & Biases and TensorBoard: exactly progress.csv, through kills; they may hang or fail; neither
sees a key.
"""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from experiments import mirror as mirror_command
from experiments import train
from experiments.config import compose_run
from experiments.status import read_status
from hippo.core import mirror
from tests import ROOT
from tests.experiments.wandb_log import history, run_record

TINY = ["env=block_hopper", "scale=smoke", "iterations=3", "batch_size=400"]
CANARY = "c0ffee" * 6 + "c0ff"  # looks like a key: 40 hexadecimal digits


def progress(folder):
    with (folder / "progress.csv").open() as file:
        return {int(row["iteration"]): {k: float(v) for k, v in row.items()} for row in csv.DictReader(file)}


def killed_once(command, is_time):
    """Start a training with one mirror and kill it when `is_time`; the mirror ends by itself."""
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not is_time():
        assert process.poll() is None
        time.sleep(0.05)
    (child,) = [p for p in psutil.Process(process.pid).children() if "hippo.core.mirror" in p.cmdline()]
    process.send_signal(signal.SIGKILL)
    process.wait()
    child.wait(20)


@pytest.fixture
def no_account(monkeypatch, tmp_path):
    """No key anywhere wandb looks for one."""
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in [name for name in os.environ if name.startswith("WANDB")]:
        monkeypatch.delenv(name)


@pytest.mark.slow
def test_after_kills_the_offline_logs_together_hold_exactly_the_rows_of_progress_csv(tmp_path, no_account):
    arguments = ["env=block_hopper", "scale=smoke", "iterations=300", "batch_size=400", f"runs_dir={tmp_path}"]
    command = [sys.executable, "-m", "experiments.train", *arguments, "wandb.mode=offline"]
    run = compose_run(arguments)
    for stop_at in (60, 120):
        killed_once(command, lambda at=stop_at: len(history(run.folder)) >= at)
        mirrored = history(run.folder)
        assert stop_at <= len(mirrored) < len(progress(run.folder)) < 300  # the last row may be dropped by a resume
        assert mirrored.items() <= progress(run.folder).items()
    assert subprocess.run(command, cwd=ROOT, capture_output=True, check=False).returncode == 0
    assert read_status(run.folder)["state"] == "finished"
    assert history(run.folder) == progress(run.folder)
    assert len(list((run.folder / "wandb").glob("offline-run-*"))) == 3
    assert {path.name for path in (run.folder / "wandb").glob("*/run-*.wandb")} == {f"run-{run.run_id}.wandb"}


def test_the_key_is_in_no_file_and_no_output(tmp_path, monkeypatch, no_account):
    monkeypatch.setenv("WANDB_API_KEY", CANARY)
    command = [sys.executable, "-m", "experiments.train", *TINY, f"runs_dir={tmp_path / 'runs'}", "wandb.mode=offline"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, check=True)
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert any(path.suffix == ".wandb" for path in files)
    assert not [path for path in files if CANARY.encode() in path.read_bytes()]
    assert CANARY.encode() not in result.stdout + result.stderr


@pytest.mark.parametrize(
    ("module", "word"),
    [
        ("import time; time.sleep(1000)", "did not finish within 1 s and was stopped"),
        ("raise RuntimeError('broken')", "ended with exit code 1"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "ended with exit code -9"),
    ],
)
def test_a_wandb_that_hangs_or_fails_never_stops_training(module, word, tmp_path, monkeypatch, capsys):
    alone = compose_run([*TINY, f"runs_dir={tmp_path / 'alone'}"])
    assert train.execute(alone) == "finished"
    (tmp_path / "fake").mkdir()
    (tmp_path / "fake/wandb.py").write_text(module)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "fake"))
    monkeypatch.setattr(mirror, "WAIT_SECONDS", 1.0 if "sleep" in module else 30.0)
    run = compose_run([*TINY, f"runs_dir={tmp_path / 'runs'}", "wandb.mode=offline"])
    start = time.monotonic()
    assert train.execute(run) == "finished"
    assert time.monotonic() - start < 20
    error = capsys.readouterr().err
    assert f"warning: the wandb mirror {word}" in error
    assert error.count("\n") == 1
    for name in ("progress.csv", "checkpoint.pt"):
        assert (run.folder / name).read_bytes() == (alone.folder / name).read_bytes()


def test_online_without_a_key_asks_nothing_and_stops_nothing(tmp_path, capsys, no_account):
    run = compose_run([*TINY, f"runs_dir={tmp_path / 'runs'}", "wandb.mode=online"])
    assert train.execute(run) == "finished"
    assert "warning: the wandb mirror ended with exit code 1" in capsys.readouterr().err
    assert "wandb" in (run.folder / "wandb/mirror.log").read_text()
    assert mirror_command.main([str(run.folder)]) == 1
    assert capsys.readouterr().err == f"error: {run.folder} is not mirrored (log: {run.folder / 'wandb/mirror.log'})\n"


def test_a_finished_run_is_mirrored_afterwards_as_if_during_training_with_group_and_tags(tmp_path, capsys, no_account):
    runs = [compose_run([*TINY, f"seed={seed}", f"runs_dir={tmp_path}"]) for seed in (0, 1)]
    for run in runs:
        assert train.execute(run) == "finished"
    (tmp_path / "plans/smoke").mkdir(parents=True)
    plan = {"figure": "fig3", "runs": [{"run_id": runs[0].run_id}]}
    (tmp_path / "plans/smoke/fig3.json").write_text(json.dumps(plan))
    assert mirror_command.main([str(run.folder) for run in runs] + ["--mode", "offline"]) == 0
    assert capsys.readouterr().out.endswith("".join(f"mirrored {run.folder}\n" for run in runs))
    records = [run_record(run.folder) for run in runs]
    for run, record in zip(runs, records, strict=True):
        assert history(run.folder) == progress(run.folder)
        assert (record.run_id, record.project) == (run.run_id, "hippo")
    assert records[0].run_group == records[1].run_group
    assert records[0].run_group.startswith("block_hopper hippo ")
    assert mirror.labels(runs[0].folder)[0] != mirror.labels(other_settings(tmp_path).folder)[0]
    common = {"env:block_hopper", "algo:hippo", "scale:smoke", "protocol:paper"}
    assert [set(record.tags) - common for record in records] == [{"seed:0", "figure:fig3"}, {"seed:1"}]
    assert all(common <= set(record.tags) for record in records)


def other_settings(runs_dir):
    """The folder of a run that differs in a setting, with what identifies it."""
    run = compose_run([*TINY, "algo.gamma=0.9", f"runs_dir={runs_dir}"])
    run.folder.mkdir()
    manifest = {"run_id": run.run_id, "identity": run.identity, "config": run.to_yaml()}
    (run.folder / "manifest.json").write_text(json.dumps(manifest))
    return run


def test_what_is_no_finished_run_is_not_mirrored(tmp_path, capsys):
    run = compose_run([*TINY, f"runs_dir={tmp_path}"])
    for folder, message in (
        (tmp_path, "is no run folder"),
        (run.folder, "is missing; only finished runs are taken"),
    ):
        run.folder.mkdir(exist_ok=True)
        (run.folder / "config.yaml").write_text(run.to_yaml())
        assert mirror_command.main([str(folder), "--mode", "offline"]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
        assert not list(tmp_path.rglob("wandb"))


def test_the_mirror_is_no_part_of_a_runs_identity():
    assert compose_run([*TINY, "wandb.mode=offline", "wandb.project=x"]).run_id == compose_run(TINY).run_id


def test_a_row_counts_as_covered_once_a_later_one_or_the_end_is_seen(tmp_path):
    (tmp_path / "progress.csv").write_text("iteration,x\n0,1\n1,2\n2,")
    for state, covered, ended in (("running", 1, False), ("preempted", 1, True), ("finished", 2, True)):
        (tmp_path / "status.json").write_text(f'{{"state": "{state}"}}')
        rows, over = mirror.covered_rows(tmp_path)
        assert (len(rows), over) == (covered, ended)


# --------------------------------------------------------------------------------------------------------- TensorBoard


def scalars(folder):
    """env_steps -> columns of what TensorBoard shows of a run."""
    shown = EventAccumulator(str(folder / "tensorboard")).Reload()
    table = {}
    for name in shown.Tags()["scalars"]:
        for event in shown.Scalars(name):
            assert name not in table.setdefault(event.step, {}), "twice"
            table[event.step][name] = event.value
    return table


def in_single_precision(folder):
    """What it is to show: event files hold single precision."""
    rows = progress(folder).values()
    with np.errstate(over="ignore"):
        return {int(row["env_steps"]): {name: float(np.float32(value)) for name, value in row.items()} for row in rows}


def test_after_a_kill_tensorboard_shows_exactly_the_rows_of_progress_csv_once(tmp_path):
    arguments = ["env=block_hopper", "scale=smoke", "iterations=60", "batch_size=400", f"runs_dir={tmp_path}"]
    command = [sys.executable, "-m", "experiments.train", *arguments, "log.tensorboard=true"]
    run = compose_run(arguments)
    killed_once(command, lambda: read_status(run.folder)["iteration"] >= 15)
    assert scalars(run.folder).items() <= in_single_precision(run.folder).items()
    assert subprocess.run(command, cwd=ROOT, capture_output=True, check=False).returncode == 0
    assert read_status(run.folder)["state"] == "finished"
    assert scalars(run.folder) == in_single_precision(run.folder)
    assert len(scalars(run.folder)) == 60
    assert len(list((run.folder / "tensorboard").glob("events.*"))) == 1


def test_a_tensorboard_that_is_missing_never_stops_or_changes_training(tmp_path, monkeypatch, capsys):
    alone = compose_run([*TINY, f"runs_dir={tmp_path / 'alone'}"])
    assert train.execute(alone) == "finished"
    (tmp_path / "fake").mkdir()
    (tmp_path / "fake/tensorboard.py").write_text("raise ModuleNotFoundError('none')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "fake"))
    run = compose_run([*TINY, f"runs_dir={tmp_path / 'runs'}", "log.tensorboard=true"])
    assert train.execute(run) == "finished"
    error = capsys.readouterr().err
    assert "warning: the tensorboard mirror ended with exit code 1; progress.csv is complete" in error
    assert error.count("\n") == 1
    for name in ("progress.csv", "checkpoint.pt"):
        assert (run.folder / name).read_bytes() == (alone.folder / name).read_bytes()


def test_a_finished_run_is_shown_to_tensorboard_afterwards(tmp_path, capsys):
    run = compose_run([*TINY, f"runs_dir={tmp_path}"])
    assert train.execute(run) == "finished"
    assert not (run.folder / "tensorboard").exists()
    for _ in range(2):
        assert mirror_command.main([str(run.folder), "--to", "tensorboard"]) == 0
        assert scalars(run.folder) == in_single_precision(run.folder)


def test_whether_it_is_shown_decides_no_number_and_is_yes_or_no(capsys):
    assert compose_run([*TINY, "log.tensorboard=true"]).run_id == compose_run(TINY).run_id
    assert train.main([*TINY, "log.tensorboard=perhaps"]) == 2
    error = capsys.readouterr().err
    assert "log.tensorboard=perhaps" in error
    assert error.count("\n") == 1
    older = compose_run(TINY).to_yaml().replace("tensorboard: false\n", "")
    assert "tensorboard" not in older
    assert not type(compose_run(TINY)).from_yaml(older, Path("runs")).tensorboard
