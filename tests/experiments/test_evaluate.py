"""Evaluation: repeatable, side by side under changed dynamics, apart from training's randomness."""

import csv

import numpy as np
import pytest
import torch

from baselines import ppo
from experiments import crossings, evaluate, export, train, video
from experiments.config import compose_run
from hippo.core.episodes import opening_episodes
from hippo.core.hierarchy import HierarchicalPolicy, collect
from hippo.core.policies import GaussianPolicy
from hippo.hippo import HippoConfig
from tests.hippo.toy import TargetEnv


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    runs = {}
    for algo in ("hippo", "ppo", "hier_vpg"):
        budget = ["iterations=1", "batch_size=400", "env.horizon=40", f"runs_dir={folder}"]
        runs[algo] = compose_run(["env=snake_gather", f"algo={algo}", "scale=smoke", *budget])
        assert train.execute(runs[algo]) == "finished"
    return runs


def returns(rows):
    return [row["return"] for row in rows]


def test_opening_episodes_worked_by_hand():
    reward = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    done = np.array([[False, True], [False, False], [True, True]])
    total, length = opening_episodes(reward, done)
    assert (total.tolist(), length.tolist()) == ([9.0, 2.0], [3, 1])
    with pytest.raises(ValueError, match="not over"):
        opening_episodes(reward, np.zeros((3, 2), bool))


@pytest.mark.parametrize("algo", ["hippo", "ppo", "hier_vpg"])
def test_evaluation_repeats_itself_and_leaves_the_run_alone(algo, trained):
    run = trained[algo]
    before = {p.name: p.read_bytes() for p in run.folder.iterdir()}
    first = evaluate.evaluate(run, 6, seed=0)
    assert first == evaluate.evaluate(run, 6, seed=0)
    assert {p.name: p.read_bytes() for p in run.folder.iterdir()} == before
    assert len(first) == 6
    assert {row["length"] for row in first} == {40}


@pytest.fixture(scope="module")
def block_run(tmp_path_factory):
    """With a normaliser of observations."""
    budget = ["iterations=1", "batch_size=400", "env.horizon=40", f"runs_dir={tmp_path_factory.mktemp('runs')}"]
    run = compose_run(["env=block_half_cheetah", "algo=ppo", "scale=smoke", "protocol=modern", *budget])
    assert train.execute(run) == "finished"
    return run


def test_blanked_walls_are_replaced_by_their_mean_before_any_normaliser_and_nothing_else_is(block_run, monkeypatch):
    looks = []

    class Spy(crossings.Walls):
        def _look(self, obs):
            before = obs.copy()
            shown = super()._look(obs)
            looks.append((self._columns, before, shown))
            return shown

    monkeypatch.setattr(evaluate, "Walls", Spy)
    plain = evaluate.evaluate(block_run, 4, seed=0)
    assert not looks
    rows = evaluate.evaluate(block_run, 4, seed=0, blank_walls=True)
    half = len(looks) // 2  # the same evaluation with walls, then without
    columns = looks[0][0]
    names = [evaluate.environments(block_run, 1, 0).observation_names[c] for c in columns]
    assert len(names) == 8
    assert all("_wall_" in name for name in names)
    mean = np.mean([before[:, columns] for _, before, _ in looks[:half]], (0, 1), dtype=float)
    for i, (_, before, shown) in enumerate(looks):
        if i < half:
            np.testing.assert_array_equal(shown, before)
        else:
            np.testing.assert_allclose(shown[:, columns], np.broadcast_to(mean, (4, 8)), rtol=1e-5)
            np.testing.assert_array_equal(np.delete(shown, columns, 1), np.delete(before, columns, 1))
            assert shown.dtype == before.dtype
    assert [row.pop("walls_blanked") for row in rows] == [True] * 4
    assert rows[0].keys() == plain[0].keys()


