"""Sweeps of one's own: Hydra's grammar, a name that means one thing, the machinery of figures, curves and a table."""

import csv
import json
import os
import signal
import subprocess
import sys
import time

import pytest

from experiments import sweep
from experiments.choices import COMMITTED
from experiments.config import compose_run
from experiments.own_sweep import UNASKED, stored
from experiments.plan import make_plan
from experiments.status import Status, read_status
from experiments.sweep_grammar import values_of
from experiments.train import execute
from hippo.core.settings import ConfigError
from tests import ROOT

TINY = ["--set", "iterations=1", "--set", "batch_size=400", "--set", "env.horizon=100"]
GRID = ["--over", "algo=hippo,ppo", "--over", "algo.learning_rate=1e-4,3e-4,1e-3"]


def run(tmp_path, *arguments, action="run"):
    """Exit code of a sweep in its own runs folder."""
    return sweep.main([action, *arguments, "--runs-dir", str(tmp_path / "runs")])


@pytest.fixture
def begun(monkeypatch):
    """The runs that a sweep hands to its pool, which trains nothing."""
    handed = []
    monkeypatch.setattr(
        sweep, "run_locally", lambda todo, *_: handed.extend(todo) or {r.run_id: "finished" for r in todo}
    )
    return handed


# ------------------------------------------------------------------------------------------------------------- grammar


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("a=5", ["5"]),
        ("algo.learning_rate=1e-4,3e-4", ["0.0001", "0.0003"]),
        ("a=range(0,10,4)", ["0", "4", "8"]),
        ("a=range(0.1,0.5,0.1)", ["0.1", "0.2", "0.3", "0.4"]),
        ("a=range(0.3,0,-0.1)", ["0.3", "0.2", "0.1"]),
        ("a=[64,64],[32]", ["[64,64]", "[32]"]),
        ("a='x,y',b", ["'x,y'", "b"]),
        ("a=choice(x,y)", ["x", "y"]),
        ("env=gym:Hopper-v5,gym:ns/Ant-v5", ["gym:Hopper-v5", "gym:ns/Ant-v5"]),
        ("algo.skills='a b,c.pt',d.pt", ["a b,c.pt", "d.pt"]),
    ],
)
def test_values_are_in_hydras_grammar(text, values):
    assert values_of(text) == (text.partition("=")[0], values)


