"""The Block task: run along x over walls of random height, +1 for every wall cleared (paper section 5.1; numbers ours).

Wall k is a box across the track, centred at `first_wall + 2 k` m. Pure functions over N environments; W walls are in
the simulation at a time, a ring in which a wall left behind is placed again ahead.
"""

from dataclasses import dataclass
from typing import Any

import mujoco
import numba
import numpy as np

from hippo.envs.physics import BatchPhysics
from hippo.envs.robots import Robot

SPACING = 2.0  # m between wall centres
LENGTH = 0.1  # m along x
RING = 12  # walls in the simulation at a time
BEHIND = 4  # of which behind the robot
HALF_HEIGHT = 1.0  # m; a wall is a tall box sunk to its height
HALF_WIDTH = 5.0  # m across the track
PITCH = 2  # of qpos, of either robot
TUMBLED = 1.0  # rad; the torso has left upright by more
NUM_HEIGHTS = 512  # heights drawn per episode; the sequence repeats after 1 km, twice what any robot can run


@dataclass(frozen=True)
class Track:
    """Where the walls stand and how high they are, in m."""

    first_wall: float
    low: float
    high: float


TRACKS = {"hopper": Track(2.0, 0.1, 0.3), "half_cheetah": Track(1.5, 0.05, 0.2)}


def draw_heights(rng: np.random.Generator, track: Track) -> np.ndarray:
    """(NUM_HEIGHTS,) wall heights of one episode."""
    return rng.uniform(track.low, track.high, NUM_HEIGHTS)


def next_wall(x: np.ndarray, track: Track) -> np.ndarray:
    """Index (N,) of the first wall whose far face lies ahead of x (N,); every wall before it is passed."""
    out = np.empty(len(x), np.int64)
    _next_wall(x, track.first_wall, out)
    return out


@numba.njit(cache=True, error_model="numpy")
def _next_wall(x: np.ndarray, first_wall: float, out: np.ndarray) -> None:
    """Write `next_wall` to out (N,) int64."""
    for i in range(len(x)):
        out[i] = _passed(x[i], first_wall)


@numba.njit(cache=True, error_model="numpy")
def _passed(x: float, first_wall: float) -> int:
    """How many walls' far faces lie behind x."""
    return int(max(np.ceil((x - (first_wall + LENGTH / 2)) / SPACING), 0.0))


def wall_x(index: np.ndarray, track: Track) -> np.ndarray:
    """Centre x of walls by index, any shape."""
    return track.first_wall + SPACING * index


