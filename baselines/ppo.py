"""Flat PPO (Schulman et al. 2017), with action repeat as a field: the baselines of the paper's Fig. 3.

One Gaussian policy sees the whole observation. With `action_repeat` p an action is held for p steps or to the end of
its episode, rewards are summed, and one step of the algorithm is one held action, as in the authors' wrapper.
Algorithm 1 of Schulman et al., line by line:

    run pi_old in N environments for T steps       here                      collect, Acting
    compute advantage estimates (equation 11)      hippo/core/gae.py         segment_gae
    optimise L wrt theta, K epochs (equation 7)    hippo/core/ppo.py         clipped_surrogate, maximize
      in minibatches of size M <= NT (modern)      hippo/core/on_policy.py   SurrogateConfig, improve
      the value function's loss                    hippo/core/value.py       ValueFunction.fit
    theta_old <- theta                             here                      the next round of train
"""

import time
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn

from hippo.core import seeding
from hippo.core.acting import OfHorizons
from hippo.core.checkpoint import Checkpoint
from hippo.core.direct import Gaussian, SquaredError, network_of
from hippo.core.gae import segment_gae
from hippo.core.log import RunLog, check_finite
from hippo.core.normalize import RewardScale, actor_of, standardize
from hippo.core.on_policy import SurrogateConfig, improve, make_optimizer
from hippo.core.policies import GaussianPolicy, gaussian_entropy
from hippo.core.ppo import Level, Rows
from hippo.core.rollout import Steps
from hippo.core.settings import WIDEST, ConfigError, setting
from hippo.core.training import MakeEnvs, Training
from hippo.core.value import ValueFunction, explained_variance

REVISION = 1  # bumped by every change that alters the metrics of tests/golden


@dataclass
class PPOConfig(SurrogateConfig):
    """The settings of flat PPO beside those of the surrogate; the defaults are the paper's."""

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
    hidden_sizes: list[int] = setting([256, 64], "policy's hidden layers", paper="256, 64 (App. A)", low=1, high=WIDEST)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.action_repeat > self.horizon:
            raise ConfigError("action_repeat", self.action_repeat, f"must be at most the horizon, {self.horizon} steps")
        if self.action_repeat == 1:
            self.discount_per_step = False  # the same either way, so one run and not two


class Acting(OfHorizons):
    """The policy at work (`hippo.core.acting.Acting`); with `greedy` it takes its mean action."""

    def __init__(
        self,
        policy: GaussianPolicy,
        config: PPOConfig,
        num_envs: int,
        seed: int,
        iteration: int,
        greedy: bool = False,
    ) -> None:
        self.config, self.greedy = config, greedy
        self._shape = (config.horizon, num_envs, policy.log_std_parameter.shape[-1])
        self._act, self._view = policy.actor(), actor_of(policy.filter)
        self._action = torch.empty(self._shape[1:]).numpy()
        self.steps_left = np.zeros(num_envs, np.int64)  # (N,) for which the action is held
        super().__init__(config.horizon, seed, iteration)

    def _draw(self, seed: int, iteration: int) -> None:
        """T rows of what is added to actions."""
        self._noise = torch.randn(self._shape, generator=seeding.torch_generator(seed, "policy", iteration)).numpy()
        self._noise *= not self.greedy

    def act(self, obs: np.ndarray) -> np.ndarray:
        """Actions (N, A), new ones where none is held."""
        self._next_horizon_if_over()
        seen, noise = self._view(obs), self._noise[self._t]
        self.is_decision = self.steps_left == 0
        where = np.flatnonzero(self.is_decision)
        if len(where) == len(obs):  # at every step without action repeat
            self._action = self._act(seen, noise)
        elif len(where):
            self._action[where] = self._act(seen[where], noise[where])
        self.steps_left[where] = self.config.action_repeat
        return self._action

    def end(self, done: np.ndarray) -> None:
        """One step has passed; an episode's end lets go of the action."""
        self.steps_left -= 1
        self.steps_left[done] = 0
        self._t += 1


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
    is_decision = np.empty((T, N), bool)
    acting = Acting(policy, config, N, seed, iteration, greedy)
    obs = steps.reset(seeding.integer(seed, "episodes", iteration))
    for t in range(T):
        obs, done = steps.step(t, acting.act(obs))
        is_decision[t] = acting.is_decision
        acting.end(done)
    steps.see_through(policy.filter)
    return steps, torch.from_numpy(is_decision)


