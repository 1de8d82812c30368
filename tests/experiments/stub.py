"""A run that takes no time: the learner is a running sum, everything around it is real."""

import types
from pathlib import Path
from typing import Any

import pytest
import torch

from experiments import manifest, train
from experiments.config import Run, compose_run
from hippo.core.checkpoint import Checkpoint
from hippo.core.log import RunLog

ITERATIONS = 6


def learn(config: Any, make_envs: Any, log: RunLog, seed: int, checkpoint: Checkpoint) -> None:
    """What every learner does around its arithmetic."""
    net = torch.nn.Linear(2, 2)
    with torch.no_grad():
        net.weight.fill_(seed)
        net.bias.zero_()
    first = checkpoint.restore(net=net)
    log.resume(first)
    for iteration in range(first, config.iterations):
        with torch.no_grad():
            net.weight.add_(iteration / 3)
        total = net.weight.sum().item()
        log.row({"iteration": iteration, "env_steps": iteration, "return_mean": total}, {"steps_per_second": 1.0})
        checkpoint.record(iteration, net=net)


def use(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `learn` stand for every learner that is trained, and ask git nothing."""
    monkeypatch.setattr(train, "learner_of", lambda name: types.SimpleNamespace(train=learn))
    monkeypatch.setattr(manifest, "git", lambda *arguments: None)


def run_in(folder: Path, *settings: str) -> Run:
    """A run of ITERATIONS iterations."""
    chosen = ["env=block_hopper", "scale=smoke", f"iterations={ITERATIONS}", "batch_size=400", *settings]
    return compose_run(chosen, folder)
