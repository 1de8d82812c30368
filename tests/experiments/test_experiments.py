"""One run from the command line, sweeps in the local pool, and what both refuse."""

import contextlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from analysis.edition import Edition
from experiments import costs, launchers, status, sweep, train
from experiments.choices import COMMITTED
from experiments.config import Run, compose_run
from experiments.plan import Plan, committed_runs, make_plan
from experiments.status import Status, read_status
from hippo.core.checkpoint import load
from tests import ROOT

TINY = ["env=block_hopper", "scale=smoke", "iterations=3", "batch_size=400"]


def command(*arguments, module="experiments.train", **options):
    return subprocess.run(
        [sys.executable, "-m", module, *arguments], capture_output=True, text=True, cwd=ROOT, timeout=120, **options
    )


# ------------------------------------------------------------------------------------------------------------ identity


def test_a_run_is_named_by_what_decides_its_numbers():
    base = compose_run(TINY)
    assert re.fullmatch("[0-9a-f]{12}", base.run_id)
    same = [[*TINY, "runs_dir=elsewhere"], [*TINY, "algo.gamma=0.999"]]
    assert {compose_run(s).run_id for s in same} == {base.run_id}
    different = [
        [*TINY, "seed=1"],
        [*TINY, "iterations=4"],
        [*TINY, "algo.gamma=0.99"],
        [*TINY, "env=block_half_cheetah"],
        [*TINY, "env.terminate_on_fall=true"],
        [*TINY, "algo=ppo"],
        [*TINY, "env.horizon=100"],
    ]
    assert len({compose_run(d).run_id for d in different} | {base.run_id}) == len(different) + 1


def test_a_revision_changes_the_name_and_a_new_default_setting_does_not(monkeypatch):
    base = compose_run(TINY)
    assert "gamma" not in base.identity["settings"]
    monkeypatch.setattr("hippo.hippo.REVISION", 99)
    assert compose_run(TINY).run_id != base.run_id


def test_a_run_survives_the_way_through_text():
    run = compose_run([*TINY, "algo.period_min=10", "algo.skill_hidden_sizes=[16,16]", "env.terminate_on_fall=true"])
    again = Run.from_yaml(run.to_yaml(), run.runs_dir)
    assert again == run
    assert again.run_id == run.run_id


def test_the_paper_is_the_default():
    run = compose_run(["env=ant_gather"])
    assert (run.scale, run.config.iterations, run.config.batch_size, run.config.horizon) == (
        "paper",
        2000,
        100_000,
        5000,
    )
    assert run.options == {}
    assert compose_run(["env=ant_gather", "scale=laptop"]).options == {"physics": "fast"}


# ----------------------------------------------------------------------------------------------------------- bad input

WRONG = [
    (["env=ant_gater"], "env=ant_gater: did you mean ant_gather?"),
    (["algo=hipo"], "algo=hipo: did you mean hippo?"),
    (["scale=smoek"], "scale=smoek: did you mean smoke?"),
    (["algo.lerning_rate=1"], "did you mean algo.learning_rate?"),
    (["learning_rate=1"], "algo.learning_rate"),
    (["algo.learning_rate=-1"], "algo.learning_rate=-1.0: must be greater than 0"),
    (["algo.learning_rate=nan"], "algo.learning_rate=nan"),
    (["algo.period_min=20"], "algo.period_min=20: must be at most period_max=15"),
    (["batch_size=100"], "batch_size=100: must be at least one horizon, 1000"),
    (["iterations=0"], "iterations=0: must be at least 1"),
    (["env.horizon=0"], "env.horizon=0: must be at least 1"),
    (["seed=x"], "seed=x"),
    (["seed=-1"], "seed=-1"),
    (["seed=???"], "seed=???: must have a value"),
    (["seed=1,2"], "seed=1,2"),
    (["env.physics=slow"], "env.physics=slow"),
    (["env.walls=true"], "env.walls=True"),
    (["env.strength=all"], "env.strength=all: changes nothing without a perturbation"),
    (["algo.num_skills=2.5"], "algo.num_skills=2.5"),
    (["algo.skill_hidden_sizes=[64,a]"], "algo.skill_hidden_sizes"),
    (["wandb.mode=sometimes"], "wandb.mode=sometimes: valid: disabled, offline, online"),
    (["runs_dir="], "runs_dir="),
    (["foo"], "foo"),
    (["+new=1"], "+new=1"),
    (["algo=ppo", "algo.num_skills=3"], "algo.num_skills=3: no such key"),
]