WRONG = [
    (["--name", "a", "--over", "algo.lerning_rate=1,2"], "did you mean algo.learning_rate?"),
    (["--name", "a", "--over", "algo=hipo,ppo"], "did you mean hippo?"),
    (["--name", "a", "--over", "env=block_hoper"], "did you mean block_hopper?"),
    (
        ["--name", "a", "--over", "algo=hippo,ppo", "--over", "algo.period_min=1,2"],
        "(in ppo period_min=1, block_hopper)",
    ),
    (["--name", "a", "--over", "algo.learning_rate=1,nan"], "over algo.learning_rate=nan: must be finite"),
    (["--name", "a", "--over", "algo.gamma=1e-1,0.1"], "over algo.gamma=0.1: is given twice"),
    (["--name", "a", "--over", "algo.gamma=range(1,1)"], "holds no value"),
    (["--name", "a", "--over", "algo.gamma=range(0,1,0)"], "a range needs a step"),
    (["--name", "a", "--over", "algo.gamma=glob(*)"], "must be choices"),
    (["--name", "a", "--over", "algo.gamma=interval(0,1)"], "must be choices"),
    (["--name", "a", "--over", "algo.gamma=shuffle(0.1,0.2)"], "must be choices"),
    (["--name", "a", "--over", "algo.gamma=0.1,"], "over algo.gamma=0.1,"),
    (["--name", "a", "--over", "+algo.gamma=0.1"], "must be KEY=VALUE"),
    (["--name", "a", "--over", "algo.gamma"], "must be KEY=VALUE"),
    (["--name", "a", "--over", "algo.gamma=0.1", "--over", "algo.gamma=0.2"], "is given twice"),
    (["--name", "a", "--over", "algo.gamma=0.1", "--set", "algo.gamma=0.2"], "is among --over already"),
    (["--name", "a", "--over", "algo.gamma=0.1", "--set", "algo=ppo"], "--over and the sweep's options decide that"),
    (["--name", "a", "--over", "algo.gamma=0.1", "--set", "nonsense"], "settings are given as key=value"),
    (["--name", "a", "--over", "seed=0,1"], "--seeds N"),
    (["--name", "a", "--over", "scale=smoke,laptop"], "a sweep has one (--scale)"),
    (["--name", "a", "--over", "env.physics=paper,fast"], "never drawn together"),
    (["--name", "a", "--over", "wandb.project=a,b"], "are the same run"),
    (["--name", "a", "--over", "algo.gamma=0.1", "--seeds", "0"], "must be a whole number from 1"),
    (["--name", "a", "--over", "algo.gamma=0.1", "--scale", "huge"], "scale=huge: valid: laptop, paper, smoke"),
    (["--name", "a", "--over", "algo.gamma=0.1", "--protocol", "new"], "protocol=new: valid: modern, paper"),
    (["--name", "../a", "--over", "algo.gamma=0.1"], "must be letters, digits and _"),
    (["--name", "fig3", "--over", "algo.gamma=0.1"], "is taken by the paper"),
    (["--name", "all", "--over", "algo.gamma=0.1"], "is taken by the paper"),
    (["--name", "a"], "say what to vary"),
    (["--over", "algo.gamma=0.1"], "name=: "),
    ([], "name=: name a figure (fig3), or a sweep of your own"),
    (["fig3", "--over", "algo.gamma=0.1"], "figure=fig3: has a name already"),
    (["fig3", "--name", "a"], "name=a: and fig3: give one"),
    (["--name", "a", "--over", "env=gym:Hoper-v5"], "Hopper-v5"),
    (["fig3", "fig4"], "takes one figure or sweep at a time"),
    (["--file", "nowhere.yaml"], "must be a yaml file"),
    (["--name", "a", "--over", "algo.gamma=range(0,1,0.0001)"], "20,000 runs: more than 1,000"),
    (["--name", "a", "--over", "algo.gamma=range(0,1e30)", "--yes"], "are too many"),
]


@pytest.mark.parametrize(("arguments", "message"), WRONG, ids=[m for _, m in WRONG])
def test_what_cannot_be_a_sweep_is_refused_in_one_line_and_nothing_is_written(
    arguments, message, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert run(tmp_path, *arguments) == 2
    said = capsys.readouterr()
    assert message in said.err
    assert said.err.startswith("error: ")
    assert said.err.count("\n") == 1
    assert not said.out
    assert not list(tmp_path.iterdir())


def test_ten_thousand_combinations_are_refused_before_one_of_them_is_made_up(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("experiments.plan.compose_run", lambda *_: pytest.fail("made one up"))
    grid = ["--over", "algo.gamma=range(0,0.1,0.001)", "--over", "algo.learning_rate=range(0.001,0.051,0.001)"]
    assert run(tmp_path, "--name", "a", *grid, "--seeds", "2") == 2
    assert f"10,000 runs: more than {UNASKED:,}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("- a", "must be a mapping of name, over"),
        ("name: a\novr: {}", "did you mean over?"),
        ("name: a\nover: algo.gamma=1", "file over=algo.gamma=1: must be keys with values"),
        ("name: a\nover: {algo.gamma: 0.1}\nseeds: many", "must be a whole number"),
        ("name: 3\nover: {algo.gamma: 0.1}", "must be text"),
        ("name: a\nover: {algo.gamma: [0.1, .nan]}", "must be finite"),
        ("over: {algo.gamma: 0.1}", "name=: "),
        ("a: [", "must be a yaml file"),
    ],
)
def test_a_bad_file_is_one_line(content, message, tmp_path, capsys):
    (tmp_path / "s.yaml").write_text(content)
    assert run(tmp_path, "--file", str(tmp_path / "s.yaml")) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "runs").exists()


