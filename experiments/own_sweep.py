"""Sweeps of one's own: a grid of settings under a name, planned, trained, resumed and drawn as a figure is.

    python -m experiments.sweep run --name lr --over algo=hippo,ppo --over algo.learning_rate=1e-4,3e-4 --seeds 5
    python -m experiments.sweep run --file lr.yaml       # the same as a file: name, over, seeds, scale, protocol, set
    python -m experiments.sweep compare lr               # learning curves and a table

`<runs_dir>/sweeps/<name>.json` keeps what was asked for, so that the name is enough from then on.
"""

import argparse
import dataclasses
import itertools
import json
import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from analysis.edition import NEVER_OVERRIDES, PAPER, Edition
from experiments.choices import COMMITTED, GROUPS, check_choice, choices, nearest
from experiments.plan import FIXED, Plan, resolved, seeds_of
from experiments.status import write_atomically
from experiments.sweep_grammar import MOST, UNASKED, text_of, values_of
from hippo.core.files import DamagedFile, read_json
from hippo.core.settings import ConfigError

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")
TAKEN = re.compile(r"(fig|table)\d+|all|compare")  # names of the paper's artefacts and of what is drawn without a name
STORED: dict[str, type | tuple[type, ...]] = {
    "name": str,
    "over": dict,
    "set": dict,
    "seeds": int,
    "scale": str,
    "protocol": str,
}
FILE_KEYS = ("name", "over", "set", "seeds", "scale", "protocol")


@dataclass(frozen=True)
class Sweep:
    """What was asked for: every combination of the values in `over`, each with `seeds` seeds."""

    name: str
    over: dict[str, list[str]]  # key -> values as overrides take them
    set: dict[str, str]  # of every run
    seeds: int
    scale: str
    protocol: str

    @property
    def edition(self) -> Edition:
        """Where its plan and its pictures lie."""
        return Edition(self.scale, self.protocol)

    def description(self) -> dict[str, Any]:
        """What conf/figure holds of a figure.

        A panel per environment; a line per combination of the others, called by its learner and by what varies.
        """
        grid = {key: values for key, values in self.over.items() if key not in ("env", "algo")}
        common = [f"{key}={value}" for key, value in self.set.items()]
        fixed = [*common, *(f"{key}={values[0]}" for key, values in grid.items() if len(values) == 1)]
        variants: dict[str, dict[str, Any]] = {}
        for algo, *values in itertools.product(self.over.get("algo", [GROUPS["algo"]]), *grid.values()):
            settings = [f"{key}={value}" for key, value in zip(grid, values, strict=True)]
            varied = [s.removeprefix("algo.") for s, of in zip(settings, grid.values(), strict=True) if len(of) > 1]
            label = " ".join([algo, *varied])
            name = re.sub(r"[^\w.-]+", "_", label)
            name = f"{name}-{len(variants)}" if name in variants else name
            variants[name] = {"label": label, "algo": algo, "settings": [*common, *settings]}
        return {
            "title": ", ".join([f"Sweep {self.name}", *fixed]),
            "environments": self.over.get("env", [GROUPS["env"]]),
            "variants": variants,
            "seeds": self.seeds,
            "committed_in": [f for f in choices("figure") if (COMMITTED / self.edition.folder / f"{f}.csv").exists()],
            "sweep": dataclasses.asdict(self),
        }

    def plan(self, settings: Sequence[str], fresh: bool, runs_dir: Path) -> Plan:
        """Its runs and how each is doing.

        Args:
            settings: what changes no number, such as wandb.mode=offline.

        Raises:
            ConfigError: an unknown key, a value that cannot work, two combinations that are the same run.
        """
        plan = resolved(self.name, self.edition, self.description(), settings, fresh, runs_dir)
        counts = Counter(entry.run.run_id for entry in plan.entries)
        twice = [entry for entry in plan.entries if counts[entry.run.run_id] > 1]
        if twice:
            same = [e for e in twice if e.run.run_id == twice[0].run.run_id]
            both = " and ".join(entry.variant_label for entry in same[:2])
            raise ConfigError("over", both, "are the same run; what tells them apart changes no number")
        return plan

    def check_stored(self, runs_dir: Path) -> None:
        """Raise ConfigError if another sweep of this name is stored."""
        other = stored(self.name, runs_dir)
        if other is not None and other != self:
            raise ConfigError("name", self.name, f"is another sweep in {runs_dir} ({self.difference(other)})")

    def difference(self, other: "Sweep") -> str:
        """The first thing in which `other` differs, in words."""
        here, there = (
            {"scale": s.scale, "protocol": s.protocol, "seeds": s.seeds, **s.over, **s.set} for s in (self, other)
        )
        for key in dict.fromkeys([*there, *here]):
            ours, theirs = (words(of[key]) if key in of else "not given" for of in (here, there))
            if ours != theirs:
                return f"{key}: {theirs} there, {ours} here"
        return "the same settings by --over and by --set, or in another order"


