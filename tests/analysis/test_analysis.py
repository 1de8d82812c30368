"""Statistics against numbers worked by hand, and run folders to a tidy frame."""

import json

import numpy as np
import pandas as pd
import pytest

from analysis import runs, stats
from tests import ROOT


def test_the_interquartile_mean_worked_by_hand():
    # Eight scores: two are cut at either end, (3 + 4 + 5 + 6) / 4 = 4.5; an outlier does not move it.
    scores = np.array([1, 2, 3, 4, 5, 6, 7, 8.0])
    assert stats.interquartile_mean(scores) == 4.5
    assert stats.interquartile_mean(np.array([1, 2, 3, 4, 5, 6, 7, 800.0])) == 4.5
    assert np.mean([1, 2, 3, 4, 5, 6, 7, 800.0]) != 4.5


def test_mean_and_sample_standard_deviation_over_seeds():
    scores = np.array([[1.0, 10.0], [3.0, 10.0]])
    assert stats.mean(scores).tolist() == [2.0, 10.0]
    assert stats.standard_deviation(scores).tolist() == pytest.approx([2**0.5, 0.0])  # (n - 1) in the denominator
    assert np.isnan(stats.standard_deviation(scores[:1])).all()


def test_probability_of_improvement_worked_by_hand():
    # x = (1, 3), y = (2, 3): 1<2, 1<3, 3>2, 3=3 -> (0 + 0 + 1 + 0.5) / 4.
    assert stats.probability_of_improvement(np.array([1.0, 3.0]), np.array([2.0, 3.0])) == 0.375
    assert stats.probability_of_improvement(np.array([2.0, 3.0]), np.array([1.0, 3.0])) == 0.625


def test_the_performance_profile_counts_runs_above_each_threshold():
    scores = np.array([[0.0, 1.0], [2.0, 3.0]])
    assert stats.performance_profile(scores, np.array([-1.0, 0.0, 1.5, 3.0])).tolist() == [1.0, 0.75, 0.5, 0.0]


def test_final_performance_is_the_mean_of_the_last_tenth():
    curve = np.stack([np.arange(20.0), np.full(20, 7.0)])
    assert stats.final_performance(curve).tolist() == [18.5, 7.0]  # of 20 the last 2
    assert stats.final_performance(np.array([[1.0, 2.0, 3.0]])).tolist() == [3.0]  # never less than one


def test_the_bootstrap_interval_is_that_of_all_resamples_for_two_seeds():
    # Means of two draws from {0, 1} are 0, 0.5, 1 with probability 1/4, 1/2, 1/4: the 2.5 and 97.5 % points are 0, 1.
    interval = stats.bootstrap_mean(np.array([[0.0, 5.0], [1.0, 5.0]]))
    assert interval.point.tolist() == [0.5, 5.0]
    assert interval.low.tolist() == [0.0, 5.0]
    assert interval.high.tolist() == [1.0, 5.0]


def test_the_bootstrap_repeats_itself_and_one_seed_has_no_interval():
    scores = np.random.default_rng(0).normal(size=(10, 4))
    first, second = stats.bootstrap_mean(scores), stats.bootstrap_mean(scores)
    assert np.array_equal(first.low, second.low)
    assert (first.low < first.point).all()
    assert (first.point < first.high).all()
    # About the normal interval for ten seeds.
    half = 1.96 * scores.std(0) / np.sqrt(10)
    np.testing.assert_allclose(first.high - first.low, 2 * half, rtol=0.1)
    assert np.isnan(stats.bootstrap_mean(scores[:1]).low).all()


def test_the_stratified_bootstrap_resamples_within_tasks():
    # Seeds agree within each task, so however they are resampled the answer is the same; pooling would vary.
    scores = np.tile([0.0, 1.0, 2.0, 9.0], (5, 1))
    interval = stats.stratified_bootstrap_iqm(scores, resamples=200)
    assert (interval.point, interval.low, interval.high) == (1.5, 1.5, 1.5)


