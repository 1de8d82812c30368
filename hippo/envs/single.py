"""One robot on one task behind Gymnasium's single-environment interface, for `gymnasium.make` and any learner."""

from typing import Any

import gymnasium as gym
import numpy as np

from hippo.envs.arguments import Refused, natural
from hippo.envs.rendering import Renderer
from hippo.envs.vector import RENDER_MODES, RobotTaskEnv


class SingleEnv(gym.Env):
    """The same simulation as environment 0 of a RobotTaskEnv; an episode that ended waits for `reset`.

    Args:
        envs: a vector environment of one, without autoreset.
        render_mode: None, "rgb_array" (frames by EGL or OSMesa) or "human" (a window, where there is a display).

    Raises:
        ValueError: an unknown render mode.
    """

    def __init__(self, envs: RobotTaskEnv, render_mode: str | None = None) -> None:
        if render_mode not in (None, *RENDER_MODES):
            raise Refused("render_mode", render_mode, f"must be one of None, {', '.join(RENDER_MODES)}")
        self.envs, self.render_mode, self.metadata = envs, render_mode, envs.metadata
        self.observation_space, self.action_space = envs.single_observation_space, envs.single_action_space
        self._renderer: Renderer | None = None
        self._viewer: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Start a new episode; `seed` and `options` as in RobotTaskEnv.reset."""
        seed = natural("seed", seed, may_be_none=True)
        super().reset(seed=seed)
        obs, info = self.envs.reset(seed=seed, options=options)
        self._show()
        return obs[0], _first(info)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """One control step; the action (A,) is clipped to [-1, 1]."""
        obs, reward, terminated, truncated, info = self.envs.step(np.asarray(action)[None])
        self._show()
        return obs[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), _first(info)

    def render(self) -> np.ndarray | None:
        """The current frame, (H, W, 3) uint8, in rgb_array mode; None otherwise."""
        self.envs.check_open()
        if self.render_mode != "rgb_array":
            return None
        if self._renderer is None:
            self._renderer = Renderer(self.envs)
        return self._renderer.frame(0)

    def _show(self) -> None:
        if self.render_mode == "human":
            if self._viewer is None:
                from hippo.envs.viewer import Viewer  # loads GLFW

                self._viewer = Viewer(self.envs, self.metadata["render_fps"])
            self._viewer.show(0)

    def __getstate__(self) -> dict[str, Any]:
        """What is pickled and copied: all but what draws, which the copy makes for itself."""
        return vars(self) | {"_renderer": None, "_viewer": None}

    def close(self) -> None:
        """Release the simulation and what renders it."""
        for part in (self._renderer, self._viewer):
            if part is not None:
                part.close()
        self._renderer = self._viewer = None
        self.envs.close()


def _first(info: dict[str, Any]) -> dict[str, Any]:
    """The entries of environment 0."""
    return {name: value[0] for name, value in info.items()}
