"""The peer's curves: kept seed by seed, cut at the budget, and not trained twice."""

import pandas as pd

from experiments import peer_curves
from experiments.bench_learning import Point


def test_what_is_kept_is_not_trained_again(tmp_path, monkeypatch, capsys):
    trained = []

    def learner(env, seed, report):
        trained.append((env, seed))
        for i in range(1, 100):
            report(Point(8192 * i, 2.0 * i, float(seed)))

    monkeypatch.setattr(peer_curves, "stable_baselines", learner)
    path = tmp_path / "rows.csv"
    arguments = ["--rows", str(path), "--budget", "20000"]
    assert peer_curves.main([*arguments, "--seeds", "1"]) == 0
    before = path.read_text()
    assert peer_curves.main([*arguments, "--seeds", "2"]) == 0
    assert path.read_text().startswith(before)
    assert trained == [(env, seed) for seed in (0, 1) for env in ("block_hopper", "block_half_cheetah")]
    rows = pd.read_csv(path)
    assert rows["env_steps"].tolist() == 4 * [8192, 16384, 24576]  # the first at or past the budget is the last
    assert peer_curves.main(["--seeds", "0", "--rows", str(path)]) == 2
    assert "seeds=0" in capsys.readouterr().err
