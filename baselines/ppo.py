"""Flat PPO (Schulman et al. 2017), with action repeat as a field: the baselines of the paper's Fig. 3.

One Gaussian policy sees the whole observation. With `action_repeat` p an action is held for p steps or to the end of
its episode, rewards are summed, and one step of the algorithm is one held action, as in the authors' wrapper.
"""

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn

from hippo.core import seeding
from hippo.core.checkpoint import Checkpoint
from hippo.core.gae import segment_gae
from hippo.core.log import RunLog, check_finite
from hippo.core.normalize import standardize
from hippo.core.policies import GaussianPolicy, gaussian_entropy
from hippo.core.ppo import Level, maximize
from hippo.core.rollout import Steps
from hippo.core.settings import ConfigError, check, setting
from hippo.core.value import ValueFunction, explained_variance

REVISION = 1  # bumped by every change that alters the metrics of tests/golden

MakeEnvs = Callable[[int, str], Any]  # (num_envs, purpose) -> a vector environment


@dataclass
class PPOConfig:
    """Every setting of flat PPO; the defaults are the paper's, then the authors' code's."""

    iterations: int = setting(dataclasses.MISSING, "training iterations", code="2000 on Gather (README)", low=1)
    batch_size: int = setting(
        dataclasses.MISSING, "environment steps per iteration", paper="Block 50 000, Gather 100 000 (App. A)", low=1
    )
    horizon: int = setting(
        dataclasses.MISSING, "episode length H in steps", paper="Block 1000, Ant 5000, Snake 8000 (App. A)", low=1
    )
    action_repeat: int = setting(
        1,
        "environment steps for which one action is held",
        paper="compared in Fig. 3, no value",
        code="1; 10 for repeatingppo (pg_test.py:856)",
        low=1,
    )
    discount_per_step: bool = setting(
        False,
        "whether gamma counts environment steps rather than held actions",
        code="held actions: gamma is not adjusted (action_repeating_env2.py:35)",
    )
    learning_rate: float = setting(3e-3, "Adam step size", paper="3e-3 (App. A)", above=0.0)
    clip_range: float = setting(0.1, "clipping parameter epsilon", paper="0.1 (App. A)", above=0.0)
    updates: int = setting(
        10, "full-batch gradient steps per iteration", paper="10 (App. A)", code="80, 10 by flag", low=1
    )
    gamma: float = setting(0.999, "discount", paper="0.999 (App. A)", code="0.99, 0.999 by flag", above=0.0, high=1.0)
    gae_lambda: float = setting(
        1.0, "GAE lambda", paper="cites GAE, gives no value", code="1 (hier_batch_polopt.py:55)", low=0.0, high=1.0
    )
    bootstrap_horizon: bool = setting(
        False,
        "whether the end of the horizon bootstraps the value",
        paper="finite-horizon MDP (section 2)",
        code="no (hier_base.py:57)",
    )
    hidden_sizes: list[int] = setting([256, 64], "policy's hidden layers", paper="256, 64 (App. A)", low=1)
    value_hidden_sizes: list[int] = setting([32, 32], "hidden layers of the baseline", paper="2 x 32 (App. A)", low=1)
    value_iterations: int = setting(
        10,
        "the most loss evaluations that the fit of a baseline may use per iteration",
        code="KL-constrained L-BFGS, up to 20 iterations x 10 penalties",
        ours="bounds the cost of an iteration; 20 explain the next batch no better (docs/performance.md)",
        low=1,
    )

    def __post_init__(self) -> None:
        check(self)
        if self.batch_size < self.horizon:
            raise ConfigError("batch_size", self.batch_size, f"must be at least one horizon, {self.horizon} steps")
        if self.action_repeat > self.horizon:
            raise ConfigError("action_repeat", self.action_repeat, f"must be at most the horizon, {self.horizon} steps")

    @property
    def num_envs(self) -> int:
        """Slots that collect one horizon each; ceil(batch / horizon)."""
        return -(-self.batch_size // self.horizon)


@torch.no_grad()
def collect(
    policy: GaussianPolicy,
    envs: gym.vector.VectorEnv,
    config: PPOConfig,
    seed: int,
    iteration: int,
    greedy: bool = False,
) -> tuple[Steps, Tensor]:
    """Run every environment for one horizon from a fresh episode; all randomness is named by (seed, iteration).

    With `greedy` the policy takes its mean action.

    Returns:
        What happened, and (T, N) bool where an action was chosen rather than held.
    """
    T, N = config.horizon, envs.num_envs
    steps = Steps(envs, T, config.bootstrap_horizon)
    noise = torch.randn(steps.action.shape, generator=seeding.torch_generator(seed, "policy", iteration)).numpy()
    noise *= not greedy
    is_decision = np.empty((T, N), bool)
    action = np.empty((N, steps.action.shape[-1]), np.float32)
    steps_left = np.zeros(N, np.int64)
    act = policy.actor()
    obs = steps.reset(seeding.integer(seed, "episodes", iteration))
    for t in range(T):
        is_decision[t] = steps_left == 0
        where = np.flatnonzero(is_decision[t])
        if len(where) == N:  # at every step without action repeat
            action = act(obs, noise[t])
        elif len(where):
            action[where] = act(obs[where], noise[t][where])
        steps_left[where] = config.action_repeat
        obs, done = steps.step(t, action)
        steps_left -= 1
        steps_left[done] = 0
    return steps, torch.from_numpy(is_decision)


def rollout(
    config: PPOConfig, envs: gym.vector.VectorEnv, seed: int, checkpoint: Checkpoint, greedy: bool = False
) -> Steps:
    """One horizon in every environment with the policy of a checkpoint; nothing is learnt."""
    obs_size, action_size = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]  # type: ignore[index]
    generator = seeding.torch_generator(0, "overwritten by the checkpoint")
    policy = GaussianPolicy(obs_size, action_size, config.hidden_sizes, generator)
    checkpoint.restore(policy=policy)
    return collect(policy, envs, config, seed, 0, greedy)[0]


