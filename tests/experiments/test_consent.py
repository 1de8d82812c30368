"""What costs hours is asked for, by a number that is the same everywhere; what costs nothing is just done."""

import json
import re
import shlex
import subprocess

import pytest

from experiments import costs, sweep
from experiments.artefacts import cost_table
from experiments.command_line import EXIT_NOT_AGREED
from experiments.plan import make_plan, trained_at
from tests import ROOT


@pytest.fixture(scope="module")
def plans():
    """Every figure and table at every scale, as if nothing were trained or committed."""
    return cost_table.all_plans()


@pytest.fixture(autouse=True)
def nothing_is_measured_or_trained(monkeypatch):
    for module, name in ((costs, "measure"), (sweep, "run_figure")):
        monkeypatch.setattr(module, name, lambda *arguments: pytest.fail("measured or trained something"))


def test_hours_are_asked_for_with_the_number_and_where_it_is_from_and_nothing_is_written(tmp_path, capsys):
    assert sweep.main(["run", "fig7", "--scale", "laptop", "--runs-dir", str(tmp_path / "runs")]) == EXIT_NOT_AGREED
    said = capsys.readouterr()
    assert said.out == ""
    assert len(said.err.splitlines()) == 3
    assert re.search(r"fig7 at scale laptop has 9 runs to train, about [\d.]+ core-hours; from 2 on", said.err)
    assert f"committed seconds per step ({costs.reference_source()})" in said.err
    for command in ("make fig7 SCALE=laptop YES=1", "--yes", "make draw-fig7 SCALE=laptop", "make plan-fig7"):
        assert command in said.err
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(("hours", "asked"), [(1.99, False), (2.0, True)])
@pytest.mark.parametrize("measured", [1e-9, 1.0])
def test_what_this_machine_measured_does_not_decide_whether_it_asks(hours, asked, measured, tmp_path, monkeypatch):
    runs = make_plan("fig7", "laptop", [], False, tmp_path).todo()
    monkeypatch.setattr(costs, "reference_seconds", lambda run: hours * 3600 / len(runs))
    known = costs.Cost(measured, 100_000, 600, "2026-01-01")
    monkeypatch.setattr(costs, "measure", lambda run: known)
    monkeypatch.setattr(sweep, "run_figure", lambda *arguments: 0)
    code = sweep.main(["run", "fig7", "--scale", "laptop", "--runs-dir", str(tmp_path / "runs")])
    assert code == (EXIT_NOT_AGREED if asked else 0)


def test_agreeing_or_a_higher_limit_starts_it(tmp_path, monkeypatch):
    started = []
    monkeypatch.setattr(costs, "measure", lambda run: costs.Cost(1e-4, 100_000, 600, "2026-01-01"))
    monkeypatch.setattr(sweep, "run_figure", lambda plan, todo, *rest: started.append(len(todo)) or 0)
    for agreed in (["--yes"], ["--max-core-hours", "1e6"]):
        assert sweep.main(["run", "fig7", "--scale", "laptop", *agreed, "--runs-dir", str(tmp_path)]) == 0
    assert started == [9, 9]


def test_a_dry_run_trains_nothing_with_any_launcher_and_is_not_asked_for(tmp_path, capsys):
    assert sweep.main(["run", "fig7", "--scale", "laptop", "--dry-run", "--runs-dir", str(tmp_path / "runs")]) == 0
    assert "to train: 9 runs" in capsys.readouterr().out
    assert not (tmp_path / "runs").exists()


def test_what_can_never_exist_at_a_scale_is_no_error_and_names_the_scales_that_have_it(tmp_path, capsys):
    assert sweep.main(["run", "fig8", "--scale", "laptop", "--runs-dir", str(tmp_path)]) == 0
    assert capsys.readouterr().out == "fig8: not trained at scale laptop, only at paper, smoke\n"
    assert json.loads((tmp_path / "plans/laptop/fig8.json").read_text())["scales"] == ["paper", "smoke"]


def test_plans_are_written_without_measuring_anything(tmp_path):
    assert sweep.main(["write", "fig6", "--scale", "laptop", "--runs-dir", str(tmp_path)]) == 0
    plan = json.loads((tmp_path / "plans/laptop/fig6.json").read_text())
    assert {run["state"] for run in plan["runs"]} == {"committed", "missing"}
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [tmp_path / "plans/laptop/fig6.json"]


@pytest.mark.slow  # every plan takes a quarter of a minute
def test_the_scales_of_a_figure_are_those_that_leave_an_environment(plans):
    for (figure, scale), plan in plans.items():
        assert (scale in trained_at(plan.description)) == bool(plan.entries), figure


