"""What callers pass, read as what it means: numpy's scalars count as Python's, and what means nothing is refused."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

LARGEST_INT, LARGEST_LONG = 2**31 - 1, 2**63 - 1  # of MuJoCo's counts and of a clock in steps


class Refused(ValueError):
    """An environment or an option that cannot be had: the message names the key, the value and what is valid."""

    def __init__(self, key: str, value: object, valid: str) -> None:
        self.key, self.value, self.valid = key, value, valid
        super().__init__(f"{key}={value}: {valid}")


def option(default: Any, doc: str) -> Any:
    """A dataclass field for an option of an environment, with its meaning."""
    if isinstance(default, dict):
        return dataclasses.field(default_factory=lambda: dict(default), metadata={"doc": doc})
    return dataclasses.field(default=default, metadata={"doc": doc})


def plain(value: Any) -> Any:
    """A numpy scalar, or an array without dimensions, as the Python value it holds; anything else as it is."""
    return value.item() if isinstance(value, np.generic | np.ndarray) and value.ndim == 0 else value


def natural(name: str, value: Any, least: int = 0, largest: int | None = None, may_be_none: bool = False) -> Any:
    """`value` as an int within its limits (or None where that is allowed); Refused if it is none."""
    number = plain(value)
    if number is None and may_be_none:
        return None
    if isinstance(number, bool) or not isinstance(number, int) or number < least:
        raise Refused(name, value, f"must be an integer of at least {least}{' or None' if may_be_none else ''}")
    if largest is not None and number > largest:
        raise Refused(name, value, f"must be at most {largest}")
    return number


def seeds(seed: Any, num_envs: int) -> list[int | None]:
    """One seed per environment: `seed + i` for an integer, else its items, of which None goes on with the generator."""
    seed = plain(seed)
    if isinstance(seed, np.ndarray | Sequence):
        every = [natural("seed", s, may_be_none=True) for s in seed]
    else:
        first = natural("seed", seed)
        every = [first + i for i in range(num_envs)]
    if len(every) != num_envs:
        raise Refused("seed", seed, f"give one integer or {num_envs} of them")
    return every


def autoreset_mode(value: Any) -> AutoresetMode:
    """True is SAME_STEP, False DISABLED; Gymnasium's modes and their values count as themselves."""
    value = plain(value)
    if isinstance(value, bool):
        return AutoresetMode.SAME_STEP if value else AutoresetMode.DISABLED
    try:
        return AutoresetMode(value)
    except ValueError:
        valid = ", ".join(mode.value for mode in AutoresetMode)
        raise Refused("autoreset", value, f"must be one of True, False, {valid}") from None


def reset_ids(mask: Any, num_envs: int) -> np.ndarray:
    """The environments (n,) that a reset mask (N,) of bools names, of which there must be one."""
    array = np.asarray(mask)
    if array.dtype != bool or array.shape != (num_envs,) or not array.any():
        raise Refused("reset_mask", mask, f"must be {num_envs} bools, at least one of them true")
    return np.flatnonzero(array)


def real(actions: Any) -> np.ndarray:
    """A copy of `actions` as float64 in C order, whatever the caller's layout, since numba compiles for each."""
    array = np.asarray(actions)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"actions are of type {array.dtype}; expected real numbers")
    return np.array(array, np.float64, order="C")