# ---------------------------------------------------------------------------------------------------------------- plan


def test_a_sweep_is_every_combination_with_every_seed_and_its_runs_are_those_that_train_makes(tmp_path, begun, capsys):
    assert run(tmp_path, "--name", "lr", *GRID, "--over", "env=block_hopper,snake_gather", *TINY, "--seeds", "2") == 0
    assert len({r.run_id for r in begun}) == 2 * 3 * 2 * 2
    settings = ["iterations=1", "batch_size=400", "env.horizon=100", "algo.learning_rate=3e-4", "scale=smoke"]
    one = compose_run(["env=snake_gather", "algo=ppo", "seed=1", *settings])
    assert one.run_id in {r.run_id for r in begun}
    plan = json.loads((tmp_path / "runs/plans/smoke/lr.json").read_text())
    assert plan["title"] == "Sweep lr, iterations=1, batch_size=400, env.horizon=100"
    assert {r["variant_label"] for r in plan["runs"]} >= {"hippo learning_rate=0.0001", "ppo learning_rate=0.001"}
    assert "python -m experiments.sweep compare lr" in capsys.readouterr().out.splitlines()[-1]


def test_environments_of_gymnasium_are_swept_and_compared_as_others_are(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sweep, "run_locally", lambda todo, *_: {run.run_id: execute(run) for run in todo})
    monkeypatch.setattr(
        "paper_figures.curves.draw", lambda results, out, **_: (out / "smoke").mkdir(parents=True, exist_ok=True) or []
    )
    arguments = ["--over", "env=gym:Pendulum-v1,gym:MountainCarContinuous-v0", "--over", "algo=ppo", *TINY]
    assert run(tmp_path, "--name", "foreign", *arguments, "--seeds", "1") == 0
    folders = [str(path.parent) for path in (tmp_path / "runs").glob("*/manifest.json")]
    capsys.readouterr()
    for targets in (["foreign"], folders):
        assert run(tmp_path, *targets, "--out", str(tmp_path / "out"), action="compare") == 0
        table = capsys.readouterr().out
        assert "\ngym:Pendulum-v1" in table
        assert "\ngym:MountainCarContinuous-v0" in table


def test_a_file_says_the_same_as_the_command_line(tmp_path, begun):
    (tmp_path / "lr.yaml").write_text(
        "name: lr\nover: {algo: [hippo, ppo], algo.learning_rate: '1e-4,3e-4,1e-3'}\nseeds: 3\n"
        "set: {iterations: 1, batch_size: 400, env.horizon: 100}\n"
    )
    assert run(tmp_path, "--file", str(tmp_path / "lr.yaml")) == 0
    before = (tmp_path / "runs/sweeps/lr.json").read_bytes()
    assert run(tmp_path, "--name", "lr", *GRID, *TINY, "--seeds", "3") == 0  # the same sweep
    assert (tmp_path / "runs/sweeps/lr.json").read_bytes() == before
    assert len(begun) == 2 * 2 * 3 * 3


def test_a_name_means_one_thing_and_is_enough(tmp_path, begun, capsys):
    assert run(tmp_path, "--name", "lr", *GRID, *TINY) == 0
    first = [r.run_id for r in begun]
    before = (tmp_path / "runs/sweeps/lr.json").read_bytes()
    for arguments, difference in (
        (["--name", "lr", "--over", "algo=hippo", *TINY], "algo: hippo,ppo there, hippo here"),
        (["--name", "lr", *GRID, *TINY, "--seeds", "3"], "seeds: 2 there, 3 here"),
        (["--name", "lr", *GRID, *TINY, "--scale", "laptop"], "scale: smoke there, laptop here"),
        (["lr", "--protocol", "modern"], "protocol: paper there, modern here"),
        (["lr", "--set", "iterations=2"], "iterations: 1 there, 2 here"),
    ):
        assert run(tmp_path, *arguments) == 2
        error = capsys.readouterr().err
        assert "name=lr: is another sweep in " in error
        assert difference in error
        assert error.count("\n") == 1
    begun.clear()
    for arguments in (["lr"], ["--name", "lr"], ["lr", "--set", "wandb.mode=offline"]):
        assert run(tmp_path, *arguments) == 0
    assert [r.run_id for r in begun] == 3 * first
    assert {r.wandb_mode for r in begun} == {"disabled", "offline"}
    assert (tmp_path / "runs/sweeps/lr.json").read_bytes() == before
    assert run(tmp_path, "lrr", action="status") == 2
    assert "figure=lrr: did you mean lr?" in capsys.readouterr().err


