"""Every figure, every table, the claims and the report, from runs that are really trained at a private, tiny scale."""

import runpy
import shutil
import sys

import pytest
import torch
from PIL import Image

from analysis.edition import Edition
from experiments import choices, config, plan
from experiments.train import execute
from tests import ROOT

SCALE = "tiny"  # one seed, two iterations of two episodes
TASKS = ("block_hopper", "block_half_cheetah", "snake_gather", "ant_gather", "ant", "snake", "hopper", "half_cheetah")
YAML = """\
# @package _global_
scale: tiny
seeds: 1
off_policy: {steps: 80, batch_size: 40}
budget:
"""
OVERRIDES = ["algo.gamma=0.9", "algo.clip_range=0.2"]
FIGURES = sorted(path.stem for path in (choices.CONF / "figure").glob("*.yaml"))
ARTEFACTS = sorted(path.stem for stem in ("fig", "table") for path in (ROOT / "paper_figures").glob(f"{stem}[0-9]*.py"))


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A runs folder with all runs of all figures."""
    folder = tmp_path_factory.mktemp("tiny")
    conf = folder / "conf"
    shutil.copytree(choices.CONF, conf)
    budgets = [f"  {task}: {{iterations: 2, batch_size: 40, horizon: 20, physics: fast}}\n" for task in TASKS]
    paper = [line.replace("fast", "paper") if "hopper" in line or "cheetah" in line else line for line in budgets]
    (conf / "scale" / f"{SCALE}.yaml").write_text(YAML + "".join(paper))
    modern = conf / "protocol/modern.yaml"
    budget = "".join(f"    {task}: {{iterations: 2, batch_size: 320}}\n" for task in TASKS)  # more than a minibatch
    modern.write_text(modern.read_text().replace("budget:\n", f"budget:\n  {SCALE}:\n{budget}"))
    for path in (conf / "figure").glob("*.yaml"):  # what makes a figure quick at smoke scale makes it quick here
        path.write_text(path.read_text().replace("smoke:", f"{SCALE}:"))
    threads = torch.get_num_threads()
    with pytest.MonkeyPatch.context() as patch:
        for module in (choices, config, plan):
            patch.setattr(module, "CONF", conf)
        config._base.cache_clear()
        for figure in FIGURES:
            todo = plan.make_plan(figure, SCALE, [], True, folder / "runs").todo()
            states = {run.run_id: execute(run) for run in todo}
            assert set(states.values()) <= {"finished"}, (figure, states)
            plan.make_plan(figure, SCALE, [], True, folder / "runs").write(folder / "runs")
        for settings, protocol in ((OVERRIDES, "paper"), ([], "modern")):  # a run of each method is enough
            again = plan.make_plan("fig3", SCALE, settings, True, folder / "runs", protocol).within(["block_hopper"])
            assert {execute(run) for run in again.todo()} == {"finished"}
            plan.make_plan("fig3", SCALE, settings, True, folder / "runs", protocol).write(folder / "runs")
    config._base.cache_clear()
    torch.set_num_threads(threads)
    torch.set_deterministic_debug_mode("default")
    return folder / "runs"


def made(module, runs, out, monkeypatch, *more):
    """Run `python -m module` for the tiny scale in this process; its exit code."""
    arguments = [module, "--scale", SCALE, "--runs-dir", str(runs), "--out", str(out), *more]
    monkeypatch.setattr(sys, "argv", arguments)
    monkeypatch.setattr("analysis.command_line.SCALES", (SCALE,))
    monkeypatch.delitem(sys.modules, module, raising=False)  # another test may have imported it
    with pytest.raises(SystemExit) as end:
        runpy.run_module(module, run_name="__main__")
    return end.value.code


def test_nothing_is_drawn_that_has_no_configuration_and_nothing_configured_is_not_drawn():
    trained_nothing = {"fig1", "fig2", "table3"}
    assert set(ARTEFACTS) - trained_nothing == set(FIGURES)
    assert {f"fig{i}" for i in range(1, 10)} | {f"table{i}" for i in range(1, 4)} <= set(ARTEFACTS)


@pytest.mark.parametrize("artefact", ARTEFACTS)
def test_it_is_made_of_the_runs_of_its_plan(artefact, runs, tmp_path, monkeypatch, capsys):
    assert made(f"paper_figures.{artefact}", runs, tmp_path, monkeypatch) == 0
    assert "missing" not in capsys.readouterr().out
    kinds = {"fig": (".png", ".pdf", ".svg", ".caption.txt"), "table": (".tex", ".md", ".csv")}[
        artefact.rstrip("123456789")
    ]
    for kind in kinds:
        assert (tmp_path / SCALE / f"{artefact}{kind}").stat().st_size > 100
    if artefact.startswith("fig") and artefact in FIGURES:
        first = [(tmp_path / SCALE / f"{artefact}{kind}").read_bytes() for kind in kinds]
        assert made(f"paper_figures.{artefact}", runs, tmp_path, monkeypatch) == 0
        assert [(tmp_path / SCALE / f"{artefact}{kind}").read_bytes() for kind in kinds] == first


def test_another_protocol_has_folders_captions_and_titles_of_its_own(runs, tmp_path, monkeypatch, capsys):
    assert made("paper_figures.fig3", runs, tmp_path, monkeypatch) == 0
    before = contents(tmp_path)
    for module in ("paper_figures.fig3", "paper_figures.fig1", "analysis.claims", "analysis.report"):
        assert made(module, runs, tmp_path, monkeypatch, "--protocol", "modern") == 0
    new = {path: content for path, content in contents(tmp_path).items() if before.get(path) != content}
    assert {path.parent for path in new} == {tmp_path / "modern" / SCALE}
    assert {"fig3.png", "fig1.png", "claims.md", "report.html"} <= {path.name for path in new}
    caption = new[tmp_path / "modern" / SCALE / "fig3.caption.txt"].decode()
    assert "time commitments, modern protocol. Scale: tiny." in caption
    assert (
        f"HiPPO reproduction, {SCALE} scale, modern protocol".encode()
        in new[tmp_path / "modern" / SCALE / "report.html"]
    )
    with Image.open(tmp_path / "modern" / SCALE / "fig3.png") as picture:
        assert picture.info["Title"].endswith(", modern protocol")
    capsys.readouterr()
    assert made("paper_figures.fig4", runs, tmp_path, monkeypatch, "--protocol", "modern") == 3
    assert f"make draw-fig4 SCALE={SCALE} PROTOCOL=modern" in capsys.readouterr().err


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_figure_with_overrides_says_so_everywhere_and_touches_no_file_of_the_unmodified_one(
    runs, tmp_path, monkeypatch
):
    assert made("paper_figures.fig3", runs, tmp_path, monkeypatch) == 0
    before, flags = contents(tmp_path), [word for setting in OVERRIDES for word in ("--set", setting)]
    assert made("paper_figures.fig3", runs, tmp_path, monkeypatch, *flags) == 0
    after = contents(tmp_path)
    assert before.items() <= after.items()
    name = Edition.of(SCALE, settings=OVERRIDES).name("fig3")
    stem = tmp_path / SCALE / "overridden" / name
    assert {path for path in after if path not in before} == {
        stem.with_name(f"{name}.{kind}") for kind in ("csv", "png", "pdf", "svg", "caption.txt", "clock.png")
    }
    said = "overridden: algo.clip_range=0.2, algo.gamma=0.9"
    assert said in after[stem.with_suffix(".caption.txt")].decode()
    with Image.open(stem.with_suffix(".png")) as picture:
        assert said in picture.info["Title"]
    assert {line.split(",")[0] for line in after[stem.with_suffix(".csv")].decode().splitlines()[1:]} == {name}


def test_one_seed_gives_no_verdict_and_all_of_it_fits_on_one_page(runs, tmp_path, monkeypatch, capsys):
    assert made("paper_figures.fig3", runs, tmp_path, monkeypatch) == 0
    assert made("analysis.claims", runs, tmp_path, monkeypatch) == 0
    said = capsys.readouterr().out
    assert "| no data | fewer than 3 seeds everywhere |" in said
    assert "| reproduced |" not in said
    assert made("analysis.report", runs, tmp_path, monkeypatch) == 0
    assert (tmp_path / SCALE / "report.html").stat().st_size > 10_000
