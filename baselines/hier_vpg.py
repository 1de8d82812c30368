"""HierVPG: the approximate hierarchical policy gradient of the paper's section 4, applied directly (Fig. 5).

The ablation of HiPPO without its trust region: one full-batch step per iteration on

    E[ sum_k log pi_h(z_k|s_k) A_k  +  sum_t log pi_l(a_t|s_t, z_k) A_t ].

At the policy that collected the batch this is the gradient of HiPPO's surrogate; the two differ in that HiPPO goes on
for more steps on the same batch, held back by clipping, and in the step size. Re-implemented from the formula: the
authors' script (hierarchical_vpg.py) does not run as published. Where to find what:

    trajectories by Algorithm 1                    hippo/core/hierarchy.py   collect
    A_k, A_t and their baselines (section 4.2)     hippo/core/advantages.py  advantages
    log pi_h, log pi_l (equation 4)                hippo/core/levels.py      levels
    theta <- theta + alpha g                       here                      policy_gradient_step
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import nn

from hippo.core import seeding
from hippo.core.advantages import Baselines, advantages
from hippo.core.checkpoint import Checkpoint
from hippo.core.hierarchy import Acting, collect, new_policy, restored
from hippo.core.hierarchy_config import HierarchyConfig
from hippo.core.levels import levels, policy_statistics
from hippo.core.log import RunLog, check_finite
from hippo.core.optimizers import Adam
from hippo.core.ppo import Level, chunks
from hippo.core.settings import setting
from hippo.core.skills import start_from
from hippo.core.training import MakeEnvs, Training

__all__ = ["Acting", "HierVPGConfig", "restored", "train"]

REVISION = 1  # bumped by every change that alters the metrics of tests/golden


@dataclass
class HierVPGConfig(HierarchyConfig):
    """The settings of HierVPG beside those of its hierarchy."""

    learning_rate: float = setting(
        0.01, "Adam step size", paper="3e-3 for PPO and HiPPO (App. A)", code="0.01 (pg_test.py:508)", above=0.0
    )


def policy_gradient_step(policy_levels: Sequence[Level], optimizer: torch.optim.Optimizer, num_steps: int) -> float:
    """One ascent step on sum over levels and rows of log pi A, over `num_steps`; returns that objective before it."""
    optimizer.zero_grad(set_to_none=True)
    objective = 0.0
    for level in policy_levels:
        for c in chunks(len(level.advantage)):
            term = (level.log_prob(c) * level.advantage[c]).sum() / num_steps
            (-term).backward()
            objective += float(term.detach())
    optimizer.step()
    return objective


def train(config: HierVPGConfig, make_envs: MakeEnvs, log: RunLog, seed: int, checkpoint: Checkpoint) -> None:
    """Train from the newest checkpoint, or from scratch, to `config.iterations`.

    Raises:
        Diverged: an observation, a reward or a parameter is no longer finite.
    """
    envs = make_envs(config.num_envs, "training")
    obs_size, generator = envs.single_observation_space.shape[0], seeding.torch_generator(seed, "initialisation")
    policy = new_policy(config, envs, generator)
    start_from(config.skills, policy.skills, envs)
    baselines = Baselines(config, obs_size, generator)
    optimizer = Adam(policy.parameters(), lr=config.learning_rate)

    parts = {"policy": policy, "baselines": baselines, "optimizer": optimizer}
    training = Training(log, checkpoint, parts)

    for iteration in range(training.begin(), config.iterations):
        start = time.perf_counter()
        batch = collect(policy, envs, config, seed, iteration)
        steps = batch.steps
        steps.check(iteration)
        collected = time.perf_counter()
        statistics = policy_statistics(policy, batch)  # of the policy that collected, before its update
        steps.scale_rewards(baselines.reward_scale, config.gamma)
        estimate = advantages(batch, baselines, config)
        objective = policy_gradient_step(
            levels(policy, batch, estimate.manager, estimate.skills), optimizer, steps.num_steps
        )
        baselines.fit(batch, estimate.returns)
        steps.feed(policy.filter)
        check_finite(iteration, parameters=nn.utils.parameters_to_vector(policy.parameters()))
        end = time.perf_counter()

        metrics = {
            "objective": objective,
            **{f"{kind}_explained_variance": value for kind, value in estimate.explained_variance.items()},
            **statistics,
        }
        training.record(iteration, steps, (start, collected, end), metrics)
    envs.close()
