"""Whatever is read from disk has a schema: one line that names the file, nothing obeyed, nothing written."""

import cProfile
import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from analysis import explain, report_runs, runs, stats
from experiments import code_snapshot, costs, evaluate, launchers, slurm, slurm_profile, sweep, train
from experiments.config import compose_run
from experiments.status import (
    SILENT,
    TAKE_OVER_SECONDS,
    check_locks,
    is_locked,
    locked,
    read_status,
    remove_abandoned,
)
from hippo.core import checkpoint
from hippo.core.files import DamagedFile, printable
from hippo.core.settings import ConfigError
from hippo.core.skills import SkillsError, read_skills
from paper_figures import curves, tabular
from tests import ROOT
from tests.experiments import stub

RUN = {
    "run_id": "0" * 12,
    "env": "block_hopper",
    "env_label": "Block Hopper",
    "variant": "ppo",
    "kind": "train",
    "variant_label": "PPO",
    "physics": "paper",
    "state": "finished",
    "seed": 0,
    "iterations": 3,
    "batch_size": 10,
}
PLAN = {"figure": "fig3", "scale": "smoke", "protocol": "paper", "overrides": [], "title": "T", "runs": [RUN]}


def planned(tmp_path, **changes):
    """A plan on disk with something changed in it, or in its run."""
    path = tmp_path / "runs/plans/smoke/fig3.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    of_plan = {key: value for key, value in changes.items() if key in PLAN}
    path.write_text(json.dumps(PLAN | {"runs": [RUN | {k: v for k, v in changes.items() if k not in PLAN}]} | of_plan))
    return path


def written_rows(tmp_path, text):
    folder = tmp_path / "runs" / RUN["run_id"]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "progress.csv").write_text(text)
    return folder


