"""The Gather task (Duan et al. 2016): collect 8 apples, avoid 8 bombs, see them through a lidar of 2 x 10 bins.

Pure functions over N environments with O = 16 objects, apples first. Positions in m, angles in rad.
"""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from hippo.envs.physics import BatchPhysics
from hippo.envs.robots import POSITION, Robot

NUM_APPLES = NUM_BOMBS = 8
NUM_OBJECTS = NUM_APPLES + NUM_BOMBS
VALUE = np.array([1.0] * NUM_APPLES + [-1.0] * NUM_BOMBS)  # (O,) reward for catching
CATCH_DISTANCE = 1.0  # m
SENSOR_RANGE = 6.0  # m
NUM_BINS = 10  # over the full circle, per type
WALL_DISTANCE = 7.0  # m from the origin to the centre of an arena wall, which is 1 m thick
DEATH_REWARD = -10.0


@dataclass(frozen=True)
class VelocityPenalty:
    """Per-step penalty on the centre of mass's speed v: 0 up to `threshold` m/s, then bias + slope (v - threshold)."""

    threshold: float
    slope: float
    bias: float

    def __call__(self, speed: np.ndarray) -> np.ndarray:
        """Speed (N,) in m/s -> penalty (N,) >= 0."""
        return np.where(speed <= self.threshold, 0.0, self.bias + self.slope * (speed - self.threshold))


PENALTIES = {"ant": VelocityPenalty(1.2, 0.0025, 0.001), "snake": VelocityPenalty(0.111, 0.0005, 0.001)}


def cells(grid: str) -> np.ndarray:
    """(C, 2) where objects may lie: multiples of 2 m around the origin, which stays free.

    "original" is the authors' {-6, -4, ..., 4}^2, which never reaches +6; "symmetric" adds it.
    """
    axis = np.arange(-6.0, 6.0 if grid == "original" else 8.0, 2.0)
    points = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    return points[(points != 0).any(1)]


def place(rng: np.random.Generator, points: np.ndarray) -> np.ndarray:
    """(O, 2) object positions, drawn from `points` (C, 2) without replacement."""
    return points[rng.permutation(len(points))[:NUM_OBJECTS]]


