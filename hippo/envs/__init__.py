"""The environments: numpy, MuJoCo and Gymnasium, no learning library."""

from hippo.envs.registration import ENVIRONMENTS, make

__all__ = ["ENVIRONMENTS", "make"]
