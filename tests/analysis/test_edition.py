"""Editions: what is overridden or trained under another protocol is never taken for, or pooled with, the paper's."""

import json
import shutil

import pytest

from analysis import claims, results, runs
from analysis.edition import Edition
from experiments import sweep
from experiments.config import Run, compose_run
from experiments.plan import make_plan
from paper_figures import curves
from tests.analysis.test_analysis import planned

OVERRIDE = ["algo.clip_range=0.2"]


@pytest.fixture
def one_method(monkeypatch):
    """A figure of one method in one environment."""
    variants = {"ppo": {"label": "PPO", "algo": "ppo"}}
    figure = {"title": "A title", "environments": ["block_hopper"], "variants": variants}
    monkeypatch.setattr("experiments.plan.load_figure", lambda name: figure)


# ------------------------------------------------------------------------------------------------------------ overrides


def test_a_name_depends_on_what_is_overridden_and_on_nothing_else():
    plain, other = Edition.of("smoke"), Edition.of("smoke", settings=OVERRIDE)
    assert plain.name("fig3") == "fig3"
    assert other.name("fig3").startswith("fig3+")
    assert Edition.of("smoke", settings=[*OVERRIDE, "iterations=3"]) == Edition.of(
        "smoke", settings=["iterations=3", *OVERRIDE]
    )
    assert Edition.of("smoke", settings=["algo.clip_range=0.3", *OVERRIDE]) == other  # the last counts, as in a run
    assert Edition.of("smoke", settings=["algo.clip_range=0.3"]).name("fig3") != other.name("fig3")
    assert Edition.of("smoke", settings=["wandb.mode=offline", "log.tensorboard=true"]) == plain  # change no number


def test_a_plan_with_overrides_lies_beside_the_unmodified_one_and_says_what_they_are(one_method, tmp_path):
    plain = make_plan("fig3", "smoke", [], False, tmp_path).write(tmp_path)
    before = plain.read_bytes()
    other = make_plan("fig3", "smoke", OVERRIDE, False, tmp_path).write(tmp_path)
    assert other == tmp_path / "plans/smoke/overridden" / f"{Edition.of('smoke', settings=OVERRIDE).name('fig3')}.json"
    assert plain.read_bytes() == before
    content = json.loads(other.read_text())
    assert content["overrides"] == OVERRIDE
    assert content["title"] == "A title, overridden: algo.clip_range=0.2"
    assert content["figure"] == other.stem


