"""The Gather task (Duan et al. 2016): collect 8 apples, avoid 8 bombs, see them through a lidar of 2 x 10 bins.

Pure functions over N environments with O = 16 objects, apples first. Positions in m, angles in rad.
"""

from dataclasses import dataclass
from typing import Any

import mujoco
import numba
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
        out = np.empty(len(speed))
        _penalise(speed, self.threshold, self.slope, self.bias, out)
        return out


@numba.njit(cache=True, error_model="numpy")
def _penalise(speed: np.ndarray, threshold: float, slope: float, bias: float, out: np.ndarray) -> None:
    """Write `VelocityPenalty` to out (N,)."""
    for i in range(len(speed)):
        out[i] = 0.0 if speed[i] <= threshold else bias + slope * (speed[i] - threshold)


@numba.njit(cache=True, error_model="numpy")
def _norm(velocity: np.ndarray, speed: np.ndarray) -> None:
    """Write the lengths of velocity (N, 3) to speed (N,)."""
    for i in range(len(speed)):
        vx, vy, vz = velocity[i, 0], velocity[i, 1], velocity[i, 2]
        speed[i] = np.sqrt(vx * vx + vy * vy + vz * vz)


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
    assert objects.shape[:2] == present.shape == (len(com), NUM_OBJECTS)
    caught = np.empty(present.shape, bool)
    _catch(com, objects, present, caught)
    return caught


@numba.njit(cache=True, error_model="numpy")
def _in_reach(com: np.ndarray, objects: np.ndarray, i: int, o: int) -> bool:
    """Whether object o of robot i is near enough to be caught."""
    dx, dy = objects[i, o, 0] - com[i, 0], objects[i, o, 1] - com[i, 1]
    return dx * dx + dy * dy < CATCH_DISTANCE**2


@numba.njit(cache=True, error_model="numpy")
def _catch(com: np.ndarray, objects: np.ndarray, present: np.ndarray, caught: np.ndarray) -> None:
    """Write `catch` to caught (N, O) bool."""
    for i in range(len(com)):
        for o in range(NUM_OBJECTS):
            caught[i, o] = present[i, o] and _in_reach(com, objects, i, o)


def lidar(com: np.ndarray, yaw: np.ndarray, objects: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Readings 1 - d / 6 of the nearest object per bin and type, 0 where there is none in range.

    Bins go counter-clockwise; bin 0 starts straight behind the robot, and an object exactly behind belongs to the last
    bin. Types do not hide each other.

    Args:
        com: (N, 2). yaw: (N,). objects: (N, O, 2). present: (N, O) bool.

    Returns:
        (N, 20): ten apple bins, ten bomb bins.
    """
    assert objects.shape[:2] == present.shape == (len(com), NUM_OBJECTS)
    out = np.zeros((len(com), 2 * NUM_BINS))
    _lidar(com, yaw, objects, present, out)
    return out


@numba.njit(cache=True, error_model="numpy")
def _lidar(com: np.ndarray, yaw: np.ndarray, objects: np.ndarray, present: np.ndarray, out: np.ndarray) -> None:
    """Write `lidar` to out (N, 20), which holds zeros."""
    for i in range(len(com)):
        for o in range(NUM_OBJECTS):
            dx, dy = objects[i, o, 0] - com[i, 0], objects[i, o, 1] - com[i, 1]
            reading = 1 - np.sqrt(dx * dx + dy * dy) / SENSOR_RANGE
            if not (present[i, o] and reading > 0):
                continue
            # Only the bin depends on this arctan2, so another last bit of it than numpy's would not show in a reading.
            turn = (np.arctan2(dy, dx) - yaw[i] + np.pi) % (2 * np.pi)
            slot = NUM_BINS - 1
            if 0 < turn < 2 * np.pi:
                slot = min(int(turn * (NUM_BINS / (2 * np.pi))), NUM_BINS - 1)
            if o >= NUM_APPLES:
                slot += NUM_BINS
            out[i, slot] = max(out[i, slot], reading)


def dead(z: np.ndarray) -> np.ndarray:
    """Whether an Ant at height z (N,) in m is: too low, too high or nowhere."""
    out = np.empty(len(z), bool)
    _dead(z, out)
    return out


@numba.njit(cache=True, error_model="numpy")
def _is_dead(z: float) -> bool:
    return not 0.3 <= z <= 1.0  # NaN compares false


@numba.njit(cache=True, error_model="numpy")
def _dead(z: np.ndarray, out: np.ndarray) -> None:
    """Write `dead` to out (N,) bool."""
    for i in range(len(z)):
        out[i] = _is_dead(z[i])


@numba.njit(cache=True, error_model="numpy")
def _collect(
    com: np.ndarray,
    z: np.ndarray,
    is_mortal: bool,
    objects: np.ndarray,
    present: np.ndarray,
    for_objects: np.ndarray,
    for_death: np.ndarray,
    reward: np.ndarray,
    terminated: np.ndarray,
) -> None:
    """One step of the task: take what is caught from present (N, O), write what is paid for what, and the ends (N,).

    com (N, 2), z (N,) heights at which mortal robots may be dead: that costs DEATH_REWARD and nothing else is paid.
    """
    for i in range(len(com)):
        for_objects[i], for_death[i], terminated[i] = 0.0, 0.0, True
        for o in range(NUM_OBJECTS):
            if present[i, o] and _in_reach(com, objects, i, o):
                for_objects[i] += VALUE[o]
                present[i, o] = False
            elif present[i, o]:
                terminated[i] = False
        if is_mortal and _is_dead(z[i]):
            for_objects[i], for_death[i], terminated[i] = 0.0, DEATH_REWARD, True
        reward[i] = for_objects[i] + for_death[i]


class Gather:
    """Apples and bombs of N simulations, and what they pay."""

    pays_for_speed = False

    def __init__(self, robot: Robot, options: Any, num_envs: int) -> None:
        self.robot, self.num_envs = robot, num_envs
        self.cells = cells(options.grid)
        self.penalty = PENALTIES[robot.name] if options.velocity_penalty else None
        self.position, self.is_mortal = options.position, robot.name == "ant"
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
        self.com, self.z = physics.com[:, :2], physics.qpos[:, 2]
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
        N = self.num_envs
        for_objects, for_death, reward, terminated = np.empty(N), np.empty(N), np.empty(N), np.empty(N, bool)
        state, paid = (self.com, self.z, self.is_mortal, self.objects, self.present), (for_objects, for_death, reward)
        _collect(*state, *paid, terminated)
        terms = {"reward_objects": for_objects}
        if self.is_mortal:
            terms["reward_death"] = for_death
        if self.penalty is not None:
            assert self.com_velocity is not None
            speed = np.empty(N)
            _norm(self.com_velocity, speed)
            terms["velocity_penalty"] = self.penalty(speed)
            reward -= terms["velocity_penalty"]
        return reward, terminated, terms

    def observe(self) -> np.ndarray:
        """(N, 20) lidar readings, then with `position` the torso's x and y."""
        readings = self.readings()
        return np.concatenate([readings, self.physics.qpos[:, :2]], 1) if self.position else readings

    def readings(self) -> np.ndarray:
        """(N, 20) lidar readings."""
        assert self.robot.yaw is not None
        return lidar(self.com, self.robot.yaw(self.physics.qpos), self.objects, self.present)

    @property
    def state(self) -> dict[str, np.ndarray]:
        """The arrays that a continuation needs."""
        return {"objects": self.objects, "present": self.present}
