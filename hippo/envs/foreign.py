"""Any environment that is registered with Gymnasium, as the learners here want it: `gym:<id>`.

Observations become one row of numbers, actions lie in [-1, 1], and an episode that ends is followed by a new one in the
same step, its last observation in `info["final_obs"]`. What cannot be had so is refused by name.
"""

import dataclasses
import difflib
import functools
import importlib
import importlib.util
import json
import warnings
from dataclasses import dataclass
from importlib.metadata import packages_distributions, version
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from hippo.envs.arguments import Refused, option
from hippo.envs.layout import Layout, layout_of_spaces, line_of

PREFIX = "gym:"
# Packages that register environments when they are imported: module -> what is installed, and how its ids begin.
PACKAGES = {
    "gymnasium_robotics": ("gymnasium-robotics", ("Ant", "Point", "Fetch", "Hand", "Adroit", "Franka")),
    "ale_py": ("ale-py", ("ALE/",)),
    "minigrid": ("minigrid", ("MiniGrid-", "BabyAI-")),
}
REVISION = 1  # bumped when what is made of an environment here changes


class EnvironmentFault(RuntimeError):
    """An environment did what none may do: the message says which, where and when."""


@dataclass
class ForeignOptions:
    """What an environment of Gymnasium's registry can be told."""

    kwargs: dict[str, Any] = option({}, "gym: arguments of the environment, as {name: value, ...}")
    skill_view: str = option("", "gym: what skills see, entries a:b or names separated by commas; empty: everything")


OPTIONS = tuple(field.name for field in dataclasses.fields(ForeignOptions))


def is_foreign(name: str) -> bool:
    """Whether an environment is one of Gymnasium's registry, by its name here."""
    return name.startswith(PREFIX)


def find(name: str) -> EnvSpec:
    """What is registered under `gym:<id>`; `gym:<module>:<id>` imports the module first, as Gymnasium does.

    Raises:
        Refused: nothing is; the message says which ids are near, or what has to be installed.
    """
    module, _, plain = name.removeprefix(PREFIX).rpartition(":")
    try:
        if module:
            importlib.import_module(module)
        else:
            _register(plain)
        with warnings.catch_warnings():  # of an old version
            warnings.simplefilter("ignore")
            return gym.spec(plain)
    except ImportError as error:
        raise Refused("env", name, str(error)) from error
    except gym.error.Error as error:
        raise Refused("env", name, _instead(plain)) from error


def _register(plain: str) -> None:
    """Import the package that registers the id, if it is none of Gymnasium's own and one of PACKAGES has it."""
    for module, (_, beginnings) in PACKAGES.items():
        if plain not in gym.registry and plain.startswith(beginnings) and importlib.util.find_spec(module):
            gym.register_envs(importlib.import_module(module))


def _instead(plain: str) -> str:
    """What to do about an id that is not registered."""
    near = difflib.get_close_matches(plain, gym.registry, n=3)
    if near:
        return f"no such id is registered; did you mean {', '.join(near)}?"
    for module, (package, beginnings) in PACKAGES.items():
        if plain.startswith(beginnings) and importlib.util.find_spec(module) is None:
            return f"no such id is registered; if it is of {package}: pip install {package}"
    return "no such id is registered; that of a package of your own is gym:<module>:<id>"


def package(spec: EnvSpec) -> str:
    """The package that an environment comes from and its version; the module alone where it is in none."""
    entry = spec.entry_point or spec.vector_entry_point
    module = entry.split(":")[0] if isinstance(entry, str) else str(getattr(entry, "__module__", ""))
    found = _distributions().get(module.split(".")[0])
    return f"{found[0]} {version(found[0])}" if found else module


@functools.cache
def _distributions() -> Any:
    return packages_distributions()


def check(name: str, options: dict[str, Any]) -> dict[str, Any]:
    """`options` of `gym:<id>` if it can be made with them and has spaces that can be learnt in.

    Raises:
        Refused: it is not so, or there is no such option.
    """
    for key in options:
        if key not in OPTIONS:
            raise Refused(key, options[key], f"{name} has no such option; its options are {', '.join(OPTIONS)}")
    layout_of(name, options)
    return options


def layout_of(name: str, options: dict[str, Any]) -> Layout:
    """The layout of `gym:<id>` with `options`, for which one is made and looked at; Refused where that fails."""
    return _layout(name, json.dumps(options.get("kwargs", {}), sort_keys=True), options.get("skill_view", ""))


@functools.cache
def _layout(name: str, kwargs: str, skill_view: str) -> Layout:
    spec = find(name)
    try:
        if spec.entry_point is None:
            env: Any = gym.make_vec(spec, 1, **json.loads(kwargs))
            observation, action = env.single_observation_space, env.single_action_space
        else:
            env = gym.make(spec, disable_env_checker=True, **json.loads(kwargs))
            observation, action = env.observation_space, env.action_space
        env.close()
    except gym.error.DependencyNotInstalled as error:
        raise Refused("env", name, str(error)) from error
    except Exception as error:  # whatever a constructor makes of its arguments
        if json.loads(kwargs):
            raise Refused("kwargs", kwargs, f"{name} does not take them ({line_of(error)})") from error
        raise Refused("env", name, f"cannot be made ({line_of(error)})") from error
    return layout_of_spaces(name, observation, action, skill_view)


