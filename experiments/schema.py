"""What a composed configuration holds, as Hydra checks it."""

import dataclasses
from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from hippo.core.settings import setting
from hippo.envs.foreign import ForeignOptions
from hippo.envs.registration import Options

BUDGET_FIELDS = ("iterations", "batch_size", "horizon")
PRETRAINING = {"ant": "snn", "snake": "snn", "hopper": "diayn", "half_cheetah": "diayn"}  # robot -> algorithm
PRETRAINED = "pretrained"  # value of algo.skills: the skills that the robot's pre-training run makes
SHARED_WITH_SKILLS = ("num_skills", "skill_hidden_sizes", "skill_integration", "log_std_per_skill")
WANDB_MODES = ("disabled", "offline", "online")


@dataclass
class EnvConfig(Options, ForeignOptions):
    """An environment and its options."""

    name: str = MISSING
    id: str = ""  # of Gymnasium's registry, for name gym
    label: str = MISSING
    horizon: int = MISSING
    seconds_per_step: float = MISSING


@dataclass
class Budget:
    """What one environment gets at one scale."""

    iterations: int = MISSING
    batch_size: int = MISSING
    horizon: int = MISSING
    physics: str = MISSING


@dataclass
class OffPolicyBudget:
    """What an off-policy learner (HIRO) gets at one scale, whatever the environment."""

    steps: int = MISSING  # in all
    batch_size: int = MISSING  # environment steps per iteration, down to whole horizons


@dataclass
class Protocol:
    """How all on-policy learners are set up: settings, budgets and seeds that differ from the defaults.

    Off-policy HIRO has none of the settings; pre-training is the same under every protocol.
    """

    name: str = MISSING
    label: str = MISSING
    settings: dict[str, Any] = field(default_factory=dict)
    learners: dict[str, dict[str, Any]] = field(default_factory=dict)
    budget: dict[str, dict[str, dict[str, int]]] = field(default_factory=dict)  # scale -> environment
    seeds: dict[str, int] = field(default_factory=dict)  # scale -> seeds of a figure


@dataclass
class WandbConfig:
    """The mirror to Weights & Biases."""

    mode: str = setting("disabled", "whether and how the run is mirrored (docs/wandb.md)", choices=WANDB_MODES)
    project: str = setting("hippo", "where it is mirrored to")


@dataclass
class LogConfig:
    """What a run leaves besides its own files."""

    tensorboard: bool = setting(False, "whether it is mirrored to <run>/tensorboard, for TensorBoard (docs/wandb.md)")


@dataclass
class RunSchema:
    """The root of a composed configuration."""

    env: EnvConfig = MISSING
    algo: Any = MISSING
    scale: str = MISSING
    seed: int = setting(MISSING, "root of every random stream; at least 0 and below 2**32")
    seeds: int = MISSING
    iterations: int = MISSING
    batch_size: int = MISSING
    runs_dir: str = setting(MISSING, "the folder in which the run makes its own")
    budget: dict[str, Budget] = field(default_factory=dict)
    off_policy: OffPolicyBudget = field(default_factory=OffPolicyBudget)
    protocol: Protocol = field(default_factory=Protocol)
    wandb: WandbConfig = field(default_factory=WandbConfig)
    log: LogConfig = field(default_factory=LogConfig)


def default_of(f: dataclasses.Field) -> Any:
    """A dataclass field's default value, MISSING where it has none."""
    return f.default_factory() if f.default_factory is not dataclasses.MISSING else f.default


def option_fields() -> list[dataclasses.Field]:
    """The fields of everything that an environment can be told."""
    return [*dataclasses.fields(Options), *dataclasses.fields(ForeignOptions)]