def make_policy(config: PPOConfig, envs: gym.vector.VectorEnv, generator: torch.Generator) -> GaussianPolicy:
    """A fresh policy for `envs`."""
    obs_size, action_size = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]  # type: ignore[index]
    how = (config.normalize_observations, config.initialisation)
    return GaussianPolicy(obs_size, action_size, config.hidden_sizes, generator, *how)


def restored(config: PPOConfig, envs: Any, checkpoint: Checkpoint) -> GaussianPolicy:
    """The policy of a checkpoint."""
    policy = make_policy(config, envs, seeding.torch_generator(0, "overwritten by the checkpoint"))
    checkpoint.restore(policy=policy)
    return policy


def train(config: PPOConfig, make_envs: MakeEnvs, log: RunLog, seed: int, checkpoint: Checkpoint) -> None:
    """Train from the newest checkpoint, or from scratch, to `config.iterations`.

    Raises:
        Diverged: an observation, a reward or a parameter is no longer finite.
    """
    envs = make_envs(config.num_envs, "training")
    obs_size, generator = envs.single_observation_space.shape[0], seeding.torch_generator(seed, "initialisation")
    policy = make_policy(config, envs, generator)
    how = (0, config.initialisation, config.values_in_loop)
    baseline = ValueFunction(obs_size, config.value_hidden_sizes, generator, *how)
    trained = [*policy.parameters(), *(baseline.parameters() if config.values_in_loop else ())]
    optimizer = make_optimizer(config, trained)

    parts: dict[str, Any] = {"policy": policy, "baseline": baseline, "optimizer": optimizer}
    reward_scale = RewardScale() if config.scale_rewards else None
    if reward_scale is not None:
        parts["reward_scale"] = reward_scale
    training = Training(log, checkpoint, parts)

    for iteration in range(training.begin(), config.iterations):
        start = time.perf_counter()
        steps, is_decision = collect(policy, envs, config, seed, iteration)
        steps.check(iteration)
        collected = time.perf_counter()
        with torch.no_grad():
            statistics = {
                "entropy": float(gaussian_entropy(policy.log_std)),
                "action_std": float(policy.log_std.exp().mean()),
            }

        steps.scale_rewards(reward_scale, config.gamma)
        value = baseline.predict(steps.obs)
        final_obs, step, env = steps.final()
        next_value = value[1:].index_put((step, env), baseline.predict(final_obs))
        advantage = segment_gae(
            steps.scaled_reward,
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

        def log_prob(c: Rows, obs: Tensor = obs, action: Tensor = action) -> Tensor:
            return policy.log_prob(obs[c], action[c])

        def direct(obs: Tensor = obs, action: Tensor = action) -> Gaussian:
            return Gaussian(network_of(policy.mean.layers), policy.log_std_parameter, obs, None, action)

        level = Level("policy", log_prob, standardize(advantage).to(obs.dtype), direct)
        critics = []
        if config.values_in_loop:
            critics = [SquaredError(network_of(baseline.layers, nn.ReLU), obs, None, target.to(obs.dtype))]
        losses = improve(config, [level], critics, optimizer, policy.filter, len(obs), seed, iteration)
        explained = explained_variance(value[:-1][is_decision], target)
        if not config.values_in_loop:
            baseline.fit(obs, target, config.value_iterations)
        steps.feed(policy.filter)
        check_finite(iteration, parameters=nn.utils.parameters_to_vector(policy.parameters()))
        end = time.perf_counter()

        metrics = {
            **losses,
            "explained_variance": explained,
            **statistics,
        }
        training.record(iteration, steps, (start, collected, end), metrics)
    envs.close()
