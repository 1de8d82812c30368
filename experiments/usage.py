"""What `python -m experiments.train --help` lists: every key of the chosen learner and environment, and its meaning."""

import dataclasses
import json
from pathlib import Path
from typing import Any

from experiments.choices import GROUPS, group_choices
from experiments.config import Run
from experiments.refusals import level_of
from experiments.schema import BUDGET_FIELDS, LogConfig, RunSchema, WandbConfig, default_of, option_fields
from hippo.envs import environment

BOUNDS = {"above": "above {}", "low": "at least {}", "high": "at most {}"}


def text(run: Run) -> str:
    """A line per key: its value in `run`, what it means and what it may be."""
    groups = [_line(group, getattr(run, group), "", group_choices(group)) for group in GROUPS]
    root = [_of(f, getattr(run, f.name)) for f in dataclasses.fields(RunSchema) if f.metadata]
    mirror = [_of(f, getattr(run, f"wandb_{f.name}"), "wandb.") for f in dataclasses.fields(WandbConfig)]
    mirror += [_of(f, getattr(run, f.name), "log.") for f in dataclasses.fields(LogConfig)]
    config = {f.name: _of(f, getattr(run.config, f.name), level_of(f.name)) for f in dataclasses.fields(run.config)}
    budget = [config.pop(name) for name in BUDGET_FIELDS]
    values, valid = {f.name: default_of(f) for f in option_fields()} | run.options, environment(run.env).options
    options = [
        _line(f"env.{f.name}", values[f.name], f.metadata["doc"], valid[f.name])
        for f in option_fields()
        if f.name in valid
    ]
    sections = {
        "The run": [*groups, *budget, *root, *mirror],
        f"The environment, {run.env}": options,
        f"The learner, {run.algo}": list(config.values()),
    }
    width = max(len(key) for lines in sections.values() for key, _ in lines)
    return "\n".join(
        "\n".join([f"\n{title}:", *(f"  {key:{width}}  {meaning}" for key, meaning in lines)])
        for title, lines in sections.items()
    )


def _of(f: dataclasses.Field, value: Any, level: str = "") -> tuple[str, str]:
    """The line of a field that `setting` made."""
    bounds = [words.format(f.metadata[name]) for name, words in BOUNDS.items() if f.metadata[name] is not None]
    return _line(level + f.name, value, "; ".join([f.metadata["doc"], *bounds]), f.metadata["choices"])


def _line(key: str, value: Any, meaning: str, choices: Any) -> tuple[str, str]:
    """`key=value` as it would be typed, and what it means."""
    one_of = [f"one of {', '.join(map(_typed, choices))}"] if choices else []
    return f"{key}={_typed(value)}", "; ".join(filter(None, [meaning, *one_of]))


def _typed(value: Any) -> str:
    """A value as an override has it."""
    return str(value) if isinstance(value, str | Path) else json.dumps(value, separators=(",", ":"))
