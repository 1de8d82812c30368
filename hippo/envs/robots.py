"""The four robots: their model files, time steps and what they observe of themselves.

Numbers are those of the authors' code (rllab's models); assets/*.xml hold bodies, joints and actuators.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numba
import numpy as np

from hippo.envs.mass_centre import Features, ant_features, hopper_features

ASSETS = Path(__file__).parent / "assets"
POSITION, VELOCITY, ANGLE = 1e3, 1e3, 1e3  # finite bounds of an observation: m, m/s or rad/s, rad


@dataclass(frozen=True)
class Quantity:
    """A slice of the robot's state in an observation."""

    source: str  # "qpos", "qvel" or "com" (whole-robot centre of mass)
    index: tuple[int, ...]
    names: tuple[str, ...]  # one per entry
    units: tuple[str, ...]
    bound: tuple[float, ...]  # symmetric bound per entry


@dataclass(frozen=True)
class Timing:
    """One control step: `frame_skip` steps of `timestep` seconds with an integrator."""

    integrator: mujoco.mjtIntegrator
    timestep: float
    frame_skip: int


@dataclass(frozen=True)
class Robot:
    """A robot and its variants."""

    name: str
    num_qpos: int
    paper: Timing
    fast: Timing | None  # a cheaper integrator, ours; None where the paper's is already cheap
    observations: dict[str, tuple[Quantity, ...]]  # variant -> what is observed; the first is the default
    yaw: Callable[[np.ndarray], np.ndarray] | None  # qpos (N, nq) -> heading (N,) in rad, where a task needs it
    com_features: Features | None = None  # see mass_centre.py; where the integrator makes MuJoCo's own slow to ask for

    def spec(self, physics: str) -> mujoco.MjSpec:
        """The editable model with the time step of `physics`, "paper" or "fast"."""
        spec = mujoco.MjSpec.from_file(str(ASSETS / f"{self.name}.xml"))
        timing = self.timing(physics)
        spec.option.integrator, spec.option.timestep = timing.integrator, timing.timestep
        return spec

    def timing(self, physics: str) -> Timing:
        """The control step under `physics`."""
        if physics == "fast" and self.fast is not None:
            return self.fast
        return self.paper


def quaternion_yaw(qpos: np.ndarray) -> np.ndarray:
    """Direction of the body's x axis in the plane from the quaternion (w, x, y, z) in qpos[:, 3:7]; (N,) rad."""
    yaw = np.empty(len(qpos))
    _quaternion_yaw(qpos, yaw)
    return yaw


def first_heading(qpos: np.ndarray) -> np.ndarray:
    """Direction of the first link of a planar chain: qpos[:, 2], (N,) rad."""
    return qpos[:, 2]


@numba.njit(cache=True, error_model="numpy")
def _quaternion_yaw(qpos: np.ndarray, yaw: np.ndarray) -> None:
    """Write `quaternion_yaw` to yaw (N,)."""
    for i in range(len(qpos)):
        w, x, y, z = qpos[i, 3], qpos[i, 4], qpos[i, 5], qpos[i, 6]
        yaw[i] = np.arctan2(2 * (x * y + w * z), w * w + x * x - y * y - z * z)


def _quantity(source: str, index: range | tuple[int, ...], names: str, unit: str, bound: float) -> Quantity:
    labels = tuple(names.split())
    assert len(labels) == len(tuple(index))
    return Quantity(source, tuple(index), labels, (unit,) * len(labels), (bound,) * len(labels))


def _velocities(names: str) -> Quantity:
    labels = tuple(f"{name}_velocity" for name in names.split())
    n = len(labels)
    return Quantity("qvel", tuple(range(n)), labels, ("m/s or rad/s",) * n, (VELOCITY,) * n)


COM = _quantity("com", range(3), "com_x com_y com_z", "m", POSITION)
ANT_JOINTS = "hip_1 ankle_1 hip_2 ankle_2 hip_3 ankle_3 hip_4 ankle_4"
SNAKE_JOINTS = "rot2 rot3 rot4 rot5"
CHEETAH_JOINTS = "bthigh bshin bfoot fthigh fshin ffoot"

EULER, RK4, IMPLICIT = (
    mujoco.mjtIntegrator.mjINT_EULER,
    mujoco.mjtIntegrator.mjINT_RK4,
    mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
)

ANT = Robot(
    "ant",
    15,
    Timing(RK4, 0.01, 1),
    Timing(IMPLICIT, 0.01, 1),
    {
        "paper": (
            _quantity("qpos", (2,), "z", "m", POSITION),
            _quantity("qpos", range(3, 7), "quat_w quat_x quat_y quat_z", "1", 1.0),
            _quantity("qpos", range(7, 15), ANT_JOINTS, "rad", ANGLE),
            _velocities(f"x y z roll pitch yaw {ANT_JOINTS}"),
        )
    },
    quaternion_yaw,
    ant_features,
)
SNAKE = Robot(
    "snake",
    7,
    Timing(EULER, 0.001, 50),
    Timing(IMPLICIT, 0.005, 10),
    {
        "paper": (
            _quantity("qpos", range(2), "x y", "m", POSITION),
            _quantity("qpos", range(2, 7), f"heading {SNAKE_JOINTS}", "rad", ANGLE),
            _velocities(f"x y heading {SNAKE_JOINTS}"),
            COM,
        ),
        "ego": (
            _quantity("qpos", range(2, 7), f"heading {SNAKE_JOINTS}", "rad", ANGLE),
            _velocities(f"x y heading {SNAKE_JOINTS}"),
        ),
    },
    first_heading,
)
HOPPER = Robot(
    "hopper",
    6,
    Timing(RK4, 0.02, 1),
    None,
    {
        "paper": (
            _quantity("qpos", (0,), "z", "m", POSITION),
            _quantity("qpos", (2, 3, 4, 5), "pitch thigh leg foot", "rad", ANGLE),
            _velocities("z x pitch thigh leg foot"),
            COM,
        )
    },
    None,
    hopper_features,
)
HALF_CHEETAH = Robot(
    "half_cheetah",
    9,
    Timing(EULER, 0.01, 5),
    None,
    {
        "paper": (
            _quantity("qpos", (1,), "z", "m", POSITION),
            _quantity("qpos", range(2, 9), f"pitch {CHEETAH_JOINTS}", "rad", ANGLE),
            _velocities(f"x z pitch {CHEETAH_JOINTS}"),
            COM,
        )
    },
    None,
)
ROBOTS = {robot.name: robot for robot in (ANT, SNAKE, HOPPER, HALF_CHEETAH)}
