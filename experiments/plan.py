"""The plan of a figure: its runs, how each is doing, what is shared with other figures and what is left to pay."""

import csv
import dataclasses
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from analysis.edition import PAPER, Edition
from experiments import costs
from experiments.choices import COMMITTED, CONF, check_choice, choices
from experiments.command_line import duration
from experiments.config import Run, compose_run
from experiments.status import ABANDONED_SECONDS, DONE, is_there, read_status, remove_abandoned, write_atomically
from hippo.core.settings import ConfigError

FIXED = ("env", "algo", "scale", "protocol", "seed", "runs_dir")  # the plan's own business, not that of --set


@dataclass
class Entry:
    """One run of a figure: where it stands in the figure and how it is doing."""

    run: Run
    env_label: str
    variant: str
    variant_label: str
    state: str

    def as_planned(self) -> dict[str, Any]:
        """What analysis and drawing know of it."""
        run = self.run
        return {
            "run_id": run.run_id,
            "env": run.env,
            "env_label": self.env_label,
            "variant": self.variant,
            "variant_label": self.variant_label,
            "seed": run.seed,
            "iterations": run.config.iterations,
            "batch_size": run.config.batch_size,
            "env_steps": run.env_steps,
            "cycle": getattr(run.config, "cycle_length", 1),  # iterations after which a method starts over
            "physics": run.options.get("physics", "paper"),
            "kind": run.kind,
            "ancestors": [ancestor.run_id for ancestor in run.ancestors],
            "state": self.state,
        }


@dataclass
class Plan:
    """All runs of one figure in one edition."""

    figure: str
    edition: Edition
    description: dict[str, Any]  # conf/figure/<figure>.yaml, or what a sweep of one's own makes in its place
    fresh: bool  # committed results do not count
    entries: list[Entry]
    refused: list[dict[str, str]] = dataclasses.field(default_factory=list)  # what the protocol cannot train
    whole: "Plan | None" = None  # of which this is a part

    @property
    def own(self) -> bool:
        """Whether it is a sweep of one's own and no figure of the paper."""
        return "sweep" in self.description

    @property
    def typed(self) -> str:
        """What names it on the command line of experiments.sweep: of a sweep of one's own the name is enough."""
        return self.figure if self.own else f"{self.figure} {self.edition.options}"

    @property
    def label(self) -> str:
        """What its jobs are called after."""
        return "-".join([self.edition.name(self.figure), *self.edition.folder.parts])

    def runs(self) -> list[Run]:
        """Its runs and what they depend on, each once, parents first."""
        return unique([run for e in self.entries for run in [*reversed(e.run.ancestors), e.run]])

    def todo(self) -> list[Run]:
        """Runs still to be done, each once, parents first; a diverged one would only diverge again."""
        waiting = [e.run for e in self.entries if e.state not in (*DONE, "diverged")]
        return unique([r for run in waiting for r in [*reversed(self._missing_ancestors(run)), run]])

    def _missing_ancestors(self, run: Run) -> list[Run]:
        """Nearest first; what lies behind a finished one is not needed."""
        parent = run.parent
        if parent is None or is_there(parent, self.fresh):
            return []
        return [parent, *self._missing_ancestors(parent)]

    def only(self, run_ids: Sequence[str]) -> "Plan":
        """The part of the plan with these runs; ConfigError for a run that is not in it."""
        for run_id in run_ids:
            check_choice("only", run_id, [e.run.run_id for e in self.entries])
        return self._part([e for e in self.entries if e.run.run_id in run_ids])

    def within(self, environments: Sequence[str]) -> "Plan":
        """The part of the plan in these environments, in this order; ConfigError for one that it does not train in."""
        for env in environments:
            check_choice("env", env, list(dict.fromkeys(e.run.env for e in self.entries)))
        return self._part([e for env in environments for e in self.entries if e.run.env == env])

    def by_seed(self) -> "Plan":
        """The plan with whole comparisons one after another: seed 0 in every environment, then seed 1 and so on."""
        return self._part(sorted(self.entries, key=lambda e: e.run.seed))

    def _part(self, entries: list[Entry]) -> "Plan":
        return dataclasses.replace(self, entries=entries, whole=self.whole or self)

    def write(self, runs_dir: Path) -> Path:
        """Write the plan for analysis and drawing, which read nothing else but run folders and committed rows.

        Of a part the whole is written: what there is to draw does not depend on what was trained last.
        """
        edition, name = self.edition, self.edition.name(self.figure)
        path = runs_dir / "plans" / edition.folder / f"{name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_abandoned(path.parent, ABANDONED_SECONDS)
        left_out = self.description.get("not_trained", {}).get(edition.scale, [])
        content = {
            "figure": name,
            **dataclasses.asdict(edition),
            "title": ", ".join([self.description["title"], *edition.marks]),
            "scales": trained_at(self.description),
            "not_trained": [{"env": env, "env_label": env_label(env)} for env in left_out],
            "refused": self.refused,
            "runs": [entry.as_planned() for entry in (self.whole or self).entries],
            "claims": self.description.get("claims", []),
            "notes": self.description.get("notes", []),
        }
        if self.own:
            content["committed_in"] = self.description["committed_in"]
        write_atomically(path, json.dumps(content, indent=1))
        return path


