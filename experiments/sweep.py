"""Plan and train the runs of a figure: what is finished is skipped, what was interrupted goes on, the rest is trained.

python -m experiments.sweep run fig3 --scale smoke
python -m experiments.sweep plan fig3 --scale paper
python -m experiments.sweep status fig3 --scale smoke
"""

import argparse
import csv
import dataclasses
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from experiments.config import CONF, Run, check_choice, choices, compose_run
from experiments.launchers import run_locally
from experiments.train import EXIT_FAILED, EXIT_REQUEUE, bad_input, clock, read_status, write_atomically
from hippo.core.settings import ConfigError

COMMITTED = Path(__file__).parent.parent / "paper_figures" / "data"
LAUNCHERS = ("local",)
REPORT_SECONDS = 10.0  # between two progress lines
DONE = ("finished", "committed")
FIXED = ("env", "algo", "scale", "seed", "runs_dir")  # the plan's own business, not that of --set


@dataclass
class Entry:
    """One run of a figure: where it stands in the figure and how it is doing."""

    run: Run
    env_label: str
    variant: str
    variant_label: str
    state: str


@dataclass
class Plan:
    """All runs of one figure at one scale."""

    figure: str
    scale: str
    title: str
    claims: list[str]
    notes: list[str]
    entries: list[Entry]

    def todo(self) -> list[Run]:
        """Runs that still have to be trained, each once; a diverged one would only diverge again."""
        return list({e.run.run_id: e.run for e in self.entries if e.state not in (*DONE, "diverged")}.values())

    def to_pay(self) -> list[Run]:
        """`todo` and the parents that its runs will have to train first, each once."""
        parents = [run.parent for run in self.todo() if run.parent is not None]
        unfinished = [run for run in parents if read_status(run.folder)["state"] != "finished"]
        return list({run.run_id: run for run in [*self.todo(), *unfinished]}.values())

    def write(self, runs_dir: Path) -> Path:
        """Write the plan for analysis and drawing, which read nothing else but run folders and committed rows."""
        path = runs_dir / "plans" / self.scale / f"{self.figure}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        content = {
            "figure": self.figure,
            "scale": self.scale,
            "title": self.title,
            "runs": [
                {
                    "run_id": e.run.run_id,
                    "env": e.run.env,
                    "env_label": e.env_label,
                    "variant": e.variant,
                    "variant_label": e.variant_label,
                    "seed": e.run.seed,
                    "iterations": e.run.config.iterations,
                    "batch_size": e.run.config.batch_size,
                    "physics": e.run.options.get("physics", "paper"),
                    "kind": e.run.kind,
                    "state": e.state,
                }
                for e in self.entries
            ],
            "claims": self.claims,
            "notes": self.notes,
        }
        write_atomically(path, json.dumps(content, indent=1))
        return path


def load_figure(figure: str) -> dict[str, Any]:
    """conf/figure/<figure>.yaml."""
    check_choice("figure", figure, choices("figure"))
    return yaml.safe_load((CONF / "figure" / f"{figure}.yaml").read_text())


def committed_runs(figure: str, scale: str) -> set[str]:
    """Ids of the runs whose rows are committed for this figure and scale."""
    path = COMMITTED / scale / f"{figure}.csv"
    if not path.exists():
        return set()
    with path.open() as file:
        return {row["run_id"] for row in csv.DictReader(file)}


