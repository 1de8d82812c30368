"""Plan and do the runs of a figure: what is finished is skipped, what was interrupted goes on, the rest is trained.

python -m experiments.sweep plan all --scale paper     what would be trained and what it costs on this machine
python -m experiments.sweep run fig3 --scale smoke     do it; the same command again continues
python -m experiments.sweep write all --scale laptop   only the plans that drawing reads; train and measure nothing
python -m experiments.sweep status fig3 --watch        how every run is doing
python -m experiments.sweep retry fig3                 once more what the machine, not the code, made fail
python -m experiments.sweep cancel fig3                take its jobs out of Slurm's queue
python -m experiments.sweep collect FOLDER...          take finished runs over from other runs folders

A sweep of your own goes by its name in the place of a figure (docs/own_sweep.md):

python -m experiments.sweep run --name lr --over algo=hippo,ppo --over algo.learning_rate=1e-4,3e-4 --seeds 5
python -m experiments.sweep compare lr                 its learning curves and a table; or any runs: runs/a runs/b
"""

import argparse
import functools
import shlex
import shutil
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from experiments import collect, costs, own_sweep, slurm
from experiments.command_line import (
    EXIT_FAILED,
    EXIT_NOT_AGREED,
    EXIT_REQUEUE,
    bad_input,
    clock,
    run_command,
)
from experiments.config import Run
from experiments.console import unattended
from experiments.launchers import run_locally
from experiments.own_compare import compare
from experiments.plan import Plan, make_plan, overview, refused_lines, summary, trained_at
from experiments.slurm_profile import load_profile
from experiments.status import DONE, check_locks, is_locked, read_status
from experiments.status_table import may_retry, show_status
from experiments.sweep_options import check_options, check_runs_dir, named, parse
from hippo.core.files import printable
from hippo.core.settings import ConfigError

REPORT_SECONDS = 10.0  # between two progress lines
NAMED = 4  # runs in progress that a progress line names


Report = Callable[[Sequence[Run], int], None]  # takes the runs in progress and the number of those that ended


def train_all(todo: Sequence[Run], workers: int, report: Report, in_order: bool = False) -> dict[str, str]:
    """Train `todo`; runs that another launch is training are waited for, and taken over should it give up.

    Args:
        report: called about once a second.
        in_order: as they are given, not the longest first.
    """
    states: dict[str, str] = {}
    here = list(todo)
    while here:
        before = len(todo) - len(here)

        def on_change(active: dict[str, Run], ended: int, before: int = before) -> None:
            report(list(active.values()), before + ended)

        states |= run_locally(here, workers, on_change, in_order)
        elsewhere = [run for run in todo if states[run.run_id] == "running"]
        here = []
        while elsewhere and not here:
            time.sleep(1.0)
            states |= {run.run_id: read_status(run.folder)["state"] for run in elsewhere}
            open_ended = [run for run in elsewhere if states[run.run_id] in ("running", "lost", "preempted")]
            # What has just been stopped still holds its run for a moment.
            here = [run for run in open_ended if states[run.run_id] != "running" and not is_locked(run.folder)]
            elsewhere = [run for run in open_ended if run not in here]
            report(elsewhere, len(todo) - len(elsewhere) - len(here))
    return states


TrainAll = Callable[[Sequence[Run], Report], dict[str, str]]


