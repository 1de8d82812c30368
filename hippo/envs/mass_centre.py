"""The centre of mass of a robot from its joint positions, for integrators after which MuJoCo has it one step late.

MuJoCo's derived fields lag one physics step behind the state. Bringing them up to date costs nothing where the next
step goes on from there, but with RK4 it repeats the whole position stage, collisions included: a sixth of the step.
The centre of mass needs none of that: in the root's frame it is linear in a few products of sines and cosines of the
joint angles. The coefficients are read off MuJoCo itself, for whatever masses the model has.
"""

from collections.abc import Callable

import mujoco
import numba
import numpy as np

Features = Callable[[np.ndarray], np.ndarray]  # qpos (N, nq) -> (N, F)


def hopper_features(qpos: np.ndarray) -> np.ndarray:
    """A planar chain: its root and the sines and cosines of its links' absolute angles."""
    angles, out = np.empty((len(qpos), 4)), np.empty((len(qpos), 11))
    _absolute_angles(qpos, angles)
    _root_and_links(qpos, np.sin(angles), np.cos(angles), out)
    return out


@numba.njit(cache=True, error_model="numpy")
def _absolute_angles(qpos: np.ndarray, angles: np.ndarray) -> None:
    """Write the angles of torso, thigh, leg and foot to angles (N, 4); NaN for infinity, of which numpy would warn."""
    for i in range(len(qpos)):
        angle = qpos[i, 2]  # pitch about y, then thigh, leg and foot about -y
        for link in range(4):
            if link > 0:
                angle -= qpos[i, 2 + link]
            angles[i, link] = angle if np.isfinite(angle) else np.nan


@numba.njit(cache=True, error_model="numpy")
def _root_and_links(qpos: np.ndarray, sin: np.ndarray, cos: np.ndarray, out: np.ndarray) -> None:
    """Sines and cosines of the links' angles (N, 4) -> 1, the root's two coordinates, sines, cosines (N, 11)."""
    for i in range(len(qpos)):
        out[i, 0], out[i, 1], out[i, 2] = 1.0, qpos[i, 0], qpos[i, 1]
        for link in range(4):
            out[i, 3 + link] = sin[i, link]
            out[i, 7 + link] = cos[i, link]


def ant_features(qpos: np.ndarray) -> np.ndarray:
    """Four legs of a hip about the torso's z axis and an ankle about an axis across the leg."""
    angles, out = np.empty((len(qpos), 8)), np.empty((len(qpos), 21))
    _leg_angles(qpos, angles)
    _leg_products(np.sin(angles), np.cos(angles), out)
    return out


@numba.njit(cache=True, error_model="numpy")
def _leg_angles(qpos: np.ndarray, angles: np.ndarray) -> None:
    """Write hip, ankle, hip, ... to angles (N, 8); NaN for infinity, of which numpy would warn."""
    for i in range(len(qpos)):
        for joint in range(8):
            angle = qpos[i, 7 + joint]
            angles[i, joint] = angle if np.isfinite(angle) else np.nan


@numba.njit(cache=True, error_model="numpy")
def _leg_products(sin: np.ndarray, cos: np.ndarray, out: np.ndarray) -> None:
    """Sines and cosines of hip, ankle, hip, ... (N, 8) -> 1 and five products of each of the four legs (N, 21)."""
    for i in range(len(sin)):
        out[i, 0] = 1.0
        for leg in range(4):
            hip, ankle = 2 * leg, 2 * leg + 1
            out[i, 1 + leg] = sin[i, hip]
            out[i, 5 + leg] = cos[i, hip]
            out[i, 9 + leg] = sin[i, hip] * cos[i, ankle]
            out[i, 13 + leg] = cos[i, hip] * cos[i, ankle]
            out[i, 17 + leg] = sin[i, ankle]


class MassCentre:
    """Whole-robot centre of mass (N, 3) as a function of qpos (N, nq); exact to rounding.

    Args:
        features: of the joint positions, in which the centre of mass in the root's frame is linear.
        is_free: the root is a free joint (position, quaternion), which the features leave out.
    """

    def __init__(self, model: mujoco.MjModel, features: Features, is_free: bool) -> None:
        self.features, self.is_free = features, is_free
        data, rng = mujoco.MjData(model), np.random.default_rng(0)
        qpos = rng.uniform(-1, 1, (400, model.nq))
        if is_free:
            qpos[:, :7] = (0, 0, 0, 1, 0, 0, 0)
        centres = np.empty((len(qpos), 3))
        for row, centre in zip(qpos, centres, strict=True):
            data.qpos[:] = row
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            centre[:] = data.subtree_com[1]
        self.coefficients, *_ = np.linalg.lstsq(features(qpos), centres, rcond=None)
        error = np.abs(features(qpos) @ self.coefficients - centres).max()
        assert error < 1e-12, f"the features do not span the centre of mass: error {error}"

    def __call__(self, qpos: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """(N, nq) -> (N, 3), which is `out` if that is given."""
        out = np.dot(self.features(qpos), self.coefficients, out=out)
        if self.is_free:
            _to_world(qpos, out)
        return out


@numba.njit(cache=True, error_model="numpy")
def _to_world(qpos: np.ndarray, points: np.ndarray) -> None:
    """Carry points (N, 3) from the frames of free roots into the world's; qpos (N, 7 + ...).

    Position + v + 2 (w t + u x t) / |q|^2 with t = u x v, for quaternions q = (w, u) of any length.
    """
    for i in range(len(points)):
        w, x, y, z = qpos[i, 3], qpos[i, 4], qpos[i, 5], qpos[i, 6]
        a, b, c = points[i, 0], points[i, 1], points[i, 2]
        r, s, t = y * c - z * b, z * a - x * c, x * b - y * a
        square = w * w + x * x + y * y + z * z
        points[i, 0] = qpos[i, 0] + (a + 2 * (w * r + (y * t - z * s)) / square)
        points[i, 1] = qpos[i, 1] + (b + 2 * (w * s + (z * r - x * t)) / square)
        points[i, 2] = qpos[i, 2] + (c + 2 * (w * t + (x * s - y * r)) / square)