def test_nothing_is_stored_by_looking(tmp_path, begun, monkeypatch):
    monkeypatch.setattr(sweep, "overview", lambda plans, _: f"{len(plans[0].entries)} runs")
    assert run(tmp_path, "--name", "lr", *GRID, *TINY, action="plan") == 0
    assert run(tmp_path, "--name", "lr", *GRID, *TINY, "--dry-run") == 0
    assert not (tmp_path / "runs").exists()


def test_a_damaged_description_is_one_line(tmp_path, capsys):
    (tmp_path / "runs/sweeps").mkdir(parents=True)
    good = {"name": "lr", "over": {"algo": ["ppo"]}, "set": {}, "seeds": 1, "scale": "smoke", "protocol": "paper"}
    changes = (
        {"name": "x"},
        {"over": {"algo": 1}},
        {"over": {"algo": [1]}},
        {"set": {"a": 1}},
        {"seeds": 0},
        {"scale": "../x"},
    )
    for content in ("{", '{"name": "lr"}', *(json.dumps(good | change) for change in (*changes, {"more": 1}))):
        (tmp_path / "runs/sweeps/lr.json").write_text(content)
        assert run(tmp_path, "lr", action="status") == 2, content
        assert capsys.readouterr().err.count("\n") == 1
    assert stored("../x", tmp_path) is None
    (tmp_path / "runs/sweeps/lr.json").write_text(json.dumps(good))
    assert run(tmp_path, "lr", action="status") == 0


def test_what_costs_hours_is_asked_for_with_commands_that_there_are(tmp_path, begun, capsys):
    arguments = ["--name", "lr", "--over", "algo=hippo,ppo", "--scale", "paper", "--seeds", "1"]
    assert run(tmp_path, *arguments) == 4
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 3
    assert "to agree: --yes; without training: python -m experiments.sweep compare lr" in error
    assert "make" not in error
    assert not (tmp_path / "runs").exists()


def test_status_shows_returns_and_retry_names_the_sweep_alone(tmp_path, begun, capsys):
    assert run(tmp_path, "--name", "lr", "--over", "algo=hippo,ppo", *TINY, "--seeds", "1") == 0
    for r, state in zip(begun, ("preempted", "running"), strict=True):
        r.folder.mkdir(parents=True)
        Status(r).update(state=state, return_mean=1.23456, iteration=0)
    capsys.readouterr()
    assert run(tmp_path, "lr", action="status") == 0
    head, *lines, last = capsys.readouterr().out.splitlines()
    assert "return" in head.split()
    assert all("1.235" in line.split() for line in lines if "block_hopper" in line)
    assert last == "1 to try again: python -m experiments.sweep retry lr"


# ------------------------------------------------------------------------------------------------ compared, interrupted


