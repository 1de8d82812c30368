"""A point that roams the plane: the smallest robot whose skills can be told apart by where they go."""

import types
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from hippo.core.checkpoint import Checkpoint
from hippo.core.log import RunLog


class RoamEnv(gym.vector.VectorEnv):
    """The action is the velocity: positions move by 0.1 a, actions clipped to [-1, 1]; the reward is 0.

    The observation is (x, velocity x, velocity y). `death_rate` ends paths at random.
    """

    metadata = {"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP}  # noqa: RUF012
    robot_name, observation_variant = "roamer", "paper"
    observation_names = ("x", "x_velocity", "y_velocity")
    robot_size = 3
    options = types.SimpleNamespace(physics="paper")

    def __init__(self, num_envs: int, seed: int, horizon: int = 20, death_rate: float = 0.0) -> None:
        self.num_envs, self.horizon, self.death_rate = num_envs, horizon, death_rate
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self.single_action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.rng = np.random.default_rng(seed)

    def _observe(self) -> np.ndarray:
        return np.concatenate([self.com[:, :1], self.velocity], 1).astype(np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.clock = np.zeros(self.num_envs, int)
        self.com, self.velocity = np.zeros((self.num_envs, 3)), np.zeros((self.num_envs, 2))
        return self._observe(), {}

    def step(self, actions: np.ndarray) -> tuple:
        self.velocity = np.clip(actions, -1, 1).astype(np.float64)
        self.com = self.com + 0.1 * np.pad(self.velocity, ((0, 0), (0, 1)))
        self.clock += 1
        terminated = self.rng.random(self.num_envs) < self.death_rate
        truncated = (self.clock == self.horizon) & ~terminated
        done = terminated | truncated
        info: dict[str, Any] = {"diverged": np.zeros(self.num_envs, bool), "com": self.com.copy()}
        if done.any():
            info |= {"final_obs": self._observe(), "_final_obs": done}
            self.com[done], self.velocity[done], self.clock[done] = 0, 0, 0
        return self._observe(), np.zeros(self.num_envs), terminated, truncated, info


def make_envs(config: Any, seed: int = 0, **options: Any) -> Any:
    """What a learner makes its environments with."""
    return lambda num_envs, purpose: RoamEnv(num_envs, seed, horizon=config.horizon, **options)


def roam(train: Any, config: Any, folder: Path, seed: int = 0, **options: Any) -> None:
    """Train in `folder` on RoamEnv, resuming from what lies there."""
    train(config, make_envs(config, seed, **options), RunLog(folder), seed, Checkpoint(folder))
