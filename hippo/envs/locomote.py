"""Locomotion of the robots alone, for the pre-training of skills: no walls, no objects.

Ant and Snake are paid for the speed of their centre of mass less a control cost, as the inner robots of the authors'
Gather tasks (the Ant's contact cost is left out: stepping does not compute those forces unless a sensor asks). Hopper
and Half-Cheetah are paid nothing: DIAYN brings its own reward.
"""

from typing import Any

import mujoco
import numba
import numpy as np

from hippo.envs.gather import dead
from hippo.envs.physics import BatchPhysics
from hippo.envs.robots import Robot

CONTROL_COST = 0.5 * 0.01  # per squared action, the actions being in [-1, 1]
SURVIVAL = {"ant": 0.05, "snake": 0.0}  # per step; robots that are not here are paid nothing at all


@numba.njit(cache=True, error_model="numpy")
def _speed(com: np.ndarray, before: np.ndarray, seconds: float, speed: np.ndarray) -> None:
    """speed (N,) m/s: from before (N, 3) to com (N, 3) in the plane in `seconds`; then com is written to before."""
    for i in range(len(com)):
        dx, dy = com[i, 0] - before[i, 0], com[i, 1] - before[i, 1]
        speed[i] = np.sqrt(dx * dx + dy * dy) / seconds
        before[i] = com[i]


@numba.njit(cache=True, error_model="numpy")
def _square(ctrl: np.ndarray, largest: np.ndarray, out: np.ndarray) -> None:
    """Write the squares of the actions that ctrl (N, A) came from to out (N, A); largest (A,) is that of action 1."""
    for i in range(len(ctrl)):
        for j in range(len(largest)):
            action = ctrl[i, j] / largest[j]
            out[i, j] = action * action


class Locomotion:
    """The centres of mass of N simulations, and what moving them pays."""

    # A difference of centres of mass would show in which order MassCentre adds up, and that depends on N.
    pays_for_speed = True

    def __init__(self, robot: Robot, options: Any, num_envs: int) -> None:
        self.robot, self.timing = robot, robot.timing(options.physics)
        self.before = np.zeros((num_envs, 3))  # (N, 3) m, centre of mass at the last step

    def build(self, spec: mujoco.MjSpec) -> None:
        """Nothing is added to the robot and its floor."""

    def attach(self, physics: BatchPhysics) -> None:
        """Take views of what the task reads from the simulations."""
        self.physics, self.com = physics, physics.com
        self.largest_control = physics.model.actuator_ctrlrange[:, 1].copy()

    @property
    def entries(self) -> list[tuple[str, str, float, float]]:
        """The task adds nothing to what the robot observes of itself."""
        return []

    def reset(self, ids: np.ndarray, layouts: list[np.random.Generator]) -> None:
        """Start at rest in simulations `ids`."""
        self.before[ids] = self.com[ids]

    def step(self) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Reward (N,), terminated (N,) and the reward's terms, read from the new state."""
        N = len(self.com)
        speed = np.empty(N)
        _speed(self.com, self.before, self.timing.timestep * self.timing.frame_skip, speed)
        if self.robot.name not in SURVIVAL:
            return np.zeros(N), np.zeros(N, bool), {}
        squares = np.empty(self.physics.ctrl.shape)
        _square(self.physics.ctrl, self.largest_control, squares)
        control = -CONTROL_COST * squares.sum(1)
        survival = np.full(N, SURVIVAL[self.robot.name])
        terms = {"reward_speed": speed, "reward_control": control, "reward_survival": survival}
        terminated = dead(self.physics.qpos[:, 2]) if self.robot.name == "ant" else np.zeros(N, bool)
        return speed + control + survival, terminated, terms

    def observe(self) -> np.ndarray:
        """(N, 0)."""
        return np.zeros((len(self.com), 0))

    @property
    def state(self) -> dict[str, np.ndarray]:
        """The arrays that a continuation needs."""
        return {"before": self.before}
