"""The numeric fingerprint of every learner: per-iteration metrics of a tiny run, stored with the learner's revision.

A change that should not alter numbers leaves these files alone. One that should bumps the learner's REVISION and writes
them anew in the same commit: `python -m tests.hippo.test_golden`. The runs are in double precision throughout, so that
they do not depend on the processor: another order of a sum or another routine for tanh differs by 1e-16, which three
iterations blow up to about 1e-12, and a draw from within that of a threshold does not happen. So a change that only
rounds differently leaves the files alone, too. What single precision, in which runs really train, may round is in
tests/hippo/test_single_precision.py.
"""

import contextlib
import dataclasses
import functools
import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from tests import ROOT
from tests.hippo.test_training import LEARNERS, MODERN_TOO, learner
from tests.hippo.toy import progress, run

EVERY = LEARNERS | MODERN_TOO
GOLDEN = ROOT / "tests/golden/training"
# The kernels of Nehalem and of Skylake-X differ by at most 1e-12 in these runs, one float32 on the way by 1e-7 or more.
TOLERANCE = {"rtol": 1e-9, "atol": 1e-10}


@contextlib.contextmanager
def double_precision() -> Iterator[None]:
    """New tensors, and so networks, environments and what is recorded of them, are in float64."""
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


@functools.cache
def metrics(name: str, changed: str = "", factor: float = 1.0) -> dict[str, list[float]]:
    """The columns of progress.csv of a tiny run in which one setting is a `factor` of what it should be."""
    train, config = learner(name, iterations=3, batch_size=400)
    if changed:
        setattr(config, changed, factor * getattr(config, changed))
    with tempfile.TemporaryDirectory() as folder, double_precision():
        run(train, config, Path(folder), seed=7, death_rate=0.02)
        return {key: column.tolist() for key, column in progress(Path(folder)).items()}


def revision(name: str) -> int:
    return sys.modules[EVERY[name][0].__module__].REVISION


def path_of(name: str) -> Path:
    return GOLDEN / f"{''.join(c if c.isalnum() else '_' for c in name)}.json"


def learning_rates(name: str) -> list[str]:
    """The step sizes that a learner has."""
    _, config = learner(name)
    rates = [field.name for field in dataclasses.fields(config) if field.name.endswith("learning_rate")]
    return ["learning_rate"] if getattr(config, "ppoc_faithful", False) else rates  # one Adam for all


@pytest.mark.parametrize("name", EVERY)
def test_a_learners_numbers_are_the_stored_ones_of_its_revision(name):
    stored = json.loads(path_of(name).read_text())
    assert stored["revision"] == revision(name), "the revision was bumped: write the golden files anew"
    now = metrics(name)
    assert list(now) == list(stored["metrics"])
    for key, column in now.items():
        np.testing.assert_allclose(column, stored["metrics"][key], **TOLERANCE, err_msg=f"{name}: {key}")


@pytest.mark.parametrize(("name", "rate"), [(name, rate) for name in EVERY for rate in learning_rates(name)])
def test_the_tolerance_still_sees_a_change_of_one_percent_in_the_learning_rate(name, rate):
    stored, now = json.loads(path_of(name).read_text())["metrics"], metrics(name, rate, 1.01)
    assert any(not np.allclose(column, stored[key], **TOLERANCE) for key, column in now.items())


@pytest.mark.parametrize("name", LEARNERS)
def test_nothing_is_read_before_it_is_written(name, monkeypatch):
    """Training does without it (experiments/train.py): torch's deterministic mode fills fresh memory with NaN."""
    plain = metrics(name)
    monkeypatch.setattr(torch.utils.deterministic, "fill_uninitialized_memory", True)
    torch.set_deterministic_debug_mode("error")
    try:
        assert torch.empty(1000).isnan().all()
        filled = metrics.__wrapped__(name)
    finally:
        torch.set_deterministic_debug_mode("default")
    assert filled == plain


if __name__ == "__main__":
    torch.set_num_threads(1)
    for each in EVERY:
        content = {"revision": revision(each), "metrics": metrics(each)}
        path_of(each).write_text(json.dumps(content, indent=1) + "\n")
        print(f"wrote {path_of(each)}")
