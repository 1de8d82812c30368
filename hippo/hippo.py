"""HiPPO: hierarchical proximal policy optimisation (paper section 4.3, Algorithm 2). Read this file first.

A manager pi_h(z|s) commits to a skill z for p steps; the skill pi_l(a|s, z) acts. Both are trained together on

    L(theta) = E[ sum_k min(w_h,k A_k, clip(w_h,k) A_k)  +  sum_t min(w_l,t A_t, clip(w_l,t) A_t) ]

where k runs over the manager's decisions and t over environment steps. Where to find what:

    Algorithm 1, HiPPO Rollout; the commitment     hippo/core/hierarchy.py   collect, Commitment
    advantages and both baselines (section 4.2)    hippo/core/advantages.py  advantages
    the clipped surrogate L^CLIP                   hippo/core/ppo.py         clipped_surrogate, maximize
    Lemma 1: exact and approximate gradient        hippo/gradients.py
    Algorithm 2, HiPPO                             here                      train
"""

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from hippo.core import seeding
from hippo.core.advantages import Baselines, advantages
from hippo.core.checkpoint import Checkpoint
from hippo.core.hierarchy import HierarchicalPolicy, collect, levels, policy_statistics
from hippo.core.log import RunLog, check_finite
from hippo.core.ppo import maximize
from hippo.core.settings import ConfigError, check, setting

REVISION = 1  # bumped by every change that alters the metrics of tests/golden

MakeEnvs = Callable[[int, str], Any]  # (num_envs, purpose) -> a vector environment that knows its robot_size


