"""Runs that a power cut stopped, or whose log somebody changed, end at the same bytes or in one line."""

import hashlib
import os
import types

import pytest
import torch

from experiments import train
from experiments.status import read_status
from hippo.core.checkpoint import Checkpoint, CheckpointError, load, save
from hippo.core.log import RunLog
from tests.experiments import stub
from tests.experiments.power_cut import Recorder, put
from tests.experiments.stub import ITERATIONS, learn

RESULTS = ("progress.csv", "checkpoint.pt")


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A run of a learner that takes no time."""
    stub.use(monkeypatch)
    return stub.run_in(tmp_path)


def results(run):
    return {name: (run.folder / name).read_bytes() for name in RESULTS}


def try_cuts(run, monkeypatch, every):
    """Cut a run at every `every`-th point, go on each time; returns the number of cuts tried."""
    recorder = Recorder(run.folder)
    with recorder.recording(monkeypatch):
        assert train.execute(run) == "finished"
    recorder.cut()
    whole = results(run)
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)  # nothing more is cut, so nothing waits for the disk
    chosen = recorder.cuts[::every]
    for number, files in enumerate(chosen):
        put(run.folder, files)
        state = read_status(run.folder)["state"]
        assert train.execute(run) == "finished", (number, state, list(files))
        assert results(run) == whole, (number, state, {name: len(content) for name, content in files.items()})
        assert read_status(run.folder)["state"] == "finished"
    return len(chosen)


def test_a_run_goes_on_to_the_same_bytes_after_a_power_cut_at_any_point(run, monkeypatch):
    tried = try_cuts(run, monkeypatch, every=10)
    assert tried >= 20


@pytest.mark.slow
def test_at_least_two_hundred_power_cuts(run, monkeypatch):
    tried = try_cuts(run, monkeypatch, every=1)
    print(f"{tried} power cuts, the same bytes after each")
    assert tried >= 200


def rewritten(text, how):
    """progress.csv as somebody left it."""
    lines = text.splitlines(keepends=True)
    return {
        "emptied": "",
        "cut": "".join(lines[:3]),
        "cut in a row": text[:-3],
        "reordered": "".join([*lines[:2], lines[3], lines[2], *lines[4:]]),
        "duplicated": "".join([*lines[:3], *lines[2:]]),
        "edited": text.replace("2,2,", "2,7,"),
        "longer": text + lines[-1],
        "zeros": "".join(lines[:3]) + "\0" * 200,
        "CRLF": text.replace("\n", "\r\n"),
        "deleted": None,
    }[how]


KINDS = ("emptied", "cut", "cut in a row", "reordered", "duplicated", "edited", "longer", "zeros", "CRLF", "deleted")


@pytest.mark.parametrize("how", KINDS)
def test_a_finished_run_whose_log_was_changed_is_not_finished_and_the_same_command_repairs_it(run, how):
    assert train.execute(run) == "finished"
    whole, path = results(run), run.folder / "progress.csv"
    text = rewritten(path.read_text(), how)
    path.unlink()
    if text is not None:
        path.write_bytes(text.encode())
    status = read_status(run.folder)
    assert status["state"] == "lost"
    assert "progress.csv" in status["message"]
    assert train.execute(run) == "finished"
    assert results(run) == whole
    assert read_status(run.folder)["state"] == "finished"


@pytest.mark.parametrize("how", ["emptied", "cut", "deleted"])
def test_a_run_of_older_code_that_noted_no_digests_is_checked_by_its_rows(run, how):
    assert train.execute(run) == "finished"
    whole = results(run)
    for name in ("checkpoint.pt", "checkpoint.prev.pt"):
        state = load(run.folder / name)
        save(run.folder / name, {key: part for key, part in state.items() if key not in ("run_id", "log")})
    status = run.folder / "status.json"
    status.write_text(status.read_text().split(',\n "results"')[0] + "}")
    assert read_status(run.folder)["state"] == "finished"
    path = run.folder / "progress.csv"
    text = rewritten(path.read_text(), how)
    path.unlink() if text is None else path.write_text(text)
    assert read_status(run.folder)["state"] == "lost"
    assert train.execute(run) == "finished"
    assert results(run) == whole


def test_an_older_checkpoint_is_taken_when_the_last_row_is_gone(run, capsys):
    assert train.execute(run) == "finished"
    whole, path = results(run), run.folder / "progress.csv"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))
    assert train.execute(run) == "finished"
    assert results(run) == whole
    said = capsys.readouterr()
    assert "starts again" not in said.err
    assert f"iteration {ITERATIONS}/{ITERATIONS}" in said.out


def test_a_run_whose_log_is_changed_while_it_trains_does_not_count_as_finished(run, monkeypatch, capsys):
    def meddled(config, make_envs, log, seed, checkpoint):
        learn(config, make_envs, log, seed, checkpoint)
        (run.folder / "progress.csv").write_text("iteration\n")

    monkeypatch.setattr(train, "learner_of", lambda name: types.SimpleNamespace(train=meddled))
    assert train.execute(run) == "failed"
    assert "somebody else changed it" in read_status(run.folder)["message"]


def test_a_checkpoint_of_another_run_is_refused_in_one_line(run, tmp_path, capsys):
    other = stub.run_in(tmp_path, "seed=1")
    assert train.execute(other) == "finished"
    run.folder.mkdir()
    for name in ("checkpoint.pt", "progress.csv"):
        (run.folder / name).write_bytes((other.folder / name).read_bytes())
    capsys.readouterr()
    assert train.execute(run) == "failed"
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error")]
    assert len(errors) == 1
    assert f"is of run {other.run_id}, not of {run.run_id}" in errors[0]


def test_a_checkpoint_of_the_right_digest_and_the_wrong_content_is_refused(tmp_path):
    net = torch.nn.Linear(2, 2)
    for content in ({"iteration": 1}, {"net": 3}, {"net": {}, "iteration": 1}, {"net": net.state_dict()}):
        save(tmp_path / "checkpoint.pt", content)
        with pytest.raises(CheckpointError, match="checkpoint"):
            Checkpoint(tmp_path).restore(net=net)
    payload = b"no archive"
    (tmp_path / "checkpoint.pt").write_bytes(b"HIPPO\x00\x01\n" + hashlib.sha256(payload).digest() + payload)
    with pytest.raises(CheckpointError, match="no intact"):
        Checkpoint(tmp_path).restore(net=net)


def test_rows_that_are_missing_are_never_skipped_over(tmp_path):
    log = RunLog(tmp_path)
    for i in range(3):
        log.row({"iteration": i, "x": i}, {"s": 1.0})
    with pytest.raises(RuntimeError, match="holds 3 rows of the 5"):
        RunLog(tmp_path).resume(5)
