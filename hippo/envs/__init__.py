"""The environments: numpy, MuJoCo and Gymnasium, no learning library."""

import hippo.envs.surroundings  # noqa: F401, I001  before MuJoCo is imported

from hippo.envs.registration import ENVIRONMENTS, environment, gymnasium_id, make, register

__all__ = ["ENVIRONMENTS", "environment", "gymnasium_id", "make"]

register()