@pytest.mark.parametrize(
    "changes",
    [
        {"figure": "/abs/path"},
        {"figure": "../fig3"},
        {"runs": 3},
        {"runs": [3]},
        {"title": "T\x1b[2J"},
        {"run_id": "../" + "0" * 9},
        {"run_id": "0" * 11 + "\n"},
        {"run_id": "\\write18{x}"},
        {"variant": "=cmd()"},
        {"env_label": "a\x1b]0;b"},
        {"seed": "0"},
        {"iterations": None},
    ],
    ids=str,
)
def test_a_plan_of_somebody_else_is_checked_where_it_is_read(changes, tmp_path, capsys):
    path = planned(tmp_path, **changes)
    written_rows(tmp_path, "iteration,env_steps,return_mean\n0,1,1.0\n")
    out = tmp_path / "out"
    assert curves.main("fig3", ["--runs-dir", str(tmp_path / "runs"), "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert str(path) in error
    assert "\x1b" not in error
    assert not out.exists()


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", "\x00", '"', "[" * 100_000])
def test_a_malformed_plan_is_one_line(text, tmp_path, capsys):
    path = planned(tmp_path)
    path.write_text(text)
    assert curves.main("fig3", ["--runs-dir", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert str(path) in error


@pytest.mark.parametrize(
    "text",
    [
        "garbage\n",
        "iteration,env_steps,return_mean\n0,1,words\n",
        "iteration,env_steps,=cmd\n0,1,1\n",
        "iteration,return_mean\n0,1\n",
    ],
)
def test_a_log_that_is_none_is_one_line_that_names_it(text, tmp_path, capsys):
    planned(tmp_path)
    folder = written_rows(tmp_path, text)
    with pytest.raises(DamagedFile, match=r"progress\.csv"):
        runs.read_progress(folder / "progress.csv", None)


def test_results_that_were_changed_after_the_run_finished_are_not_drawn(tmp_path, monkeypatch, capsys):
    stub.use(monkeypatch)
    run = stub.run_in(tmp_path / "runs")
    assert train.execute(run) == "finished"
    planned(tmp_path, run_id=run.run_id, iterations=stub.ITERATIONS)
    path = run.folder / "progress.csv"

    def load():
        return runs.load("fig3", "smoke", tmp_path / "runs", tmp_path / "data")

    assert load().missing == []
    path.write_text(path.read_text().replace("\n3,3,", "\n3,3,1"))
    with pytest.raises(runs.MissingData):
        load()


def test_values_that_are_not_finite_are_counted_in_the_caption(tmp_path):
    planned(tmp_path)
    written_rows(tmp_path, "iteration,env_steps,return_mean\n0,1,1.0\n1,2,inf\n2,3,nan\n")
    results = runs.load("fig3", "smoke", tmp_path / "runs", tmp_path / "data")
    assert f"2 of 3 values, of runs {RUN['run_id']} (2)" in curves.caption(results, 0.0, None)
    _, values = curves.bundle(results, "block_hopper", "ppo", 0.0)
    assert np.isfinite(values[:, 0]).all()
    assert not np.isinf(values).any()


def test_long_curves_are_thinned_and_the_bootstrap_in_pieces_gives_the_same_numbers(monkeypatch):
    assert curves.thinned(5).tolist() == [0, 1, 2, 3, 4]
    chosen = curves.thinned(100_000)
    assert (len(chosen), chosen[0], chosen[-1]) == (curves.MOST_POINTS, 0, 99_999)
    values = np.random.default_rng(0).normal(size=(3, 50))
    whole = stats.bootstrap_mean(values, 100)
    monkeypatch.setattr(stats, "AT_ONCE", 3 * 100 * 7)
    pieces = stats.bootstrap_mean(values, 100)
    assert np.array_equal(whole.low, pieces.low)
    assert np.array_equal(whole.high, pieces.high)
    assert stats.bootstrap_mean(values[:, 0], 100).low.shape == ()


def long_runs(tmp_path, rows):
    """The plan and the logs of five finished runs of so many rows each."""
    names = [str(seed) * 12 for seed in range(5)]
    runs_of = [RUN | {"run_id": name, "seed": seed, "iterations": rows} for seed, name in enumerate(names)]
    planned(tmp_path, runs=runs_of)
    for seed, name in enumerate(names):
        folder = tmp_path / "runs" / name
        folder.mkdir(exist_ok=True)
        values = np.random.default_rng(seed).normal(size=rows).tolist()
        text = "".join(f"{i},{i * 8000},{value}\n" for i, value in enumerate(values))
        (folder / "progress.csv").write_text("iteration,env_steps,return_mean\n" + text)


def test_drawing_takes_few_calls_per_row(tmp_path, monkeypatch):
    """Calls instead of seconds, which say as much about the machine."""
    monkeypatch.setattr(curves.style, "save", lambda *_: [])  # the same for every number of rows

    def calls(rows):
        place = tmp_path / str(rows)
        long_runs(place, rows)
        (place / "smoke").mkdir(exist_ok=True)
        with cProfile.Profile() as profile:
            results = runs.load("fig3", "smoke", place / "runs", place / "data")
            results.provenance()
            curves.draw(results, place)
        return sum(each.callcount for each in profile.getstats())

    few, many = curves.MOST_POINTS, 2 * curves.MOST_POINTS
    calls(few)  # what is imported by the first picture
    assert (calls(many) - calls(few)) / (5 * (many - few)) < 3


def test_rows_are_written_as_pandas_writes_them(tmp_path):
    planned(tmp_path)
    written_rows(tmp_path, "iteration,env_steps,return_mean\n0,1,0.1\n1,2,inf\n2,3,nan\n3,4,1e-300\n4,5,-3\n")
    frame = runs.load("fig3", "smoke", tmp_path / "runs", tmp_path / "data").frame
    runs.write_rows(frame, tmp_path / "rows.csv")
    assert (tmp_path / "rows.csv").read_text() == frame.to_csv(index=False, lineterminator="\n")


@pytest.mark.slow
def test_five_runs_of_a_hundred_thousand_rows_are_drawn_in_little_memory(tmp_path):
    long_runs(tmp_path, 100_000)
    code = f"""
import re, time
from pathlib import Path
from paper_figures import fig3
assert fig3.main(["--runs-dir", {str(tmp_path / "runs")!r}, "--out", {str(tmp_path)!r}]) == 0
print(re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1], time.process_time())
"""
    kilobytes, seconds = map(float, python(code).split()[-2:])
    print(f"{seconds:.1f} CPU-seconds, {kilobytes / 1024:.0f} MB")
    assert kilobytes / 1024 < 500


def test_nothing_in_a_line_of_latex_s_comment_ends_it():
    assert "\n\\write18" not in tabular.latex([{"a": "b"}], "x\n\\write18{touch}")


def test_a_link_in_a_run_s_folder_is_not_read(tmp_path):
    (tmp_path / "secret.mp4").write_bytes(b"secret")
    folder = tmp_path / "runs" / RUN["run_id"]
    folder.mkdir(parents=True)
    (folder / "a.mp4").symlink_to(tmp_path / "secret.mp4")
    (folder / "b.mp4").write_bytes(b"own")
    facts = report_runs.RunFacts(RUN["run_id"])
    report_runs.read_folder(facts, tmp_path / "runs")
    assert facts.videos == [folder / "b.mp4"]


def test_terminal_escapes_of_a_status_are_shown_not_obeyed(tmp_path):
    assert printable("a\x1b[2Jb\n") == "a\\x1b[2Jb\\x0a"
    assert runs.code_of({"git_commit": "\x1b]0;x", "git_difference": None}) == "unknown"


def test_explain_shows_terminal_escapes_of_all_that_it_prints(tmp_path, monkeypatch, capsys):
    stub.use(monkeypatch)
    run = stub.run_in(tmp_path)
    assert train.execute(run) == "finished"
    for name, key in (("status.json", "message"), ("manifest.json", "cpu")):
        path = run.folder / name
        path.write_text(json.dumps(json.loads(path.read_text()) | {key: "a\x1b[2J"}))
    capsys.readouterr()
    assert explain.main([str(run.folder)]) == 0
    said = capsys.readouterr().out
    assert "\x1b" not in said
    assert said.count("a\\x1b[2J") == 2


@pytest.mark.parametrize(
    "text", ["[]", "{", "\x00", '{"a": 3}', '{"KEY": {"seconds_per_step": "fast"}}', '{"KEY": {}}']
)
def test_a_bad_costs_file_counts_for_nothing(text, tmp_path, monkeypatch):
    run = compose_run(["scale=smoke"], tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    costs.cache_file().parent.mkdir(parents=True)
    costs.cache_file().write_text(text.replace("KEY", costs.key(run)))
    assert costs.seconds(run) > 0
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", "/dev/null")
    assert costs.known() == {}


def test_the_file_to_write_is_checked_before_anything_is_evaluated(tmp_path, capsys):
    for out in (tmp_path, tmp_path / "nowhere" / "x.csv", "/dev/null/x.csv"):
        assert evaluate.main([str(tmp_path), "--out", str(out)]) == 2
        assert capsys.readouterr().err.startswith(f"error: --out={out}: must be a file that can be written")


@pytest.mark.parametrize("content", [{"metadata": 3, "policy": {}}, {"metadata": [], "policy": {}}, {"x": 1}])
def test_a_skills_file_of_the_right_digest_and_the_wrong_content_is_refused(content, tmp_path):
    checkpoint.save(tmp_path / "s.pt", content)
    with pytest.raises(SkillsError, match=str(tmp_path)):
        read_skills(tmp_path / "s.pt")


@pytest.mark.parametrize(
    "setting", ["algo.num_skills=1000000000", "algo.skill_hidden_sizes=[1000000000]", "batch_size=1000000000000"]
)
def test_sizes_are_checked_before_memory_is_asked_for(setting, tmp_path, capsys):
    assert train.main([setting, "scale=smoke", f"runs_dir={tmp_path / 'runs'}"]) == 2
    assert "must be at most" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_a_lock_that_is_a_folder_is_one_line(tmp_path, monkeypatch, capsys):
    stub.use(monkeypatch)
    run = stub.run_in(tmp_path)
    (run.folder / ".lock").mkdir(parents=True)
    assert train.execute(run) == "failed"
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert f"{run.run_id} cannot start" in error


# ------------------------------------------------------------------------------------------------- sweeps and launchers

FIGURE = {
    "title": "tiny",
    "environments": ["block_hopper"],
    "variants": {"hippo": {"label": "HiPPO", "algo": "hippo"}, "ppo": {"label": "PPO", "algo": "ppo"}},
}


@pytest.fixture
def tiny(monkeypatch):
    monkeypatch.setattr("experiments.plan.load_figure", lambda name: FIGURE)


@pytest.mark.parametrize("action", ["run", "write"])
def test_a_runs_dir_that_is_no_folder_is_one_line(action, tiny, tmp_path, capsys):
    place = tmp_path / "file"
    place.write_text("")
    assert sweep.main([action, "tiny", "--runs-dir", str(place)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: runs-dir={place}: must be a folder that can be written")
    assert error.count("\n") == 1


class Pipe:
    """What a worker receives, and what it answers."""

    def __init__(self, *messages):
        self.messages, self.answers = list(messages), []

    def recv(self):
        if not self.messages:
            raise EOFError
        return self.messages.pop(0)

    def send(self, answer):
        self.answers.append(answer)


def test_one_folder_that_cannot_be_written_fails_its_own_run_only(tmp_path, monkeypatch):
    monkeypatch.setattr(launchers, "execute", lambda run: "finished")
    monkeypatch.setattr(os, "dup2", lambda *_: None)
    monkeypatch.setattr(launchers.signal, "signal", lambda *_: None)
    bad, good = stub.run_in(tmp_path), stub.run_in(tmp_path, "seed=1")
    bad.folder.write_text("no folder")
    pipe = Pipe(*[(run.to_yaml(), str(tmp_path)) for run in (bad, good)])
    launchers._work(pipe)
    assert pipe.answers[0][0] == "failed"
    assert "cannot be written" in pipe.answers[0][1]
    assert pipe.answers[1] == ("finished", "")


def test_a_full_disk_leaves_the_right_state_and_is_recognised(tmp_path, monkeypatch, capsys):
    stub.use(monkeypatch)
    run = stub.run_in(tmp_path)
    real = os.fsync

    def full(descriptor):
        if os.path.exists(run.folder / "checkpoint.prev.pt"):
            raise OSError(errno.ENOSPC, "No space left on device")
        real(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    assert train.execute(run) == "failed"
    status = json.loads((run.folder / "status.json").read_text())
    assert (status["state"], status["cause"]) == ("failed", "infrastructure")  # written into the room of the old one
    assert "No space left" in status["message"]
    assert launchers.is_full(tmp_path)
    monkeypatch.setattr(os, "fsync", real)
    assert not launchers.is_full(tmp_path)
    assert train.execute(run) == "finished"


def test_a_stopped_trainer_that_holds_its_lock_is_waited_for_quietly(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep.time, "sleep", lambda seconds: None)
    run, launches, looks = stub.run_in(tmp_path), [], []

    def launch(todo, *_):
        launches.append(todo)
        return {each.run_id: "running" if len(launches) == 1 else "finished" for each in todo}

    monkeypatch.setattr(sweep, "run_locally", launch)
    monkeypatch.setattr(sweep, "read_status", lambda folder: {"state": "lost"})
    run.folder.mkdir()
    lock = locked(run.folder / ".lock")
    lock.__enter__()

    def report(running, ended):
        looks.append(len(running))
        if len(looks) == 5:
            assert len(launches) == 1  # no launch while the lock is held
            lock.__exit__(None, None, None)

    assert sweep.train_all([run], 1, report) == {run.run_id: "finished"}
    assert len(launches) == 2
    assert len(looks) >= 5  # not launched again before


def test_a_soft_lock_whose_owner_has_been_silent_for_long_is_taken_over(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HIPPO_SOFT_LOCKS", "1")
    stub.use(monkeypatch)
    run = stub.run_in(tmp_path)
    run.folder.mkdir()
    soft, status = run.folder / ".lock.soft", run.folder / "status.json"
    status.write_text(json.dumps({"state": "running", "host": "another", "pid": 1, "iteration": 0}))
    soft.write_text("1\nanother\n")  # a half-finished run copied from another host
    long_ago = soft.stat().st_mtime - TAKE_OVER_SECONDS / 2
    for path in (soft, status):
        os.utime(path, (long_ago, long_ago))
    assert read_status(run.folder)["state"] == "running"
    assert is_locked(run.folder)  # so a sweep waits
    assert train.execute(run) == "running"
    assert f"which holds its lock and has been silent: stopped? If it is gone, delete {soft}" in capsys.readouterr().out
    long_ago -= TAKE_OVER_SECONDS
    for path in (soft, status):
        os.utime(path, (long_ago, long_ago))
    assert read_status(run.folder)["state"] == "lost"
    assert soft.exists()  # who only looks takes nothing over
    assert train.execute(run) == "finished"
    assert "taken over" in capsys.readouterr().err


@pytest.mark.parametrize("text", ['{"state": "running", "message": "", "iteration": 0}', "damaged"])
@pytest.mark.parametrize("kind", ["0", "1"])
def test_status_and_lock_say_the_same_of_a_silent_run(kind, text, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HIPPO_SOFT_LOCKS", kind)
    stub.use(monkeypatch)
    run = stub.run_in(tmp_path)
    run.folder.mkdir()
    path = run.folder / "status.json"
    path.write_text(text)
    os.utime(path, (path.stat().st_mtime - TAKE_OVER_SECONDS / 2,) * 2)
    with locked(run.folder / ".lock"):
        monkeypatch.setenv("HIPPO_SOFT_LOCKS", "0")  # of the shell that asks
        assert is_locked(run.folder)
        status = read_status(run.folder)
        assert (status["state"], status["message"]) == ("running", SILENT)
    assert not is_locked(run.folder)
    assert read_status(run.folder)["state"] == "lost"


def test_asking_for_a_lock_makes_none(tmp_path):
    assert not is_locked(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_is_one_line(number, tmp_path, monkeypatch):
    import fcntl

    def flock(descriptor, operation):
        raise OSError(number, "no locks here")

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.raises(OSError, match="no file locks"):
        check_locks(tmp_path)


def test_temporary_files_of_killed_processes_are_removed_at_the_next_start(tiny, tmp_path):
    place = tmp_path / "plans/smoke"
    place.mkdir(parents=True)
    left, ours, fresh = (place / f"tiny.json.{pid}.tmp" for pid in (2**22 + 1, os.getppid(), 2**22 + 2))
    (tmp_path / "code-1.4194305.tmp").mkdir()
    for path in (left, ours, fresh, tmp_path / "code-1.4194305.tmp"):
        path.exists() or path.write_text("")
        os.utime(path, (1, 1)) if path != fresh else None  # one of another host, perhaps
    assert sweep.main(["write", "tiny", "--runs-dir", str(tmp_path)]) == 0
    assert {path.name for path in place.iterdir()} == {"tiny.json", ours.name, fresh.name}
    remove_abandoned(tmp_path)
    assert not (tmp_path / "code-1.4194305.tmp").exists()


# ---------------------------------------------------------------------------------------------------------------- Slurm


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ('partition: "a\\ncurl x | sh"', "partition"),
        ("account: 'a b'", "account"),
        ("constraint: $(x)", "constraint"),
        ("partition: 3", "partition"),
        ("memory_gb: 0.0001", "memory_gb"),
        ("memory_gb: '2'", "memory_gb"),
        ("memory_gb: .nan", "memory_gb"),
        ("cpus: 1.5", "cpus"),
        ("cpus: true", "cpus"),
        ("time_minutes: ten", "time_minutes"),
        ("signal_seconds: 60000", "signal_seconds"),
        ("a: [", "profile"),
        ("\x00", "profile"),
        ("- a", "profile"),
    ],
)
def test_a_bad_profile_is_one_line(text, key, tmp_path):
    (tmp_path / "p.yaml").write_text(text)
    with pytest.raises(ConfigError, match=key) as caught:
        slurm_profile.load_profile(tmp_path / "p.yaml")
    assert "\n" not in str(caught.value)


def test_what_sbatch_takes_is_taken(tmp_path):
    (tmp_path / "p.yaml").write_text("constraint: '[rack1*2&rack2*4]'\npartition: gpu,cpu-long\nmemory_gb: 0.5")
    assert slurm_profile.load_profile(tmp_path / "p.yaml").memory_gb == 0.5


def test_slurm_without_slurm_is_one_line_and_writes_nothing(tiny, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert sweep.main(["run", "tiny", "--launcher", "slurm", "--runs-dir", str(tmp_path / "runs")]) == 2
    assert "needs Slurm's sbatch" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_the_queue_is_read_whatever_a_job_is_called(tmp_path, monkeypatch, capsys):
    batches = tmp_path / "slurm/batches"
    batches.mkdir(parents=True)
    ours, damaged = "hippo-0123456789", "hippo-aaaaaaaaaa"
    (batches / f"{ours}.json").write_text(json.dumps([["a"], ["b"]]))
    (batches / f"{damaged}.json").write_text("{}")
    names = ["my|job", ours, "../" + ours, "", damaged]
    lines = [f"1|7{i}|RUNNING|{name}" for i, name in enumerate(names)]
    monkeypatch.setattr(slurm, "_ask", lambda *_: "\n".join([*lines, "what?"]))
    assert slurm.queued(tmp_path) == {"b": "71_1"}
    assert damaged in capsys.readouterr().err


@pytest.fixture
def code(tmp_path, monkeypatch):
    """A tree without usable git, with runs, data and an environment in it, in the place of ours."""
    root = tmp_path / "tree"
    for name, text in {
        "hippo/a.py": "x = 1",
        "experiments/conf/b.yaml": "y: 1",
        "requirements.lock": "z",
        "runs/r/checkpoint.py": "run",
        "venv/lib/c.py": "no",
        "paper_figures/data/laptop/big.csv": "1",
        "hippo/notes.bin": "no code",
    }.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    monkeypatch.setattr(code_snapshot, "ROOT", root)
    monkeypatch.setattr(code_snapshot, "git", lambda *_: None)
    return root


def test_a_snapshot_holds_code_only_and_there_is_one_per_digest(code):
    first = code_snapshot.snapshot(code / "runs/slurm")
    held = {str(path.relative_to(first)) for path in first.rglob("*") if path.is_file()}
    assert held == {"hippo/a.py", "experiments/conf/b.yaml", "requirements.lock", "snapshot.json"}
    (code / "runs/r/more.py").write_text("run")
    assert code_snapshot.snapshot(code / "runs/slurm") == first
    (code / "hippo/a.py").write_text("x = 2")
    assert code_snapshot.snapshot(code / "runs/slurm") != first


def test_a_snapshot_has_a_limit(code, monkeypatch):
    monkeypatch.setattr(code_snapshot, "MOST_CODE", 5)
    with pytest.raises(ConfigError, match="at most 5 bytes"):
        code_snapshot.snapshot(code / "runs/slurm")


@pytest.mark.parametrize("name", ["hippo/a.py", "sitecustomize.py", "hippo/link.py", "hippo/torch.pth"])
def test_a_planted_snapshot_is_not_taken(name, code):
    target = code_snapshot.snapshot(code / "runs/slurm")
    planted = target / name
    planted.unlink(missing_ok=True)
    planted.symlink_to(code / "hippo/a.py") if "link" in name else planted.write_text("import os")
    with pytest.raises(ConfigError, match="is not the code that its name says"):
        code_snapshot.snapshot(code / "runs/slurm")


def test_planted_bytecode_in_a_snapshot_is_not_run(code):
    target = code_snapshot.snapshot(code / "runs/slurm")
    for name in ("hippo/__pycache__/a.cpython-311.pyc", "hippo/__pycache__/a.f-1.py311.nbc"):
        (target / name).parent.mkdir(exist_ok=True)
        (target / name).write_bytes(b"planted")
    code_snapshot.snapshot(code / "runs/slurm")
    assert not list((target / "hippo/__pycache__").iterdir())


# --------------------------------------------------------------------------------------------------------- surroundings


def python(code, **environment):
    """What a fresh interpreter prints, in our environment changed by `environment`."""
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **environment}, cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_surroundings_break_neither_training_nor_drawing():
    code = """
import paper_figures, matplotlib.pyplot as plt
print(plt.get_backend())
import hippo.envs.surroundings, mujoco, os
print(os.environ["MUJOCO_GL"])
"""
    told = {"MPLBACKEND": "module://nowhere.backend", "HOME": "/dev/null", "MUJOCO_GL": "nonsense"}
    assert python(code, **told).split() == ["agg", "nonsense"]


def test_kernels_have_a_place_where_neither_the_code_nor_home_takes_files(tmp_path, monkeypatch):
    from hippo.envs.surroundings import place_for_kernels

    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    assert place_for_kernels(tmp_path) == ""
    monkeypatch.setenv("HOME", "/dev/null")
    place = place_for_kernels(Path("/dev/null"))
    assert os.path.isdir(place)


def test_a_temporary_place_for_kernels_goes_when_its_process_ends(tmp_path):
    code = """
from pathlib import Path
from hippo.envs.surroundings import place_for_kernels
place = Path(place_for_kernels(Path("/dev/null")))
(place / "kernel.nbc").write_bytes(b"compiled")
print(place)
"""
    place = Path(python(code, HOME="/dev/null", TMPDIR=str(tmp_path), NUMBA_CACHE_DIR="").strip())
    assert place.parent == tmp_path
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["glfw", "nonsense"])
def test_an_opengl_that_cannot_be_had_is_one_line(name, monkeypatch):
    from hippo.envs.rendering import NoOpenGL, open_gl

    monkeypatch.setenv("MUJOCO_GL", name)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(NoOpenGL, match=f"MUJOCO_GL={name}"):
        open_gl()
