"""Committed results: curves thinned as said, whole runs only, nothing twice, and where every run comes from."""

import json

import numpy as np
import pandas as pd
import pytest

from analysis import runs
from experiments import commit
from tests.analysis.test_analysis import planned


def finished(tmp_path, lengths, iterations):
    """Two planned runs with manifests."""
    planned(tmp_path, lengths, iterations)
    for seed in (0, 1):
        origin = {
            "git_commit": f"c0ffee{seed}",
            "git_difference": None,
            "lock": "10c",
            "cpu": "A, B",
            "cpu_flags": "no",
        }
        name = {"run_id": f"{seed:012x}", "identity": {}, "earlier": [origin | {"git_commit": "c0de"}]}
        (tmp_path / f"{seed:012x}/manifest.json").write_text(json.dumps(origin | name))


def committed(tmp_path):
    results = runs.load("fig3", "smoke", tmp_path, tmp_path / "data", None)
    return commit.commit(results, tmp_path, tmp_path / "data")


def test_a_long_curve_is_thinned_to_means_of_equal_groups():
    rows = pd.DataFrame({"env_steps": 10 * np.arange(1, 601), "run_id": "a", "value": np.arange(600.0)})
    thin = commit.thinned(rows)  # 600 rows in groups of 3
    assert len(thin) == 200
    assert thin["value"].tolist()[:2] == [1.0, 4.0]
    assert thin["env_steps"].tolist()[-2:] == [5970, 6000]
    assert thin["value"].mean() == rows["value"].mean()
    assert thin["value"][-20:].mean() == rows["value"][-60:].mean()  # the last 10 %
    every_third = rows["value"][2::3]  # which picking rows would not keep
    assert every_third[-20:].mean() != rows["value"][-60:].mean()
    assert commit.thinned(rows[:250]).equals(rows[:250].reset_index(drop=True))


def test_whole_runs_are_committed_once_with_their_origin(tmp_path):
    finished(tmp_path, [3, 2], 3)
    assert committed(tmp_path) == (1, 1)  # the other was cut short
    path = tmp_path / "data/smoke/fig3.csv"
    before = path.read_bytes()
    rows = runs.read_committed(path, "smoke")
    assert (rows["metric"] == "return_mean").all()
    assert rows["value"].tolist() == [0.0, 0.1, 0.2]
    assert path.with_suffix(".runs.csv").read_text() == (
        'run_id,git_commit,git_difference,lock,cpu,cpu_capability\n000000000000,c0de then c0ffee0,,10c,"A, B",\n'
    )
    assert committed(tmp_path) == (1, 0)
    assert path.read_bytes() == before


def test_a_committed_curve_may_have_fewer_rows_than_iterations(tmp_path):
    finished(tmp_path, [600, 600], 600)
    assert committed(tmp_path) == (2, 2)
    plan = tmp_path / "plans/smoke/fig3.json"
    plan.write_text(plan.read_text().replace('"finished"', '"committed"'))
    results = runs.load("fig3", "smoke", tmp_path, tmp_path / "data")
    assert results.missing == []
    assert len(results.frame) == 400


@pytest.mark.parametrize("arguments", [["fig99"], ["fig3", "--scale", "nonsense"]])
def test_what_is_no_figure_or_scale_is_refused(arguments, tmp_path, capsys):
    try:
        code = commit.main([*arguments, "--runs-dir", str(tmp_path), "--data", str(tmp_path)])
    except SystemExit as stopped:
        code = stopped.code
    assert code == 2
    assert arguments[-1] in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