def run_figure(plan: Plan, todo: Sequence[Run], train: TrainAll, runs_dir: Path) -> int:
    """Do `todo`, write the plan with what became of it, and name what failed; returns the exit code."""
    started, last_report = time.monotonic(), time.monotonic()
    table = costs.known()
    estimate = {run.run_id: costs.seconds(run, table) for run in todo}
    names = names_of(plan)
    begun = {run.run_id: read_status(run.folder).get("iteration", -1) + 1 for run in todo}

    def progress() -> float:
        """Estimated seconds of work done since the start."""
        return sum(
            (read_status(run.folder).get("iteration", -1) + 1 - begun[run.run_id])
            / run.config.iterations
            * estimate[run.run_id]
            for run in todo
        )

    terminal = sys.stdout.isatty()
    stopping = False

    def stop(_signal: int, _frame: object) -> None:
        """Ctrl-C and SIGTERM alike: every run stays resumable."""
        nonlocal stopping
        stopping = True
        raise KeyboardInterrupt

    def report(running: Sequence[Run], ended: int) -> None:
        nonlocal last_report
        if stopping:  # an exception raised inside a finaliser is lost; the flag is not
            raise KeyboardInterrupt
        if time.monotonic() - last_report < (1.0 if terminal else REPORT_SECONDS):
            return
        last_report = time.monotonic()
        elapsed, done = last_report - started, progress()
        eta = clock(elapsed * (sum(estimate.values()) - done) / done) if done > 0 else "unknown"
        line = (
            f"[{ended}/{len(todo)}] {len(running)} running, elapsed {clock(elapsed)}, ETA {eta}{doing(running, names)}"
        )
        cut = line[: shutil.get_terminal_size().columns - 1]  # a longer line could not be written over
        print(f"\r{cut}\x1b[K" if terminal else line, end="" if terminal else "\n", flush=True)

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with unattended():
            states = train(todo, report)
    except KeyboardInterrupt:
        print("\nstopped; the same command continues where it left off", file=sys.stderr)
        return EXIT_REQUEUE
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    for entry in plan.entries:
        entry.state = states.get(entry.run.run_id, entry.state)
    try:
        plan.write(runs_dir)
    except OSError as error:
        print(f"error: the plan of {plan.figure} is not written: {error}", file=sys.stderr)
    if todo:
        start_of_line = "\r" if terminal else ""
        print(f"{start_of_line}[{len(todo)}/{len(todo)}] done in {clock(time.monotonic() - started)}")
    if plan.own or plan.edition.overrides:
        what = "learning curves and a table" if plan.own else "with overrides, a figure of its own"
        print(f"{what}: {drawing(plan)} --runs-dir {shlex.quote(str(runs_dir))}")
    return name_failures(plan, todo, states)


def names_of(plan: Plan) -> dict[str, str]:
    """What a reader calls the runs of a plan, by id."""
    return {e.run.run_id: f"{e.run.env} {e.variant} seed {e.run.seed}" for e in plan.entries}


def doing(running: Sequence[Run], names: dict[str, str]) -> str:
    """The runs in progress with their last return, as the end of a progress line; of many only the first few."""
    words = []
    for run in running[:NAMED]:
        last = read_status(run.folder).get("return_mean")
        name = names.get(run.run_id, f"{run.env} {run.algo} seed {run.seed}")
        words.append(name if last is None else f"{name} return {last:.3g}")
    more = [f"{len(running) - NAMED} more"] if len(running) > NAMED else []
    return ": " + "; ".join([*words, *more]) if words else ""


