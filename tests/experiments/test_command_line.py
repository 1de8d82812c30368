"""What is typed: paths and names of any spelling, words other people use for a key, and what the commands refuse."""

import dataclasses
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from analysis import claims, report
from analysis.command_line import PROTOCOLS, SCALES
from experiments import sweep, synonyms, train
from experiments.choices import COMMITTED, GROUPS, choices
from experiments.config import LEARNERS, PLAIN_TEXT, Run, compose_run
from experiments.plan import make_plan
from experiments.schema import BUDGET_FIELDS, PRETRAINING
from hippo.core.settings import ConfigError
from hippo.envs import ENVIRONMENTS, make
from paper_figures import draw

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


def refused(main, arguments, capsys):
    """What `main` says about arguments that it must refuse: at most three lines, exit code 2."""
    try:
        code = main(arguments)
    except SystemExit as exit:
        code = exit.code
    said = capsys.readouterr()
    assert code == 2
    assert not said.out
    assert said.err.count("\n") <= 3
    return said.err


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


# ----------------------------------------------------------------------------------------------------- others' words

MEANT = [
    (["lr=1e-3"], "lr=0.001: no such key; did you mean algo.learning_rate?"),
    (["algo.lr=1e-3"], "did you mean algo.learning_rate?"),
    (["ppo.lr=1e-3"], "did you mean algo.learning_rate?"),
    (["learning_rate=1e-3"], "did you mean algo.learning_rate?"),
    (["algo=hiro", "lr=1e-3"], "did you mean algo.actor_learning_rate?"),
    (["n_steps=2048"], "did you mean batch_size? (environment steps of all"),
    (["total_timesteps=1e6"], "did you mean iterations? (of batch_size environment steps each)"),
    (["num_envs=8"], "did you mean batch_size?"),
    (["algo.n_envs=8"], "did you mean batch_size?"),
    (["batch=64"], "did you mean batch_size?"),
    (["gamma=0.9"], "did you mean algo.gamma?"),
    (["clip_range=0.1"], "did you mean algo.clip_range?"),
    (["ent_coef=0.1"], "did you mean algo.entropy_weight?"),
    (["algo=option_critic", "ent_coef=0.1"], "did you mean algo.manager_entropy_weight?"),
    (["algo=hiro", "ent_coef=0.1"], "it is called algo.entropy_weight, which this learner does not have"),
    (["n_epochs=4"], "did you mean algo.updates? (passes over the batch"),
    (["vf_coef=0.5"], "did you mean algo.value_loss_weight?"),
    (["max-grad-norm=1"], "a key has letters, _ and dots only"),
    (["--lr=1"], "a key has letters, _ and dots only"),
    (["env_id=Hopper-v5"], "did you mean env?"),
    (["env.name=hopper"], "did you mean env?"),
    (["device=cuda"], "one core of the processor"),
    (["env=hopper-v5"], "env=hopper-v5: did you mean block_hopper? valid: ant, ant_gather,"),
    (["env=HalfCheetah-v5"], "did you mean block_half_cheetah or gym:HalfCheetah-v5?"),
    (["env=hippo/AntGather-v0"], "did you mean ant_gather or gym:hippo/AntGather-v0?"),
    (["algo=diayn", "env=Walker2d-v5"], "did you mean gym:Walker2d-v5? valid: ant, ant_gather,"),
    (["env=hopper"], "paid nothing, algo=diayn brings its own reward; did you mean block_hopper?"),
    (["env=half_cheetah", "algo=ppo"], "did you mean block_half_cheetah?"),
]


@pytest.mark.parametrize(("typed", "said"), MEANT)
def test_a_word_of_another_library_leads_to_ours(typed, said):
    with pytest.raises(ConfigError) as refusal:
        compose_run(typed)
    assert said in str(refusal.value)


def test_every_key_that_a_synonym_leads_to_exists():
    runs = [compose_run([f"algo={algo}"]) for algo in LEARNERS]
    known = {f"algo.{f.name}" for run in runs for f in dataclasses.fields(run.config)}
    known |= {*GROUPS, *PLAIN_TEXT, "iterations", "batch_size", "seed", "env.horizon", "wandb.mode"}
    assert {key for keys in synonyms.KEYS.values() for key in keys} <= known
    assert synonyms.NOTES.keys() <= known


@pytest.mark.parametrize("name", PRETRAINING)
def test_a_robot_alone_says_whether_it_is_paid(name):
    envs = make(name, 1, 0)
    envs.reset(seed=0)
    _, reward, *_ = envs.step(np.full((1, *envs.single_action_space.shape), 0.5))
    assert ENVIRONMENTS[name].pays == bool(reward[0])
    assert compose_run([f"env={name}", f"algo={PRETRAINING[name]}"]).kind == "pretrain"


# -------------------------------------------------------------------------------------------------- help and yaml


