"""How walls are cleared on the Block tasks: how far from upright the torso is there, and how high."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from hippo.envs.blocks import TUMBLED, Blocks
from hippo.envs.vector import RobotTaskEnv

COLUMNS = ("crossings", "crossings_tumbled", "crossings_height")


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