@dataclass
class HippoConfig:
    """Every setting of HiPPO; the defaults are the paper's, then the authors' code's."""

    iterations: int = setting(dataclasses.MISSING, "training iterations", code="2000 on Gather (README)", low=1)
    batch_size: int = setting(
        dataclasses.MISSING, "environment steps per iteration", paper="Block 50 000, Gather 100 000 (App. A)", low=1
    )
    horizon: int = setting(
        dataclasses.MISSING, "episode length H in steps", paper="Block 1000, Ant 5000, Snake 8000 (App. A)", low=1
    )
    num_skills: int = setting(6, "number of skills n", paper="6 (App. A)", code="6 (pg_test.py:332)", low=1)
    period_min: int = setting(
        5, "shortest commitment in steps; equal to period_max: a fixed period", paper="5 (App. A)", low=1
    )
    period_max: int = setting(15, "longest commitment in steps, inclusive", paper="15 (App. A)", low=1)
    skill_baseline: str = setting(
        "skill",
        "baseline of the skills: V(s, z, time left), the manager's V(s), or none",
        paper="skill-dependent (section 4.2, Fig. 4)",
        code="-sbl",
        choices=("skill", "single", "none"),
    )
    manager_baseline: str = setting(
        "single",
        "baseline of the manager: V(s) or none",
        paper="single (section 4.2)",
        choices=("single", "none"),
    )
    learning_rate: float = setting(3e-3, "Adam step size", paper="3e-3 (App. A)", above=0.0)
    clip_range: float = setting(0.1, "clipping parameter epsilon of both levels", paper="0.1 (App. A)", above=0.0)
    updates: int = setting(
        10, "full-batch gradient steps per iteration", paper="10 (App. A)", code="80, 10 by flag", low=1
    )
    gamma: float = setting(
        0.999, "discount per environment step", paper="0.999 (App. A)", code="0.99, 0.999 by flag", above=0, high=1
    )
    gae_lambda: float = setting(
        1.0, "GAE lambda", paper="cites GAE, gives no value", code="1 (hier_batch_polopt.py:55)", low=0, high=1
    )
    manager_advantage: str = setting(
        "step",
        "advantage of a decision: the per-step advantage where it is made, or semi-Markov GAE; equal for lambda 1",
        code="step (hippo2.py:186)",
        choices=("step", "smdp"),
    )
    bootstrap_horizon: bool = setting(
        False,
        "whether the end of the horizon bootstraps the value",
        paper="finite-horizon MDP (section 2)",
        code="no (hier_base.py:57)",
    )
    manager_hidden_sizes: list[int] = setting([32, 32], "manager's hidden layers", paper="2 x 32 (App. A)", low=1)
    skill_hidden_sizes: list[int] = setting([64, 64], "skill network's hidden layers", paper="2 x 64 (App. A)", low=1)
    value_hidden_sizes: list[int] = setting([32, 32], "hidden layers of both baselines", paper="2 x 32 (App. A)", low=1)
    value_iterations: int = setting(
        20,
        "loss evaluations per baseline and iteration",
        code="KL-constrained L-BFGS, up to 20 iterations x 10 penalties",
        ours="one warm-started L-BFGS bounds the cost of an iteration",
        low=1,
    )
    skill_integration: str = setting(
        "bilinear",
        "how the skill enters the skill network",
        code="bilinear (pg_test.py:157)",
        choices=("bilinear", "concatenate"),
    )
    skill_observation: str = setting(
        "robot",
        "what skills see: the robot's own observation or everything",
        paper="pi(a|s, z), silent",
        code="robot (test2_hier_snn_mlp_policy.py:180)",
        choices=("robot", "full"),
    )
    log_std_per_skill: bool = setting(
        False, "one log-std vector per skill instead of a shared one", code="shared (test2_hier_snn_mlp_policy.py:226)"
    )
    truncate_to_period: bool = setting(
        False,
        "do not learn from the steps of an episode after its last whole period, as the authors with fixed p",
        code="yes for fixed p (hier_batch_sampler.py:36)",
        ours="no: it hides about 90 % of the Ant's falls at p = 10",
    )
    train_manager: bool = setting(True, "update the manager", paper="yes; Fig. 6 compares")
    train_skills: bool = setting(True, "update the skills, log-std included", paper="yes; Fig. 6 compares")

    def __post_init__(self) -> None:
        check(self)
        if self.period_min > self.period_max:
            raise ConfigError("period_min", self.period_min, f"must be at most period_max={self.period_max}")
        if self.batch_size < self.horizon:
            raise ConfigError("batch_size", self.batch_size, f"must be at least one horizon, {self.horizon} steps")
        if self.truncate_to_period and self.period_min < self.period_max:
            raise ConfigError("truncate_to_period", True, "needs a fixed period (period_min = period_max)")
        if not (self.train_manager or self.train_skills):
            raise ConfigError("train_manager", False, "at least one of train_manager, train_skills must be true")

    @property
    def trained_levels(self) -> list[str]:
        """The levels that are updated."""
        return ["manager"] * self.train_manager + ["skill"] * self.train_skills

    @property
    def num_envs(self) -> int:
        """Slots that collect one horizon each; ceil(batch / horizon)."""
        return -(-self.batch_size // self.horizon)


def train(config: HippoConfig, make_envs: MakeEnvs, log: RunLog, seed: int, checkpoint: Checkpoint) -> None:
    """Train from the newest checkpoint, or from scratch, to `config.iterations` (Algorithm 2).

    Raises:
        Diverged: an observation, a reward or a parameter is no longer finite.
    """
    envs = make_envs(config.num_envs, "training")
    obs_size, action_size = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    generator = seeding.torch_generator(seed, "initialisation")
    policy = HierarchicalPolicy(config, obs_size, envs.robot_size, action_size, generator)
    baselines = Baselines(config, obs_size, generator)
    # A frozen level stays out of the optimiser, log-std included.
    networks = {"manager": policy.manager, "skill": policy.skills}
    trained = [p for name in config.trained_levels for p in networks[name].parameters()]
    optimizer = torch.optim.Adam(trained, lr=config.learning_rate)

    parts = {"policy": policy, "baselines": baselines, "optimizer": optimizer}
    first = checkpoint.restore(**parts)
    log.resume(first)

    for iteration in range(first, config.iterations):
        start = time.perf_counter()
        batch = collect(policy, envs, config, seed, iteration)
        steps = batch.steps
        steps.check(iteration)
        collected = time.perf_counter()
        statistics = policy_statistics(policy, batch)  # of the policy that collected, before its update
        estimate = advantages(batch, baselines, config)
        objective = levels(policy, batch, estimate.manager, estimate.skills, config.trained_levels)
        losses = maximize(objective, optimizer, config.updates, config.clip_range, steps.num_steps)
        baselines.fit(batch, estimate.returns)
        check_finite(iteration, parameters=nn.utils.parameters_to_vector(policy.parameters()))
        end = time.perf_counter()

        metrics = {
            "iteration": iteration,
            "env_steps": (iteration + 1) * steps.num_steps,
            **steps.statistics(),
            **losses,
            **{f"{kind}_explained_variance": value for kind, value in estimate.explained_variance.items()},
            **statistics,
        }
        log.row(metrics, steps.timing(start, collected, end))
        checkpoint.record(iteration, **parts)
    envs.close()
