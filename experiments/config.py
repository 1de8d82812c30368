"""One run's configuration: composed by Hydra from conf/ and overrides, validated, and named by its content."""

import dataclasses
import functools
import hashlib
import json
import operator
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf

from experiments.choices import COMMITTED, CONF, GROUPS, check_choice
from experiments.refusals import (
    as_config_error,
    check_group,
    check_key,
    check_reward,
    check_skills,
    of_algo,
    of_environment,
    parsed,
    unquoted,
)
from experiments.schema import (
    BUDGET_FIELDS,
    PRETRAINED,
    PRETRAINING,
    SHARED_WITH_SKILLS,
    WANDB_MODES,
    EnvConfig,
    RunSchema,
    WandbConfig,
    default_of,
    option_fields,
)
from hippo.core.settings import ConfigError
from hippo.core.skills import read_skills
from hippo.envs import environment, foreign
from hippo.envs.registration import check_options
from hippo.learners import LEARNERS, config_class, learner_of

# Names and paths: the text after `key=` is taken as it is typed and never parsed, so it may hold any character.
PLAIN_TEXT = ("runs_dir", "algo.skills", "algo.goal_space", "env.skill_view", "wandb.project")
KINDS = ("train", "pretrain", "evaluate", "measure")
# Bumped when what hippo.gradients.measure, experiments.evaluate or an algorithm's `skills` makes of a run changes.
KIND_REVISIONS = {"measure": 1, "evaluate": 1}

installed = functools.cache(version)  # reading a package's metadata takes 3 ms, and a plan asks a thousand times


@dataclass(frozen=True)
class Run:
    """One validated run."""

    algo: str
    config: Any  # the algorithm's dataclass
    env: str
    options: dict[str, Any]  # environment options that are not at their default
    scale: str
    seed: int
    runs_dir: Path
    wandb_mode: str
    wandb_project: str
    seconds_per_step: float
    kind: str = "train"  # or pretrain; evaluate and measure are about the trained run with the same settings
    evaluation: dict[str, Any] | None = None  # of kind evaluate: episodes, perturbations, strengths
    protocol: str = "paper"
    tensorboard: bool = False
    place: Path | None = None  # its folder, if it was read from one that need not be named after it

    @functools.cached_property
    def parent(self) -> "Run | None":
        """The run that must be finished before this one can start."""
        if self.is_about_another:
            return dataclasses.replace(self, kind="train", evaluation=None, place=None)
        return self.pretraining

    @property
    def is_about_another(self) -> bool:
        """Whether this run looks at a trained one instead of training."""
        return self.kind in KIND_REVISIONS

    @property
    def ancestors(self) -> "list[Run]":
        """The parent, its parent and so on."""
        return [] if self.parent is None else [self.parent, *self.parent.ancestors]

    @property
    def skills(self) -> str:
        """Where the skills come from: PRETRAINED, a skills file, or "" for none."""
        return getattr(self.config, "skills", "")

    @property
    def restored_config(self) -> Any:
        """The config with which a checkpoint is read: it holds the skills, the file they came from is not needed."""
        return dataclasses.replace(self.config, skills="") if self.skills else self.config

    @functools.cached_property
    def pretraining(self) -> "Run | None":
        """The run that makes this one's skills, one for all seeds as the authors' (Fig. 6); None if they are given."""
        if self.skills != PRETRAINED:
            return None
        robot = environment(self.env).robot
        shared = {name: getattr(self.config, name) for name in SHARED_WITH_SKILLS if hasattr(self.config, name)}
        overrides = [f"algo.{name}={json.dumps(value)}" for name, value in shared.items()]
        overrides += ["algo.skill_observation=ego"] * (getattr(self.config, "skill_observation", "") == "ego")
        overrides += [f"env.{name}={value}" for name, value in self.options.items() if name == "observation"]
        chosen = [f"env={robot}", f"algo={PRETRAINING[robot]}", f"scale={self.scale}"]
        return compose_run([*chosen, *overrides], self.runs_dir)

    @functools.cached_property
    def identity(self) -> dict[str, Any]:
        """Everything that decides the numbers of this run; settings at their default are left out."""
        settings = {
            f.name: getattr(self.config, f.name)
            for f in dataclasses.fields(self.config)
            if f.name not in BUDGET_FIELDS and getattr(self.config, f.name) != default_of(f)
        }
        if self.skills:
            settings["skills"] = self.pretraining.run_id if self.pretraining else digest(Path(self.skills))
        of_the_kind = {}
        if self.is_about_another:
            of_the_kind = {"kind": self.kind, f"{self.kind}_revision": KIND_REVISIONS[self.kind]}
        return (
            {
                "algo": self.algo,
                "algo_revision": learner_of(self.algo).REVISION,
                "settings": settings,
                "env": self.env,
                "env_revision": environment(self.env).revision,
                "options": self.options,
                **{name: getattr(self.config, name) for name in BUDGET_FIELDS},
                "seed": self.seed,
                "mujoco": installed("mujoco"),
            }
            | ({"protocol": self.protocol} if self.protocol != Run.protocol else {})
            | ({"package": environment(self.env).package} if foreign.is_foreign(self.env) else {})
            | of_the_kind
            | ({"evaluation": self.evaluation} if self.evaluation else {})
        )

    @functools.cached_property
    def run_id(self) -> str:
        """The run's name: a hash of its identity."""
        return hashlib.sha256(json.dumps(self.identity, sort_keys=True).encode()).hexdigest()[:12]

    @property
    def folder(self) -> Path:
        """Where the run lives; not part of its identity."""
        return self.place or self.runs_dir / self.run_id

    @property
    def env_steps(self) -> int:
        """Environment steps that the whole run takes, without its parent's; a measurement takes two batches."""
        if self.evaluation is not None:
            environments = 1 + len(self.evaluation["perturbations"]) * len(self.evaluation["strengths"])
            return environments * self.evaluation["episodes"] * self.config.horizon
        batches = 2 if self.kind == "measure" else self.config.iterations
        return batches * self.config.num_envs * self.config.horizon

    def to_yaml(self) -> str:
        """The run as text; `Run.from_yaml` gives it back."""
        plain = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in ("runs_dir", "place")}
        return yaml.safe_dump(plain | {"config": dataclasses.asdict(self.config)}, sort_keys=False)

    @staticmethod
    def from_yaml(text: str, runs_dir: Path) -> "Run":
        """Rebuild a run from what `to_yaml` wrote.

        Raises:
            ValueError: that is not what it wrote.
        """
        try:
            plain = yaml.safe_load(text)
            check_choice("algo", plain["algo"], tuple(LEARNERS))
            check_group("env", plain["env"])
            check_choice("kind", plain["kind"], KINDS)
            for key, kind in {"seed": int, "options": dict, "config": dict, "scale": str}.items():
                if not isinstance(plain[key], kind):
                    raise ConfigError(key, plain[key], f"must be {kind.__name__}")
            mirror = {"wandb_mode": WandbConfig.mode, "wandb_project": WandbConfig.project}  # older runs do not say
            return Run(
                **mirror | plain | {"config": config_class(plain["algo"])(**plain["config"]), "runs_dir": runs_dir}
            )
        except (yaml.YAMLError, AttributeError, KeyError, TypeError) as error:
            raise ValueError(f"is not a run's config.yaml ({' '.join(str(error).split())})") from error