def test_the_sweeps_last_line_draws_it_and_status_and_retry_find_it(one_method, tmp_path, capsys, monkeypatch):
    arguments = ["fig3", "--runs-dir", str(tmp_path), "--set", OVERRIDE[0]]
    monkeypatch.setattr(sweep, "train_all", lambda todo, **_: {run.run_id: "finished" for run in todo})
    assert sweep.main(["run", *arguments]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    command = "python -m paper_figures.fig3 --scale smoke --set algo.clip_range=0.2"
    assert last == f"with overrides, a figure of its own: {command} --runs-dir {tmp_path}"
    run = make_plan("fig3", "smoke", OVERRIDE, False, tmp_path).entries[0].run
    run.folder.mkdir()
    (run.folder / "status.json").write_text(json.dumps({"state": "preempted", "message": ""}))
    assert sweep.main(["status", *arguments]) == 0
    assert f"sweep retry fig3 --scale smoke --set {OVERRIDE[0]}" in capsys.readouterr().out


def test_a_plan_that_says_it_is_of_another_edition_is_not_drawn(one_method, tmp_path, capsys):
    plain = tmp_path / "plans/smoke/fig3.json"
    for settings, protocol, said in (
        (OVERRIDE, "paper", "figure must be fig3, is 'fig3+"),
        ([], "modern", "is a plan of scale smoke, modern protocol, not of scale smoke"),
    ):
        other = make_plan("fig3", "smoke", settings, False, tmp_path, protocol).write(tmp_path)
        plain.parent.mkdir(exist_ok=True)
        shutil.copy(other, plain)
        assert curves.main("fig3", ["--runs-dir", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
        assert said in capsys.readouterr().err
        shutil.copy(
            other, tmp_path / "plans/smoke/overridden" / f"{Edition.of('smoke', settings=['a=1']).name('fig3')}.json"
        )
        assert curves.main("fig3", ["--runs-dir", str(tmp_path), "--out", str(tmp_path / "out"), "--set", "a=1"]) == 2
        capsys.readouterr()
    assert not (tmp_path / "out").exists()


def test_rows_and_names_with_overrides_are_refused_as_results(tmp_path, capsys):
    planned(tmp_path, [3, 3], states=("committed", None))
    name = Edition.of("smoke", settings=OVERRIDE).name("fig3")
    data = tmp_path / "data/smoke"
    data.mkdir(parents=True)
    row = f"{name},smoke,block_hopper,ppo,0,{0:012x},10,return_mean,1.0\n"
    (data / "fig3.csv").write_text(",".join(runs.COLUMNS) + "\n" + row)
    with pytest.raises(ValueError, match=r"fig3.csv: holds rows of fig3\+.{8}, not only of fig3"):
        runs.load("fig3", "smoke", tmp_path, tmp_path / "data")
    with pytest.raises(ValueError, match=r"fig3\+.{8}: is no figure or table; one with overrides .* is no result"):
        runs.load(name, "smoke", tmp_path, tmp_path / "data")
    (tmp_path / "data/laptop").mkdir()
    (data / "fig3.csv").rename(tmp_path / "data/laptop" / f"{name}.csv")
    docs = ["--data", str(tmp_path / "data"), "--docs", str(tmp_path)]
    assert results.main(["--runs-dir", str(tmp_path), *docs]) == 2
    assert f"{name}: is no figure or table" in capsys.readouterr().err
    with pytest.raises(SystemExit) as end:
        claims.main(["--runs-dir", str(tmp_path), "--set", OVERRIDE[0]])
    assert end.value.code == 2


# ------------------------------------------------------------------------------------------------------------ protocols


def test_a_protocol_has_its_own_seeds_and_budgets_and_leaves_the_papers_runs_alone(tmp_path):
    paper, modern = (make_plan("fig3", "laptop", [], False, tmp_path, name) for name in ("paper", "modern"))
    assert {e.run.seed for e in modern.entries} == set(range(10))
    assert {(e.run.env, e.run.env_steps) for e in modern.entries} == {
        ("block_hopper", 2_000_000),
        ("block_half_cheetah", 3_000_000),
    }
    assert {e.run.protocol for e in modern.entries} == {"modern"}
    by_hand = compose_run(["env=block_hopper", "scale=laptop"], tmp_path)
    assert paper.entries[0].run.run_id == by_hand.run_id
    assert "committed" in {e.state for e in paper.entries}
    assert not {e.run.run_id for e in modern.entries} & {e.run.run_id for e in paper.entries}
    assert modern.write(tmp_path) == tmp_path / "plans/modern/laptop/fig3.json"
    assert paper.write(tmp_path) == tmp_path / "plans/laptop/fig3.json"


def test_what_a_protocol_cannot_train_is_listed_and_the_rest_of_the_figure_is_planned(tmp_path, capsys):
    arguments = ["--protocol", "modern", "--runs-dir", str(tmp_path)]
    assert sweep.main(["write", "fig6", *arguments]) == 0
    plan = json.loads((tmp_path / "plans/modern/smoke/fig6.json").read_text())
    refused = {each["variant_label"] for each in plan["refused"]}
    assert "HiPPO p = 10, given skills" in refused
    assert all("given skills" in label or "fixed skills" in label for label in refused)
    assert "hippo_p10" in {run["variant"] for run in plan["runs"]}
    assert sweep.main(["run", "table2", *arguments, "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "table2: not trained under the modern protocol: given skills, p = 10 (algo.skills=pretrained" in said


def test_an_override_that_no_run_can_have_is_not_taken_for_what_the_protocol_cannot_train(one_method, tmp_path, capsys):
    arguments = ["write", "fig3", "--protocol", "modern", "--runs-dir", str(tmp_path / "runs")]
    assert sweep.main([*arguments, "--set", "algo.gamma=2"]) == 2
    assert "algo.gamma=2" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("action", ["plan", "run", "status", "retry", "write"])
def test_an_unknown_protocol_is_refused_in_one_line(action, tmp_path, capsys):
    assert sweep.main([action, "fig3", "--protocol", "modrn", "--runs-dir", str(tmp_path / "runs")]) == 2
    assert capsys.readouterr().err == "error: protocol=modrn: did you mean modern? valid: modern, paper\n"
    assert not (tmp_path / "runs").exists()


def test_only_the_papers_protocol_has_no_folder_of_its_own():
    assert str(Edition("laptop").folder) == "laptop"
    assert str(Edition("laptop", "modern").folder) == "modern/laptop"
    assert Run.protocol == Edition("laptop").protocol
