"""HiPPO: hierarchical proximal policy optimisation (paper section 4.3, Algorithm 2). Read this file first.

A manager pi_h(z|s) commits to a skill z for p steps; the skill pi_l(a|s, z) acts. Both are trained together on

    L(theta) = E[ sum_k min(w_h,k A_k, clip(w_h,k) A_k)  +  sum_t min(w_l,t A_t, clip(w_l,t) A_t) ]

where k runs over the manager's decisions and t over environment steps. Where to find what:

    Algorithm 1, HiPPO Rollout                     hippo/core/hierarchy.py   collect
      lines 4, 5: draw p, then z ~ pi_h                                      Commitment.renew, Acting.decide
      lines 6 to 9: a ~ pi_l for p steps                                     Acting.action, Commitment.advance
    settings of the hierarchy (n, p, networks)     hippo/core/hierarchy_config.py  HierarchyConfig
    Algorithm 2, HiPPO                             here                      train
      line 4: N trajectories                       hippo/core/hierarchy.py   collect
      line 5: advantages of both levels (4.2)      hippo/core/advantages.py  advantages
      line 7: the two terms of equation 4          hippo/core/levels.py      levels
              clipped, L^CLIP, ascended            hippo/core/ppo.py         clipped_surrogate, maximize
              in minibatches (modern)              hippo/core/on_policy.py   SurrogateConfig, improve
    Lemma 1: exact and approximate gradient        hippo/gradients.py
"""

import time
from dataclasses import dataclass

from torch import nn

from hippo.core import seeding
from hippo.core.advantages import Baselines, advantages
from hippo.core.checkpoint import Checkpoint
from hippo.core.hierarchy import Acting, collect, new_policy, restored
from hippo.core.hierarchy_config import HierarchyConfig
from hippo.core.levels import levels, policy_statistics
from hippo.core.log import RunLog, check_finite
from hippo.core.on_policy import SurrogateConfig, improve, make_optimizer
from hippo.core.settings import ConfigError, setting
from hippo.core.skills import start_from
from hippo.core.training import MakeEnvs, Training

__all__ = ["Acting", "HippoConfig", "restored", "train"]

REVISION = 1  # bumped by every change that alters the metrics of tests/golden


@dataclass
class HippoConfig(SurrogateConfig, HierarchyConfig):
    """The settings of HiPPO beside those of its hierarchy and of the surrogate; the defaults are the paper's."""

    train_manager: bool = setting(True, "update the manager", paper="yes; Fig. 6 compares")
    train_skills: bool = setting(True, "update the skills, log-std included", paper="yes; Fig. 6 compares")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.train_manager or self.train_skills):
            raise ConfigError("train_manager", False, "at least one of train_manager, train_skills must be true")

    @property
    def trained_levels(self) -> list[str]:
        """The levels that are updated."""
        return ["manager"] * self.train_manager + ["skill"] * self.train_skills


def train(config: HippoConfig, make_envs: MakeEnvs, log: RunLog, seed: int, checkpoint: Checkpoint) -> None:
    """Train from the newest checkpoint, or from scratch, to `config.iterations` (Algorithm 2).

    Raises:
        Diverged: an observation, a reward or a parameter is no longer finite.
    """
    envs = make_envs(config.num_envs, "training")
    obs_size, generator = envs.single_observation_space.shape[0], seeding.torch_generator(seed, "initialisation")
    policy = new_policy(config, envs, generator)
    start_from(config.skills, policy.skills, envs)
    baselines = Baselines(config, obs_size, generator, in_loop=config.values_in_loop)
    # A frozen level stays out of the optimiser, log-std included.
    networks = {"manager": policy.manager, "skill": policy.skills}
    trained = [p for name in config.trained_levels for p in networks[name].parameters()]
    if config.values_in_loop:
        trained += baselines.parameters()
    optimizer = make_optimizer(config, trained)

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
        objective = levels(policy, batch, estimate.manager, estimate.skills, config.trained_levels)
        critics = baselines.critics(batch, estimate.returns) if config.values_in_loop else []
        losses = improve(config, objective, critics, optimizer, policy.filter, steps.num_steps, seed, iteration)
        if not config.values_in_loop:
            baselines.fit(batch, estimate.returns)
        steps.feed(policy.filter)
        check_finite(iteration, parameters=nn.utils.parameters_to_vector(policy.parameters()))
        end = time.perf_counter()

        metrics = {
            **losses,
            **{f"{kind}_explained_variance": value for kind, value in estimate.explained_variance.items()},
            **statistics,
        }
        training.record(iteration, steps, (start, collected, end), metrics)
    envs.close()
