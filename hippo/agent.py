"""A trained policy to act with, and training without a configuration file.

agent = hippo.load("runs/<id>")
action, state = agent.act(obs)          # the first observation of an episode
action, state = agent.act(obs, state)   # and every later one
"""

import csv
import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import yaml

from hippo.core.acting import parts_that_act
from hippo.core.checkpoint import Checkpoint, CheckpointError, save
from hippo.core.files import DamagedFile, read_json, write_synced
from hippo.core.log import RunLog
from hippo.envs import make
from hippo.envs.foreign import GymnasiumEnv
from hippo.envs.layout import Layout, layout_of_spaces
from hippo.envs.vector import RobotTaskEnv
from hippo.learners import LEARNERS, config_class, learner_of

CARD = "agent.json"  # what an agent is; beside it checkpoint.pt and README.md
FINAL = 0.1  # share of the iterations that a score is the mean over


class AgentError(RuntimeError):
    """A folder holds no policy that can be loaded here; the message says why."""


@dataclass
class Task:
    """What a policy's networks are about; stands in for the environments where they are not needed."""

    robot_name: str
    observation_variant: str
    observation_names: list[str]
    robot_size: int
    action_size: int
    layout: Layout | None = None  # of an environment that is not one of ours

    @classmethod
    def of(cls, envs: Any) -> "Task":
        """What there is to know of vector environments."""
        names, actions = list(envs.observation_names), envs.single_action_space.shape[0]
        layout = getattr(envs, "layout", None)
        return cls(envs.robot_name, envs.observation_variant, names, envs.robot_size, actions, layout)

    @classmethod
    def read(cls, plain: dict[str, Any]) -> "Task":
        """What `dataclasses.asdict` made of one."""
        layout = plain.pop("layout")
        return cls(**plain, layout=None if layout is None else Layout(**layout))

    @property
    def single_observation_space(self) -> gym.spaces.Box:
        """Rows (D,), as the networks see them before their filter."""
        return gym.spaces.Box(-np.inf, np.inf, (len(self.observation_names),), np.float32)

    @property
    def single_action_space(self) -> gym.spaces.Box:
        """What the networks are asked for, (A,)."""
        return gym.spaces.Box(-1.0, 1.0, (self.action_size,), np.float32)


class State:
    """Where a policy is in its episodes: `act` returns it, takes it back and changes it; `copy.deepcopy` keeps one."""

    def __init__(self, acting: Any) -> None:
        self._acting = acting

    @property
    def skill(self) -> np.ndarray | None:
        """(N,) the skill or option in force; None for a learner that has none."""
        return getattr(self._acting, "skill", None)

    @property
    def steps_left(self) -> np.ndarray | None:
        """(N,) for how many more steps, the last action's included; None where that is not decided beforehand."""
        return getattr(self._acting, "steps_left", None)


