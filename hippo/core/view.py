"""What skills see of the robot that is free of where it stands and where it faces (`skill_observation=ego`).

Pre-training starts every path at the origin and facing along x. What only says where a path has got to (x, y, com_x,
com_y, a heading) means nothing to a skill elsewhere: it is left out, and what depends on the heading is turned by it,
as if the robot faced along x. Pitch and height stay: gravity knows them. The entries are told by their names.
"""

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from hippo.core.settings import ConfigError

ABSOLUTE = ("x", "y", "com_x", "com_y")  # entries that say where in the plane the robot is
HEADING, QUATERNION, VELOCITY = "heading", "quat_w", ("x_velocity", "y_velocity")


class Ego:
    """The view of a robot whose observation has these entries: observations (..., D) -> (..., size).

    A quaternion keeps four entries, of the same pose facing along x, with quat_w at least 0.
    """

    def __init__(self, names: Sequence[str]) -> None:
        own = list(names)
        self.heading = own.index(HEADING) if HEADING in own else -1
        self.quaternion = own.index(QUATERNION) if QUATERNION in own else -1
        self.velocity = own.index(VELOCITY[0]) if set(VELOCITY) <= set(own) else -1
        self.kept = np.array([i for i, name in enumerate(own) if name not in (*ABSOLUTE, HEADING)])
        assert self.velocity < 0 or own[self.velocity + 1] == VELOCITY[1]

    @property
    def size(self) -> int:
        """Entries that are seen."""
        return len(self.kept)

    def of_array(self, obs: np.ndarray) -> np.ndarray:
        """(N, D) -> (N, size)."""
        turned = obs.copy()
        if self.heading >= 0 or self.quaternion >= 0:
            _turn(turned, self.heading, self.quaternion, self.velocity)
        return turned[:, self.kept]

    def __call__(self, obs: Tensor) -> Tensor:
        """(..., D) -> (..., size), without gradients."""
        rows = obs.detach().reshape(-1, obs.shape[-1]).numpy()
        return torch.from_numpy(self.of_array(rows)).view(*obs.shape[:-1], self.size)


@numba.njit(cache=True, error_model="numpy")
def _turn(obs: np.ndarray, heading: int, quaternion: int, velocity: int) -> None:
    """Turn rows of obs (N, D) back by their heading, in place; an index below 0 is an entry that there is none of."""
    for i in range(len(obs)):
        if heading >= 0:
            angle = obs[i, heading]
        else:
            q = quaternion
            w, x, y, z = obs[i, q], obs[i, q + 1], obs[i, q + 2], obs[i, q + 3]
            angle = np.arctan2(2 * (x * y + w * z), w * w + x * x - y * y - z * z)
            cos, sin = np.cos(angle / 2), np.sin(angle / 2)
            # The product of (cos, 0, 0, -sin), which turns back, and the pose; q and -q are one pose.
            w, x, y, z = cos * w + sin * z, cos * x + sin * y, cos * y - sin * x, cos * z - sin * w
            sign = -1.0 if w < 0 else 1.0
            obs[i, q], obs[i, q + 1], obs[i, q + 2], obs[i, q + 3] = sign * w, sign * x, sign * y, sign * z
        if velocity >= 0:
            cos, sin = np.cos(angle), np.sin(angle)
            vx, vy = obs[i, velocity], obs[i, velocity + 1]
            obs[i, velocity], obs[i, velocity + 1] = cos * vx + sin * vy, cos * vy - sin * vx


def check_view(skill_observation: str, layout: Any) -> None:
    """Raise ConfigError for the view ego in an environment of gym:<id>, which has a `layout`."""
    if skill_observation == "ego" and layout is not None:
        valid = "knows place and heading of ant, snake, hopper, half_cheetah; valid here: robot, full"
        raise ConfigError("skill_observation", "ego", valid)