def test_blanking_walls_is_said_and_refused_where_there_are_none(block_run, trained, capsys):
    assert evaluate.main([str(block_run.folder), "--episodes", "2", "--blank-walls"]) == 0
    assert capsys.readouterr().out.endswith("walls replaced by its mean\n")
    assert evaluate.main([str(block_run.folder), "--episodes", "2", "--blank-walls", "--csv"]) == 0
    assert capsys.readouterr().out.splitlines()[0].endswith(",walls_blanked")
    assert evaluate.main([str(trained["ppo"].folder), "--blank-walls"]) == 2
    assert "--blank-walls=snake_gather: has no walls" in capsys.readouterr().err


def test_on_block_tasks_a_row_says_how_walls_were_crossed_and_elsewhere_it_does_not(block_run, trained, capsys):
    run = block_run
    capsys.readouterr()
    assert evaluate.main([str(run.folder), "--episodes", "3", "--csv"]) == 0
    rows = list(csv.DictReader(capsys.readouterr().out.splitlines()))
    assert tuple(rows[0]) == (*evaluate.COLUMNS, *crossings.COLUMNS)
    assert [float(row["return"]) for row in rows] == [float(row["crossings"]) for row in rows]
    assert evaluate.main([str(run.folder), "--episodes", "3"]) == 0
    assert "cleared" in capsys.readouterr().out.splitlines()[-1]
    assert evaluate.evaluate(trained["ppo"], 2, seed=0)[0].keys() == set(evaluate.COLUMNS)


def test_changed_dynamics_meet_the_same_episodes(trained):
    # Damping and friction cannot change the Snake, so the very same returns prove the same episodes and noise.
    run = trained["hippo"]
    lengths = []
    for perturbation in (None, "damping", "friction"):
        rows = evaluate.evaluate(run, 8, seed=3, perturbation=perturbation)
        lengths.append((returns(rows), rows[0]["perturbation"]))
    assert lengths[0][0] == lengths[1][0] == lengths[2][0]
    assert [name for _, name in lengths] == ["none", "damping", "friction"]


def test_greedy_rollouts_take_the_most_likely_choices():
    config = HippoConfig(iterations=1, batch_size=200, horizon=20)
    policy = HierarchicalPolicy(config, 2, 2, 2, torch.Generator().manual_seed(0))
    batch = collect(policy, TargetEnv(10, 0), config, 0, 0, greedy=True)
    obs, skill, time_left = batch.steps.obs[:-1], batch.skill[:-1], batch.time_left[:-1]
    decided = batch.is_decision[:-1]
    best = policy.manager.logits(policy.manager_input(obs, time_left)).argmax(-1)
    assert torch.equal(skill[decided], best[decided])
    rows = policy.skill_input(obs, time_left).flatten(0, 1)
    mean = policy.skills.means(rows)[torch.arange(200), skill.flatten()]
    torch.testing.assert_close(batch.steps.action.flatten(0, 1), mean)
    noisy = collect(policy, TargetEnv(10, 0), config, 0, 0)
    assert not torch.equal(noisy.skill, batch.skill)
    assert (noisy.steps.action - batch.steps.action).abs().mean() > 0.5

    flat_config = ppo.PPOConfig(iterations=1, batch_size=200, horizon=20)
    flat = GaussianPolicy(2, 2, [8], torch.Generator().manual_seed(0))
    steps, _ = ppo.collect(flat, TargetEnv(10, 0), flat_config, 0, 0, greedy=True)
    torch.testing.assert_close(steps.action, flat.mean(steps.obs[:-1]))


def test_the_command_line_writes_a_csv_or_refuses(trained, tmp_path, capsys):
    run, out = trained["ppo"], tmp_path / "mass.csv"
    assert evaluate.main([str(run.folder), "--perturbation", "mass", "--episodes", "3", "--out", str(out)]) == 0
    rows = list(csv.DictReader(out.open()))
    assert [row["perturbation"] for row in rows] == ["mass"] * 3
    assert {row["run_id"] for row in rows} == {run.run_id}
    capsys.readouterr()
    for arguments, message in (
        ([str(tmp_path)], "is no run folder"),
        ([str(run.folder), "--perturbation", "wind"], "--perturbation=wind: "),
        ([str(run.folder), "--episodes", "0"], "--episodes=0: "),
    ):
        assert evaluate.main([*arguments, "--out", str(tmp_path / "no.csv")]) == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / "no.csv").exists()