@dataclass
class Agent:
    """A policy of any learner, with the statistics that it normalises by."""

    algo: str
    config: Any  # its learner's dataclass
    task: Task
    about: dict[str, Any]  # run_id, env, options, protocol, seed, where they are known, and its score
    folder: Path

    def __post_init__(self) -> None:
        self._learner = learner_of(self.algo)
        if not hasattr(self._learner, "Acting"):
            raise AgentError(f"{self.folder}: {self.algo} makes skills, which act on their own nowhere")
        try:
            source = Checkpoint(self.folder, self.about.get("run_id", ""))
            if source.load() is None:
                raise AgentError(f"{self.folder}: has no checkpoint; train it first")
            self.policy = self._learner.restored(self.config, self.task, source)
        except CheckpointError as error:
            raise AgentError(str(error)) from error
        self.skill: Any = None  # of the last action: () for one observation, (N,) for a batch, None where there is none

    @property
    def spaces(self) -> tuple[gym.spaces.Box, gym.spaces.Box]:
        """Observation and action of one environment, as rows of numbers; a gym:<id> is asked in its own."""
        return self.task.single_observation_space, self.task.single_action_space

    @torch.no_grad()
    def act(
        self, obs: Any, state: State | None = None, *, done: Any = None, greedy: bool = False, seed: int = 0
    ) -> tuple[np.ndarray, State]:
        """What to do about `obs`, one observation or a batch of N, of the environment that was trained in.

        Args:
            state: what the last call returned; None where episodes begin.
            done: (N,) or one bool, where the last step ended an episode and `obs` begins another. greedy, seed: of a
                new state only: most likely choices instead of samples; the root of these.

        Returns:
            The action (A,) or (N, A) in the range of the environment, and the state for the next call.

        Raises:
            ValueError: `obs` has another shape.
        """
        rows, is_one = self._rows(obs)
        if state is None:
            state = State(self._learner.Acting(self.policy, self.config, len(rows), seed, 0, greedy))
        else:
            state._acting.end(np.broadcast_to(False if done is None else np.asarray(done, bool), len(rows)).copy())
        action = np.clip(state._acting.act(rows), -1, 1)
        if self.task.layout is not None:
            action = self.task.layout.scaled(action)
        self.skill = None if state.skill is None else state.skill.copy()
        if is_one:
            self.skill = None if self.skill is None else int(self.skill[0])
            return action[0].copy(), state
        return action.copy(), state

    def _rows(self, obs: Any) -> tuple[np.ndarray, bool]:
        """(N, D) float32 and whether it was one observation."""
        layout = self.task.layout
        parts = [np.asarray(obs[key]) for key in layout.keys] if layout and layout.keys else [np.asarray(obs)]
        sizes = layout.sizes if layout else [len(self.task.observation_names)]
        is_one, count = parts[0].ndim == 1, len(np.atleast_2d(parts[0]))
        for part, size in zip(parts, sizes, strict=True):
            if part.shape != ((size,) if is_one else (count, size)):
                raise ValueError(f"obs has shape {part.shape}: must be ({size},) or (N, {size})")
        rows = layout.rows(obs, count) if layout else parts[0].reshape(count, -1).astype(np.float32)
        return rows, is_one

    def save(self, folder: str | Path) -> Path:
        """Write the policy to `folder`, which `load` takes: tensors, what they are, and a card to read; returns it."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        kept = parts_that_act(self.folder / "checkpoint.pt")
        write_synced(folder / CARD, self.card().encode())
        write_synced(folder / "README.md", self.readme().encode())
        save(folder / "checkpoint.pt", kept)
        return folder

    def card(self) -> str:
        """Everything but the tensors, as JSON."""
        plain = {"algo": self.algo, "config": dataclasses.asdict(self.config), "task": dataclasses.asdict(self.task)}
        return json.dumps(plain | {"about": self.about}, indent=1)

    def readme(self) -> str:
        """The card for people, in Markdown."""
        about = "\n".join(f"| {key} | {value} |" for key, value in self.about.items())
        observed, acted = len(self.task.observation_names), self.task.action_size
        return (
            f"# A {self.algo} policy\n\n| | |\n|---|---|\n{about}\n| observation, action | {observed}, {acted} |\n\n"
            "```python\nimport hippo\n\nagent = hippo.load('this folder')\n"
            "action, state = agent.act(obs)  # then agent.act(obs, state)\n```\n"
        )


def load(folder: str | Path) -> Agent:
    """The policy of a run folder, or of a folder that `Agent.save` or `train` wrote.

    Raises:
        AgentError: there is none, it is damaged, or its learner's code is not here.
    """
    folder = Path(folder)
    try:
        if (folder / CARD).exists():
            plain = read_json(folder / CARD, {})
            config = _config_class(folder, plain["algo"])(**plain["config"])
            return Agent(plain["algo"], config, Task.read(plain["task"]), plain["about"], folder)
        if not (folder / "config.yaml").exists():
            raise AgentError(f"{folder}: holds neither {CARD} nor config.yaml; a run folder or a saved policy does")
        run = yaml.safe_load((folder / "config.yaml").read_text())
        config = _config_class(folder, run["algo"])(**(run["config"] | _without_skills(run["config"])))
        envs = make(run["env"], 1, 0, horizon=config.horizon, **run["options"])
        task = Task.of(envs)
        envs.close()
        manifest = read_json(folder / "manifest.json", {}) if (folder / "manifest.json").exists() else {}
    except (OSError, DamagedFile, yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise AgentError(f"{folder}: holds no policy that can be read ({' '.join(str(error).split())})") from error
    about = {key: run[key] for key in ("env", "options", "protocol", "scale", "seed") if key in run}
    about |= {"run_id": manifest.get("run_id", folder.name)} | score(folder / "progress.csv")
    return Agent(run["algo"], config, task, about, folder)


def _without_skills(config: dict[str, Any]) -> dict[str, Any]:
    """The file of given skills is not needed: they are in the checkpoint."""
    return {"skills": ""} if config.get("skills") else {}


def _config_class(folder: Path, algo: str) -> Any:
    """The config class of a learner."""
    try:
        return config_class(algo)
    except ImportError as error:
        where = f"{LEARNERS[algo][0]}, which is in the checkout: start Python there or put it on PYTHONPATH"
        raise AgentError(f"{folder}: needs {where} ({error})") from error


def score(progress: Path) -> dict[str, Any]:
    """Steps trained and the mean return over the last tenth of the iterations; nothing where there is no log."""
    if not progress.exists():
        return {}
    with progress.open() as file:
        rows = list(csv.DictReader(file))
    last = rows[-max(1, round(FINAL * len(rows))) :]
    mean = float(np.mean([float(row["return_mean"]) for row in last])) if last else float("nan")
    return {"env_steps": int(rows[-1]["env_steps"]) if rows else 0, "return_mean": round(mean, 4)}


def train(
    config: Any,
    envs: gym.vector.VectorEnv,
    folder: str | Path,
    seed: int = 0,
    skill_view: str = "",
    on_iteration: Callable[[dict[str, Any]], None] | None = None,
) -> Agent:
    """Train on environments that the caller has made, from the last checkpoint in `folder` if there is one.

    Args:
        config: a learner's, e.g. `hippo.HippoConfig(iterations=100, batch_size=8000, horizon=1000)`.
        envs: `config.num_envs` of them, in Gymnasium's mode SAME_STEP; `config.horizon` is their time limit.
        skill_view: what skills see of the observation, as `env.skill_view`. on_iteration: gets every row of metrics.

    Returns:
        The trained policy, which `load(folder)` gives, too.

    Raises:
        ValueError: the environments are of another number, or cannot be learnt in; the message says why.
        Diverged: an observation, a reward or a parameter is no longer finite.
    """
    if envs.num_envs != config.num_envs:
        raise ValueError(f"envs={envs.num_envs}: must be batch_size / horizon, {config.num_envs}")
    name = getattr(getattr(envs, "spec", None), "id", None) or type(envs).__name__
    if not isinstance(envs, RobotTaskEnv | GymnasiumEnv):
        layout = layout_of_spaces(name, envs.single_observation_space, envs.single_action_space, skill_view)
        envs = GymnasiumEnv(envs, layout, name, skill_view=skill_view)
    torch.set_num_threads(1)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    algo = next(name for name, (_, settings) in LEARNERS.items() if settings == type(config).__name__)
    log = RunLog(folder, lambda metrics, timing: on_iteration(dict(metrics)) if on_iteration else None)
    task = Task.of(envs)
    learner_of(algo).train(config, lambda num_envs, purpose: envs, log, seed, Checkpoint(folder, "", log))
    agent = Agent(algo, config, task, {"env": name, "seed": seed} | score(folder / "progress.csv"), folder)
    write_synced(folder / CARD, agent.card().encode())
    return agent