def make_plan(figure: str, scale: str, settings: Sequence[str], fresh: bool, runs_dir: Path) -> Plan:
    """Resolve a figure into runs and look up how each is doing."""
    description = load_figure(figure)
    check_choice("scale", scale, choices("scale"))
    for setting in settings:
        if (key := setting.partition("=")[0]) in FIXED:
            raise ConfigError(f"set {key}", setting.partition("=")[2], f"{figure} and the sweep's options decide {key}")
    seeds = yaml.safe_load((CONF / "scale" / f"{scale}.yaml").read_text())["seeds"]
    committed = set() if fresh else committed_runs(figure, scale)
    entries = []
    for env in description["environments"]:
        label = yaml.safe_load((CONF / "env" / f"{env}.yaml").read_text())["label"]
        for variant, what in description["variants"].items():
            chosen = [f"env={env}", f"algo={what['algo']}", f"scale={scale}", f"runs_dir={runs_dir}"]
            for seed in range(seeds):
                run = compose_run([*chosen, *what.get("settings", []), *settings, f"seed={seed}"])
                run = dataclasses.replace(run, kind=what.get("kind", description.get("kind", "train")))
                state = read_status(run.folder)["state"]
                if state != "finished" and run.run_id in committed:
                    state = "committed"
                entries.append(Entry(run, label, variant, what["label"], state))
    return Plan(
        figure, scale, description["title"], description.get("claims", []), description.get("notes", []), entries
    )


def summary(plan: Plan) -> str:
    """One paragraph: how many runs, how they are doing, what is left to pay."""
    runs = {e.run.run_id: e for e in plan.entries}
    states = sorted({e.state for e in runs.values()})
    counts = ", ".join(f"{sum(e.state == state for e in runs.values())} {state}" for state in states)
    todo, cost = plan.to_pay(), sum(run.estimated_seconds for run in plan.to_pay())
    return (
        f"{plan.figure} at scale {plan.scale}: {len(runs)} runs ({counts}); to train: {len(todo)} runs, "
        f"{sum(run.env_steps for run in todo):,} environment steps, about {duration(cost)} on one core"
    )


def duration(seconds: float) -> str:
    """Seconds in the unit that reads best."""
    return f"{seconds / 60:.1f} minutes" if seconds < 3600 else f"{seconds / 3600:,.1f} hours"


def train_all(todo: Sequence[Run], workers: int, report: Callable[[int, int], None]) -> dict[str, str]:
    """Train `todo`; runs that another launch is training are waited for, and taken over should it give up.

    Args:
        report: called about once a second with the number of runs in progress and of those that ended.
    """
    states: dict[str, str] = {}
    here = list(todo)
    while here:
        before = len(todo) - len(here)
        states |= run_locally(here, workers, lambda active, ended, before=before: report(len(active), before + ended))  # type: ignore[misc]
        elsewhere = [run for run in todo if states[run.run_id] == "running"]
        here = []
        while elsewhere and not here:
            time.sleep(1.0)
            states |= {run.run_id: read_status(run.folder)["state"] for run in elsewhere}
            here = [run for run in elsewhere if states[run.run_id] in ("lost", "preempted")]
            elsewhere = [run for run in elsewhere if states[run.run_id] == "running"]
            report(len(elsewhere), len(todo) - len(elsewhere) - len(here))
    return states