def train(config: PPOConfig, make_envs: MakeEnvs, log: RunLog, seed: int, checkpoint: Checkpoint) -> None:
    """Train from the newest checkpoint, or from scratch, to `config.iterations`.

    Raises:
        Diverged: an observation, a reward or a parameter is no longer finite.
    """
    envs = make_envs(config.num_envs, "training")
    obs_size, action_size = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    generator = seeding.torch_generator(seed, "initialisation")
    policy = GaussianPolicy(obs_size, action_size, config.hidden_sizes, generator)
    baseline = ValueFunction(obs_size, config.value_hidden_sizes, generator)
    optimizer = torch.optim.Adam(policy.parameters(), lr=config.learning_rate)

    parts = {"policy": policy, "baseline": baseline, "optimizer": optimizer}
    first = checkpoint.restore(**parts)
    log.resume(first)

    for iteration in range(first, config.iterations):
        start = time.perf_counter()
        steps, is_decision = collect(policy, envs, config, seed, iteration)
        steps.check(iteration)
        collected = time.perf_counter()
        with torch.no_grad():
            statistics = {
                "entropy": float(gaussian_entropy(policy.log_std)),
                "action_std": float(policy.log_std.exp().mean()),
            }

        value = baseline.predict(steps.obs)
        final_obs, step, env = steps.final()
        next_value = value[1:].index_put((step, env), baseline.predict(final_obs))
        advantage = segment_gae(
            steps.reward,
            value[:-1],
            next_value,
            steps.terminated,
            steps.done,
            is_decision,
            config.gamma,
            config.gae_lambda,
            discount_inside=config.discount_per_step,
        )[is_decision]
        obs, action, target = (
            steps.obs[:-1][is_decision],
            steps.action[is_decision],
            advantage + value[:-1][is_decision],
        )

        def log_prob(c: slice, obs: Tensor = obs, action: Tensor = action) -> Tensor:
            return policy.log_prob(obs[c], action[c])

        level = Level("policy", log_prob, standardize(advantage).to(obs.dtype))
        losses = maximize([level], optimizer, config.updates, config.clip_range, len(obs))
        explained = explained_variance(value[:-1][is_decision], target)
        baseline.fit(obs, target, config.value_iterations)
        check_finite(iteration, parameters=nn.utils.parameters_to_vector(policy.parameters()))
        end = time.perf_counter()

        metrics = {
            "iteration": iteration,
            "env_steps": (iteration + 1) * steps.num_steps,
            **steps.statistics(),
            **losses,
            "explained_variance": explained,
            **statistics,
        }
        log.row(metrics, steps.timing(start, collected, end))
        checkpoint.record(iteration, **parts)
    envs.close()