def digest(path: Path) -> str:
    """The start of the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]


def committed_skills(run: Run) -> Path | None:
    """The committed skills file, if it is the one that the pre-training `run` would make."""
    path = COMMITTED / "skills" / f"{run.env}.pt"
    return path if run.kind == "pretrain" and path.exists() and read_skills(path)[0]["run_id"] == run.run_id else None


def whole(batch: int, horizon: int) -> int:
    """Environment steps that an iteration takes: a batch, up to whole horizons, as every learner collects it."""
    return -(-batch // horizon) * horizon


@functools.cache
def _register() -> None:
    # What conf/algo/hiro.yaml makes of an off-policy budget, so that it is the same for every horizon.
    OmegaConf.register_new_resolver("whole_horizons", lambda batch, horizon: max(horizon, batch // horizon * horizon))
    OmegaConf.register_new_resolver("iterations_of", lambda steps, batch, horizon: -(-steps // whole(batch, horizon)))
    store = ConfigStore.instance()
    store.store(name="run_schema", node=RunSchema)
    store.store(group="env", name="env_schema", node=EnvConfig)
    for name in LEARNERS:
        store.store(group="algo", name=f"{name}_schema", node=config_class(name))


@functools.cache
def _base(env: str, algo: str, scale: str, protocol: str) -> DictConfig:
    """The composed configuration before any override; Hydra is asked once per combination."""
    _register()
    group = "gym" if foreign.is_foreign(env) else env
    chosen = {"env": group, "algo": algo, "scale": scale, "protocol": protocol}
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=[f"{group}={name}" for group, name in chosen.items()])
    if algo in config.protocol.learners:
        of_all = {key: value for key, value in config.protocol.settings.items() if key in config.algo}
        config.algo.merge_with(of_all | dict(config.protocol.learners[algo]))
        config.budget.merge_with(config.protocol.budget.get(scale, {}))
    if foreign.is_foreign(env):
        _name_foreign(config, env)
    return config


def _name_foreign(config: DictConfig, env: str) -> None:
    """Fill in the configuration of gym:<id> what the registry knows of it."""
    limit, longest = environment(env).horizon, config.budget.gym.horizon
    config.env.id = config.env.label = env.removeprefix(foreign.PREFIX)
    config.env.horizon = min(limit or longest, longest or limit) or MISSING
    if "bootstrap_horizon" in config.algo:  # a time limit is none of the task's; the paper's horizon is
        config.algo.bootstrap_horizon = True


def compose_run(overrides: Sequence[str], runs_dir: Path | None = None) -> Run:
    """The run described by `overrides`, e.g. ["env=ant_gather", "algo.period_min=5"].

    Values are in Hydra's grammar; those of PLAIN_TEXT are taken as they are typed.

    Args:
        runs_dir: where the run lives, if not where the overrides say.

    Raises:
        ConfigError: an unknown group choice or key, a value of the wrong type or out of range.
    """
    groups = dict(GROUPS)
    names: dict[str, str] = {}
    settings = []
    for text in overrides:
        key, equals, value = text.partition("=")
        if not key or not equals:
            raise ConfigError(key, value, "settings are given as key=value")
        if not re.fullmatch(r"[\w.]+", key):
            raise ConfigError(key, value, "a key has letters, _ and dots only, as in algo.learning_rate=1e-3")
        if key in PLAIN_TEXT:
            names[key] = unquoted(value)
        elif key in groups:
            groups[key] = check_group(key, str(parsed(key, text).value()))
        else:
            settings.append(parsed(key, text))
    if runs_dir is not None:
        names["runs_dir"] = str(runs_dir)
    check_reward(groups["env"], groups["algo"])
    config = _base(**groups).copy()
    for override in settings:
        check_key(config, override.key_or_group, override.value())
        if override.value() == MISSING:
            raise ConfigError(override.key_or_group, MISSING, "must have a value")
        with as_config_error(override.key_or_group, override.value()):
            of_any_name = override.key_or_group == "env.kwargs"
            OmegaConf.update(config, override.key_or_group, override.value(), force_add=of_any_name)
    for key, name in names.items():
        check_key(config, key, name)
    return _validated(config, groups["algo"], names)


def _validated(config: DictConfig, algo: str, names: dict[str, str]) -> Run:
    if OmegaConf.is_missing(config.env, "horizon"):
        raise ConfigError("env.horizon", MISSING, f"must be given: {config.env.id} has no registered time limit")
    with as_config_error("config", algo):
        plain: Any = OmegaConf.to_container(config, resolve=True)
    for key, value in names.items():  # here, where nothing is parsed or interpolated any more
        *groups, name = key.split(".")
        functools.reduce(operator.getitem, groups, plain)[name] = value
    env: dict[str, Any] = plain["env"]
    if env["id"]:
        env["name"] = f"{foreign.PREFIX}{env['id']}"
    with of_algo():
        settings = config_class(algo)(**plain["algo"])
    options = {f.name: env[f.name] for f in option_fields() if env[f.name] != default_of(f)}
    with of_environment():
        check_options(env["name"], options)
    if hasattr(settings, "check_environment"):
        layout = foreign.layout_of(env["name"], options) if foreign.is_foreign(env["name"]) else None
        with of_algo():
            settings.check_environment(environment(env["name"]).robot, options, layout)
    skills = plain["algo"].get("skills", "")
    if skills == PRETRAINED and foreign.is_foreign(env["name"]):
        raise ConfigError("algo.skills", skills, f"there are none for {env['name']}; valid: a skills file, or nothing")
    if skills not in ("", PRETRAINED):
        check_skills(skills, env, plain["algo"])
    check_choice("wandb.mode", plain["wandb"]["mode"], WANDB_MODES)
    if not plain["runs_dir"]:
        raise ConfigError("runs_dir", "", "must name a folder")
    if not 0 <= plain["seed"] < 2**32:
        raise ConfigError("seed", plain["seed"], "must be at least 0 and below 2**32")
    return Run(
        algo,
        settings,
        env["name"],
        options,
        plain["scale"],
        plain["seed"],
        Path(plain["runs_dir"]),
        plain["wandb"]["mode"],
        plain["wandb"]["project"],
        env["seconds_per_step"],
        kind="pretrain" if algo in PRETRAINING.values() else "train",
        tensorboard=plain["log"]["tensorboard"],
        protocol=plain["protocol"]["name"] if algo in plain["protocol"]["learners"] else Run.protocol,
    )