@pytest.mark.slow  # every plan takes a quarter of a minute
def test_every_planned_run_has_a_committed_cost(plans):
    kinds = {costs.kind(run) for plan in plans.values() for run in plan.runs()}
    assert kinds == set(costs.reference()["seconds_per_step"]), (
        "run `python -m experiments.artefacts.cost_table --measure`"
    )


@pytest.mark.slow  # every plan takes a quarter of a minute
def test_the_readmes_costs_are_those_that_decide(plans):
    written = cost_table.MARK.search(cost_table.README.read_text())
    assert written is not None
    assert written[0] == f"{written[1]}{cost_table.table(plans)}\n{written[2]}", (
        "run `python -m experiments.artefacts.cost_table`"
    )


def test_no_other_page_repeats_what_a_target_costs():
    hours = re.compile(r"make (?:all|fig\d|table\d)[^.\n]*?[\d,.]+ (?:core-)?hours")
    for page in (ROOT / "docs").rglob("*.md"):
        assert not hours.search(page.read_text()), f"{page}: link to the README's table"
    assert hours.search("`make fig3 SCALE=paper`, 392 core-hours")  # as one page had it


# ------------------------------------------------------------------------------------------------------------- Makefile


def recipe(target, *variables):
    """The commands of a target as lists of words, as the shell would split them."""
    command = ["make", "--dry-run", "--no-print-directory", "--old-file=install", target, *variables]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [shlex.split(line) for line in said.replace("\\\n", "").splitlines()]


def value(words, option):
    return words[words.index(option) + 1]


HOSTILE = "a b; touch 'owned' $(touch owned) ${seed} `x` \"y=z@%#1,ünï "


@pytest.mark.parametrize("target", ["fig3", "table1", "draw-fig3", "draw-all", "plan-fig3", "report"])
def test_variables_reach_the_commands_as_one_word_whatever_they_hold(target):
    commands = recipe(target, f"RUNS_DIR={HOSTILE}", f"SCALE={HOSTILE}")
    commands = [words for words in commands if words and "-m" in words]
    assert commands
    for words in commands:
        assert value(words, "--runs-dir") == HOSTILE
        assert value(words, "--scale") == HOSTILE


def test_so_do_those_of_a_sweep_and_a_video():
    words = recipe("fig3", f"PROFILE={HOSTILE}", "WORKERS=3; x", "LAUNCHER=slurm")[0]
    assert (value(words, "--profile"), value(words, "--workers")) == (HOSTILE, "3; x")
    assert value(words, "--launcher") == "slurm"
    assert recipe("video", "RUN=x; cmd")[-1][-2:] == ["experiments.video", "x; cmd"]


def test_all_goes_on_to_the_tables_whatever_becomes_of_a_figure():
    first, *rest = recipe("all", "SCALE=laptop")
    assert "--keep-going" in first
    swept = [words[words.index("run") + 1] for words in rest if "experiments.sweep" in words and "run" in words]
    assert {"fig3", "fig8", "table1", "table2"} <= set(swept)
    assert any(words[-6:-4] == ["paper_figures.draw", "table3"] for words in rest)


def test_help_lists_every_variable_with_a_line():
    said = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in ("SCALE", "PROTOCOL", "LAUNCHER", "PROFILE", "FRESH", "YES", "RUNS_DIR", "WORKERS"):
        (line,) = re.findall(rf"^  {name}=\S+ +(\S.*)$", said, re.MULTILINE)
        assert line
    for target in ("figN", "tableN", "draw-figN", "draw-all", "plan-figN"):
        assert re.search(rf"^  make {target} ", said, re.MULTILINE)


@pytest.mark.parametrize(("code", "drawn", "ends"), [(0, 1, 0), (2, 0, 2), (4, 1, 2), (1, 1, 2)])
def test_a_figure_is_drawn_whatever_became_of_its_training_unless_the_input_was_bad(code, drawn, ends, tmp_path):
    stub = tmp_path / "bin/python"
    stub.parent.mkdir()
    stub.write_text(
        f'#!/bin/sh\necho "$2 $3" >> {tmp_path}/said\n[ "$2 $3" != "experiments.sweep run" ] || exit {code}\n'
    )
    stub.chmod(0o755)
    command = ["make", "--old-file=install", "fig3", f"BIN={tmp_path}/bin"]
    assert subprocess.run(command, cwd=ROOT, capture_output=True, check=False).returncode == ends
    said = (tmp_path / "said").read_text().splitlines()
    assert said[0] == "experiments.sweep run"
    assert said.count("paper_figures.draw fig3") == drawn
