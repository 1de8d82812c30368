"""A policy at work: what it does next, with nothing of learning. Every learner has its own `Acting` and `restored`."""

from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from hippo.core import seeding
from hippo.core.checkpoint import Checkpoint, load
from hippo.core.rollout import Steps

PARTS = ("policy", "agents")  # of a checkpoint, what `restored` needs


class Acting(Protocol):
    """A policy at work in N environments, from fresh episodes on; for every step `act`, the environments', `end`.

    All randomness of a horizon of T steps is drawn when it begins, from streams named by (seed, iteration); the
    horizons that follow have the iterations that follow.
    """

    def act(self, obs: np.ndarray) -> np.ndarray:
        """Actions (N, A), not clipped, for observations (N, D) as the environments give them."""

    def end(self, done: np.ndarray) -> None:
        """The step is over, and with it the episodes where `done` (N,)."""


class OfHorizons:
    """An `Acting` whose randomness is drawn a horizon at a time."""

    def __init__(self, horizon: int, seed: int, iteration: int) -> None:
        self._horizon, self._seed, self._iteration = horizon, seed, iteration
        self._t = 0  # steps of this horizon taken
        self._draw(seed, iteration)

    def _draw(self, seed: int, iteration: int) -> None:
        """Draw what one horizon of T steps needs, every purpose from a stream of its own."""
        raise NotImplementedError

    def _next_horizon_if_over(self) -> None:
        """To be called before a step."""
        if self._t == self._horizon:
            self._t, self._iteration = 0, self._iteration + 1
            self._draw(self._seed, self._iteration)


def parts_that_act(path: Path) -> dict[str, Any]:
    """The content of a checkpoint without what only training needs.

    Raises:
        FileNotFoundError, CheckpointError: as `hippo.core.checkpoint.load`.
    """
    return {name: part for name, part in load(path).items() if name in ("iteration", "run_id", *PARTS)}


@torch.no_grad()
def rollout(learner: Any, config: Any, envs: Any, seed: int, checkpoint: Checkpoint, greedy: bool = False) -> Steps:
    """One horizon in every environment with the policy of a checkpoint; nothing is learnt.

    Args:
        learner: the module that trained it. greedy: every level takes its most likely choice.
    """
    policy = learner.restored(config, envs, checkpoint)
    acting = learner.Acting(policy, config, envs.num_envs, seed, 0, greedy)
    steps = Steps(envs, config.horizon)
    obs = steps.reset(seeding.integer(seed, "episodes", 0))
    for t in range(config.horizon):
        obs, done = steps.step(t, acting.act(obs))
        acting.end(done)
    return steps