@pytest.mark.parametrize(("overrides", "message"), WRONG)
def test_a_wrong_configuration_is_refused_in_one_line_and_nothing_is_written(overrides, message, tmp_path, capsys):
    code = train.main([f"runs_dir={tmp_path}/runs", *overrides])
    captured = capsys.readouterr()
    assert code == 2
    assert message in captured.err
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") <= 3
    assert not captured.out
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "fig33"], "figure=fig33: did you mean fig3?"),
        (["run", "fig3", "--scale", "huge"], "scale=huge"),
        (["run", "fig3", "--launcher", "slrum"], "launcher=slrum"),
        (["run", "fig3", "--workers", "0"], "workers=0"),
        (["run", "fig3", "--set", "algo.gama=1"], "algo.gama=1"),
        (["run", "fig3", "--max-core-hours", "nan"], "max-core-hours=nan"),
        (["run", "fig3", "--max-core-hours", "inf"], "max-core-hours=inf: must be 0 or more; --yes starts"),
        (["run", "fig3", "--max-core-hours", "-1"], "max-core-hours=-1.0"),
        (["fly", "fig3"], "fly"),
        (["run"], "figure"),
    ],
)
def test_a_wrong_sweep_is_refused_in_one_line_and_nothing_is_written(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(costs, "measure", lambda run: costs.Cost(1e-4, 100_000, 600, "2026-01-01"))
    try:
        code = sweep.main([*arguments, "--runs-dir", str(tmp_path / "runs")])
    except SystemExit as exit:
        code = exit.code
    error = capsys.readouterr().err
    assert code == 2
    assert message in error
    assert error.count("\n") <= 3
    assert not (tmp_path / "runs").exists()


def test_bad_input_from_the_shell_shows_no_traceback(tmp_path):
    result = command("env=ant_gater", f"runs_dir={tmp_path}")
    assert result.returncode == 2
    assert "Traceback" not in result.stderr


# -------------------------------------------------------------------------------------------------------------- one run


def test_a_run_leaves_what_it_is_where_it_came_from_and_what_it_measured(tmp_path, capsys):
    arguments = [*TINY, f"runs_dir={tmp_path}"]
    assert train.main(arguments) == 0
    run = compose_run(arguments)
    names = {path.name for path in run.folder.iterdir()} - {".lock"}
    assert names == {
        "config.yaml",
        "manifest.json",
        "status.json",
        "progress.csv",
        "timing.csv",
        "checkpoint.pt",
        "checkpoint.prev.pt",
        "train.log",
    }
    status, manifest = (json.loads((run.folder / f"{name}.json").read_text()) for name in ("status", "manifest"))
    assert (status["state"], status["iteration"], status["env_steps"]) == ("finished", 2, 1200)
    assert manifest["identity"] == run.identity
    assert manifest["versions"]["mujoco"] == "3.17.0"
    assert Run.from_yaml(manifest["config"], tmp_path).run_id == run.run_id
    assert (run.folder / "progress.csv").read_text().count("\n") == 4
    said = capsys.readouterr().out.splitlines()
    assert "iteration 3/3" in said[-2]
    assert said[-1].startswith(f"finished: {run.folder}  evaluate: python -m experiments.evaluate {run.folder}  ")
    assert f"video: make video RUN={run.folder}  " in said[-1]
    assert f"compare: python -m paper_figures.compare {run.folder} " in said[-1]
    assert status["return_mean"] == pytest.approx(float(said[-2].partition("return ")[2].split()[0]), abs=1e-3)
    before = (run.folder / "progress.csv").stat().st_mtime_ns
    assert train.main(arguments) == 0  # finished: nothing is trained again
    assert "is finished" in capsys.readouterr().out
    assert (run.folder / "progress.csv").stat().st_mtime_ns == before


@pytest.mark.parametrize("name", [signal.SIGTERM, signal.SIGUSR1, signal.SIGKILL])
def test_a_signalled_run_continues_to_the_same_bytes(name, tmp_path):
    arguments = ["env=block_hopper", "scale=smoke", "iterations=8", "batch_size=2000"]
    whole = compose_run([*arguments, f"runs_dir={tmp_path}/whole"])
    cut = compose_run([*arguments, f"runs_dir={tmp_path}/cut"])
    train.execute(whole)
    process = subprocess.Popen(
        [sys.executable, "-m", "experiments.train", *arguments, f"runs_dir={tmp_path}/cut"],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
    )
    deadline = time.monotonic() + 60
    while not (cut.folder / "checkpoint.pt").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(name)
    code = process.wait(30)
    state = json.loads((cut.folder / "status.json").read_text())["state"]
    assert (code, state) == ((-9, "running") if name == signal.SIGKILL else (75, "preempted"))
    assert train.execute(cut) == "finished"
    for file in ("progress.csv", "checkpoint.pt"):
        assert (cut.folder / file).read_bytes() == (whole.folder / file).read_bytes()


def test_a_second_launch_of_a_running_run_leaves_it_alone(tmp_path, capsys):
    run = compose_run([*TINY, f"runs_dir={tmp_path}"])
    run.folder.mkdir()
    with train.locked(run.folder / ".lock"):
        Status(run).update()
        assert train.execute(run) == "running"
    assert f"already running (host {socket.gethostname()}, pid {os.getpid()})" in capsys.readouterr().out
    assert not (run.folder / "progress.csv").exists()


def test_a_run_that_diverges_or_fails_says_so(tmp_path, monkeypatch, capsys):
    run = compose_run([*TINY, f"runs_dir={tmp_path}"])

    def diverge(*_):
        raise train.Diverged("iteration 1: parameters has 3 non-finite of 9 entries", {"name": "parameters"})

    monkeypatch.setitem(train.WORK, "train", diverge)
    assert train.execute(run) == "diverged"
    assert json.loads((run.folder / "status.json").read_text())["message"].startswith("iteration 1: parameters")
    assert train.EXIT_CODES["diverged"] == 3

    def fail(*_):
        raise RuntimeError("out of luck")

    assert load(run.folder / "diverged.pt") == {"name": "parameters"}
    monkeypatch.setitem(train.WORK, "train", fail)
    assert train.execute(run) == "failed"
    assert "RuntimeError: out of luck" in json.loads((run.folder / "status.json").read_text())["message"]
    assert "Traceback" in capsys.readouterr().err


def test_a_run_whose_heartbeat_stopped_is_lost_by_the_file_system_s_clock(tmp_path, monkeypatch):
    path, now = tmp_path / "run" / "status.json", time.time()
    path.parent.mkdir()
    for ahead in (-3600.0, 0.0, 7200.0):  # what a host with a wrong clock wrote
        path.write_text(json.dumps({"state": "running", "heartbeat": now + ahead}))
        assert read_status(path.parent)["state"] == "running"
        os.utime(path, (now - 100, now - 100))
        assert read_status(path.parent)["state"] == "lost"
    path.write_text(json.dumps({"state": "running", "heartbeat": now}))
    for day in (-86400.0, 86400.0):  # by which our own clock is wrong
        monkeypatch.setattr(time, "time", lambda day=day: now + day)
        status._clock_ahead.cache_clear()
        assert read_status(path.parent)["state"] == "running"
    status._clock_ahead.cache_clear()
    assert read_status(tmp_path / "nowhere")["state"] == "missing"


# --------------------------------------------------------------------------------------------------------------- sweeps


@pytest.fixture
def tiny_figure(monkeypatch):
    """A figure of four short runs."""
    monkeypatch.setattr(
        "experiments.plan.load_figure",
        lambda name: {
            "title": "tiny",
            "environments": ["block_hopper"],
            "variants": {
                "hippo": {"label": "HiPPO", "algo": "hippo"},
                "ppo": {"label": "PPO", "algo": "ppo", "settings": ["algo.action_repeat=4"]},
            },
            "claims": ["a claim"],
        },
    )
    return ["run", "tiny", "--set", "iterations=2", "--set", "batch_size=400"]


def overridden(runs_dir, figure):
    """The only plan with overrides of a figure."""
    (path,) = (runs_dir / "plans/smoke/overridden").glob(f"{figure}+????????.json")
    return json.loads(path.read_text())


def test_a_sweep_trains_what_is_missing_once_and_writes_its_plan(tiny_figure, tmp_path, capsys):
    arguments = [*tiny_figure, "--runs-dir", str(tmp_path)]
    assert sweep.main(arguments) == 0
    plan = overridden(tmp_path, "tiny")
    assert [r["state"] for r in plan["runs"]] == ["finished"] * 4
    assert {(r["variant"], r["seed"]) for r in plan["runs"]} == {(v, s) for v in ("hippo", "ppo") for s in (0, 1)}
    stamps = {r["run_id"]: (tmp_path / r["run_id"] / "progress.csv").stat().st_mtime_ns for r in plan["runs"]}
    assert len(stamps) == 4
    capsys.readouterr()
    assert sweep.main(arguments) == 0
    assert "to train: 0 runs" in capsys.readouterr().out
    assert all((tmp_path / i / "progress.csv").stat().st_mtime_ns == t for i, t in stamps.items())
    assert sweep.main(["status", *arguments[1:]]) == 0
    assert capsys.readouterr().out.count("finished") == 4


def test_a_measurement_trains_its_parent_first_and_shares_it(tmp_path, capsys):
    settings = ["--set", "iterations=1", "--set", "batch_size=400", "--set", "env.horizon=50"]
    one_robot = ["run", "table2", *settings, "--env", "ant_gather", "--runs-dir", str(tmp_path)]
    assert sweep.main(one_robot) == 0
    runs = [r for r in overridden(tmp_path, "table2")["runs"] if r["env"] == "ant_gather"]
    assert {(r["kind"], r["state"]) for r in runs} == {("measure", "finished")}
    ids = {r["run_id"] for r in runs}
    parents = {p.name for p in tmp_path.iterdir() if (p / "checkpoint.pt").exists()}
    skills = {p.name for p in tmp_path.iterdir() if (p / "skills.pt").exists()}
    assert (len(ids), len(skills), len(parents - skills)) == (8, 1, 8)
    assert not parents & ids
    # The Snake's with them: 16 runs of one batch (400 steps), 16 measurements of two, two pre-trainings of four.
    again = make_plan("table2", "smoke", settings[1::2], False, tmp_path / "elsewhere")
    assert (len(again.todo()), sum(run.env_steps for run in again.todo())) == (
        34,
        16 * 400 + 16 * 800 + 2 * 4 * 2400,
    )
    (row,) = (tmp_path / min(ids) / "progress.csv").read_text().splitlines()[1:]
    assert row.startswith("1,")  # the batch after one iteration of training
    run = compose_run(["env=ant_gather", "scale=smoke", *settings[1::2], f"runs_dir={tmp_path}"])
    assert run.run_id in parents  # the same training by hand is the same run
    shutil.rmtree(tmp_path / max(ids))
    capsys.readouterr()
    assert sweep.main(one_robot) == 0
    assert "to train: 1 runs" in capsys.readouterr().out


def test_committed_rows_stand_in_for_training_unless_fresh_is_asked_for(tiny_figure, tmp_path, monkeypatch):
    plan = make_plan("tiny", "smoke", [], False, tmp_path)
    assert len(plan.todo()) == 4
    committed = tmp_path / "data"
    (committed / "smoke").mkdir(parents=True)
    (committed / "smoke/tiny.csv").write_text(f"run_id,value\n{plan.entries[0].run.run_id},1\n")
    monkeypatch.setattr("experiments.plan.COMMITTED", committed)
    assert len(make_plan("tiny", "smoke", [], False, tmp_path).todo()) == 3
    assert len(make_plan("tiny", "smoke", [], True, tmp_path).todo()) == 4


def test_a_worker_that_dies_fails_its_own_run_only_and_the_next_sweep_continues_it(tmp_path):
    runs = [
        compose_run([*TINY[:2], "iterations=20", "batch_size=400", f"seed={s}", f"runs_dir={tmp_path}"]) for s in (0, 1)
    ]
    runs += [compose_run([*TINY, f"seed={s}", f"runs_dir={tmp_path}"]) for s in (2, 3)]
    killed = []

    def kill_once(active, ended):
        for run in active.values():
            status = read_status(run.folder)
            if not killed and run.seed == 0 and status["iteration"] >= 1:
                killed.append(run.run_id)
                os.kill(status["pid"], signal.SIGKILL)

    poll, launchers.POLL_SECONDS = launchers.POLL_SECONDS, 0.05
    try:
        states = launchers.run_locally(runs, 2, kill_once)
    finally:
        launchers.POLL_SECONDS = poll
    assert killed == [runs[0].run_id]
    assert [states[r.run_id] for r in runs] == ["lost", "finished", "finished", "finished"]
    assert launchers.run_locally(runs[:1], 2, lambda *_: None) == {runs[0].run_id: "finished"}
    assert load(runs[0].folder / "checkpoint.pt")["iteration"] == 19


def test_ctrl_c_leaves_every_run_resumable_and_no_orphan(tmp_path):
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "experiments.sweep",
            "run",
            "fig3",
            "--runs-dir",
            str(tmp_path),
            "--set",
            "iterations=500",
            "--yes",
        ],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    deadline, running = time.monotonic() + 60, []
    while len(running) < 1 and time.monotonic() < deadline:
        running = [p.parent for p in tmp_path.glob("*/checkpoint.pt")]
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    _, error = process.communicate(timeout=40)
    assert process.returncode == 75
    assert "the same command continues" in error
    assert "Traceback" not in error
    states = [json.loads(p.read_text()) for p in tmp_path.glob("*/status.json")]
    assert states
    assert {s["state"] for s in states} == {"preempted"}
    assert not any(Path(f"/proc/{s['pid']}").exists() for s in states)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_whose_exception_was_lost_is_heard_at_the_next_report(number, tmp_path, capsys):
    handler = signal.getsignal(number)

    def train(_todo, report):
        with contextlib.suppress(KeyboardInterrupt):  # as Python does when a finaliser raises
            os.kill(os.getpid(), number)
        for _ in range(3):
            report([], 0)
        return {}

    plan = Plan("fig3", Edition("smoke"), {}, fresh=True, entries=[])
    assert sweep.run_figure(plan, [], train, tmp_path) == 75
    assert "the same command continues" in capsys.readouterr().err
    assert signal.getsignal(number) is handler


