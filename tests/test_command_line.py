"""What is typed: paths and names of any spelling, words other people use for a key, and what the commands refuse."""

import json
import shutil
from pathlib import Path

import pytest

from experiments import sweep, train
from experiments.config import COMMITTED, compose_run
from experiments.plan import make_plan

TINY = ["env=block_hopper", "scale=smoke", "iterations=1", "batch_size=200"]
FOLDERS = [
    "data/user=a/x",
    "data/x@y%z#1",
    "data/ünï",
    "data/it's",
    'a "b"',
    "w/${seed}",
    r"a\${b}\\",
    "2026_11_26",
    "true",
    "1e3",
    "null",
    "a,b",
    "[a]",
    "???",
    "~x",
    " outer spaces ",
]

# ---------------------------------------------------------------------------------------------------- paths and names


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_is_the_text_that_was_typed(folder, tmp_path):
    typed = f"{tmp_path}/{folder}"
    run = compose_run(["env=snake_gather", "algo.skills=pretrained", f"runs_dir={typed}"])
    assert [str(each.runs_dir) for each in (run, run.pretraining)] == [typed] * 2
    assert str(compose_run([f"runs_dir={folder}"]).runs_dir) == folder  # relative, where a number would be read as one


@pytest.mark.parametrize("folder", ["2026_11_26", "w/${seed}", " user=a/it's "])
def test_a_sweep_writes_its_plan_beside_its_runs(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = {"given": {"label": "given skills", "algo": "hippo", "settings": ["algo.skills=pretrained"]}}
    figure = {"title": "one", "environments": ["ant_gather"], "variants": given}
    monkeypatch.setattr("experiments.plan.load_figure", lambda _: figure)
    assert sweep.main(["write", "fig6", "--runs-dir", folder]) == 0
    (path,) = tmp_path.glob("**/fig6.json")
    assert str(path.parent.parent.parent.relative_to(tmp_path)) == folder
    runs = make_plan("fig6", "smoke", [], fresh=False, runs_dir=Path(folder)).runs()
    assert [str(run.runs_dir) for run in runs] == [folder] * 3  # of the pre-training, too


def test_a_run_is_trained_where_it_was_told_to(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    folder = "a=b/x@y%z#1, ünï it's ${seed} "
    assert train.main([*TINY, f"runs_dir={folder}"]) == 0
    (status,) = tmp_path.glob("**/status.json")
    assert json.loads(status.read_text())["state"] == "finished"
    assert str(status.parent.parent.relative_to(tmp_path)) == folder
    assert train.main(["--from-manifest", str(status.with_name("manifest.json")), f"runs_dir={folder}"]) == 0
    assert "is finished" in capsys.readouterr().out


@pytest.mark.parametrize("quote", ["'", '"'])
def test_the_quotes_that_a_grammar_once_asked_for_are_not_part_of_a_name(quote):
    run = compose_run([f"runs_dir={quote}w/eq=x{quote}", "algo.skills=pretrained", "env=ant_gather"])
    assert [str(each.runs_dir) for each in (run, run.pretraining)] == ["w/eq=x"] * 2
    with pytest.raises(ValueError, match="runs_dir=: must name a folder"):
        compose_run([f"runs_dir={quote}{quote}"])


def test_a_skills_file_and_a_wandb_project_may_hold_any_character(tmp_path):
    path = tmp_path / "it's=${seed}, 1e3 ünï#.pt"
    shutil.copy(COMMITTED / "skills" / "hopper.pt", path)
    run = compose_run(["env=block_hopper", f"algo.skills={path}", "wandb.project=a=b, it's ${x}"])
    assert (run.config.skills, run.wandb_project) == (str(path), "a=b, it's ${x}")
    with pytest.raises(ValueError, match=r"algo.skills=it's: must be pretrained or a skills file"):
        compose_run(["algo.skills=it's"])
    with pytest.raises(ValueError, match=r"algo.skills=it's: no such key"):
        compose_run(["algo=ppo", "algo.skills=it's"])
