"""How observations and actions of any Gymnasium environment become flat arrays with names."""

import functools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from hippo.envs.arguments import Refused


@dataclass(frozen=True)
class Layout:
    """What an environment's observations and actions are, and how rows of numbers become of them.

    A row holds the entries in `order` of the flattened observation: what skills see, then the rest.
    """

    keys: Sequence[str]  # parts of a Dict observation as they are flattened; empty for a Box
    sizes: Sequence[int]  # entries of every part, or of the Box
    flat: Sequence[str]  # names of the flattened observation's entries
    order: Sequence[int]  # (D,) which of them each entry of a row is
    view: int  # how many entries of a row skills see
    middle: Sequence[float]  # (A,) of the action's range
    half: Sequence[float]  # (A,) half of its width
    dtype: str  # of actions

    @functools.cached_property
    def names(self) -> list[str]:
        """(D,) of the entries of a row."""
        return [self.flat[i] for i in self.order]

    @functools.cached_property
    def _order(self) -> np.ndarray:
        return np.array(self.order)

    @functools.cached_property
    def _range(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array(self.middle), np.array(self.half)

    def find(self, key: str, text: str) -> list[int]:
        """Where in a row the entries stand that `text`, the value of `key`, lists as `skill_view` does.

        Raises:
            Refused: it lists none, or some that do not exist.
        """
        return [self.order.index(i) for i in _entries(key, text or "nothing", self.flat)]

    def rows(self, observation: Any, count: int) -> np.ndarray:
        """(count, D) float32 of a batch of observations."""
        parts = [observation[key] for key in self.keys] if self.keys else [observation]
        flat = np.concatenate([np.asarray(part).reshape(count, -1) for part in parts], 1)
        return flat[:, self._order].astype(np.float32)

    def scaled(self, actions: np.ndarray) -> np.ndarray:
        """Actions (N, A), clipped to [-1, 1], in the environment's range."""
        middle, half = self._range
        return (middle + half * np.clip(actions, -1, 1)).astype(self.dtype)


def layout_of_spaces(name: str, observation: gym.Space, action: gym.Space, skill_view: str = "") -> Layout:
    """How rows are made of these spaces; Refused, under `name`, where it cannot be done."""
    parts = list(_parts(name, observation))
    flat = [f"{key}[{i}]" for key, size in parts for i in range(size)]
    seen = _entries("skill_view", skill_view, flat) or list(range(len(flat)))
    low, high = _action_range(name, action)
    return Layout(
        tuple(key for key, _ in parts) if isinstance(observation, gym.spaces.Dict) else (),
        tuple(size for _, size in parts),
        tuple(flat),
        (*seen, *(i for i in range(len(flat)) if i not in set(seen))),
        len(seen),
        tuple(((high + low) / 2).tolist()),
        tuple(((high - low) / 2).tolist()),
        str(action.dtype),
    )


def line_of(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def _parts(name: str, space: gym.Space) -> Any:
    """(key, entries) of every part of an observation in the order in which it is flattened, that of its Dict."""
    for key, part in space.spaces.items() if isinstance(space, gym.spaces.Dict) else [("observation", space)]:
        if not isinstance(part, gym.spaces.Box) or len(part.shape) != 1:
            what = part if isinstance(space, gym.spaces.Dict) else type(part).__name__
            valid = "valid are Boxes of one dimension and Dicts of them"
            raise Refused("env", name, f"observes {what}; {valid}")
        yield key, int(np.prod(part.shape))


def _action_range(name: str, space: gym.Space) -> tuple[np.ndarray, np.ndarray]:
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
        raise Refused("env", name, f"acts in {space}; policies here act in a Box of one dimension")
    if not np.isfinite([space.low, space.high]).all():
        raise Refused("env", name, f"acts in {space}; valid are bounded actions (gymnasium.wrappers.RescaleAction)")
    return space.low.astype(np.float64), space.high.astype(np.float64)


def _entries(key: str, text: str, names: Sequence[str]) -> list[int]:
    """Which of `names` a list like `0:27,30,goal,goal[1]` means: places, slices, parts and names; none for ""."""
    found: list[int] = []
    for word in filter(None, text.replace(" ", "").split(",")):
        number = re.fullmatch(r"(\d+)(?::(\d+))?", word)
        if number:
            first, last = int(number[1]), int(number[2] or int(number[1]) + 1)
            found += range(first, last) if first < last <= len(names) else [-1]
        else:
            found += [i for i, name in enumerate(names) if word in (name, name.split("[")[0])] or [-1]
    if -1 in found or len(set(found)) < len(found):
        parts = ", ".join(dict.fromkeys(name.split("[")[0] for name in names))
        valid = f"must list entries below {len(names)}, slices a:b or names, each once; the parts are {parts}"
        raise Refused(key, text, valid)
    return found
