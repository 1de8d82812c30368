"""DIAYN: skills whose states tell them apart (Eysenbach et al. 2019), the source of the Block tasks' given skills.

A discriminator q(z|s) learns which skill led to a state; a step of skill z that arrives at s' earns

    log q(z|s') - log p(z) - alpha log pi(a|s, z),        p(z) = 1 / n,

the last term being the sample of the entropy that the method maximises beside. Departures, *ours*: on-policy, with
HiPPO's network and clipped surrogate instead of SAC, so that the skills load as they are; absolute x is hidden from the
discriminator, which would otherwise only have to measure distance. docs/algorithms/diayn.md has the whole list.
Algorithm 1 of Eysenbach et al., line by line:

    sample z ~ p(z), kept for the whole path       hippo/core/pretraining.py collect
    sample a ~ pi(a|s, z), step the environment    hippo/core/pretraining.py collect
    compute q(z|s') with the discriminator         here                      Discriminator.log_probs
    r = log q(z|s') - log p(z)                     here                      skill_reward
    update the policy to maximise r (SAC there)    hippo/core/pretraining.py update
    update the discriminator                       here                      Distinguishable.learn, Discriminator.fit
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import cross_entropy

from hippo.core import seeding
from hippo.core.checkpoint import Checkpoint
from hippo.core.log import RunLog
from hippo.core.networks import mlp
from hippo.core.normalize import Standardizer
from hippo.core.optimizers import Adam
from hippo.core.policies import SkillPolicy
from hippo.core.ppo import in_chunks
from hippo.core.pretraining import Paths, PretrainingConfig, train_skills, trained_skills
from hippo.core.settings import WIDEST, setting
from hippo.core.training import MakeEnvs
from hippo.core.view import ABSOLUTE

__all__ = ["DIAYNConfig", "skills", "train"]

REVISION = 1  # bumped by every change that alters the metrics of tests/golden


@dataclass
class DIAYNConfig(PretrainingConfig):
    """The settings of DIAYN beside those of all pre-training."""

    entropy_weight: float = setting(
        0.01,
        "alpha, weight of the action entropy",
        code="0.1 (mujoco_all_diayn.py:39)",
        ours="a Gaussian's entropy has no bound: with 0.1 the action noise of Hopper's skills grew to 8",
        low=0,
    )
    discriminator_hidden_sizes: list[int] = setting(
        [128, 128],
        "discriminator's hidden layers (ReLU)",
        code="300, 300 (mujoco_all_diayn.py:30)",
        ours="six skills need less; a third of the time of an iteration otherwise",
        low=1,
        high=WIDEST,
    )
    discriminator_learning_rate: float = setting(
        1e-3,
        "Adam step size of the discriminator",
        code="3e-4 (mujoco_all_diayn.py:26)",
        ours="larger minibatches",
        above=0,
    )
    discriminator_minibatch_size: int = setting(
        512, "states per gradient step of the discriminator", code="128 (mujoco_all_diayn.py:31)", ours="faster", low=1
    )
    discriminator_epochs: int = setting(
        1, "passes of the discriminator over a batch", code="one gradient step per environment step", low=1
    )


class Discriminator(nn.Module):
    """q(z|s): tells skills apart by the entries of the robot's observation that do not hold its absolute place."""

    def __init__(
        self, names: Sequence[str], num_skills: int, hidden_sizes: Sequence[int], generator: torch.Generator
    ) -> None:
        super().__init__()
        self.seen = [i for i, name in enumerate(names) if name not in ABSOLUTE]
        self.inputs = Standardizer(len(self.seen))
        self.net = mlp([len(self.seen), *hidden_sizes, num_skills], generator, nn.ReLU)

    def log_probs(self, obs: Tensor) -> Tensor:
        """log q(.|s): observations (B, D), the robot's first -> (B, Z)."""
        return self.net(self.inputs(obs[:, self.seen])).log_softmax(-1)

    def fit(
        self,
        optimizer: torch.optim.Optimizer,
        obs: Tensor,
        skill: Tensor,
        epochs: int,
        minibatch_size: int,
        generator: torch.Generator,
    ) -> None:
        """Lower the cross-entropy of skills (B,) given observations (B, D) for some passes in random order."""
        self.inputs.fit(obs[:, self.seen])
        for _ in range(epochs):
            for rows in torch.randperm(len(obs), generator=generator).split(minibatch_size):
                optimizer.zero_grad(set_to_none=True)
                cross_entropy(self.log_probs(obs[rows]), skill[rows]).backward()
                optimizer.step()


