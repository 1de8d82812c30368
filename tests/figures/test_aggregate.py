"""The picture over all tasks and seeds: scores and chances worked by hand."""

import numpy as np
import pandas as pd
import pytest

from analysis.runs import Results
from paper_figures import aggregate

TASKS = ("block_hopper", "block_half_cheetah")


def test_a_return_is_the_mean_of_the_last_tenth_before_the_mark():
    steps = np.arange(1, 13) * 100_000 - 50_000
    returns = np.arange(12.0)
    assert aggregate.return_at(steps, returns) == 9.0  # 0.95 M alone lies in (0.9 M, 1 M]
    assert np.isnan(aggregate.return_at(steps[:9], returns[:9]))  # ends at 0.85 M


def test_chances_worked_by_hand():
    x, y = np.array([[1.0, 0.0], [3.0, 0.0]]), np.array([[2.0, 1.0], [3.0, 1.0]])
    assert float(aggregate.improvement(x, y).point) == pytest.approx((0.375 + 0.0) / 2)
    assert float(aggregate.improvement(x, x).point) == 0.5


def test_scores_are_relative_to_the_peers_mean_and_the_picture_is_drawn(tmp_path):
    steps = np.arange(1, 11) * 100_000
    runs = [
        {"env": env, "env_label": env, "variant": variant, "variant_label": variant, "seed": seed, "kind": "train"}
        for env in TASKS
        for variant in ("hippo_random", "ppo")
        for seed in (0, 1, 2)
    ]
    rows = [
        run | {"env_steps": t, "metric": "return_mean", "value": run["seed"] + 2.0 * (run["variant"] == "ppo")}
        for run in runs
        for t in steps
    ]
    frame = pd.DataFrame(rows).assign(run_id="ab")
    peer = pd.DataFrame([[env, s, t, 4.0 * s] for env in TASKS for s in (0, 1) for t in steps])
    peer.columns = ["env", "seed", "env_steps", "return_mean"]
    reached = aggregate.peer_scores(peer)
    assert reached["block_hopper"].tolist() == [0.0, 4.0]
    plan = {"figure": "fig3", "scale": "laptop", "protocol": "modern", "title": "Title", "runs": runs}
    results = Results(plan, frame, [])
    assert aggregate.matrices(results, reached)["ppo"].tolist() == [[1.0, 1.0], [1.5, 1.5], [2.0, 2.0]]  # over 2
    elsewhere = peer.assign(env="gym:Hopper-v5")  # kept in the same file, and none of the figure's tasks
    picture, caption = aggregate.draw(results, tmp_path, pd.concat([peer, elsewhere]))
    assert picture.stat().st_size > 10_000
    assert "block_hopper 2.00 (2 seeds)" in caption.read_text()
    short = Results(plan, frame[frame["env_steps"] < 500_000], [])
    assert aggregate.draw(short, tmp_path, peer) == []
