"""SNN4HRL: skills that visit different places (Florensa, Duan and Abbeel 2017), as the authors pre-train theirs.

The plane is cut into cells. With N(z, c) steps of skill z in cell c and N(c) of all, both counted over the batch, a
step earns, beside the environment's reward,

    coefficient * ( mi_weight * log(N(z, c) / N(c))  +  survival  +  distance_weight * distance in cells )

whose first term averages to I(z; c) - H(z). Sources: SNN = github.com/florensacc/snn4hrl (grid_bonus_evaluator.py) and
the authors' copy of it. Departure, *ours*: HiPPO's clipped surrogate and baseline instead of TRPO and a linear one.
docs/algorithms/snn.md has the whole list. Algorithm 1 of SNN4HRL, line by line:

    initialise the policy; a latent z of K skills  hippo/core/pretraining.py new_policy
    z ~ Cat(1/K), kept for the whole path          hippo/core/pretraining.py collect
    collect rollouts, count (c, z)                 here                      GridBonus.positions, cells
    p(Z = z|c) from the counts                     here                      log_shares
    R <- R + alpha log p(Z = z|c)                  here                      GridBonus.reward
    a policy step (TRPO there)                     hippo/core/pretraining.py update
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hippo.core.checkpoint import Checkpoint
from hippo.core.log import RunLog
from hippo.core.policies import SkillPolicy
from hippo.core.pretraining import Paths, PretrainingConfig, train_skills, trained_skills
from hippo.core.settings import setting
from hippo.core.training import MakeEnvs

__all__ = ["SNNConfig", "skills", "train"]

REVISION = 1  # bumped by every change that alters the metrics of tests/golden


@dataclass(frozen=True)
class Bonus:
    """What is paid beside the environment's reward."""

    coefficient: float
    mi_weight: float
    cells_per_metre: int
    survival: dict[str, float]  # by robot; robots that are not here cannot die
    distance_weight: float  # per cell of distance from where the path began to count
    start_after: int  # steps at the start of a path that neither count nor earn information and distance
    virtual_reset: bool  # positions relative to the path's start, turned by its heading there


PRESETS = {
    "snn4hrl": Bonus(1.0, 0.05, 5, {}, 0.0, 0, False),
    "hippo_authors": Bonus(100.0, 2.0, 10, {"ant": 5.0}, 0.05, 10, True),
}


@dataclass
class SNNConfig(PretrainingConfig):
    """The settings of SNN4HRL beside those of all pre-training."""

    preset: str = setting(
        "hippo_authors",
        "weights of the bonus: those of SNN4HRL or of HiPPO's authors",
        code="hippo_authors (train_snn_ant.py; the Ant's are those in sanity_check_rollout.py:66)",
        choices=tuple(PRESETS),
    )


