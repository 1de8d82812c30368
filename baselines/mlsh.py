"""MLSH: meta learning shared hierarchies (Frans et al. 2018), as the paper compares it (section 5.3, Fig. 5 and 6).

The hierarchy is HiPPO's with a fixed period; what differs is the schedule. Time runs in cycles. A cycle has one
environment configuration (object positions, wall heights) and starts with a new master (manager); for its first
iterations only the master learns, then master and sub-policies (skills) learn together. docs/algorithms/mlsh.md lists
what differs from the published code. Algorithm 1 of Frans et al., line by line:

    initialise phi                                 here                      train, start_from
    repeat: sample a task                          here                      train, layout_seed of a cycle
      initialise theta                             here                      start_cycle
      warm-up: for w = 0 .. W                      here                      train, joint = False
        collect D by pi_phi,theta                  hippo/core/hierarchy.py   collect
        update theta to maximise the return        here                      macro_advantages, optimize
          seen at 1/N of the time scale
      joint: for u = 0 .. U                        here                      train, joint = True
        collect D, update theta, then phi          here                      levels, optimize
          as above; phi seen at every step         hippo/core/advantages.py  advantages
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from hippo.core import seeding
from hippo.core.advantages import Advantages, Baselines, advantages, masked_standardize
from hippo.core.checkpoint import Checkpoint
from hippo.core.gae import segment_gae
from hippo.core.hierarchy import Acting, Batch, HierarchicalPolicy, collect, restored
from hippo.core.hierarchy_config import HierarchyConfig
from hippo.core.levels import levels, policy_statistics
from hippo.core.log import RunLog, check_finite
from hippo.core.minibatch import maximize_in_minibatches
from hippo.core.optimizers import Adam
from hippo.core.policies import Manager
from hippo.core.ppo import Level
from hippo.core.settings import ConfigError, setting
from hippo.core.skills import start_from
from hippo.core.training import MakeEnvs, Training
from hippo.core.value import ValueFunction, explained_variance

__all__ = ["Acting", "MLSHConfig", "restored", "train"]

REVISION = 1  # bumped by every change that alters the metrics of tests/golden


@dataclass
class MLSHConfig(HierarchyConfig):
    """The settings of MLSH; where they differ from HiPPO's, the defaults are those that MLSH was published with.

    The paper takes only the schedule from MLSH and is silent on the rest. `code` names github.com/openai/mlsh.
    """

    warmup_iterations: int = setting(
        20, "iterations of a cycle in which only the master learns, W", paper="20 (section 5.3)", code="19", low=0
    )
    joint_iterations: int = setting(
        40, "further iterations of a cycle in which both levels learn, T", paper="40 (section 5.3)", code="41", low=1
    )
    period_min: int = setting(10, "shortest commitment; equal to period_max", paper="10 (section 5.1)", low=1)
    period_max: int = setting(10, "longest commitment; equal to period_min", paper="10 (section 5.1)", low=1)
    exploration: float = setting(
        0.1, "share of the master's decisions that are uniformly random", code="0.1 (rollouts.py:42)", low=0.0, high=1.0
    )
    manager_learning_rate: float = setting(
        0.01, "Adam step size of the master", code="0.01 (learner.py:100)", above=0.0
    )
    skill_learning_rate: float = setting(
        3e-4, "Adam step size of the sub-policies", code="3e-5; 3e-4 in the MLSH paper (openai/mlsh#9)", above=0.0
    )
    updates: int = setting(10, "passes over the batch per iteration", code="10 (learner.py:100)", low=1)
    manager_minibatch_size: int = setting(
        64, "decisions per gradient step; 0: the whole batch", code="64 (learner.py:100)", low=0
    )
    skill_minibatches: int = setting(
        15, "minibatches per pass of the sub-policies; 1: the whole batch", code="15 (learner.py:119)", low=1
    )
    clip_range: float = setting(0.2, "clipping parameter of both levels", code="0.2 (master.py:40)", above=0.0)
    gamma: float = setting(
        0.99,
        "discount: of the sub-policies per step, of the master per decision (manager_advantage macro) or per step",
        code="0.99 at both levels (master.py:70)",
        above=0.0,
        high=1.0,
    )
    gae_lambda: float = setting(0.98, "GAE lambda of both levels", code="0.98 (master.py:70)", low=0.0, high=1.0)
    manager_advantage: str = setting(
        "macro",
        "advantage of a decision: GAE over decisions with undiscounted sums of rewards in between (macro), or HiPPO's",
        code="macro (rollouts.py:94)",
        choices=("macro", "step", "smdp"),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.period_min != self.period_max:
            raise ConfigError("period_min", self.period_min, f"MLSH's period is fixed: period_max={self.period_max}")
        if self.period_max > self.horizon:
            raise ConfigError("period_max", self.period_max, f"must be at most the horizon, {self.horizon} steps")
        if self.manager_advantage == "macro":
            # V(s) of the master then counts decisions, V(s, z) of the sub-policies steps.
            if self.skill_baseline == "single":
                raise ConfigError("skill_baseline", "single", "manager_advantage=macro needs skill or none")
            if self.truncate_to_period:
                raise ConfigError("truncate_to_period", True, "needs manager_advantage step or smdp")

    @property
    def cycle_length(self) -> int:
        """Iterations for which one environment configuration and one master last, W + T."""
        return self.warmup_iterations + self.joint_iterations


class Master(Manager):
    """A manager that takes a uniformly random skill in a share of its decisions; what it learns from is unchanged."""

    exploration = 0.0

    def actor(self) -> Callable[[np.ndarray], np.ndarray]:
        """Logits (K, Z) of (1 - exploration) pi_h + exploration / n for what the manager sees (K, D)."""
        logits_of = super().actor()
        if self.exploration == 0.0:
            return logits_of

        def mixed(seen: np.ndarray) -> np.ndarray:
            logits = logits_of(seen)
            p = np.exp(logits - logits.max(-1, keepdims=True))
            p /= p.sum(-1, keepdims=True)
            return np.log((1 - self.exploration) * p + self.exploration / p.shape[-1])

        return mixed


class MLSHPolicy(HierarchicalPolicy):
    """HiPPO's hierarchy with a master that can start over."""

    def __init__(
        self,
        config: MLSHConfig,
        obs_size: int,
        robot_size: int,
        action_size: int,
        generator: torch.Generator,
        names: Sequence[str] = (),
    ) -> None:
        super().__init__(config, obs_size, robot_size, action_size, generator, names)
        self.obs_size = obs_size
        self.manager = Master(obs_size, config.num_skills, config.manager_hidden_sizes, generator)
        self.manager.exploration = config.exploration


