"""Runs of several machines together: finished ones are copied, the same bytes count once, other bytes are refused."""

import json
import shutil

import pytest

from experiments import sweep
from experiments.config import compose_run
from experiments.status import Status, locked, read_status
from hippo.core.results import digests


def finished(runs_dir, seed=0, rows=2, state="finished", cpu="A"):
    """The folder of a run as training leaves it, as far as collecting reads it."""
    settings = [f"seed={seed}", "scale=smoke", "iterations=2", "batch_size=400", "env.horizon=100"]
    run = compose_run(settings, runs_dir)
    run.folder.mkdir(parents=True)
    manifest = {
        "run_id": run.run_id,
        "identity": run.identity,
        "config": run.to_yaml(),
        "cpu": cpu,
        "git_commit": "c" * 40,
    }
    (run.folder / "manifest.json").write_text(json.dumps(manifest))
    (run.folder / "progress.csv").write_text("iteration,x\n" + "".join(f"{i},{cpu == 'A'}\n" for i in range(rows)))
    (run.folder / "checkpoint.pt").write_bytes(b"checkpoint")
    (run.folder / "tensorboard").mkdir()
    (run.folder / "tensorboard/events").write_bytes(b"events")
    for left in (".lock", "status.json.123.tmp"):
        (run.folder / left).touch()
    Status(run).end(state, results=digests(run.folder))
    return run


def collect(tmp_path, *folders):
    return sweep.main(["collect", *map(str, folders), "--runs-dir", str(tmp_path / "runs")])


def files(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_finished_runs_of_several_folders_come_together_once(tmp_path, capsys):
    runs = [finished(tmp_path / "a"), finished(tmp_path / "a", seed=1, state="preempted"), finished(tmp_path / "b", 2)]
    finished(tmp_path / "b")  # the same bytes as the first
    assert collect(tmp_path, tmp_path / "a", tmp_path / "b") == 0
    assert capsys.readouterr().out == "2 copied, 1 here already, 1 not finished, 0 refused\n"
    for run in (runs[0], runs[2]):
        here = tmp_path / "runs" / run.run_id
        assert read_status(here)["state"] == "finished"
        there = files(run.folder)
        assert files(here) == {name: there[name] for name in there if not name.endswith(".tmp")}
    assert {path.name for path in (tmp_path / "runs").iterdir()} == {runs[0].run_id, runs[2].run_id}
    assert collect(tmp_path, tmp_path / "b" / runs[2].run_id, tmp_path / "runs") == 0  # one run; the folder itself
    assert capsys.readouterr().out == "0 copied, 3 here already, 0 not finished, 0 refused\n"


def test_other_bytes_are_refused_with_the_machines_behind_them_and_the_rest_is_copied(tmp_path, capsys):
    ours, other = finished(tmp_path / "runs"), finished(tmp_path / "a", cpu="B")
    finished(tmp_path / "a", seed=1)
    before = files(ours.folder)
    assert collect(tmp_path, tmp_path / "a") == 1
    said = capsys.readouterr()
    assert said.out == "1 copied, 0 here already, 0 not finished, 1 refused\n"
    assert said.err.startswith(f"refused: {other.folder}: progress.csv differs from {ours.folder}")
    assert "trained there on B, commit cccccccccc; here on A, commit cccccccccc" in said.err
    assert said.err.count("\n") == 1
    assert files(ours.folder) == before


def test_what_was_begun_here_gives_way_to_what_is_finished_unless_it_is_being_trained(tmp_path, capsys):
    begun, whole = finished(tmp_path / "runs", rows=1, state="preempted"), finished(tmp_path / "a")
    with locked(begun.folder / ".lock"):
        assert collect(tmp_path, tmp_path / "a") == 1
    assert "is being trained; try again when it has ended" in capsys.readouterr().err
    assert collect(tmp_path, tmp_path / "a") == 0
    assert read_status(begun.folder)["state"] == "finished"
    assert (begun.folder / "progress.csv").read_bytes() == (whole.folder / "progress.csv").read_bytes()


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (lambda f: (f / "progress.csv").write_text("iteration,x\n0,5\n"), "progress.csv: not what the run wrote"),
        (lambda f: (f / "secret").symlink_to("/etc/passwd"), "holds a link"),
        (lambda f: (f / "manifest.json").write_text("{"), "manifest.json: is no JSON"),
        (lambda f: (f / "manifest.json").write_text('{"run_id": "../x", "identity": {}}'), "names no run"),
        (lambda f: (f / "manifest.json").unlink(), "No such file"),
    ],
)
def test_what_is_no_whole_run_is_refused_by_name_and_nothing_is_copied(harm, message, tmp_path, capsys):
    run = finished(tmp_path / "a")
    harm(run.folder)
    assert collect(tmp_path, tmp_path / "a") == 1
    error = capsys.readouterr().err
    assert message in error
    assert str(run.folder) in error
    assert error.count("\n") == 1
    assert not [path for path in (tmp_path / "runs").rglob("*") if path.is_file()]


def test_bad_folders_are_one_line_and_nothing_is_written(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    for folders, message in (
        ([], "name the runs folders"),
        ([tmp_path / "none"], "must be a folder"),
        ([tmp_path / "empty"], "holds no run"),
    ):
        assert collect(tmp_path, *folders) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    assert not (tmp_path / "runs").exists()


def test_a_copy_that_was_interrupted_counts_for_nothing_and_is_made_again(tmp_path, monkeypatch, capsys):
    run = finished(tmp_path / "a")

    def half(source, target, **_):
        target.mkdir()
        shutil.copy(source / "status.json", target)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("experiments.collect.shutil.copytree", half)
    assert collect(tmp_path, tmp_path / "a") == 1
    assert "No space left on device" in capsys.readouterr().err
    assert read_status(tmp_path / "runs" / run.run_id)["state"] == "missing"
    monkeypatch.undo()
    assert collect(tmp_path, tmp_path / "a") == 0
    assert read_status(tmp_path / "runs" / run.run_id)["state"] == "finished"
    assert not list((tmp_path / "runs").rglob("*.tmp"))