def test_the_statistics_agree_with_rliable():
    golden = json.loads((ROOT / "tests/golden/analysis/rliable.json").read_text())
    x, y = np.array(golden["x"]), np.array(golden["y"])
    assert stats.mean(x).mean() == pytest.approx(golden["mean"], abs=1e-12)
    assert stats.interquartile_mean(x) == pytest.approx(golden["iqm"], abs=1e-12)
    per_task = [stats.probability_of_improvement(a, b) for a, b in zip(x.T, y.T, strict=True)]
    assert np.mean(per_task) == pytest.approx(golden["probability_of_improvement"], abs=1e-12)
    assert stats.performance_profile(x, np.array(golden["taus"])).tolist() == pytest.approx(golden["profile"])
    # Two bootstraps of 20 000 resamples with different random numbers; the ends' own noise is about 0.003.
    iqm = stats.stratified_bootstrap_iqm(x, golden["resamples"])
    assert [iqm.low, iqm.high] == pytest.approx(golden["iqm_interval"], abs=0.01)
    assert np.ptp(golden["iqm_interval"]) > 0.2
    mean = stats.bootstrap_mean(x[:, :1], golden["resamples"])
    assert [*mean.low, *mean.high] == pytest.approx(golden["mean_interval_of_task_0"], abs=0.01)


@pytest.mark.parametrize(("seeds", "expected"), [(3, 0.73), (5, 0.83), (10, 0.90)])
def test_a_nominal_95_percent_bootstrap_covers_less_with_few_seeds(seeds, expected):
    # Normal scores with mean 0. Three seeds: the ends are close to the smallest and the largest of the three (each is
    # the mean of a resample with probability 1/27 = 3.7 %), and 0 lies between them with probability 1 - 2/8 = 0.75.
    scores = np.random.default_rng(seeds).normal(size=(seeds, 3000))
    interval = stats.bootstrap_mean(scores, resamples=500)
    coverage = np.mean((interval.low < 0) & (interval.high > 0))
    print(f"n = {seeds}: a nominal {stats.LEVEL:.0%} interval covers {coverage:.3f}")
    assert coverage == pytest.approx(expected, abs=0.03)


# ---------------------------------------------------------------------------------------------------------- run folders


def planned(tmp_path, lengths, iterations=3, physics=("paper", "paper"), states=(None, None)):
    """A plan of two seeds, whose progress.csv have the given numbers of rows, None for no folder."""
    entries = []
    for seed, length in enumerate(lengths):
        run_id = f"{seed:012x}"
        entries.append(
            {"run_id": run_id, "env": "block_hopper", "env_label": "Block Hopper", "variant": "ppo"}
            | {"variant_label": "PPO", "seed": seed, "iterations": iterations, "physics": physics[seed]}
            | {"state": states[seed] or ("finished" if length == iterations else "failed")}
            | {"batch_size": 10, "kind": "train"}
        )
        if length is not None:
            (tmp_path / run_id).mkdir()
            rows = "".join(f"{i},{10 * (i + 1)},{seed + 0.1 * i!r},7\n" for i in range(length))
            (tmp_path / run_id / "progress.csv").write_text("iteration,env_steps,return_mean,episodes\n" + rows)
    plan = {"figure": "fig3", "scale": "smoke", "title": "A title", "runs": entries, "claims": []}
    (tmp_path / "plans/smoke").mkdir(parents=True)
    (tmp_path / "plans/smoke/fig3.json").write_text(json.dumps(plan))


def test_run_folders_become_one_tidy_frame(tmp_path):
    planned(tmp_path, [3, 3])
    results = runs.load("fig3", "smoke", tmp_path, tmp_path / "data")
    assert list(results.frame.columns) == runs.COLUMNS
    assert results.missing == []
    seeds, steps, table = runs.scores(results.frame, "block_hopper", "ppo")
    assert (seeds, steps) == ([0, 1], [10, 20, 30])
    assert table.to_numpy().tolist() == [[0.0, 1.0], [0.1, 1.1], [0.2, 1.2]]


