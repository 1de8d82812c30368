"""How walls are cleared on the Block tasks, how far from upright the torso is there and how high; and walls unseen."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from hippo.envs.blocks import TUMBLED, Blocks
from hippo.envs.vector import RobotTaskEnv

COLUMNS = ("crossings", "crossings_tumbled", "crossings_height")
CEILING = {"block_hopper": 7.60, "block_half_cheetah": 16.27}  # walls per episode of the blind gait, as the page says


def has_walls(envs: Any) -> bool:
    """Whether there is anything to cross."""
    return isinstance(envs, RobotTaskEnv) and isinstance(envs.task, Blocks)


class Crossings:
    """Block environments that look at the torso whenever a wall is paid for, in every one's first episode.

    The angle from upright is that of the torso as it is, whole turns left out; its height is above the floor.
    """

    def __init__(self, envs: RobotTaskEnv) -> None:
        self._envs = envs
        self._pitch, self._z = (envs.observation_names.index(name) for name in ("pitch", "z"))
        model = envs.physics.model
        joint = model.joint("z").qposadr[0]
        self._lift = float(model.body("torso").pos[2] - model.qpos0[joint])
        self._begin()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._envs, name)

    def _begin(self) -> None:
        self._is_first = np.ones(self._envs.num_envs, bool)
        self._paid, self._tumbled, self._height = np.zeros((3, self._envs.num_envs))

    def reset(self, **arguments: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """As the environments' own; forgets what was seen."""
        self._begin()
        return self._envs.reset(**arguments)

    def step(self, actions: np.ndarray) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """As the environments' own."""
        obs, reward, terminated, truncated, info = self._envs.step(actions)
        seen = obs
        if "final_obs" in info:
            seen = np.where(info["_final_obs"][:, None], info["final_obs"], obs)
        paid = info["reward_walls"] * self._is_first
        angle = (seen[:, self._pitch] + np.pi) % (2 * np.pi) - np.pi
        self._paid += paid
        self._tumbled += paid * (np.abs(angle) > TUMBLED)
        self._height += paid * (seen[:, self._z] + self._lift)
        self._is_first &= ~(terminated | truncated)
        return obs, reward, terminated, truncated, info

    def rows(self) -> list[dict[str, Any]]:
        """COLUMNS of every environment: walls paid for, of them with a tumbled torso, and its mean height there in m.

        The height of no crossing is None.
        """
        return [
            dict(zip(COLUMNS, (int(n), int(tumbled), float(height / n) if n else None), strict=True))
            for n, tumbled, height in zip(self._paid, self._tumbled, self._height, strict=True)
        ]


class Walls:
    """Block environments that note the mean of what is observed of walls, or show such a mean in its place.

    The observation is the environment's own, before any normaliser of the policy; final observations, on which no
    action depends, are left as they are.
    """

    def __init__(self, envs: Any, shown: np.ndarray | None = None) -> None:
        names = [name for name, *_ in envs.task.entries]
        self._envs, self._shown = envs, shown  # shown (8,): in the place of the entries of walls, None: as they are
        self._columns = [envs.observation_names.index(name) for name in names]
        self._sum, self._count = np.zeros(len(names)), 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._envs, name)

    def reset(self, **arguments: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """As the environments' own."""
        obs, info = self._envs.reset(**arguments)
        return self._look(obs), info

    def step(self, actions: np.ndarray) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """As the environments' own."""
        obs, *others = self._envs.step(actions)
        return self._look(obs), *others

    def _look(self, obs: np.ndarray) -> np.ndarray:
        self._sum += obs[:, self._columns].sum(0, dtype=float)
        self._count += len(obs)
        if self._shown is not None:
            obs = obs.copy()
            obs[:, self._columns] = self._shown
        return obs

    def mean(self) -> np.ndarray:
        """(8,) of the entries of walls, over all environments and steps."""
        return self._sum / self._count


def totals(rows: Sequence[dict[str, Any]]) -> tuple[int, float, float]:
    """Of `rows` together: walls cleared, the share of them with a tumbled torso, its mean height in m; NaN for none."""
    paid = sum(row["crossings"] for row in rows)
    if not paid:
        return 0, math.nan, math.nan
    height = sum(row["crossings"] * row["crossings_height"] for row in rows if row["crossings"])
    return paid, sum(row["crossings_tumbled"] for row in rows) / paid, height / paid


def summary(rows: Sequence[dict[str, Any]]) -> str:
    """One line about the crossings in `rows`."""
    paid, tumbled, height = totals(rows)
    if not paid:
        return "no wall was cleared"
    return f"{paid} walls cleared, {tumbled:.0%} of them with |pitch| > {TUMBLED:g} rad, torso at {height:.2f} m"
