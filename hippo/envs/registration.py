"""The environments by name, with robot, task, horizon and options of each; any other of Gymnasium's as gym:<id>."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from hippo.envs import foreign
from hippo.envs.arguments import LARGEST_INT, LARGEST_LONG, Refused, autoreset_mode, natural, option, plain
from hippo.envs.blocks import Blocks
from hippo.envs.gather import Gather
from hippo.envs.locomote import SURVIVAL, Locomotion
from hippo.envs.perturb import PERTURBATIONS, STRENGTHS
from hippo.envs.robots import ROBOTS
from hippo.envs.vector import RobotTaskEnv


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
    terminate_on_tumble: bool = option(False, "Block (ours): a torso more than 1 rad from upright ends the episode")


@dataclass(frozen=True)
class Environment:
    """One named environment."""

    robot: str
    task: Any
    horizon: int  # steps; 0 where none is registered
    revision: int  # bumped when golden trajectories change
    options: dict[str, tuple[Any, ...]]  # option -> valid values, none where they are not listed
    package: str = ""  # of one of Gymnasium's: where it comes from, and its version

    @property
    def pays(self) -> bool:
        """Whether there is any reward."""
        return self.task is not Locomotion or self.robot in SURVIVAL


RENAMED = {"max_episode_steps": "horizon", "autoreset_mode": "autoreset"}  # Gymnasium's words, to whom they occur

_SHARED = {"perturbation": (None, *PERTURBATIONS), "strength": STRENGTHS}
_SWITCH = (False, True)
_ALONE = _SHARED  # the robots without a task, for the pre-training of skills
_GATHER = _SHARED | {
    "velocity_penalty": _SWITCH,
    "position": _SWITCH,
    "grid": ("original", "symmetric"),
    "physics": ("paper", "fast"),
}
_BLOCK = _SHARED | {
    "terminate_on_fall": _SWITCH,
    "terminate_on_tumble": _SWITCH,
    "physics": ("paper",),
    "observation": ("paper",),
}

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


def environment(name: str) -> Environment:
    """One of ENVIRONMENTS, or any that is registered with Gymnasium as `gym:<id>`.

    Raises:
        ValueError: there is no such environment; the message names it and the valid ones.
    """
    if foreign.is_foreign(name):
        spec = foreign.find(name)
        options: dict[str, tuple[Any, ...]] = dict.fromkeys(foreign.OPTIONS, ())
        horizon, package = spec.max_episode_steps or 0, foreign.package(spec)
        return Environment(name, None, horizon, foreign.REVISION, options, package)
    if name not in ENVIRONMENTS:
        raise Refused("env", name, f"must be one of {', '.join(ENVIRONMENTS)} or gym:<id>")
    return ENVIRONMENTS[name]


def make(
    name: str,
    num_envs: int,
    seed: int,
    num_threads: int = 1,
    horizon: int | None = None,
    autoreset: bool | str | gym.vector.AutoresetMode = True,
    render_mode: str | None = None,
    **options: Any,
) -> Any:
    """Build a vector environment, a RobotTaskEnv or for `gym:<id>` a GymnasiumEnv.

    Args:
        name: a key of ENVIRONMENTS or `gym:<id>`. num_envs: simulations. seed: environment i draws from `seed + i`.
        num_threads: that MuJoCo steps on, in ENVIRONMENTS; results do not depend on it.
        horizon: steps to truncation instead of the environment's own. autoreset: whether ended episodes are followed
        by new ones in the same step (True), when the caller resets them (False), or a mode of Gymnasium's by its value
        ("NextStep": in the next step). render_mode: Gymnasium's, of `gym:<id>` only.
        options: fields of Options. numpy's scalars count as Python's.

    Raises:
        ValueError: a name, option or value that does not exist; the message names it and the valid ones.
    """
    found = environment(name)
    options = check_options(name, options)
    num_envs, seed = natural("num_envs", num_envs, 1, LARGEST_INT), natural("seed", seed)
    horizon = natural("horizon", found.horizon if horizon is None else horizon, 1, LARGEST_LONG)
    if foreign.is_foreign(name):
        if autoreset_mode(autoreset) is not gym.vector.AutoresetMode.SAME_STEP:
            raise Refused("autoreset", autoreset, f"{name} has SameStep here; gymnasium.make_vec has the others")
        return foreign.make(name, num_envs, seed, horizon, render_mode=render_mode, **options)
    if render_mode is not None:
        raise Refused("render_mode", render_mode, "a vector environment has none; use gymnasium.make")
    return RobotTaskEnv(
        ROBOTS[found.robot],
        found.task,
        dataclasses.replace(Options(), **options),
        num_envs,
        seed,
        horizon,
        found.revision,
        natural("num_threads", num_threads, 1, LARGEST_INT),
        autoreset_mode(autoreset),
    )


def gymnasium_id(name: str) -> str:
    """The id for `gymnasium.make`, e.g. hippo/AntGather-v0; its version counts revisions of the golden trajectories."""
    return f"hippo/{name.title().replace('_', '')}-v{ENVIRONMENTS[name].revision - 1}"


def make_single(name: str, render_mode: str | None = None, seed: int | None = None, **options: Any) -> Any:
    """The environment as a gymnasium.Env, for `gymnasium.make`; arguments as `make`.

    The end of an episode is Gymnasium's TimeLimit, as for its own robots: `max_episode_steps` moves it. A shorter
    `horizon` ends it within. An unseeded environment starts from the machine's entropy.

    Raises:
        ValueError: what `make` refuses; what a single environment does not have; a horizon beyond the limit.
    """
    from hippo.envs.single import SingleEnv

    limit = ENVIRONMENTS[name].horizon
    for key, instead in (("num_envs", "gymnasium.make_vec makes several"), ("autoreset", "call reset()")):
        if key in options:
            raise Refused(key, options[key], f"gymnasium.make takes none; {instead}")
    options["horizon"] = LARGEST_LONG if options.get("horizon") is None else natural("horizon", options["horizon"], 1)
    if limit < options["horizon"] < LARGEST_LONG:
        raise Refused("horizon", options["horizon"], f"gymnasium.make ends it after {limit}; give max_episode_steps")
    return SingleEnv(make(name, 1, entropy() if seed is None else seed, autoreset=False, **options), render_mode)


def make_several(
    name: str,
    num_envs: int = 1,
    render_mode: str | None = None,
    seed: int | None = None,
    max_episode_steps: int | None = None,
    **options: Any,
) -> RobotTaskEnv:
    """The environment as a gymnasium.vector.VectorEnv, for `gymnasium.make_vec`; arguments as `make`.

    Args:
        max_episode_steps: Gymnasium's word for the horizon, which it always gives.

    Raises:
        ValueError: what `make` refuses; a render mode, since a single environment renders; two different horizons.
    """
    if max_episode_steps is not None:
        limit = natural("max_episode_steps", max_episode_steps, 1, LARGEST_LONG)
        horizon = options.setdefault("horizon", limit)
        if limit not in (ENVIRONMENTS[name].horizon, horizon):
            raise Refused("max_episode_steps", limit, f"is the horizon, which is given as {horizon}")
    return make(name, num_envs, entropy() if seed is None else seed, render_mode=render_mode, **options)


def entropy() -> int:
    """A fresh seed."""
    return int(np.random.SeedSequence().generate_state(1)[0])


def register() -> None:
    """Make every environment known to Gymnasium."""
    for name in ENVIRONMENTS:
        gym.register(
            gymnasium_id(name),
            entry_point=f"{__name__}:make_single",
            vector_entry_point=f"{__name__}:make_several",
            max_episode_steps=ENVIRONMENTS[name].horizon,
            kwargs={"name": name},
        )


def check_option(name: str, key: str, value: Any) -> Any:
    """`value` as option `key` of environment `name`, a Python value for numpy's; ValueError if it is none."""
    valid, value = ENVIRONMENTS[name].options, plain(value)
    if key not in valid:
        hint = RENAMED.get(key)
        instead = f"its name here is {hint}" if hint else f"its options are {', '.join(valid)}"
        raise Refused(key, value, f"{name} has no such option; {instead}")
    if not any(type(value) is type(one) and value == one for one in valid[key]):
        raise Refused(key, value, f"{name} takes one of {', '.join(map(str, valid[key]))}")
    return value


def check_options(name: str, options: dict[str, Any]) -> dict[str, Any]:
    """`options` of environment `name` as Python values; ValueError if one is none or, beside the others, idle."""
    if foreign.is_foreign(name):
        return foreign.check(name, options)
    options = {key: check_option(name, key, value) for key, value in options.items()}
    if options.get("strength", Options.strength) != Options.strength and options.get("perturbation") is None:
        raise Refused("strength", options["strength"], "changes nothing without a perturbation")
    return options