class _Silent(gym.Wrapper):
    """The same environment without `info`, which would be gathered at every step and read by nobody."""

    def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
        return self.env.reset(**arguments)[0], {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        return *self.env.step(action)[:4], {}


class GymnasiumEnv(gym.vector.VectorEnv):
    """Somebody's vector environment as the learners here want it; an end wins over a time limit.

    Args:
        envs: begins a new episode in the step that ends one (SAME_STEP). layout: of its spaces. name: in messages.
        seed: of the first reset if that is given none; environment i starts from `seed + i`. skill_view: `layout`'s.

    Raises:
        Refused: it begins episodes in another way.
    """

    def __init__(
        self, envs: gym.vector.VectorEnv, layout: Layout, name: str, seed: int | None = None, skill_view: str = ""
    ) -> None:
        mode = envs.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise Refused("env", name, f"its vector environment resets by {mode}; needed is {AutoresetMode.SAME_STEP}")
        self.envs, self.layout, self.metadata, self.num_envs = envs, layout, envs.metadata, envs.num_envs
        self.robot_name, self.observation_variant = name, skill_view
        self.robot_size, self.observation_names = layout.view, list(layout.names)
        bound = np.full(len(layout.order), np.inf, np.float32)
        self.single_observation_space = gym.spaces.Box(-bound, bound, dtype=np.float32)
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (len(layout.half),), np.float32)
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, self.num_envs)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, self.num_envs)
        self._first_seed = seed
        self._clock = np.zeros(self.num_envs, np.int64)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start new episodes, from `seed + i` if one is given.

        Args:
            options: the environment's own. There is no layout here that `layout_seed` could fix.
        """
        options = {key: value for key, value in (options or {}).items() if key != "layout_seed"}
        seed, self._first_seed = self._first_seed if seed is None else seed, None
        observation, _ = self.envs.reset(seed=seed, options=options or None)
        self._clock[:] = 0
        obs = self.layout.rows(observation, self.num_envs)
        self._check("observation", np.isfinite(obs).all(1))
        return obs, {"diverged": np.zeros(self.num_envs, bool)}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of every environment; actions (N, A) are clipped to [-1, 1] and scaled to the action's range.

        Raises:
            EnvironmentFault: an observation or a reward is not finite.
        """
        observation, reward, terminated, truncated, info = self.envs.step(self.layout.scaled(actions))
        self._clock += 1
        obs, reward = self.layout.rows(observation, self.num_envs), np.asarray(reward, np.float64)
        self._check("observation", np.isfinite(obs).all(1))
        self._check("reward", np.isfinite(reward))
        truncated = truncated & ~terminated
        done = terminated | truncated
        told: dict[str, Any] = {"diverged": np.zeros(self.num_envs, bool)}
        if done.any():
            final = obs.copy()
            for i in np.flatnonzero(done).tolist():
                final[i] = self.layout.rows(_item(info["final_obs"], i), 1)[0]
            self._check("last observation", np.isfinite(final).all(1))
            told |= {"final_obs": final, "_final_obs": done}
            self._clock[done] = 0
        return obs, reward, terminated, truncated, told

    def _check(self, what: str, fine: np.ndarray) -> None:
        if not fine.all():
            i = int(np.flatnonzero(~fine)[0])
            when = f"at step {self._clock[i]}"
            raise EnvironmentFault(f"{self.robot_name}: {what} of environment {i} is not finite {when}")

    def frame(self, i: int) -> np.ndarray:
        """A picture (H, W, 3) of environment `i`, which must have been made to draw them."""
        return np.asarray(self.envs.render()[i])  # type: ignore[index]

    def close_extras(self, **_: Any) -> None:
        """Close the environments within."""
        self.envs.close()


def _item(batch: Any, i: int) -> Any:
    """Observation `i` of a batch, which holds arrays of observations or an array of them."""
    return {key: part[i] for key, part in batch.items()} if isinstance(batch, dict) else batch[i]


def make(
    name: str,
    num_envs: int,
    seed: int,
    horizon: int,
    kwargs: dict[str, Any] | None = None,
    skill_view: str = "",
    render_mode: str | None = None,
) -> GymnasiumEnv:
    """N environments of `gym:<id>`: its own vector environment where that is SAME_STEP, else N of the single one.

    Args:
        horizon: the time limit in steps. kwargs: arguments of the environment. skill_view: what skills see, "" for
        everything. render_mode: Gymnasium's.

    Raises:
        Refused: what `find` and `check` refuse.
    """
    layout = layout_of(name, {"kwargs": kwargs or {}, "skill_view": skill_view})
    spec, arguments = find(name), (kwargs or {}) | {"max_episode_steps": horizon}
    if render_mode is not None:
        arguments["render_mode"] = render_mode
    envs: gym.vector.VectorEnv | None = None
    if spec.vector_entry_point is not None:
        envs = gym.make_vec(spec, num_envs, **arguments)
        if envs.metadata.get("autoreset_mode") is not AutoresetMode.SAME_STEP and spec.entry_point is not None:
            envs.close()
            envs = None

    def single() -> gym.Env:
        return _Silent(gym.make(spec, disable_env_checker=True, **arguments))

    if envs is None:
        envs = SyncVectorEnv([single] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    return GymnasiumEnv(envs, layout, name, seed, skill_view)
