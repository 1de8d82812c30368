"""A folder is read as it was given, and every stretch of a run keeps its own record; what is unknown is never clean."""

import json
import shutil
import subprocess

import pytest

from analysis import explain, runs
from experiments import evaluate, manifest, train
from experiments.status import Status, read_status
from hippo.core.settings import ConfigError
from tests import ROOT
from tests.experiments import stub


@pytest.fixture
def run(tmp_path, monkeypatch):
    stub.use(monkeypatch)
    return stub.run_in(tmp_path / "runs")


def test_a_copied_folder_is_read_itself_and_said_to_be_a_copy(run, tmp_path, capsys):
    assert train.execute(run) == "finished"
    capsys.readouterr()
    evaluate.load_run(run.folder)
    assert capsys.readouterr().err == ""
    copy = tmp_path / "renamed"
    shutil.copytree(run.folder, copy)
    shutil.rmtree(run.folder)
    read = evaluate.load_run(copy)
    assert read.folder == copy
    assert evaluate.trained(read).current == copy / "checkpoint.pt"
    assert f"{copy} is a copy of run {run.run_id}" in capsys.readouterr().err
    assert read.parent is None


def test_a_run_of_another_revision_is_read_where_it_lies_and_the_difference_is_named(run, monkeypatch, capsys):
    assert train.execute(run) == "finished"
    monkeypatch.setattr("hippo.hippo.REVISION", 99)
    read = evaluate.load_run(run.folder)
    assert read.folder == run.folder
    assert evaluate.name_of(read) == run.run_id
    error = capsys.readouterr().err
    assert f"is run {run.run_id}, under this code it would be {read.run_id}: algo_revision" in error
    assert evaluate.trained(read).load()["iteration"] == stub.ITERATIONS - 1


def test_a_policy_of_another_run_in_a_folder_is_refused(run):
    other = stub.run_in(run.runs_dir, "seed=1")
    assert {train.execute(each) for each in (run, other)} == {"finished"}
    shutil.copy(other.folder / "checkpoint.pt", run.folder / "checkpoint.pt")
    with pytest.raises(RuntimeError, match=f"is of run {other.run_id}, not of {run.run_id}"):
        evaluate.trained(evaluate.load_run(run.folder)).load()


