"""docs/own_sweep.md, done: its files are written, its commands are run; Optuna, which is not installed, is played."""

import sys
import types

import pytest

from experiments import sweep
from experiments.train import execute
from tests.docs.pages import blocks, follow


class Trial:
    def __init__(self, values):
        self.values = values

    def suggest_float(self, name, low, high, log=False):
        (value,) = (v for v in self.values if low <= v <= high)
        return value


class Study:
    """Tries two values, best last."""

    best_params = None

    def optimize(self, objective, n_trials):
        results = {value: objective(Trial([value])) for value in (1e-4, 3e-4)}
        assert all(isinstance(float(result), float) for result in results.values())
        self.best_params = f"{len(results)} tried of {n_trials}"


@pytest.fixture
def page(tmp_path, monkeypatch, capsys):
    """What was printed by all that the page says."""
    monkeypatch.setattr("paper_figures.compare.OUT", tmp_path / "out")
    # No processes: importing torch in each would take longer than all that they train.
    monkeypatch.setattr(sweep, "run_locally", lambda todo, *_: {run.run_id: execute(run) for run in todo})
    optuna = types.SimpleNamespace(create_study=lambda **_: Study(), TrialPruned=RuntimeError)
    monkeypatch.setitem(sys.modules, "optuna", optuna)
    return follow("own_sweep.md", tmp_path, monkeypatch, capsys)


def test_the_page_does_what_it_says(page, tmp_path):
    assert "lr at scale smoke: 8 runs (8 missing)" in page
    assert "wide at scale smoke: 4 runs (4 missing)" in page
    assert page.count(" finished ") == 8
    assert (tmp_path / "out/smoke/lr.table.csv").read_text().count("\n") == 1 + 4
    assert "2 tried of 3" in page


def test_the_part_about_optuna_is_as_short_as_it_says():
    (code,) = [b for k, t, b in blocks("own_sweep.md") if t == "tune.py"]
    assert len([line for line in code.splitlines() if line.strip()]) <= 20