def test_a_torn_line_is_left_out_and_a_short_run_is_reported(tmp_path):
    planned(tmp_path, [3, 2])
    with (tmp_path / f"{1:012x}/progress.csv").open("a") as file:
        file.write("2,30,99")
    results = runs.load("fig3", "smoke", tmp_path, tmp_path / "data")
    assert [r["seed"] for r in results.missing] == [1]
    assert results.frame["value"].max() < 2
    assert np.isnan(runs.scores(results.frame, "block_hopper", "ppo")[2].to_numpy()[2, 1])


def test_a_header_torn_by_a_kill_counts_as_nothing(tmp_path):
    planned(tmp_path, [3, None])
    (tmp_path / f"{1:012x}").mkdir()
    (tmp_path / f"{1:012x}/progress.csv").write_text("iteration,env_st")
    assert [r["seed"] for r in runs.load("fig3", "smoke", tmp_path, tmp_path).missing] == [1]


def commit(tmp_path, scale="smoke"):
    """Committed rows of seeds 0, 1, 2: three steps each, 40 + seed."""
    (tmp_path / "data/smoke").mkdir(parents=True)
    rows = [
        {"figure": "fig3", "scale": scale, "env": "block_hopper", "variant": "ppo", "seed": s, "run_id": f"{s:012x}"}
        | {"env_steps": 10 * (i + 1), "metric": "return_mean", "value": 40.0 + s}
        for s in (0, 1, 2)
        for i in range(3)
    ]
    pd.DataFrame(rows).to_csv(tmp_path / "data/smoke/fig3.csv", index=False)


@pytest.mark.parametrize("length", [None, 1])  # no run folder, or one that was begun here and left
def test_committed_rows_are_used_for_the_runs_that_the_plan_calls_committed(tmp_path, length):
    planned(tmp_path, [3, length], states=("finished", "committed"))
    commit(tmp_path)
    results = runs.load("fig3", "smoke", tmp_path, tmp_path / "data")
    # Seed 0 has a folder of its own, seed 1 comes from the committed file, seed 2 is not planned.
    assert results.frame.groupby("seed")["value"].max().to_dict() == {0: 0.2, 1: 41.0}
    assert results.missing == []


def test_committed_rows_do_not_stand_in_for_a_run_that_failed_here(tmp_path):
    planned(tmp_path, [3, None], states=("finished", "failed"))  # as with FRESH=1
    commit(tmp_path)
    results = runs.load("fig3", "smoke", tmp_path, tmp_path / "data")
    assert set(results.frame["seed"]) == {0}
    assert [r["seed"] for r in results.missing] == [1]


def test_two_scales_are_never_drawn_together(tmp_path):
    planned(tmp_path, [3, 3])
    commit(tmp_path, scale="paper")
    with pytest.raises(ValueError, match=r"rows of scale paper, not only of smoke"):
        runs.load("fig3", "smoke", tmp_path, tmp_path / "data")
    (tmp_path / "plans/paper").mkdir()
    (tmp_path / "plans/smoke/fig3.json").rename(tmp_path / "plans/paper/fig3.json")
    with pytest.raises(ValueError, match="a plan of scale smoke, not of scale paper"):
        runs.load("fig3", "paper", tmp_path, tmp_path / "data")


def test_nothing_to_show_is_an_error_that_says_what_to_do(tmp_path):
    with pytest.raises(runs.MissingData, match="make draw-fig3 SCALE=smoke"):
        runs.load("fig3", "smoke", tmp_path, tmp_path)
    planned(tmp_path, [None, 0])
    with pytest.raises(runs.MissingData, match="none of its 2 runs"):
        runs.load("fig3", "smoke", tmp_path, tmp_path)


def test_two_kinds_of_physics_are_never_drawn_together(tmp_path):
    planned(tmp_path, [3, 3], physics=("paper", "fast"))
    with pytest.raises(ValueError, match="block_hopper mixes"):
        runs.load("fig3", "smoke", tmp_path, tmp_path)