def name_failures(plan: Plan, todo: Sequence[Run], states: dict[str, str]) -> int:
    """A line on stderr for every run that is not done; returns the exit code."""
    names = names_of(plan)
    bad = {e.run.run_id: (e.run, e.state) for e in plan.entries if e.state not in DONE}
    bad |= {run.run_id: (run, states[run.run_id]) for run in todo if states.get(run.run_id, "finished") not in DONE}
    for run_id, (run, state) in bad.items():
        name = names.get(run_id, f"{run.env} {run.algo} seed {run.seed}")
        unfinished = [a.run_id for a in run.ancestors if a.run_id in bad]
        message = f"needs {unfinished[0]}" if unfinished else read_status(run.folder).get("message", "")
        print(f"{state}: {name}: {printable(message)} (log: {run.folder / 'train.log'})", file=sys.stderr)
    return EXIT_FAILED if bad else 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Plan, run, report or retry; the exit code is 0 when everything asked for is there."""
    options = parse(arguments, ACTIONS, __doc__)

    def plan_of(figure: str) -> Plan:
        if (sweep := own_sweep.chosen(options)) is not None:
            plan = sweep.plan(own_sweep.harmless(options.set), options.fresh, options.runs_dir)
        else:
            scale = "smoke" if options.scale is None else options.scale
            protocol = Run.protocol if options.protocol is None else options.protocol
            plan = make_plan(figure, scale, options.set, options.fresh, options.runs_dir, protocol)
        plan = plan.within(options.env) if options.env and plan.entries else plan
        plan = plan.by_seed() if options.order == "seeds" else plan
        return plan.only(options.only) if options.only else plan

    try:
        check_options(options)
        return ACTIONS[options.action](options, plan_of)
    except ConfigError as error:
        return bad_input(error)
    except BrokenPipeError:
        raise
    except OSError as error:  # of a file system without locks, too
        print(f"error: {error}", file=sys.stderr)
        return EXIT_FAILED


def show_plan(options: argparse.Namespace, plan_of: Callable[[str], Plan]) -> int:
    """`plan`."""
    print(overview([plan_of(figure) for figure in named(options)], options.workers))
    return 0


def write_plans(options: argparse.Namespace, plan_of: Callable[[str], Plan]) -> int:
    """`write`."""
    plans = [plan_of(figure) for figure in named(options)]
    check_runs_dir(options.runs_dir)
    for plan in plans:
        own_sweep.store(plan, options.runs_dir)
        plan.write(options.runs_dir)
    return 0


def run_or_retry(options: argparse.Namespace, plan_of: Callable[[str], Plan]) -> int:
    """`run` and `retry`; what costs much is started only if it was agreed to, else nothing is written."""
    plan = plan_of(options.figure)
    if not plan.entries:
        print(
            f"{plan.figure}: not trained at {plan.edition}, only at {', '.join(trained_at(plan.description))}",
            *refused_lines([plan]),
            sep="\n",
        )
        plan.write(options.runs_dir)
        return 0
    todo = plan.todo() if options.action == "run" else may_retry(plan)
    profile = load_profile(options.profile) if options.launcher == "slurm" else None
    if profile is not None and not options.dry_run:
        slurm.check_installed()
    hours = sum(costs.reference_seconds(run) for run in todo) / 3600
    if hours >= options.max_core_hours and todo and not options.yes and not options.dry_run:
        print(ask(plan, len(todo), hours, options), file=sys.stderr)
        return EXIT_NOT_AGREED
    if not options.dry_run:
        check_runs_dir(options.runs_dir)
        own_sweep.store(plan, options.runs_dir)
    if options.action == "run" and plan.edition.scale != "smoke" and not options.dry_run:
        costs.calibrate(todo)
    print(summary(plan), flush=True)
    if profile is not None:
        slurm.submit(todo, options.runs_dir, profile, options.dry_run, plan.label)
    if options.dry_run:
        return 0
    plan.write(options.runs_dir)
    check_locks(options.runs_dir)
    if profile is None:
        in_order = options.order == "seeds"
        train = functools.partial(train_all, workers=options.workers, in_order=in_order)
        return run_figure(plan, todo, lambda runs, report: train(runs, report=report), options.runs_dir)
    if not options.wait:
        return 0
    return run_figure(plan, todo, lambda runs, report: slurm.wait(runs, options.runs_dir, report), options.runs_dir)


def ask(plan: Plan, runs: int, hours: float, options: argparse.Namespace) -> str:
    """Three lines: which number asks for consent, where it is from, and how to give it.

    The number is that of the committed reference costs, so that the answer is the same on every machine, every time.
    """
    target, variables = plan.figure, plan.edition.variables
    agree, draw = f"make {target} {variables} YES=1, or --yes", f"make draw-{target} {variables}"
    measure = f"make plan-{target} {variables}"
    if plan.own or plan.edition.overrides:  # make knows none
        agree, draw, measure = "--yes", drawing(plan), "`plan` in the place of `run`"
    return (
        f"not started: {target} at {plan.edition} has {runs} runs to train, about {hours:,.1f} core-hours; "
        f"from {options.max_core_hours:g} on (--max-core-hours) you are asked\n"
        f"  estimate: environment steps times the committed seconds per step ({costs.reference_source()}); "
        f"{measure} measures this machine\n"
        f"  to agree: {agree}; without training: {draw}"
    )


def drawing(plan: Plan) -> str:
    """The command that draws a plan, which is the only one for a plan with overrides or of one's own."""
    if plan.own:
        return f"python -m experiments.sweep compare {plan.figure}"
    return f"python -m paper_figures.{plan.figure} {plan.edition.options}"


def cancel(options: argparse.Namespace, plan_of: Callable[[str], Plan]) -> int:
    """`cancel`."""
    plan = plan_of(options.figure)
    jobs = slurm.cancel(plan.label, options.runs_dir)
    elsewhere = "" if jobs else "; what was started with --launcher local ends at Ctrl-C"
    print(f"{plan.figure}: {jobs} jobs cancelled{elsewhere}")
    return 0


def take_over(options: argparse.Namespace, _plan_of: Callable[[str], Plan]) -> int:
    """`collect`."""
    collect.check(options.targets)
    check_runs_dir(options.runs_dir)
    return collect.collect([Path(folder) for folder in options.targets], options.runs_dir)


ACTIONS = {
    "plan": show_plan,
    "write": write_plans,
    "run": run_or_retry,
    "status": show_status,
    "retry": run_or_retry,
    "cancel": cancel,
    "compare": compare,
    "collect": take_over,
}


if __name__ == "__main__":
    run_command(main)
