"""Small vector environments with the interface of hippo.envs, whose right answers are known."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from hippo.core.checkpoint import Checkpoint
from hippo.core.log import RunLog
from hippo.core.policies import SkillPolicy
from hippo.core.skills import save_skills


class TargetEnv(gym.vector.VectorEnv):
    """The reward is 1 - |a - o|^2 for an observation o drawn anew at every step: the best action is the observation.

    `death_rate` ends episodes at random, for learners that must cope with early ends.
    """

    metadata = {"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP}  # noqa: RUF012
    robot_name, observation_variant = "toy", "paper"

    def __init__(self, num_envs: int, seed: int, horizon: int = 20, size: int = 2, death_rate: float = 0.0) -> None:
        self.num_envs, self.horizon, self.death_rate = num_envs, horizon, death_rate
        self.robot_size = size
        self.observation_names = ["position_x", "position_y", "z", "w"][:size]
        self.single_observation_space = gym.spaces.Box(-1, 1, (size,), np.float32)
        self.single_action_space = gym.spaces.Box(-1, 1, (size,), np.float32)
        self.rng = np.random.default_rng(seed)

    def _draw(self) -> np.ndarray:
        obs = self.rng.uniform(-1, 1, (self.num_envs, self.robot_size))
        return torch.from_numpy(obs).to(torch.get_default_dtype()).numpy()

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.clock = np.zeros(self.num_envs, int)
        self.obs = self._draw()
        return self.obs.copy(), {}

    def step(self, actions: np.ndarray) -> tuple:
        reward = 1 - ((actions - self.obs) ** 2).sum(1).astype(np.float64)
        self.clock += 1
        terminated = self.rng.random(self.num_envs) < self.death_rate
        truncated = (self.clock == self.horizon) & ~terminated
        done = terminated | truncated
        self.obs = self._draw()
        info: dict[str, Any] = {"diverged": np.zeros(self.num_envs, bool)}
        if done.any():
            info |= {"final_obs": self.obs.copy(), "_final_obs": done}
            self.obs[done] = self._draw()[done]
            self.clock[done] = 0
        return self.obs.copy(), reward, terminated, truncated, info


class PointMass(gym.vector.VectorEnv):
    """A point that walks by action times 0.25 m in a corridor from x = -2 to x = 2 m, |y| < 1, and sees where it is.

    It starts near the left end; the reward is minus the distance to the right end.
    """

    metadata = {"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP}  # noqa: RUF012
    robot_name, observation_variant, robot_size = "point", "paper", 2
    observation_names = ("position_x", "position_y")
    end, half_size, step_size = np.array([1.8, 0.0]), np.array([2.0, 1.0]), 0.25

    def __init__(self, num_envs: int, seed: int, horizon: int = 40) -> None:
        self.num_envs, self.horizon = num_envs, horizon
        self.single_observation_space = gym.spaces.Box(-2, 2, (2,), np.float32)
        self.single_action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.rng = np.random.default_rng(seed)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.clock = 0
        self.place = np.array([-1.8, 0.0]) + self.rng.uniform(-0.2, 0.2, (self.num_envs, 2))
        return self.place.astype(np.float32), {}

    def step(self, actions: np.ndarray) -> tuple:
        self.place = np.clip(self.place + self.step_size * np.clip(actions, -1, 1), -self.half_size, self.half_size)
        self.clock += 1
        reward = -np.linalg.norm(self.place - self.end, axis=1)
        no, truncated = np.zeros(self.num_envs, bool), np.full(self.num_envs, self.clock == self.horizon)
        obs, info = self.place.astype(np.float32), {"diverged": no}
        if truncated.any():
            info |= {"final_obs": obs, "_final_obs": truncated}
            obs, _ = self.reset()
        return obs, reward, no, truncated, info


def run(train: Any, config: Any, folder: Path, seed: int = 0, **env_options: Any) -> None:
    """Train in `folder` on TargetEnv, resuming from what lies there."""

    def make_envs(num_envs: int, purpose: str) -> TargetEnv:
        return TargetEnv(num_envs, seed, horizon=config.horizon, **env_options)

    train(config, make_envs, RunLog(folder), seed, Checkpoint(folder))


def progress(folder: Path) -> dict[str, np.ndarray]:
    """The columns of progress.csv."""
    lines = [line.split(",") for line in (folder / "progress.csv").read_text().splitlines()]
    table = np.array(lines[1:], dtype=float)
    return dict(zip(lines[0], table.T, strict=True))


def given_skills(path: Path) -> dict[str, Any]:
    """Write a file of three skills for TargetEnv; returns the state of their network."""
    policy = SkillPolicy(2, 3, 2, [64, 64], torch.Generator().manual_seed(5))
    metadata = {"robot": "toy", "observation": "paper"}
    metadata |= {"env": "toy", "algo": "snn", "run_id": "0", "env_steps": 1, "physics": "paper"}
    save_skills(path, policy, metadata)
    return policy.state_dict()