@pytest.mark.parametrize("text", ["", "[]", "algo: hippo", "algo: nonsense", "\x00", "a: b: c"])
def test_a_damaged_config_is_named_in_one_line(text, tmp_path, capsys):
    (tmp_path / "config.yaml").write_text(text)
    assert evaluate.main([str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert str(tmp_path / "config.yaml") in error


def test_committed_policies_load_without_a_name():
    folders = sorted((ROOT / "paper_figures/data/laptop/policies").iterdir())
    assert evaluate.trained(evaluate.load_run(folders[0])).load()["iteration"] > 0


def continued(run, **changes):
    """Train `run` on after its manifest was made to say that its first stretch was made under other conditions."""
    path = run.folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    Status(run).update(state="preempted", iteration=3)
    assert train.execute(run) == "finished"
    return json.loads(path.read_text())


def test_every_stretch_keeps_its_own_record_and_a_change_is_announced(run, monkeypatch, capsys):
    monkeypatch.setattr(
        manifest, "git", lambda command, *_: f"{manifest.ROOT}\n{'a' * 40}" if command == "rev-parse" else ""
    )
    assert train.execute(run) == "finished"
    first = json.loads((run.folder / "manifest.json").read_text())
    assert (first["from_iteration"], first["earlier"], first["git_difference"]) == (0, [], None)
    assert continued(run)["earlier"] == []  # nothing has changed, so it is one stretch
    assert "warning" not in capsys.readouterr().err
    versions = first["versions"] | {"torch": "1.0"}
    after = continued(run, versions=versions, cpu="An old CPU", git_commit="b" * 40, python="3.1")
    assert after["from_iteration"] == 4
    assert [(each["cpu"], each["versions"]["torch"]) for each in after["earlier"]] == [("An old CPU", "1.0")]
    warning = capsys.readouterr().err
    assert "bytes may differ" in warning
    assert f"torch 1.0 before, {first['versions']['torch']} now" in warning
    for what in ("cpu An old CPU", "commit bbbb", "python 3.1"):
        assert f"{what}" in warning
    assert runs.read_commits(run.runs_dir, [run.run_id]) == ["a" * 10, "b" * 10]
    text = "\n".join(explain.describe_run(run.folder))
    assert "torch 1.0" in text
    assert "from iteration 4: commit aaaaaaaaaa, Python" in text


def test_a_damaged_manifest_is_set_aside_and_the_run_goes_on(run, capsys):
    assert train.execute(run) == "finished"
    for damaged in (b"", b"{", b"\xff\xfe", b"[]", b'{"run_id": 3}'):
        (run.folder / "manifest.json").write_bytes(damaged)
        Status(run).update(state="preempted")
        capsys.readouterr()
        assert train.execute(run) == "finished"
        assert "manifest.json" in capsys.readouterr().err
        assert (run.folder / "manifest.json.damaged").read_bytes() == damaged
        content = json.loads((run.folder / "manifest.json").read_text())
        assert content["run_id"] == run.run_id
        assert content["earlier"][0]["git_commit"] == "unknown"


@pytest.mark.parametrize("damaged", [b"", b"[]", b"{}", b"\xff\xfe\x00", b'{"state": 3}', b'{"state": "nonsense"}'])
def test_a_damaged_status_is_lost_and_the_run_goes_on(run, damaged):
    run.folder.mkdir(parents=True)
    (run.folder / "status.json").write_bytes(damaged)
    assert read_status(run.folder)["state"] == "lost"
    assert train.execute(run) == "finished"


def test_without_git_the_code_is_unknown_and_training_goes_on(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert manifest.code_version() == {"git_commit": "unknown", "git_difference": "unknown"}
    assert runs.code_of(manifest.code_version()) == "unknown"
    assert runs.code_of({"git_commit": "", "git_difference": None}) == "unknown"  # of older code


@pytest.fixture
def tree(tmp_path, monkeypatch):
    """A repository with one commit, in the place of ours."""
    folder = tmp_path / "tree"
    folder.mkdir()
    (folder / "a.py").write_text("x = 1\n")
    git = ["git", "-C", str(folder), "-c", "user.name=n", "-c", "user.email=e@x"]
    for command in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "one"]):
        subprocess.run([*git, *command], check=True)
    monkeypatch.setattr(manifest, "ROOT", folder)
    return folder


def test_code_that_git_does_not_track_yet_is_a_change(tree):
    clean = manifest.code_version()
    assert clean["git_difference"] is None
    (tree / "notes.txt").write_text("no code")
    assert manifest.code_version() == clean
    (tree / "b.py").write_text("y = 1\n")
    new = manifest.code_version()
    assert new["git_difference"] is not None
    (tree / "b.py").write_text("y = 2\n")
    assert manifest.code_version()["git_difference"] not in (None, new["git_difference"])


def test_a_tree_of_another_owner_is_read_and_one_inside_another_repository_is_unknown(tree, monkeypatch):
    (tree / "a.py").write_text("x = 2\n")
    monkeypatch.setenv("GIT_TEST_ASSUME_DIFFERENT_OWNER", "1")
    assert manifest.code_version()["git_difference"] not in (None, "unknown")
    inner = tree / "copy"
    inner.mkdir()
    monkeypatch.setattr(manifest, "ROOT", inner)
    assert manifest.code_version()["git_commit"] == "unknown"


def test_a_folder_without_config_is_no_run(tmp_path):
    with pytest.raises(ConfigError, match=r"no config\.yaml"):
        evaluate.load_run(tmp_path)