def run_figure(plan: Plan, workers: int, runs_dir: Path) -> int:
    """Train what is missing; returns the exit code."""
    todo, started, last_report = plan.todo(), time.monotonic(), time.monotonic()
    by_id = {run.run_id: run for run in plan.to_pay()}
    total = sum(run.estimated_seconds for run in by_id.values())
    begun = {i: read_status(run.folder).get("iteration", -1) + 1 for i, run in by_id.items()}

    def progress() -> float:
        """Estimated seconds of work done since the start."""
        return sum(
            (read_status(run.folder).get("iteration", -1) + 1 - begun[i])
            / run.config.iterations
            * run.estimated_seconds
            for i, run in by_id.items()
        )

    terminal = sys.stdout.isatty()

    def report(running: int, ended: int) -> None:
        nonlocal last_report
        if time.monotonic() - last_report < (1.0 if terminal else REPORT_SECONDS):
            return
        last_report = time.monotonic()
        elapsed, done = last_report - started, progress()
        eta = clock(elapsed * (total - done) / done) if done > 0 else "unknown"
        line = f"[{ended}/{len(todo)}] {running} running, elapsed {clock(elapsed)}, ETA {eta}"
        print(f"\r{line}\x1b[K" if terminal else line, end="" if terminal else "\n", flush=True)

    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C: every run stays resumable
    try:
        states = train_all(todo, workers, report)
    except KeyboardInterrupt:
        print("\nstopped; the same command continues where it left off", file=sys.stderr)
        return EXIT_REQUEUE
    for entry in plan.entries:
        entry.state = states.get(entry.run.run_id, entry.state)
    plan.write(runs_dir)
    if todo:
        start_of_line = "\r" if terminal else ""
        print(f"{start_of_line}[{len(todo)}/{len(todo)}] done in {clock(time.monotonic() - started)}")
    bad = {e.run.run_id: e for e in plan.entries if e.state not in DONE}
    for e in bad.values():
        message = read_status(e.run.folder).get("message", "")
        where = f"{e.run.env} {e.variant} seed {e.run.seed}"
        print(f"{e.state}: {where}: {message} (log: {e.run.folder / 'train.log'})", file=sys.stderr)
    return EXIT_FAILED if bad else 0


def status_table(plan: Plan) -> str:
    """A line per run: state, progress, speed, message."""
    lines = [
        f"{'run':12}  {'environment':18} {'variant':14} {'seed':>4}  {'state':10} {'iteration':>11} {'steps/s':>9}"
    ]
    for e in plan.entries:
        s = read_status(e.run.folder)
        done = f"{s.get('iteration', -1) + 1}/{e.run.config.iterations}"
        speed = f"{s['steps_per_second']:,.0f}" if s.get("steps_per_second") else ""
        lines.append(
            f"{e.run.run_id:12}  {e.run.env:18} {e.variant:14} {e.run.seed:4}  {e.state:10} {done:>11} {speed:>9}"
            f"  {s.get('message', '')}".rstrip()
        )
    return "\n".join(lines)


class _Parser(argparse.ArgumentParser):
    """Reports bad arguments in one line, as every other bad input."""

    def error(self, message: str) -> Any:
        print(f"error: {message}", file=sys.stderr)
        sys.exit(2)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = _Parser(prog="experiments.sweep", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("action", choices=("plan", "run", "status"))
    parser.add_argument("figure", help="a figure or table of conf/figure")
    parser.add_argument("--scale", default="smoke", help="smoke, laptop or paper")
    parser.add_argument("--launcher", default="local", help=", ".join(LAUNCHERS))
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)), help="processes, one thread each")
    parser.add_argument("--runs-dir", type=Path, default=Path("runs"))
    parser.add_argument("--fresh", action="store_true", help="ignore committed results")
    parser.add_argument("--max-core-hours", type=float, default=100.0, help="refuse to start more than this")
    parser.add_argument("--yes", action="store_true", help="start it all the same")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override in every run")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Plan, run or report; the exit code is 0 when everything asked for is there."""
    options = parse(arguments)
    try:
        check_choice("launcher", options.launcher, LAUNCHERS)
        if options.workers < 1:
            raise ConfigError("workers", options.workers, "must be at least 1")
        plan = make_plan(options.figure, options.scale, options.set, options.fresh, options.runs_dir)
        cost = sum(run.estimated_seconds for run in plan.to_pay()) / 3600
        if options.action == "run" and cost > options.max_core_hours and not options.yes:
            valid = f"below the estimate of {cost:,.0f}; raise it or agree with --yes (make ... YES=1)"
            raise ConfigError("max-core-hours", options.max_core_hours, valid)
    except ConfigError as error:
        return bad_input(error)
    if options.action == "status":
        print(status_table(plan))
        return 0
    print(summary(plan), flush=True)
    if options.action == "plan":
        return 0
    plan.write(options.runs_dir)
    return run_figure(plan, options.workers, options.runs_dir)


if __name__ == "__main__":
    sys.exit(main())