def skill_reward(log_q: Tensor, log_prob: Tensor, num_skills: int, entropy_weight: float) -> Tensor:
    """log q(z|s') - log p(z) - alpha log pi(a|s, z) in float64, from the first and the third logarithm, any shape."""
    return log_q.double() + math.log(num_skills) - entropy_weight * log_prob.double()


class Distinguishable:
    """The objective of DIAYN and the discriminator that it trains."""

    def __init__(self, config: DIAYNConfig, names: Sequence[str], seed: int) -> None:
        self.config = config
        generator = seeding.torch_generator(seed, "discriminator")
        self.discriminator = Discriminator(names, config.num_skills, config.discriminator_hidden_sizes, generator)
        rate = config.discriminator_learning_rate
        self.optimizer = Adam(self.discriminator.parameters(), lr=rate)
        self.parts: dict[str, Any] = {
            "discriminator": self.discriminator,
            "discriminator_optimizer": self.optimizer,
        }

    def reward(self, paths: Paths, policy: SkillPolicy) -> tuple[Tensor, dict[str, float]]:
        """Rewards (T, N), and how well the discriminator knows states that it has not been fitted to."""
        skill = paths.skill[:-1].flatten()
        next_obs = paths.next_obs.flatten(0, 1)
        log_q = in_chunks(lambda c: self.discriminator.log_probs(next_obs[c]), len(next_obs))
        right = log_q.argmax(-1) == skill
        log_q = log_q.gather(-1, skill.unsqueeze(-1)).squeeze(-1)
        log_prob = self.log_prob(paths, policy)
        reward = skill_reward(log_q, log_prob, policy.num_skills, self.config.entropy_weight)
        metrics = {
            "discriminator_accuracy": float(right.double().mean()),
            "discriminator_log_prob": float(log_q.double().mean()),
        }
        return reward.view(paths.next_obs.shape[:2]), metrics

    def log_prob(self, paths: Paths, policy: SkillPolicy) -> Tensor:
        """log pi(a|s, z) of every step, flat (T N,)."""
        steps, skill = paths.steps, paths.skill[:-1].flatten()
        order = skill.argsort(stable=True)
        obs, action = policy.see(steps.obs[:-1].flatten(0, 1)[order]), steps.action.flatten(0, 1)[order]
        active = skill[order]
        sorted_log_prob = in_chunks(lambda c: policy.log_prob(obs[c], active[c], action[c]), len(obs))
        return torch.empty_like(sorted_log_prob).index_copy_(0, order, sorted_log_prob)

    def learn(self, paths: Paths, seed: int, iteration: int) -> None:
        """Fit the discriminator to where the batch arrived."""
        config, generator = self.config, seeding.torch_generator(seed, "discriminator", iteration)
        obs, skill = paths.next_obs.flatten(0, 1), paths.skill[:-1].flatten()
        epochs, minibatch_size = config.discriminator_epochs, config.discriminator_minibatch_size
        self.discriminator.fit(self.optimizer, obs, skill, epochs, minibatch_size, generator)


def train(config: DIAYNConfig, make_envs: MakeEnvs, log: RunLog, seed: int, checkpoint: Checkpoint) -> None:
    """Train skills from the newest checkpoint, or from scratch, to `config.iterations`.

    Raises:
        Diverged: an observation, a reward or a parameter is no longer finite.
    """
    envs = make_envs(config.num_envs, "training")
    objective = Distinguishable(config, envs.observation_names[: envs.robot_size], seed)
    train_skills(config, envs, objective, log, seed, checkpoint)


def skills(config: DIAYNConfig, make_envs: MakeEnvs, checkpoint: Checkpoint) -> tuple[SkillPolicy, dict[str, Any]]:
    """The trained skills of a run and the metadata of their file, but for the run's id."""
    return trained_skills("diayn", config, make_envs, checkpoint)
