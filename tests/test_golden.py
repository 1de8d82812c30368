"""The numeric fingerprint of every learner: per-iteration metrics of a tiny run, stored with the learner's revision.

A change that should not alter numbers leaves these files alone. One that should bumps the learner's REVISION and writes
them anew in the same commit: `python -m tests.test_golden`. One that only rounds differently (another order of a sum,
another routine for tanh) writes them anew, says so in its message and leaves the revision: L-BFGS and samples near a
threshold blow rounding up beyond the tolerance, but runs before and after are draws from the same distribution.
"""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.test_training import LEARNERS, learner
from tests.toy import progress, run

GOLDEN = Path(__file__).parent / "golden" / "training"


def metrics(name: str, folder: Path) -> dict[str, list[float]]:
    train, config = learner(name, iterations=3, batch_size=400)
    run(train, config, folder, seed=7, death_rate=0.02)
    return {key: column.tolist() for key, column in progress(folder).items()}


def revision(name: str) -> int:
    return sys.modules[LEARNERS[name][0].__module__].REVISION


def path_of(name: str) -> Path:
    return GOLDEN / f"{''.join(c if c.isalnum() else '_' for c in name)}.json"


@pytest.mark.parametrize("name", LEARNERS)
def test_a_learners_numbers_are_the_stored_ones_of_its_revision(name, tmp_path):
    stored = json.loads(path_of(name).read_text())
    assert stored["revision"] == revision(name), "the revision was bumped: write the golden files anew"
    now = metrics(name, tmp_path)
    assert list(now) == list(stored["metrics"])
    for key, column in now.items():
        # Other processors round differently; anything that matters is far larger than this.
        np.testing.assert_allclose(column, stored["metrics"][key], rtol=1e-3, atol=1e-4, err_msg=f"{name}: {key}")


@pytest.mark.parametrize("name", LEARNERS)
def test_nothing_is_read_before_it_is_written(name, tmp_path, monkeypatch):
    """Training does without it (experiments/train.py): torch's deterministic mode fills fresh memory with NaN."""
    plain = metrics(name, tmp_path / "plain")
    monkeypatch.setattr(torch.utils.deterministic, "fill_uninitialized_memory", True)
    torch.use_deterministic_algorithms(True)
    try:
        assert torch.empty(1000).isnan().all()
        filled = metrics(name, tmp_path / "filled")
    finally:
        torch.use_deterministic_algorithms(False)
    assert filled == plain


def test_the_tolerance_still_sees_a_change_of_one_percent_in_the_learning_rate(tmp_path):
    stored = json.loads(path_of("ppo").read_text())["metrics"]
    train, config = learner("ppo", iterations=3, batch_size=400)
    config.learning_rate *= 1.01
    run(train, config, tmp_path, seed=7, death_rate=0.02)
    difference = np.abs(progress(tmp_path)["return_mean"] - stored["return_mean"])
    assert difference.max() > 1e-3 * np.abs(stored["return_mean"]).max() + 1e-4


if __name__ == "__main__":
    torch.set_num_threads(1)
    for each in LEARNERS:
        with tempfile.TemporaryDirectory() as temporary:
            content = {"revision": revision(each), "metrics": metrics(each, Path(temporary))}
        path_of(each).write_text(json.dumps(content, indent=1) + "\n")
        print(f"wrote {path_of(each)}")
