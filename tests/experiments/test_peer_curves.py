"""The peer's curves: kept seed by seed, cut at the budget, not trained twice, and drawn beside a study's own."""

import pandas as pd
import pytest

from experiments import peer_rows, study
from experiments.artefacts import calibration, peer_curves
from experiments.bench.learning import Point


@pytest.fixture
def trained(monkeypatch):
    """What was trained, by a learner whose return is its seed."""
    seen = []

    def train_peer(learner, report):
        seen.append(learner)
        for i in range(1, 100):
            report(Point(8192 * i, 2.0 * i, float(learner[1])))

    monkeypatch.setattr(peer_curves, "peer", lambda env, seed: (env, seed))
    monkeypatch.setattr(peer_curves, "train_peer", train_peer)
    monkeypatch.setattr(peer_curves, "calibrated", lambda learner, env, seed: f"| `{env}` |")
    return seen


def test_what_is_kept_is_not_trained_again(tmp_path, trained, capsys):
    path = tmp_path / "rows.csv"
    arguments = ["--rows", str(path), "--budget", "20000"]
    assert peer_curves.main([*arguments, "--seeds", "1"]) == 0
    before = path.read_text()
    assert peer_curves.main([*arguments, "--seeds", "2"]) == 0
    assert path.read_text().startswith(before)
    assert trained == [(env, seed) for seed in (0, 1) for env in ("block_hopper", "block_half_cheetah")]
    rows = pd.read_csv(path)
    assert rows["env_steps"].tolist() == 4 * [8192, 16384, 24576]  # the first at or past the budget is the last
    assert "block_hopper seed 1: 1.00 over the last tenth" in capsys.readouterr().out
    assert peer_curves.main(["--seeds", "0", "--rows", str(path)]) == 2
    assert "seeds=0" in capsys.readouterr().err
    assert peer_curves.main(["--env", "block_hoper", "--rows", str(path)]) == 2
    assert "block_hoper" in capsys.readouterr().err
    assert len(trained) == 4


def test_a_study_has_it_beside_its_variants(tmp_path, trained, monkeypatch):
    path = tmp_path / "rows.csv"
    monkeypatch.setattr(peer_rows, "ROWS", path)
    arguments = ["--rows", str(path), "--budget", "20000", "--seeds", "3"]
    assert peer_curves.main([*arguments, "--env", "gym:Pendulum-v1", "--env", "block_hopper"]) == 0
    described = {
        "title": "A task",
        "text": "Why.",
        "settings": ["scale=smoke", "iterations=3", "batch_size=8000"],
        "environments": {"gym:Pendulum-v1": []},
        "variants": {"PPO": ["algo=ppo"]},
        "peer": True,
        "seeds": [0],
        "metrics": ["return_mean"],
    }
    made = study.build("beside", described, tmp_path / "runs")
    lines = study.table(made, made.peer())
    assert lines[-1].startswith("| PPO, Stable-Baselines3 | 3 | 1.00 ± 1.00 | 1.00 ± 1.00 |")
    assert "block_hopper" not in "".join(lines)
    assert made.peer()["env_steps"].max() == 16384  # 24000 of the study's, and one iteration more is beyond them
    drawn = made.results(made.peer())
    assert {run["variant"]: run["batch_size"] for run in drawn.plan["runs"]} == {
        "PPO": made.entries[0].run.config.batch_size,
        "PPO, Stable-Baselines3": 8192,
    }
    without = study.build("alone", described | {"peer": False}, tmp_path / "runs")
    assert without.peer().empty
    assert len(study.table(without, without.peer())) == len(lines) - 1


def test_its_policy_is_measured_as_ours_are_and_again_with_walls_blanked(monkeypatch):
    measured, seen = peer_curves.measure, []

    def shortly(*arguments, **given):
        seen.append((given.get("walls_as"), *measured(*arguments, horizon=20, **given)))
        return seen[-1][1:]

    monkeypatch.setattr(peer_curves, "EPISODES", 2)
    monkeypatch.setattr(peer_curves, "measure", shortly)
    cells = peer_curves.calibrated(peer_curves.peer("block_hopper", 0), "block_hopper", 7).split(" | ")
    assert cells[:2] == ["| `block_hopper`", "PPO, Stable-Baselines3, seed 7"]
    assert len(cells) == len((calibration.HEADER + calibration.BLANKED).split(" | "))
    assert seen[0][0] is None
    assert seen[1][0] is seen[0][2]  # what the first saw on average