def start_cycle(
    config: MLSHConfig,
    policy: MLSHPolicy,
    baselines: Baselines,
    optimizer: torch.optim.Optimizer,
    generator: torch.Generator,
) -> None:
    """A master as freshly drawn: its weights, its value function and the moments of its `optimizer`, in place."""
    obs_size = policy.obs_size
    master = Manager(obs_size, config.num_skills, config.manager_hidden_sizes, generator)
    policy.manager.load_state_dict(master.state_dict())
    value = ValueFunction(obs_size, config.value_hidden_sizes, generator)
    baselines.single.load_state_dict(value.state_dict())
    optimizer.state.clear()


def macro_advantages(batch: Batch, baselines: Baselines, config: MLSHConfig) -> tuple[Tensor, Tensor]:
    """The master's advantages and lambda-returns, one step being a decision: gamma per decision, rewards summed.

    Returns:
        (T, N) advantages and (T, N) returns, to be read at decisions.
    """
    steps = batch.steps
    value = baselines.predict(config.manager_baseline, steps.obs, batch.time_left, batch.skill)
    final_obs, step, env = steps.final()
    final_value = baselines.predict(
        config.manager_baseline, final_obs, batch.time_left[step, env], batch.skill[step, env]
    )
    advantage = segment_gae(
        steps.scaled_reward,
        value[:-1],
        value[1:].index_put((step, env), final_value),
        steps.terminated,
        steps.done,
        batch.is_decision[:-1],
        config.gamma,
        config.gae_lambda,
        discount_inside=False,
    )
    return advantage, advantage + value[:-1]


