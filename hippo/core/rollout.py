"""What every on-policy learner records of T steps of N environments, and how the end of an episode is read.

An iteration starts with a fresh episode in every environment and takes one horizon of steps. An episode that ends early
is followed by a new one in its place; what the end of the batch cuts is bootstrapped, the horizon itself is not (the
paper's MDP has a finite horizon) unless `bootstrap_horizon` says so.
"""

import time
from typing import Any

import gymnasium as gym
import numba
import numpy as np
import torch
from torch import Tensor

from hippo.core.episodes import episode_statistics
from hippo.core.log import check_finite
from hippo.core.normalize import ObservationFilter, RewardScale


class LastInfo(gym.vector.VectorWrapper):
    """The same environments, which keep the `info` of the last step."""

    info: dict[str, Any]

    def step(self, actions: np.ndarray) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """As the environments' own."""
        result = self.env.step(actions)
        self.info = result[-1]
        return result


@numba.njit(cache=True, error_model="numpy")
def _record(
    t: int,
    action: np.ndarray,
    obs: np.ndarray,
    reward: np.ndarray,
    terminated: np.ndarray,
    truncated: np.ndarray,
    actions: np.ndarray,
    observations: np.ndarray,
    rewards: np.ndarray,
    ends: np.ndarray,
    done: np.ndarray,
) -> bool:
    """Write step t, what followed it and whether an episode ended, in ends and done; return if any did."""
    ended = False
    for i in range(len(reward)):
        for j in range(action.shape[1]):
            actions[t, i, j] = action[i, j]
        for j in range(obs.shape[1]):
            observations[t + 1, i, j] = obs[i, j]
        rewards[t, i] = reward[i]
        ends[t, i] = done[t, i] = terminated[i] or truncated[i]
        ended |= done[t, i]
    return ended


class Steps:
    """Arrays of one iteration, filled by `reset` and then `step` for t = 0 .. T - 1."""

    def __init__(self, envs: gym.vector.VectorEnv, num_steps: int, bootstrap_horizon: bool = False) -> None:
        T, N = num_steps, envs.num_envs
        obs_size = envs.single_observation_space.shape[0]  # type: ignore[index]
        action_size = envs.single_action_space.shape[0]  # type: ignore[index]
        self.envs, self.bootstrap_horizon = envs, bootstrap_horizon
        self.obs = torch.empty(T + 1, N, obs_size)  # the last row follows the last step
        self.action = torch.empty(T, N, action_size)
        self.reward = torch.empty(T, N, dtype=torch.float64)
        self.terminated = torch.empty(T, N, dtype=torch.bool)  # nothing follows the step
        self.done = torch.empty(T, N, dtype=torch.bool)  # the episode ended with the step
        # The same memory for numpy, whose small assignments cost a tenth of torch's.
        names = ("obs", "action", "reward", "terminated", "done")
        self._write = {name: getattr(self, name).numpy() for name in names}
        self._final: list[tuple[int, np.ndarray, np.ndarray]] = []
        self.raw_obs, self.scaled_reward = self.obs, self.reward  # before an observation filter, after a reward scale
        self.diverged = 0  # simulations that diverged
        self.penalty = 0.0  # velocity penalty summed over all steps
        self.physics_seconds = 0.0  # spent inside the environments

    def reset(self, seed: int) -> np.ndarray:
        """Start a fresh episode in every environment; returns the first observations (N, D)."""
        obs, _ = self.envs.reset(seed=seed)
        self._write["obs"][0] = obs
        return obs

    def step(self, t: int, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Take `action` (N, A) and record what follows; returns the next observations and which episodes ended (N,)."""
        start = time.perf_counter()
        obs, reward, terminated, truncated, info = self.envs.step(action)
        self.physics_seconds += time.perf_counter() - start
        write = self._write
        done = write["done"][t]
        ended = _record(
            t,
            *(action, obs, reward, terminated, truncated),
            *(write["action"], write["obs"], write["reward"], write["terminated"], write["done"]),
        )
        if ended:
            self.diverged += int(info["diverged"].sum())
            if self.bootstrap_horizon:
                bootstrapped = truncated & ~info["diverged"]
                where = np.flatnonzero(bootstrapped)
                self._final.append((t, where, info["final_obs"][where]))
                write["terminated"][t, where] = False
        if "velocity_penalty" in info:
            self.penalty += float(info["velocity_penalty"].sum())
        return obs, done

    def see_through(self, observation_filter: ObservationFilter | None) -> None:
        """Turn the observations into what a policy with this filter saw of them; `raw_obs` keeps them as they were."""
        if observation_filter is not None:
            self.obs = observation_filter(self.raw_obs)
            view = observation_filter.actor()
            self._final = [(t, where, view(obs)) for t, where, obs in self._final]

    def feed(self, observation_filter: ObservationFilter | None) -> None:
        """Let the filter know the observations of a batch that has been learnt from."""
        if observation_filter is not None:
            observation_filter.update(self.raw_obs[:-1])

    def scale_rewards(self, reward_scale: RewardScale | None, gamma: float, frozen: bool = False) -> None:
        """Learn from scaled rewards, if there is a scale, which knows the batch's first; `frozen`: from it as it is."""
        if reward_scale is not None:
            if not frozen:
                reward_scale.take_in(self.reward, self.done, gamma)
            self.scaled_reward = reward_scale(self.reward)

    @property
    def num_steps(self) -> int:
        """Environment steps taken, T N."""
        return self.reward.numel()

    def final(self) -> tuple[Tensor, Tensor, Tensor]:
        """Of the E episodes whose horizon is bootstrapped: last observation (E, D), step (E,) and environment (E,)."""
        if not self._final:
            return self.obs[:0, 0], torch.empty(0, dtype=torch.long), torch.empty(0, dtype=torch.long)
        step = torch.cat([torch.full((len(where),), t) for t, where, _ in self._final])
        env = torch.from_numpy(np.concatenate([where for _, where, _ in self._final]))
        return torch.from_numpy(np.concatenate([obs for _, _, obs in self._final])), step, env

    def statistics(self) -> dict[str, float | int]:
        """Returns and lengths of the episodes, the velocity penalty per environment, diverged simulations."""
        return {
            **episode_statistics(self.reward.numpy(), self.done.numpy()),
            "velocity_penalty": self.penalty / self.reward.shape[1],
            "diverged_simulations": self.diverged,
        }

    def check(self, iteration: int) -> None:
        """Raise Diverged where an observation or a reward is not finite."""
        check_finite(iteration, observations=self.raw_obs, rewards=self.reward)

    def timing(self, start: float, collected: float, end: float) -> dict[str, float]:
        """Where the seconds between `start`, `collected` and `end` (perf_counter) of an iteration went."""
        return {
            "seconds": end - start,
            "steps_per_second": self.num_steps / (end - start),
            "physics_seconds": self.physics_seconds,
            "policy_seconds": collected - start - self.physics_seconds,
            "update_seconds": end - collected,
        }