class GridBonus:
    """The objective of SNN4HRL; nothing in it is learnt."""

    def __init__(self, bonus: Bonus, robot: str, observation_names: Sequence[str]) -> None:
        self.bonus, self.survival, self.names = bonus, bonus.survival.get(robot, 0.0), list(observation_names)
        self.parts: dict[str, Any] = {}

    def learn(self, paths: Paths, seed: int, iteration: int) -> None:
        """Nothing: counts are taken from every batch anew."""

    def reward(self, paths: Paths, policy: SkillPolicy) -> tuple[Tensor, dict[str, float]]:
        """Rewards (T, N) and the information that the cell of a step gives about its skill, in nat."""
        bonus, skill = self.bonus, paths.skill[:-1].numpy()
        position, counted = self.positions(paths)
        cell = cells(position, bonus.cells_per_metre)
        log_share = np.zeros(skill.shape)
        log_share[counted] = log_shares(cell[counted], skill[counted], policy.num_skills)
        # Distance in cells from the place where the path began to count.
        begun = np.minimum(paths.start.numpy() + bonus.start_after, len(skill) - 1)
        moved = position - np.take_along_axis(position, begun[..., None], 0)
        distance = np.where(counted, np.linalg.norm(moved, axis=-1) * bonus.cells_per_metre, 0.0)
        earned = bonus.mi_weight * log_share + self.survival + bonus.distance_weight * distance
        reward = paths.steps.reward + bonus.coefficient * torch.from_numpy(earned)
        metrics = {
            "mutual_information": float(log_share[counted].mean() + entropy(skill[counted])) if counted.any() else 0.0,
            "cells_visited": float(len(np.unique(cell[counted], axis=0))),
        }
        return reward, metrics

    def positions(self, paths: Paths) -> tuple[np.ndarray, np.ndarray]:
        """Positions after each step (T, N, 2) in m, in the frame that the preset wants, and which count (T, N)."""
        start = paths.start.numpy()
        counted = np.arange(len(start))[:, None] - start >= self.bonus.start_after
        position = paths.next_position[..., :2].numpy()
        if self.bonus.virtual_reset:
            heading = headings(paths.steps.obs[:-1].numpy(), self.names)
            origin = np.take_along_axis(paths.position[:-1, :, :2].numpy(), start[..., None], 0)
            position = turned(position - origin, -np.take_along_axis(heading, start, 0))
        return position, counted


def cells(position: np.ndarray, cells_per_metre: int) -> np.ndarray:
    """Integer cell (..., 2) of positions (..., 2) in m: ceil((x + F) density), F the largest |x|, |y| rounded up."""
    reach = np.ceil(np.abs(position).max()) if position.size else 0.0
    return np.ceil((position + reach) * cells_per_metre).astype(np.int64)


def log_shares(cell: np.ndarray, skill: np.ndarray, num_skills: int) -> np.ndarray:
    """log(N(z, c) / N(c)) of every step: cells (B, 2), skills (B,) -> (B,), in (-inf, 0]."""
    _, index = np.unique(cell, axis=0, return_inverse=True)
    index = index.reshape(-1)
    counts = np.zeros((index.max(initial=-1) + 1, num_skills))
    np.add.at(counts, (index, skill), 1)
    return np.log(counts[index, skill] / counts.sum(1)[index])


def entropy(skill: np.ndarray) -> float:
    """Entropy of the skills' shares of steps, in nat."""
    share = np.unique(skill, return_counts=True)[1] / skill.size
    return float(-(share * np.log(share)).sum())


def headings(obs: np.ndarray, names: list[str]) -> np.ndarray:
    """Headings (...) in rad of observations (..., D) by their entries' names; 0 for robots that do not turn."""
    if "heading" in names:
        return obs[..., names.index("heading")].astype(np.float64)
    if "quat_w" in names:
        first = names.index("quat_w")
        w, x, y, z = np.moveaxis(obs[..., first : first + 4].astype(np.float64), -1, 0)
        return np.arctan2(2 * (x * y + w * z), w * w + x * x - y * y - z * z)
    return np.zeros(obs.shape[:-1])


def turned(position: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Positions (..., 2) turned counter-clockwise by angles (...) in rad."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = position[..., 0], position[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], -1)


def train(config: SNNConfig, make_envs: MakeEnvs, log: RunLog, seed: int, checkpoint: Checkpoint) -> None:
    """Train skills from the newest checkpoint, or from scratch, to `config.iterations`.

    Raises:
        Diverged: an observation, a reward or a parameter is no longer finite.
    """
    envs = make_envs(config.num_envs, "training")
    objective = GridBonus(PRESETS[config.preset], envs.robot_name, envs.observation_names)
    train_skills(config, envs, objective, log, seed, checkpoint)


def skills(config: SNNConfig, make_envs: MakeEnvs, checkpoint: Checkpoint) -> tuple[SkillPolicy, dict[str, Any]]:
    """The trained skills of a run and the metadata of their file, but for the run's id."""
    return trained_skills("snn", config, make_envs, checkpoint)
