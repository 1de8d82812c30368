"""What a configuration refuses, each in one line that names key, value and valid choices."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from experiments import synonyms
from experiments.choices import GROUPS, check_choice, group_choices, nearest
from experiments.schema import BUDGET_FIELDS, PRETRAINED, PRETRAINING, SHARED_WITH_SKILLS
from hippo.core.settings import ConfigError
from hippo.core.skills import SkillsError, read_skills, view_of
from hippo.envs import ENVIRONMENTS, environment, foreign
from hippo.envs.arguments import Refused

# Filled in from the run level, or descriptions that no override should touch.
NOT_OVERRIDDEN = {
    "budget",
    "off_policy",
    "protocol",
    "seeds",
    "scale",
    "env.name",
    "env.id",
    "env.label",
    "env.seconds_per_step",
} | {f"algo.{name}" for name in BUDGET_FIELDS}
ONE_VALUE = "must be key=value with one value; several make a sweep: experiments.sweep run --name NAME --over key=a,b"


def unquoted(text: str) -> str:
    """`text` without one pair of quotes around it, which Hydra's grammar would ask for and a shell may leave."""
    return text[1:-1] if len(text) > 1 and text[0] == text[-1] and text[0] in "'\"" else text


def parsed(key: str, text: str) -> Override:
    value = text.partition("=")[2]
    with as_config_error(key, value):
        (override,) = OverridesParser.create().parse_overrides([text])
    if override.is_sweep_override() or override.is_add() or override.is_delete():
        raise ConfigError(key, value, ONE_VALUE)
    return override


def check_group(group: str, value: str) -> str:
    if group == "env" and foreign.is_foreign(value):
        with of_environment():
            environment(value)
        return value
    valid = group_choices(group)
    meant = synonyms.environment(value, valid) if group == "env" and value not in valid else ""
    if meant:
        raise ConfigError(group, value, f"did you mean {meant}? valid: {', '.join(valid)}")
    return check_choice(group, value, valid)


def check_reward(env: str, algo: str) -> None:
    """Refuse to learn a task where there is none."""
    if foreign.is_foreign(env) and algo in PRETRAINING.values():
        raise ConfigError("algo", algo, f"makes skills of the robots here, {', '.join(PRETRAINING)}, not in {env}")
    if not environment(env).pays and algo not in PRETRAINING.values():
        tasks = [name for name, e in ENVIRONMENTS.items() if e.robot == ENVIRONMENTS[env].robot and e.pays]
        there = f"the robot alone is paid nothing, algo={PRETRAINING[env]} brings its own reward"
        raise ConfigError("env", env, f"{there}; did you mean {', '.join(tasks)}?")


def check_key(config: DictConfig, key: str, value: Any) -> None:
    known = sorted(_keys(config))
    if key not in known:
        hint = synonyms.hint(key, [*known, *GROUPS])
        raise ConfigError(key, value, hint or f"no such key; {nearest(key, known)}")


def _keys(node: DictConfig, prefix: str = "") -> Iterator[str]:
    for name in map(str, node):
        key, child = f"{prefix}{name}", node._get_node(name)
        if isinstance(child, DictConfig) and name not in ("budget", "off_policy", "protocol", "kwargs"):
            yield from _keys(child, f"{key}.")
        elif key not in NOT_OVERRIDDEN:
            yield key


@contextlib.contextmanager
def as_config_error(key: str, value: Any) -> Iterator[None]:
    """Turn what Hydra and OmegaConf raise into one line about the key and the value."""
    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(key, value, str(error).splitlines()[0]) from error


@contextlib.contextmanager
def of_environment() -> Iterator[None]:
    """Name what an environment refuses, itself or one of its options, by its key in the whole configuration."""
    try:
        yield
    except Refused as error:
        raise ConfigError("env" if error.key == "env" else f"env.{error.key}", error.value, error.valid) from error


def level_of(name: str) -> str:
    """Where a setting of an algorithm stands in the whole configuration."""
    return {"iterations": "", "batch_size": "", "horizon": "env."}.get(name, "algo.")


@contextlib.contextmanager
def of_algo() -> Iterator[None]:
    """Name a setting that an algorithm refuses by its key in the whole configuration."""
    try:
        yield
    except (ConfigError, Refused) as error:
        raise ConfigError(f"{level_of(error.key)}{error.key}", error.value, error.valid) from error


def check_skills(path: str, env: dict[str, Any], settings: dict[str, Any]) -> None:
    """Refuse a skills file that cannot be read, or is for another robot, observation or network."""
    try:
        metadata, _ = read_skills(Path(path))
    except SkillsError as error:
        raise ConfigError("algo.skills", path, f"must be {PRETRAINED} or a skills file ({error})") from error
    wanted = {"robot": environment(env["name"]).robot, "observation": env["observation"]}
    wanted |= {name.removeprefix("skill_"): settings[name] for name in SHARED_WITH_SKILLS if name in settings}
    if "skill_observation" in settings:  # HIRO, which has no skills of its own, takes either
        wanted["view"] = "ego" if settings["skill_observation"] == "ego" else "robot"
    for key, value in wanted.items():
        if (has := view_of(metadata) if key == "view" else metadata[key]) != value:
            raise ConfigError("algo.skills", path, f"has {key} {has}, this run needs {value}")