def unique(runs: Sequence[Run]) -> list[Run]:
    """Each run once, in the order of their first mention."""
    return list({run.run_id: run for run in runs}.values())


def load_figure(figure: str) -> dict[str, Any]:
    """conf/figure/<figure>.yaml."""
    check_choice("figure", figure, choices("figure"))
    return yaml.safe_load((CONF / "figure" / f"{figure}.yaml").read_text())


def trained_at(description: dict[str, Any]) -> list[str]:
    """Scales at which a figure trains anything."""
    left_out = description.get("not_trained", {})
    return [scale for scale in choices("scale") if set(description["environments"]) - set(left_out.get(scale, []))]


def env_label(env: str) -> str:
    """How figures call an environment; a foreign one is called by its id."""
    if env not in choices("env"):
        return env
    return yaml.safe_load((CONF / "env" / f"{env}.yaml").read_text())["label"]


def committed_runs(figure: str, edition: Edition) -> set[str]:
    """Ids of the runs whose rows are committed for this figure and edition; with overrides, none ever are."""
    path = COMMITTED / edition.folder / f"{figure}.csv"
    if edition.overrides or not path.exists():
        return set()
    with path.open() as file:
        return {row["run_id"] for row in csv.DictReader(file)}


def make_plan(
    figure: str, scale: str, settings: Sequence[str], fresh: bool, runs_dir: Path, protocol: str = PAPER
) -> Plan:
    """Resolve a figure into runs and look up how each is doing.

    A variant one of whose own settings cannot be had under the protocol is listed as refused.
    """
    description = load_figure(figure)
    check_choice("scale", scale, choices("scale"))
    check_choice("protocol", protocol, choices("protocol"))
    for setting in settings:
        if (key := setting.partition("=")[0]) in FIXED:
            raise ConfigError(f"set {key}", setting.partition("=")[2], f"{figure} and the sweep's options decide {key}")
    edition = Edition.of(scale, protocol, settings)
    return resolved(figure, edition, description, settings, fresh, runs_dir)


def resolved(
    figure: str, edition: Edition, description: dict[str, Any], settings: Sequence[str], fresh: bool, runs_dir: Path
) -> Plan:
    """The plan that a description makes.

    Args:
        settings: overrides of every run, after those of the description.
    """
    scale, protocol = edition.scale, edition.protocol
    seeds = description["seeds"] if "seeds" in description else seeds_of(edition)
    committed: set[str] = set()
    if not fresh:
        committed = committed.union(*(committed_runs(f, edition) for f in description.get("committed_in", [figure])))
    left_out = description.get("not_trained", {}).get(scale, [])
    plan = Plan(figure, edition, description, fresh, [])
    for env in (env for env in description["environments"] if env not in left_out):
        label, of_env = env_label(env), description.get("environment_settings", {}).get(env, [])
        for variant, what in description["variants"].items():
            if env not in what.get("environments", [env]):
                continue
            chosen = [f"env={env}", f"algo={what['algo']}", f"scale={scale}", f"protocol={protocol}"]
            kind = what.get("kind", description.get("kind"))
            of_scale = what.get("scale_settings", {}).get(scale, [])
            try:
                first = compose_run([*chosen, *of_env, *what.get("settings", []), *of_scale, *settings], runs_dir)
            except ConfigError as error:
                if plan.own:
                    raise ConfigError(error.key, error.value, f"{error.valid} (in {what['label']}, {env})") from error
                if protocol == PAPER or f"{error.key}={error.value}" not in what.get("settings", []):
                    raise
                refused = {"env": env, "env_label": label, "variant_label": what["label"], "why": str(error)}
                plan.refused.append(refused)
                continue
            if kind is not None:
                evaluation = description["evaluation"] if kind == "evaluate" else None
                first = dataclasses.replace(first, kind=kind, evaluation=evaluation)
            for seed in range(seeds):
                run = dataclasses.replace(first, seed=seed)
                state = read_status(run.folder)["state"]
                if state != "finished" and run.run_id in committed:
                    state = "committed"
                plan.entries.append(Entry(run, label, variant, what["label"], state))
    return plan