def test_what_figures_have_committed_is_not_trained_again_and_is_drawn_with_a_table(tmp_path, begun, capsys):
    with (COMMITTED / "laptop/fig3.csv").open() as file:
        committed = {row["run_id"] for row in csv.DictReader(file)}
    figure = [e.run.run_id for e in make_plan("fig3", "laptop", [], False, tmp_path / "runs").entries]
    arguments = ["--name", "both", "--over", "algo=hippo,ppo", "--scale", "laptop"]
    assert run(tmp_path, *arguments) == 0
    assert not begun
    plan = json.loads((tmp_path / "runs/plans/laptop/both.json").read_text())
    shared = {r["run_id"] for r in plan["runs"]}
    assert len(shared) == 2 * 3
    assert shared <= set(figure) & committed
    capsys.readouterr()
    assert run(tmp_path, "both", "--out", str(tmp_path / "out"), action="compare") == 0
    said = capsys.readouterr().out
    head, *_ = said.splitlines()
    assert head.split() == ["environment", "label", "final", "low", "high", "area", "seeds", "hours"]
    with (tmp_path / "out/laptop/both.table.csv").open() as file:
        rows = {row["label"]: row for row in csv.DictReader(file)}
    assert {label: row["seeds"] for label, row in rows.items()} == {"hippo": "3", "ppo": "3"}
    for row in rows.values():
        assert float(row["low"]) <= float(row["final"]) <= float(row["high"])
        assert row["hours"] == ""  # nobody trained here
    assert (tmp_path / "out/laptop/both.png").stat().st_size > 1000
    assert "paper" not in said.partition("wrote")[0]


def test_comparing_what_is_not_there_is_one_line(tmp_path, begun, capsys):
    assert run(tmp_path, "--name", "lr", *GRID, *TINY) == 0
    capsys.readouterr()
    for arguments, code, message in (
        (["lr"], 3, "none of its 12 runs at scale smoke has a result yet; `python -m experiments.sweep run lr"),
        (["lrr"], 2, "is no run folder and no sweep of your own; did you mean lr?"),
        ([], 2, "name a sweep of your own (lr) or run folders"),
        ([str(tmp_path)], 2, "is no run folder"),
    ):
        assert run(tmp_path, *arguments, "--out", str(tmp_path / "out"), action="compare") == code
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_rows_that_are_committed_beside_figures_are_none_of_a_sweep(tmp_path, begun, capsys, monkeypatch):
    committed = tmp_path / "data/smoke"
    committed.mkdir(parents=True)
    for name in ("fig3.csv", "fig3.runs.csv"):
        (committed / name).write_text("figure,scale,env,variant,seed,run_id,env_steps,metric,value\n")
    monkeypatch.setattr("experiments.own_sweep.COMMITTED", tmp_path / "data")
    assert run(tmp_path, "--name", "lr", *GRID, *TINY) == 0
    plan = json.loads((tmp_path / "runs/plans/smoke/lr.json").read_text())
    assert plan["committed_in"] == ["fig3"]


@pytest.mark.slow
def test_a_sweep_is_planned_killed_resumed_and_compared(tmp_path, capsys):
    arguments = ["--name", "lr", *GRID, *TINY, "--seeds", "2", "--runs-dir", str(tmp_path / "runs")]
    assert sweep.main(["plan", *arguments]) == 0
    assert capsys.readouterr().out.splitlines()[-4].split()[:2] == ["lr", "12"]
    command = [sys.executable, "-m", "experiments.sweep", "run", *arguments, "--workers", "2"]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    folders = tmp_path / "runs"

    def finished():
        return {
            path.parent for path in folders.glob("*/status.json") if read_status(path.parent)["state"] == "finished"
        }

    while len(finished()) < 3:
        assert process.poll() is None
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    before = {path: (path / "status.json").read_bytes() for path in finished()}
    assert sweep.main(["run", "lr", "--runs-dir", str(folders), "--workers", "2"]) == 0
    assert len(finished()) == 12
    assert before == {path: (path / "status.json").read_bytes() for path in before}  # not trained again
    assert sweep.main(["compare", "lr", "--runs-dir", str(folders), "--out", str(tmp_path / "out")]) == 0
    with (tmp_path / "out/smoke/lr.table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["seeds"] for row in rows] == 6 * ["2"]
    assert all(float(row["hours"]) > 0 for row in rows)
    assert not sweep.main(["cancel", "lr", "--runs-dir", str(folders)])
    assert "lr: 0 jobs cancelled" in capsys.readouterr().out


def test_values_of_names_the_key():
    with pytest.raises(ConfigError, match=r"over algo\.gamma"):
        values_of("algo.gamma=(")