def catch(com: np.ndarray, objects: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Which objects are caught: centre of mass (N, 2), objects (N, O, 2), present (N, O) -> (N, O) bool."""
    offset = objects - com[:, None]
    return present & ((offset * offset).sum(-1) < CATCH_DISTANCE**2)


def lidar(com: np.ndarray, yaw: np.ndarray, objects: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Readings 1 - d / 6 of the nearest object per bin and type, 0 where there is none in range.

    Bins go counter-clockwise; bin 0 starts straight behind the robot, and an object exactly behind belongs to the last
    bin. Types do not hide each other.

    Args:
        com: (N, 2). yaw: (N,). objects: (N, O, 2). present: (N, O) bool.

    Returns:
        (N, 20): ten apple bins, ten bomb bins.
    """
    offset = objects - com[:, None]
    distance = np.sqrt((offset * offset).sum(-1))  # (N, O)
    reading = np.where(present, np.maximum(1 - distance / SENSOR_RANGE, 0.0), 0.0)
    behind = np.arctan2(offset[..., 1], offset[..., 0]) - yaw[:, None] + np.pi
    turn = behind % (2 * np.pi)
    bins = np.minimum((turn * (NUM_BINS / (2 * np.pi))).astype(np.int64), NUM_BINS - 1)
    bins[turn == 0] = NUM_BINS - 1
    N = len(com)
    out = np.zeros(N * 2 * NUM_BINS)
    kind = np.arange(NUM_OBJECTS) // NUM_APPLES * NUM_BINS
    np.maximum.at(out, (bins + kind + (np.arange(N) * 2 * NUM_BINS)[:, None]).ravel(), reading.ravel())
    return out.reshape(N, 2 * NUM_BINS)


def dead(z: np.ndarray) -> np.ndarray:
    """Whether an Ant at height z (N,) in m is: too low, too high or nowhere."""
    return ~((z >= 0.3) & (z <= 1.0))


class Gather:
    """Apples and bombs of N simulations, and what they pay."""

    pays_for_speed = False

    def __init__(self, robot: Robot, options: Any, num_envs: int) -> None:
        self.robot, self.num_envs = robot, num_envs
        self.cells = cells(options.grid)
        self.penalty = PENALTIES[robot.name] if options.velocity_penalty else None
        self.position = options.position
        self.has_walls = options.walls or robot.name == "ant"
        self.objects = np.zeros((num_envs, NUM_OBJECTS, 2))  # (N, O, 2) m
        self.present = np.zeros((num_envs, NUM_OBJECTS), bool)  # (N, O) not caught yet

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the arena's walls and, for the penalty, a sensor of the centre of mass's velocity."""
        solid = self.has_walls and self.robot.name != "ant"  # the Snake's links touch nothing unless asked to
        for geom in spec.geoms if solid else ():
            geom.contype = 1
        places = {"east": (1, 0), "west": (-1, 0), "north": (0, 1), "south": (0, -1)}
        for name, (x, y) in places.items():
            spec.worldbody.add_geom(
                name=f"wall_{name}",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=[WALL_DISTANCE * x, WALL_DISTANCE * y, 0],
                size=[0.5 if x else 7.5, 0.5 if y else 7.5, 1],
                contype=int(self.has_walls),
                conaffinity=int(self.has_walls),
                condim=3,
                rgba=[0.55, 0.57, 0.62, 1],
            )
        if self.penalty is not None:
            spec.add_sensor(
                type=mujoco.mjtSensor.mjSENS_SUBTREELINVEL, objtype=mujoco.mjtObj.mjOBJ_BODY, objname="torso"
            )

    def attach(self, physics: BatchPhysics) -> None:
        """Take views of what the task reads from the simulations."""
        self.physics = physics
        self.com = physics.com
        self.com_velocity = physics.bind("sensordata") if self.penalty is not None else None

    @property
    def entries(self) -> list[tuple[str, str, float, float]]:
        """Name, unit and bounds of the task's part of an observation."""
        lidar = [(f"{kind}_{i}", "1", 0.0, 1.0) for kind in ("apple", "bomb") for i in range(NUM_BINS)]
        return lidar + [(f"position_{axis}", "m", -POSITION, POSITION) for axis in "xy"] * self.position

    def reset(self, ids: np.ndarray, layouts: list[np.random.Generator]) -> None:
        """Place new objects in simulations `ids`."""
        for i, rng in zip(ids, layouts, strict=True):
            self.objects[i] = place(rng, self.cells)
        self.present[ids] = True

    def step(self) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Reward (N,), terminated (N,) and the reward's terms, read from the new state."""
        caught = catch(self.com[:, :2], self.objects, self.present)
        self.present &= ~caught
        reward = caught @ VALUE
        terminated = np.asarray(~self.present.any(1))
        terms = {"reward_objects": reward}
        if self.robot.name == "ant":
            is_dead = dead(self.physics.qpos[:, 2])
            terms["reward_objects"] = np.where(is_dead, 0.0, reward)
            terms["reward_death"] = np.where(is_dead, DEATH_REWARD, 0.0)
            terminated = terminated | is_dead
        if self.penalty is not None:
            assert self.com_velocity is not None
            terms["velocity_penalty"] = self.penalty(np.linalg.norm(self.com_velocity, axis=1))
        return _total(terms), terminated, terms

    def observe(self) -> np.ndarray:
        """(N, 20) lidar readings, then with `position` the torso's x and y."""
        readings = self.readings()
        return np.concatenate([readings, self.physics.qpos[:, :2]], 1) if self.position else readings

    def readings(self) -> np.ndarray:
        """(N, 20) lidar readings."""
        assert self.robot.yaw is not None
        return lidar(self.com[:, :2], self.robot.yaw(self.physics.qpos), self.objects, self.present)

    @property
    def state(self) -> dict[str, np.ndarray]:
        """The arrays that a continuation needs."""
        return {"objects": self.objects, "present": self.present}


def _total(terms: dict[str, np.ndarray]) -> np.ndarray:
    """The reward: its terms summed, the penalty subtracted."""
    reward = sum(value for name, value in terms.items() if name != "velocity_penalty")
    return np.asarray(reward - terms.get("velocity_penalty", 0.0))