def store(plan: Plan, runs_dir: Path) -> None:
    """Write down what a plan of one's own was made of; nothing of a figure."""
    if plan.own:
        Sweep(**plan.description["sweep"]).check_stored(runs_dir)
        path = place(plan.figure, runs_dir)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, json.dumps(plan.description["sweep"], indent=1))


def words(value: Any) -> str:
    """A setting as it is typed."""
    return ",".join(value) if isinstance(value, list) else str(value)


def place(name: str, runs_dir: Path) -> Path:
    """Where a sweep is stored."""
    return runs_dir / "sweeps" / f"{name}.json"


def stored(name: str, runs_dir: Path) -> Sweep | None:
    """The sweep of that name, None where there is none.

    Raises:
        ConfigError: its file is damaged.
    """
    if not NAME.fullmatch(name):
        return None
    path = place(name, runs_dir)
    try:
        found = read_json(path, STORED)
        if (
            set(found) != set(STORED)
            or found["name"] != name
            or not all(
                isinstance(of, list) and of and all(isinstance(x, str) for x in of) for of in found["over"].values()
            )
            or not all(isinstance(value, str) for value in found["set"].values())
            or found["scale"] not in choices("scale")
            or found["protocol"] not in choices("protocol")
            or not 1 <= found["seeds"] <= MOST
        ):
            raise DamagedFile(f"{path}: is no sweep called {name}")
        return Sweep(**found)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except DamagedFile as error:
        raise ConfigError("name", name, f"{error}; delete it and give --over again") from error


def names(runs_dir: Path) -> list[str]:
    """The sweeps that are stored."""
    return sorted(path.stem for path in (runs_dir / "sweeps").glob("*.json"))


# -------------------------------------------------------------------------------------------------------- command line


def add_options(parser: argparse.ArgumentParser) -> None:
    """What describes a sweep of one's own."""
    group = parser.add_argument_group("a sweep of your own (docs/own_sweep.md)")
    group.add_argument("--name", help="what it is called from now on")
    group.add_argument("--over", action="append", metavar="KEY=VALUE,VALUE|range(A,B[,STEP])", help="what it varies")
    group.add_argument("--seeds", type=int, help="of every combination (default: the scale's)")
    group.add_argument("--file", type=Path, help=f"the same as yaml: {', '.join(FILE_KEYS)}")


def chosen(options: argparse.Namespace) -> Sweep | None:
    """The sweep of one's own that a command line describes or names; None of a figure.

    Raises:
        ConfigError: a value that cannot be, or another sweep of that name.
    """
    if options.figure is not None and options.name is not None:
        raise ConfigError("name", options.name, f"and {options.figure}: give one")
    if all(getattr(options, key) is None for key in ("over", "seeds", "file")) and (options.figure or options.name):
        name = options.figure or options.name
        sweep = None if name in (*choices("figure"), "all") else stored(name, options.runs_dir)
        if sweep is None and options.name is None:
            if name != "all" and (own := names(options.runs_dir)):
                check_choice("figure", name, [*own, *choices("figure")])
            return None
        if sweep is None:
            return asked_for(options)
        given = {key: getattr(options, key) for key in ("scale", "protocol") if getattr(options, key) is not None}
        set_here = sweep.set | settings_of(telling(options.set))
        dataclasses.replace(sweep, **given, set=set_here).check_stored(options.runs_dir)
        return sweep
    if options.figure is not None:
        raise ConfigError(
            "figure", options.figure, "has a name already; --over, --seeds and --file describe another (--name)"
        )
    sweep = asked_for(options)
    sweep.check_stored(options.runs_dir)
    check_size(sweep, options.yes)
    return sweep