def seeds_of(edition: Edition) -> int:
    """Seeds of every variant: the protocol's number, or the scale's where it has none."""
    protocol, scale = (
        yaml.safe_load((CONF / group / f"{name}.yaml").read_text())
        for group, name in (("protocol", edition.protocol), ("scale", edition.scale))
    )
    return protocol.get("seeds", {}).get(edition.scale, scale["seeds"])


def summary(plan: Plan) -> str:
    """One paragraph: how many runs, how they are doing, what is left to pay."""
    states = Counter(e.state for e in {e.run.run_id: e for e in plan.entries}.values())
    counts = ", ".join(f"{number} {state}" for state, number in sorted(states.items()))
    todo, table = plan.todo(), costs.known()
    lines = [
        f"{plan.figure} at {plan.edition}: {sum(states.values())} runs ({counts}); to train: {len(todo)} runs, "
        f"{sum(run.env_steps for run in todo):,} environment steps, "
        f"about {duration(sum(costs.seconds(run, table) for run in todo))} on one core"
    ]
    return "\n".join([*lines, *refused_lines([plan])])


def refused_lines(plans: Sequence[Plan]) -> list[str]:
    """A line per variant that its protocol cannot train."""
    return [
        f"{plan.figure}: not trained under the {plan.edition.protocol} protocol: {label} ({why})"
        for plan in plans
        for label, why in {each["variant_label"]: each["why"] for each in plan.refused}.items()
    ]


COLUMNS = (
    *("figure", "runs", "shared", "done", "running", "preempted", "failed", "missing"),
    *("env steps", "core-hours", "disk"),
)


def overview(plans: Sequence[Plan], workers: int) -> str:
    """A table with a line per figure and the total of what is left, every run counted once.

    `runs` counts those that a figure depends on too, `shared` those that another figure of the table also needs; the
    remaining columns are about what is left to do.
    """
    table = costs.calibrate([run for plan in plans for run in plan.runs()])
    uses = Counter(run.run_id for plan in plans for run in plan.runs())
    lines, all_todo = [], []
    everything: dict[str, str] = {}
    for plan in plans:
        own = {e.run.run_id: e.state for e in plan.entries}
        states = {r.run_id: own.get(r.run_id) or _state(r, plan.fresh) for r in plan.runs()}
        everything |= states
        all_todo += plan.todo()
        shared = sum(uses[run_id] > 1 for run_id in states)
        lines.append(_line(plan.figure, states, shared, plan.todo(), table))
    todo = unique(all_todo)
    lines.append(_line("together", everything, sum(n > 1 for n in uses.values()), todo, table))
    seconds = sum(costs.seconds(run, table) for run in todo)
    chains = (sum(costs.seconds(r, table) for r in [run, *run.ancestors] if r in todo) for run in todo)
    days = sorted({costs.cost(run, table).measured for plan in plans for run in plan.runs()} - {""})
    notes = [
        f"wall-clock with {workers} processes: at least {duration(max([seconds / workers, *chains]))}",
        f"seconds per step measured on {costs.cpu_name()}, {', '.join(days)} ({costs.cache_file()})",
    ]
    return "\n".join([_row(COLUMNS), *lines, *notes, *refused_lines(plans)])


def _state(run: Run, fresh: bool) -> str:
    state = read_status(run.folder)["state"]
    return "committed" if state != "finished" and is_there(run, fresh) else state


def _line(name: str, states: dict[str, str], shared: int, todo: Sequence[Run], table: dict[str, Any]) -> str:
    count = Counter(states.values())
    failed = sum(count[state] for state in ("failed", "diverged", "lost"))
    done, running = sum(count[state] for state in DONE), count["running"] + count["pending"]
    preempted = count["preempted"]  # not failed: the same command continues it
    missing = len(states) - done - running - preempted - failed
    steps, seconds = sum(run.env_steps for run in todo), sum(costs.seconds(run, table) for run in todo)
    disk = sum(costs.disk(run, table) for run in todo)
    numbers = (len(states), shared, done, running, preempted, failed, missing)
    return _row((name, *numbers, f"{steps / 1e6:,.1f} M", f"{seconds / 3600:,.2f}", f"{disk / 1e6:,.1f} MB"))


def _row(cells: Sequence[Any]) -> str:
    widths = (9, 6, 7, 6, 8, 10, 7, 8, 12, 11, 11)
    return "".join(
        f"{cell:<{w}}" if i == 0 else f"{cell:>{w}}" for i, (cell, w) in enumerate(zip(cells, widths, strict=True))
    )