def test_the_terminal_shows_a_summary_and_the_rows_only_when_asked(trained, capsys):
    folder = str(trained["ppo"].folder)
    assert evaluate.main([folder, "--episodes", "3", "--perturbation", "mass"]) == 0
    header, line = capsys.readouterr().out.splitlines()
    rows = evaluate.evaluate(trained["ppo"], 3, 0, perturbation="mass")
    low, high = evaluate.interval(np.array(returns(rows)))
    assert " ".join(header.split()).endswith("strength episodes mean return 95 % interval mean length")
    assert line.split()[:4] == ["snake_gather", "mass", "original", "3"]
    assert line.split()[4:8] == [f"{np.mean(returns(rows)):.3f}", f"{low:.3f}", "to", f"{high:.3f}"]
    assert evaluate.main([folder, "--episodes", "3", "--perturbation", "mass", "--csv"]) == 0
    assert capsys.readouterr().out == evaluate.as_csv(rows)


def test_the_interval_worked_by_hand():
    # 1, 2, 3: mean 2, standard deviation 1, standard error 1 / sqrt 3; Student's 97.5 % point of 2 degrees is 4.3027.
    assert evaluate.interval(np.array([1.0, 2.0, 3.0])) == pytest.approx(
        (2 - 4.3027 / 3**0.5, 2 + 4.3027 / 3**0.5), 1e-4
    )
    assert evaluate.interval(np.array([5.0, 5.0])) == evaluate.interval(np.array([5.0])) == (5.0, 5.0)


def test_what_a_robot_cannot_have_names_the_flag_to_type(tmp_path, capsys):
    hopper = compose_run(["env=block_hopper", "algo=ppo", "scale=smoke", "iterations=1", f"runs_dir={tmp_path}"])
    hopper.folder.mkdir()
    (hopper.folder / "config.yaml").write_text(hopper.to_yaml())
    (hopper.folder / "checkpoint.pt").touch()
    for command in (evaluate, video):
        assert command.main([str(hopper.folder), "--perturbation", "mass"]) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: --strength=original: ")
        assert error.endswith("use --strength all\n")


@pytest.mark.parametrize("algo", ["hippo", "ppo", "hier_vpg"])
def test_an_exported_policy_acts_as_the_run_it_comes_from_and_is_smaller(algo, trained, tmp_path, capsys):
    run = trained[algo]
    assert export.main([str(run.folder), "--to", str(tmp_path)]) == 0
    place = tmp_path / run.run_id
    assert (place / "checkpoint.pt").stat().st_size < 0.6 * (run.folder / "checkpoint.pt").stat().st_size
    again = evaluate.evaluate(evaluate.load_run(place), 3, 5)
    assert returns(again) == returns(evaluate.evaluate(run, 3, 5))
    assert f"wrote {place}" in capsys.readouterr().out


def test_what_is_no_finished_run_is_not_exported(trained, tmp_path, capsys):
    assert export.main([str(tmp_path), "--to", str(tmp_path / "out")]) == 2
    unfinished = tmp_path / trained["ppo"].run_id
    unfinished.mkdir()
    (unfinished / "config.yaml").write_text(trained["ppo"].to_yaml())
    assert export.main([str(unfinished), "--to", str(tmp_path / "out")]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert "is no run folder" in errors[0]
    assert "only finished runs are taken" in errors[1]
    assert not (tmp_path / "out").exists()


def test_a_run_folder_from_before_the_mirror_had_settings_can_be_read(trained, tmp_path):
    text = trained["ppo"].to_yaml()
    older = "".join(line for line in text.splitlines(keepends=True) if not line.startswith("wandb_project"))
    assert older != text
    (tmp_path / "config.yaml").write_text(older)
    assert evaluate.load_run(tmp_path).run_id == trained["ppo"].run_id