def test_a_progress_line_names_the_runs_in_progress_with_their_last_return(tiny_figure, tmp_path, monkeypatch, capsys):
    plan = make_plan("tiny", "smoke", tiny_figure[3::2], False, tmp_path)
    runs = plan.todo()
    for run, last in zip(runs[:2], ({"return_mean": 1.25}, {}), strict=True):
        run.folder.mkdir(parents=True)
        status = {"state": "running", "heartbeat": time.time(), "iteration": 0, "pid": 1} | last
        (run.folder / "status.json").write_text(json.dumps(status))
    monkeypatch.setattr(sweep, "REPORT_SECONDS", 0.0)

    def train(_todo, report):
        report(runs[:2], 2)
        return dict.fromkeys((run.run_id for run in runs), "finished")

    assert sweep.run_figure(plan, runs, train, tmp_path) == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("[2/4]"))
    assert line.endswith(": block_hopper hippo seed 0 return 1.25; block_hopper hippo seed 1")
    assert "2 running" in line
    assert sweep.doing(runs * 2, {}).endswith("; 4 more")
    assert sweep.doing([], {}) == ""


def test_every_committed_row_belongs_to_a_run_that_its_plan_still_yields():
    for path in COMMITTED.glob("*/fig*.csv"):
        plan = make_plan(path.stem, path.parent.name, [], True, Path("runs"))
        assert committed_runs(path.stem, Edition(path.parent.name)) <= {e.run.run_id for e in plan.entries}
