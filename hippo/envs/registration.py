"""The environments by name: robot, task, horizon, and which options each of them has."""

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from hippo.envs.blocks import Blocks
from hippo.envs.gather import Gather
from hippo.envs.locomote import SURVIVAL, Locomotion
from hippo.envs.perturb import PERTURBATIONS, STRENGTHS
from hippo.envs.robots import ROBOTS
from hippo.envs.vector import RobotTaskEnv


def option(default: Any, doc: str) -> Any:
    """A field of Options with its meaning."""
    return dataclasses.field(default=default, metadata={"doc": doc})


@dataclass
class Options:
    """Every option of an environment, at its default; the paper's choice unless its meaning says otherwise."""

    physics: str = option("paper", "fast (ours): the same robot with a cheaper integrator")
    observation: str = option("paper", "Snake: ego leaves out absolute x, y and the centre of mass")
    perturbation: str | None = option(None, "one quantity of the dynamics changed, for Table 1")
    strength: str = option("original", "what a perturbation changes: the authors' elements, or all (ours)")
    velocity_penalty: bool = option(False, "Gather: penalise the centre of mass's speed, for Fig. 6")
    grid: str = option("original", "Gather: symmetric (ours) also places objects at +6 m")
    walls: bool = option(False, "Snake Gather (ours): the arena's walls hold the Snake; they always hold the Ant")
    position: bool = option(False, "Gather: append the torso's absolute x, y to the observation, for HIRO (Fig. 7)")
    terminate_on_fall: bool = option(False, "Block: rllab's conditions; the paper names none")


@dataclass(frozen=True)
class Environment:
    """One named environment."""

    robot: str
    task: Any
    horizon: int  # steps
    revision: int  # bumped when golden trajectories change
    options: dict[str, tuple[Any, ...]]  # option -> valid values

    @property
    def pays(self) -> bool:
        """Whether there is any reward."""
        return self.task is not Locomotion or self.robot in SURVIVAL


_SHARED = {"perturbation": (None, *PERTURBATIONS), "strength": STRENGTHS}
_SWITCH = (False, True)
_ALONE = _SHARED  # the robots without a task, for the pre-training of skills
_GATHER = _SHARED | {
    "velocity_penalty": _SWITCH,
    "position": _SWITCH,
    "grid": ("original", "symmetric"),
    "physics": ("paper", "fast"),
}
_BLOCK = _SHARED | {"terminate_on_fall": _SWITCH, "physics": ("paper",), "observation": ("paper",)}

ENVIRONMENTS = {
    "ant_gather": Environment("ant", Gather, 5000, 1, _GATHER | {"observation": ("paper",)}),
    "snake_gather": Environment(
        "snake", Gather, 8000, 1, _GATHER | {"observation": ("paper", "ego"), "walls": _SWITCH}
    ),
    "block_hopper": Environment("hopper", Blocks, 1000, 1, _BLOCK),
    "block_half_cheetah": Environment("half_cheetah", Blocks, 1000, 1, _BLOCK),
    "ant": Environment("ant", Locomotion, 400, 1, _ALONE | {"observation": ("paper",), "physics": ("paper", "fast")}),
    "snake": Environment(
        "snake", Locomotion, 400, 1, _ALONE | {"observation": ("paper", "ego"), "physics": ("paper", "fast")}
    ),
    "hopper": Environment("hopper", Locomotion, 1000, 1, _ALONE | {"observation": ("paper",), "physics": ("paper",)}),
    "half_cheetah": Environment(
        "half_cheetah", Locomotion, 1000, 1, _ALONE | {"observation": ("paper",), "physics": ("paper",)}
    ),
}


def make(
    name: str,
    num_envs: int,
    seed: int,
    num_threads: int = 1,
    horizon: int | None = None,
    autoreset: bool = True,
    **options: Any,
) -> RobotTaskEnv:
    """Build a vector environment.

    Args:
        name: a key of ENVIRONMENTS. num_envs: simulations. seed: environment i draws from `seed + i`.
        num_threads: that MuJoCo steps on; results do not depend on it.
        horizon: steps to truncation instead of the environment's own. autoreset: whether ended episodes are followed
        by new ones in the same step. options: fields of Options.

    Raises:
        ValueError: a name, option or value that does not exist; the message names it and the valid ones.
    """
    if name not in ENVIRONMENTS:
        raise ValueError(f"env={name}: must be one of {', '.join(ENVIRONMENTS)}")
    environment = ENVIRONMENTS[name]
    horizon = environment.horizon if horizon is None else horizon
    for key, number in (("num_envs", num_envs), ("horizon", horizon), ("num_threads", num_threads)):
        if isinstance(number, bool) or not isinstance(number, int) or number < 1:
            raise ValueError(f"{key}={number}: must be an integer of at least 1")
    for key, value in options.items():
        check_option(name, key, value)
    return RobotTaskEnv(
        ROBOTS[environment.robot],
        environment.task,
        dataclasses.replace(Options(), **options),
        num_envs,
        seed,
        horizon,
        environment.revision,
        num_threads,
        autoreset,
    )


def gymnasium_id(name: str) -> str:
    """The id for `gymnasium.make`, e.g. hippo/AntGather-v0; its version counts revisions of the golden trajectories."""
    return f"hippo/{name.title().replace('_', '')}-v{ENVIRONMENTS[name].revision - 1}"


def make_single(name: str, render_mode: str | None = None, **options: Any) -> Any:
    """The environment as a gymnasium.Env; arguments as `make`. Unseeded resets start from the machine's entropy."""
    from hippo.envs.single import SingleEnv

    return SingleEnv(make(name, 1, entropy(), autoreset=False, **options), render_mode)


def make_several(name: str, num_envs: int = 1, render_mode: str | None = None, **options: Any) -> RobotTaskEnv:
    """The environment as a gymnasium.vector.VectorEnv, for `gymnasium.make_vec`; arguments as `make`.

    Raises:
        ValueError: a render mode; a single environment renders.
    """
    if render_mode is not None:
        raise ValueError(f"render_mode={render_mode}: a vector environment has none; use gymnasium.make")
    return make(name, num_envs, entropy(), **options)


def entropy() -> int:
    """A fresh seed."""
    return int(np.random.SeedSequence().generate_state(1)[0])


def register() -> None:
    """Make every environment known to Gymnasium."""
    for name in ENVIRONMENTS:
        gym.register(
            gymnasium_id(name),
            entry_point=functools.partial(make_single, name),
            vector_entry_point=functools.partial(make_several, name),
        )


def check_option(name: str, key: str, value: Any) -> None:
    """Raise ValueError unless `key` is an option of environment `name` and `value` one of its values."""
    valid = ENVIRONMENTS[name].options
    if key not in valid:
        raise ValueError(f"{key}={value}: {name} has no such option; its options are {', '.join(valid)}")
    if value not in valid[key] or isinstance(value, bool) != isinstance(valid[key][0], bool):
        raise ValueError(f"{key}={value}: {name} takes one of {', '.join(map(str, valid[key]))}")