def estimate_and_fit(batch: Batch, baselines: Baselines, config: MLSHConfig) -> Advantages:
    """Advantages of both levels from the baselines as they are, which are then fitted to this batch."""
    if config.manager_advantage != "macro":
        estimate = advantages(batch, baselines, config)
        baselines.fit(batch, estimate.returns)
        return estimate
    estimate = advantages(batch, baselines, dataclasses.replace(config, manager_baseline="none"))
    where = batch.is_decision[:-1]
    advantage, returns = macro_advantages(batch, baselines, config)
    estimate.manager = masked_standardize(advantage, where)
    baselines.fit(batch, estimate.returns)
    if config.manager_baseline == "single":
        value = returns - advantage
        estimate.explained_variance["single"] = explained_variance(value[where], returns[where])
        baselines.single.fit(batch.steps.obs[:-1][where], returns[where], config.value_iterations)
    return estimate


def optimize(
    config: MLSHConfig,
    both: list[Level],
    optimizers: dict[str, torch.optim.Optimizer],
    num_steps: int,
    seed: int,
    iteration: int,
) -> dict[str, float]:
    """Ascend every level's clipped surrogate with its own optimiser; `surrogate` is the sum over the levels."""
    losses: dict[str, float] = {"surrogate": 0.0}
    for level in both:
        parts = config.skill_minibatches
        if level.name == "manager":
            size = config.manager_minibatch_size
            parts = len(level.advantage) // size if size else 1
        generator = seeding.torch_generator(seed, f"{level.name} minibatches", iteration)
        optimizer = optimizers[level.name]
        new = maximize_in_minibatches(level, optimizer, config.updates, parts, config.clip_range, num_steps, generator)
        losses |= new | {"surrogate": losses["surrogate"] + new["surrogate"]}
    return losses


def train(config: MLSHConfig, make_envs: MakeEnvs, log: RunLog, seed: int, checkpoint: Checkpoint) -> None:
    """Train from the newest checkpoint, or from scratch, to `config.iterations`.

    Raises:
        Diverged: an observation, a reward or a parameter is no longer finite.
        SkillsError: the given skills cannot be read or do not fit.
    """
    envs = make_envs(config.num_envs, "training")
    obs_size, action_size = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    generator = seeding.torch_generator(seed, "initialisation")
    policy = MLSHPolicy(config, obs_size, envs.robot_size, action_size, generator, envs.observation_names)
    start_from(config.skills, policy.skills, envs)
    baselines = Baselines(config, obs_size, generator)
    optimizers: dict[str, torch.optim.Optimizer] = {
        "manager": Adam(policy.manager.parameters(), lr=config.manager_learning_rate, fused=True),
        "skill": Adam(policy.skills.parameters(), lr=config.skill_learning_rate, fused=True),
    }
    parts = {
        "policy": policy,
        "baselines": baselines,
        "manager_optimizer": optimizers["manager"],
        "skill_optimizer": optimizers["skill"],
    }
    training = Training(log, checkpoint, parts)

    for iteration in range(training.begin(), config.iterations):
        start = time.perf_counter()
        cycle, cycle_iteration = divmod(iteration, config.cycle_length)
        if cycle_iteration == 0:
            fresh = seeding.torch_generator(seed, "master", cycle)
            start_cycle(config, policy, baselines, optimizers["manager"], fresh)
        joint = cycle_iteration >= config.warmup_iterations
        # The option outlasts the seeded reset with which `collect` begins; said anew so that a resumed run has it too.
        envs.reset(options={"layout_seed": seeding.integer(seed, "configuration", cycle)})
        batch = collect(policy, envs, config, seed, iteration)
        steps = batch.steps
        steps.check(iteration)
        collected = time.perf_counter()
        statistics = policy_statistics(policy, batch)  # of the policy that collected, before its update
        steps.scale_rewards(baselines.reward_scale, config.gamma)
        estimate = estimate_and_fit(batch, baselines, config)
        trained = ["manager", "skill"] if joint else ["manager"]
        objective = levels(policy, batch, estimate.manager, estimate.skills, trained)
        losses = optimize(config, objective, optimizers, steps.num_steps, seed, iteration)
        steps.feed(policy.filter)
        check_finite(iteration, parameters=nn.utils.parameters_to_vector(policy.parameters()))
        end = time.perf_counter()

        metrics = {
            "cycle": cycle,
            "joint": int(joint),
            **{"skill_approx_kl": 0.0, "skill_clip_fraction": 0.0} | losses,  # warm-up leaves the skills alone
            **{f"{kind}_explained_variance": value for kind, value in sorted(estimate.explained_variance.items())},
            **statistics,
        }
        training.record(iteration, steps, (start, collected, end), metrics)
    envs.close()