def asked_for(options: argparse.Namespace) -> Sweep:
    """The sweep that --file or --name, --over and so on describe."""
    file = read_file(options.file) if options.file else {}
    if options.file and (options.over or options.set):
        raise ConfigError("file", options.file, "says what --over and --set would; give one or the other")
    name = options.name or file.get("name")
    if not name:
        raise ConfigError(
            "name", "", "name a figure (fig3), or a sweep of your own to resume it by (--name lr --over ...)"
        )
    if not NAME.fullmatch(name):
        raise ConfigError("name", name, "must be letters, digits and _, a letter first, at most 64")
    if TAKEN.fullmatch(name) or name in choices("figure"):
        raise ConfigError("name", name, "is taken by the paper; choose another")
    over: dict[str, list[str]] = {}
    for text in options.over or [f"{key}={text_of(value)}" for key, value in file.get("over", {}).items()]:
        key, values = values_of(text)
        if key in over:
            raise ConfigError(f"over {key}", words(values), "is given twice; put all values into one")
        over[key] = values
    if not over:
        raise ConfigError("over", "", "say what to vary, as in --over algo.learning_rate=1e-4,3e-4")
    common = options.set or [f"{key}={text_of(value)}" for key, value in file.get("set", {}).items()]
    for key in settings_of(common):
        if key in over:
            raise ConfigError(f"set {key}", settings_of(common)[key], "is among --over already")
    asked = {"scale": "smoke", "protocol": PAPER} | file
    asked |= {key: value for key in ("scale", "protocol", "seeds") if (value := getattr(options, key)) is not None}
    scale, protocol = asked["scale"], asked["protocol"]
    check_choice("scale", scale, choices("scale"))
    check_choice("protocol", protocol, choices("protocol"))
    seeds = asked["seeds"] if "seeds" in asked else seeds_of(Edition(scale, protocol))
    if isinstance(seeds, bool) or not isinstance(seeds, int) or not 1 <= seeds <= MOST:
        raise ConfigError("seeds", seeds, f"must be a whole number from 1 to {MOST:,}")
    return Sweep(name, over, settings_of(telling(common)), seeds, scale, protocol)


def telling(settings: Sequence[str]) -> list[str]:
    """Those that change numbers, and so are part of what a sweep is."""
    return [setting for setting in settings if not setting.startswith(NEVER_OVERRIDES)]


def harmless(settings: Sequence[str]) -> list[str]:
    """Those that change no number."""
    return [setting for setting in settings if setting.startswith(NEVER_OVERRIDES)]


def settings_of(settings: Sequence[str]) -> dict[str, str]:
    """key=value texts as a mapping, of which the last counts; ConfigError for what is the sweep's own business."""
    found = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not key or not equals:
            raise ConfigError("set", setting, "settings are given as key=value")
        if key in (*FIXED, "over"):
            raise ConfigError(f"set {key}", value, "--over and the sweep's options decide that")
        found[key] = value
    return found


def read_file(path: Path) -> dict[str, Any]:
    """A sweep's yaml file, its keys and their kinds checked."""
    try:
        content = yaml.safe_load(path.read_text())
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError("file", path, f"must be a yaml file ({' '.join(str(error).split())[:200]})") from error
    if not isinstance(content, dict):
        raise ConfigError("file", path, f"must be a mapping of {', '.join(FILE_KEYS)}")
    for key, value in content.items():
        if key not in FILE_KEYS:
            raise ConfigError(f"file {key}", value, nearest(str(key), FILE_KEYS))
        kind = {"over": dict, "set": dict, "seeds": int}.get(key, str)
        if not isinstance(value, kind) or isinstance(value, bool):
            what = {dict: "keys with values", int: "a whole number", str: "text"}[kind]
            raise ConfigError(f"file {key}", value, f"must be {what}")
    return content


def check_size(sweep: Sweep, agreed: bool) -> None:
    """Raise ConfigError for more runs than anybody looks through, before any of them is made up."""
    runs = sweep.seeds * math.prod(len(values) for values in sweep.over.values())
    if runs > MOST:
        raise ConfigError("over", f"{runs:,} runs", f"are too many; at most {MOST:,}")
    if runs > UNASKED and not agreed:
        raise ConfigError("over", f"{runs:,} runs", f"more than {UNASKED:,} are not made up without --yes")
