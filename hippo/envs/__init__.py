"""The environments: numpy, MuJoCo and Gymnasium, no learning library."""

from hippo.envs.registration import ENVIRONMENTS, gymnasium_id, make, register

__all__ = ["ENVIRONMENTS", "gymnasium_id", "make"]

register()