CHOSEN = {"hiro": "ant_gather", "diayn": "hopper"}  # algorithm -> environment, where not every one will do


@pytest.mark.parametrize("algo", LEARNERS)
def test_help_lists_every_key_with_a_value_that_may_be_typed_and_its_meaning(algo, capsys):
    chosen = [f"algo={algo}", f"env={CHOSEN.get(algo, 'snake_gather')}", "scale=laptop"]
    assert train.main([*chosen, "--help"]) == 0
    said = re.findall(r"^  ([\w.]+)=(\S*) {2,}(\S.*)$", capsys.readouterr().out, re.MULTILINE)
    run = compose_run(chosen)
    settings = {f"algo.{f.name}" for f in dataclasses.fields(run.config)} - {f"algo.{name}" for name in BUDGET_FIELDS}
    options = {f"env.{name}" for name in ENVIRONMENTS[run.env].options}
    others = {"env.horizon", "iterations", "batch_size", "seed", "runs_dir", "wandb.mode", "wandb.project"} | {
        "log.tensorboard"
    }
    assert {key for key, *_ in said} == settings | options | others | GROUPS.keys()
    assert compose_run([f"{key}={value}" for key, value, _ in said]) == run  # the values are those of the run


def test_help_is_about_the_chosen_protocol_and_names_choices_and_ranges(capsys):
    assert train.main(["--help", "protocol=modern", "algo.gamma=0.9"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"algo.minibatch_size=256 +environment steps per gradient step; .*at least 0\n", said)
    assert re.search(r"algo.gamma=0.9 +discount per environment step; above 0.0; at most 1.0\n", said)
    assert re.search(r"env=block_hopper +one of ant, ant_gather, ", said)
    assert re.search(r"seed=0 +root of every random stream", said)


@pytest.mark.parametrize("flags", [["--cfg"], ["--cfg", "job"], ["-c", "job"]])
def test_cfg_prints_the_composed_run_and_trains_nothing(flags, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert train.main([*flags, *TINY, "algo.gamma=0.9"]) == 0
    said = capsys.readouterr().out
    run = compose_run([*TINY, "algo.gamma=0.9"])
    assert said.startswith(f"# {run.folder}\n")
    assert Run.from_yaml(said, run.runs_dir) == run
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-m", "seed=1,2"], "error: --multirun: one command, one run; several: experiments.sweep run"),
        (["--multirun"], "experiments.sweep"),
        (["--lr=1e-3"], "--lr=1e-3"),
        (["--from-manifest"], "--from-manifest"),
        (["--from-manifest", "manifest.json", "runs_dir="], "takes a manifest.json and at most runs_dir=FOLDER"),
        (["--cfg", "algo=hipo"], "did you mean hippo?"),
        (["--help", "algo.gama=1"], "did you mean algo.gamma?"),
    ],
)
def test_flags_that_cannot_be_followed_are_refused(arguments, message, capsys):
    assert message in refused(train.main, arguments, capsys)


# ---------------------------------------------------------------------------------------------- one check of the scale


@pytest.mark.parametrize("scale", ["nonsense", "../../tr", "", "Smoke"])
@pytest.mark.parametrize("command", ["claims", "report", "sweep", "train", "all", "fig1", "fig2", "fig3", "table3"])
def test_a_scale_that_does_not_exist_is_refused_by_every_command(command, scale, tmp_path, monkeypatch, capsys):
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    options = ["--scale", scale, "--runs-dir", "runs"]
    mains = {"claims": claims.main, "report": report.main}
    if command in mains:
        said = refused(mains[command], [*options, "--out", "out"], capsys)
    elif command == "sweep":
        said = refused(sweep.main, ["write", "fig3", *options], capsys)
    elif command == "train":
        said = refused(train.main, [f"scale={scale}"], capsys)
    else:
        said = refused(draw.main, [command, *options, "--out", "out"], capsys)
    assert "scale" in said
    assert scale in said
    assert all(valid in said for valid in SCALES)
    assert not list(here.iterdir())


@pytest.mark.parametrize("command", ["claims", "report", "sweep", "train", "fig1", "fig3"])
def test_so_is_a_protocol_that_does_not_exist(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    main, arguments = {
        "claims": (claims.main, []),
        "report": (report.main, []),
        "sweep": (sweep.main, ["write", "fig3"]),
        "train": (train.main, []),
    }.get(command, (draw.main, [command]))
    option = ["protocol=../modern"] if command == "train" else ["--protocol", "../modern"]
    said = refused(main, [*arguments, *option], capsys)
    assert all(word in said for word in ("protocol", "../modern", *PROTOCOLS))
    assert not list(tmp_path.iterdir())


def test_the_scales_and_protocols_of_the_analysis_are_those_that_are_trained():
    assert sorted(SCALES) == choices("scale")
    assert sorted(PROTOCOLS) == choices("protocol")