def height_of(index: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Heights of walls: index (N,) or (N, W), heights (N, NUM_HEIGHTS) -> the shape of index."""
    flat = index.reshape(len(heights), -1) % NUM_HEIGHTS
    return np.take_along_axis(heights, flat, 1).reshape(index.shape)


def ring_indices(ahead: np.ndarray) -> np.ndarray:
    """Which wall stands in every slot of the ring, given the next wall (N,) -> (N, W); wall k is in slot k mod W."""
    start = np.maximum(ahead - BEHIND, 0)[:, None]
    return start + (np.arange(RING) - start) % RING


def ring_positions(index: np.ndarray, heights: np.ndarray, track: Track) -> np.ndarray:
    """Centres of the boxes so that their tops are at the walls' heights: (N, W) -> (N, W, 3)."""
    z = height_of(index, heights) - HALF_HEIGHT
    return np.stack([wall_x(index, track), np.zeros_like(z), z], -1)


def observe(x: np.ndarray, ahead: np.ndarray, heights: np.ndarray, track: Track) -> np.ndarray:
    """Height, length, x and signed distance from x of the next and of the previous wall: (N, 8).

    The previous wall is zeros before the first.
    """
    out = np.zeros((len(x), 8))
    _observe(x, ahead, heights, track.first_wall, out)
    return out


@numba.njit(cache=True, error_model="numpy")
def _observe(x: np.ndarray, ahead: np.ndarray, heights: np.ndarray, first_wall: float, out: np.ndarray) -> None:
    """Write `observe` to out (N, 8), which holds zeros."""
    for i in range(len(x)):
        for column, index in ((0, ahead[i]), (4, ahead[i] - 1)):
            if index >= 0:
                centre = first_wall + SPACING * index
                out[i, column] = heights[i, index % NUM_HEIGHTS]
                out[i, column + 1] = LENGTH
                out[i, column + 2] = centre
                out[i, column + 3] = centre - x[i]


@numba.njit(cache=True, error_model="numpy")
def _run(
    x: np.ndarray,
    heights: np.ndarray,
    first_wall: float,
    ahead: np.ndarray,
    cleared: np.ndarray,
    boxes: np.ndarray,
    reward: np.ndarray,
) -> None:
    """One step of the task with the robots at x (N,).

    Updates ahead (N,), the walls passed now, and cleared (N,), the most ever, whose growth is the reward (N,). Where
    `ahead` changes, the ring turns: boxes (N, W, 3) become `ring_positions` of `ring_indices`.
    """
    for i in range(len(x)):
        passed = _passed(x[i], first_wall)
        if passed != ahead[i]:
            ahead[i] = passed
            start = max(passed - BEHIND, 0)
            for slot in range(RING):
                wall = start + (slot - start) % RING
                boxes[i, slot, 0] = first_wall + SPACING * wall
                boxes[i, slot, 1] = 0.0
                boxes[i, slot, 2] = heights[i, wall % NUM_HEIGHTS] - HALF_HEIGHT
        reward[i] = max(passed - cleared[i], 0)
        cleared[i] = max(passed, cleared[i])


class Blocks:
    """Walls of N simulations, and what clearing them pays."""

    pays_for_speed = False

    def __init__(self, robot: Robot, options: Any, num_envs: int) -> None:
        self.robot, self.track = robot, TRACKS[robot.name]
        self.terminate_on_fall, self.terminate_on_tumble = options.terminate_on_fall, options.terminate_on_tumble
        self.heights = np.zeros((num_envs, NUM_HEIGHTS))  # (N, NUM_HEIGHTS) m
        self.cleared = np.zeros(num_envs, np.int64)  # (N,) walls paid for
        self.ahead = np.zeros(num_envs, np.int64)  # (N,) index of the next wall

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the ring of walls as massless mocap bodies: their positions are state, so no model field is touched."""
        for slot in range(RING):
            body = spec.worldbody.add_body(name=f"block_{slot}", mocap=True, pos=[0, 0, -10])
            body.add_geom(
                name=f"block_{slot}",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                size=[LENGTH / 2, HALF_WIDTH, HALF_HEIGHT],
                mass=0,
                contype=1,
                conaffinity=1,
                condim=3,
                rgba=[0.45, 0.5, 0.6, 1],
            )

    def attach(self, physics: BatchPhysics) -> None:
        """Take views of what the task reads from and writes to the simulations."""
        self.physics = physics
        self.com = physics.com

    @property
    def entries(self) -> list[tuple[str, str, float, float]]:
        """Name, unit and bounds of the task's part of an observation."""
        return [
            (f"{which}_wall_{name}", "m", -1e3, 1e3)
            for which in ("next", "previous")
            for name in ("height", "length", "x", "distance")
        ]

    def reset(self, ids: np.ndarray, layouts: list[np.random.Generator]) -> None:
        """Draw new heights in simulations `ids` and put the first walls up."""
        for i, rng in zip(ids, layouts, strict=True):
            self.heights[i] = draw_heights(rng, self.track)
        self.cleared[ids] = self.ahead[ids] = 0
        self.raise_walls(ids)

    def raise_walls(self, ids: np.ndarray) -> None:
        """Put the walls of simulations `ids` where they belong."""
        index = ring_indices(self.ahead[ids])
        self.physics.mocap_pos[ids] = ring_positions(index, self.heights[ids], self.track)

    def step(self) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Reward (N,), terminated (N,) and the reward's terms, read from the new state."""
        x = self.com[:, 0]
        reward, boxes = np.empty(len(x)), self.physics.mocap_pos
        _run(x, self.heights, self.track.first_wall, self.ahead, self.cleared, boxes, reward)
        terminated = self._fallen() if self.terminate_on_fall else np.zeros(len(x), bool)
        if self.terminate_on_tumble:
            terminated |= np.abs(self.physics.qpos[:, PITCH]) > TUMBLED
        return reward.copy(), terminated, {"reward_walls": reward}

    def _fallen(self) -> np.ndarray:
        """rllab's termination: the Hopper must stay up; the Half-Cheetah never ends."""
        qpos, qvel = self.physics.qpos, self.physics.qvel
        if self.robot.name != "hopper":
            return np.zeros(len(qpos), bool)
        state = np.concatenate([qpos, qvel], 1)
        fine = (np.abs(state[:, 3:]) < 100).all(1) & (qpos[:, 0] > 0.7) & (np.abs(qpos[:, 2]) < 0.2)
        return ~fine

    def observe(self) -> np.ndarray:
        """(N, 8) the next and the previous wall."""
        return observe(self.com[:, 0], self.ahead, self.heights, self.track)

    @property
    def state(self) -> dict[str, np.ndarray]:
        """The arrays that a continuation needs."""
        return {"heights": self.heights, "cleared": self.cleared, "ahead": self.ahead}
