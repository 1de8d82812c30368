"""How the runs of a plan are doing, as a table; and which of them may be tried again."""

import argparse
import sys
import time
from collections.abc import Callable

from experiments import slurm
from experiments.command_line import clock
from experiments.config import Run
from experiments.plan import Plan
from experiments.status import DONE, read_status
from hippo.core.files import printable

WATCH_SECONDS = 2.0  # between two tables
MAX_ATTEMPTS = 3  # of a run that the machine made fail, before `retry` leaves it alone


def show_status(options: argparse.Namespace, plan_of: Callable[[str], Plan]) -> int:
    """`status`, once or until nothing runs or waits any more."""
    while True:
        plan, waiting = plan_of(options.figure), slurm.queued(options.runs_dir)
        clear = "\x1b[2J\x1b[H" if options.watch and sys.stdout.isatty() else ""
        print(clear + status_table(plan, waiting), flush=True)
        active = (r.run_id in waiting or read_status(r.folder)["state"] == "running" for r in plan.runs())
        if not options.watch or not any(active):
            return 0
        time.sleep(WATCH_SECONDS)


def status_table(plan: Plan, waiting: dict[str, str]) -> str:
    """A line per run: state, progress, return, ETA, speed; of those that ended badly also cause, log and what to type.

    Args:
        waiting: run id -> Slurm job of what is in the queue.
    """
    variants = {e.run.run_id: (e.variant, e.state) for e in plan.entries}
    env_width, width = (
        max([least, *map(len, names)])
        for least, names in (
            (18, {run.env for run in plan.runs()}),
            (22, {variant for variant, _ in variants.values()}),
        )
    )
    columns = f"{'state':10} {'iteration':>11} {'return':>9} {'ETA':>8} {'steps/s':>9}"
    lines = [f"{'run':12}  {'environment':{env_width}} {'variant':{width}} {'seed':>4}  {columns}"]
    for run in plan.runs():
        variant, state = variants.get(run.run_id, (run.kind, ""))
        s = read_status(run.folder)
        state = state if state == "committed" else s["state"]
        if run.run_id in waiting and state not in (*DONE, "running"):
            state = "pending"
        done = f"{s.get('iteration', -1) + 1}/{run.config.iterations}"
        reached = "" if s.get("return_mean") is None else f"{s['return_mean']:.4g}"
        speed = f"{s['steps_per_second']:,.0f}" if s.get("steps_per_second") else ""
        eta = clock(s["eta"]) if state == "running" and "eta" in s else ""
        cells = f"{state:10} {done:>11} {reached:>9} {eta:>8} {speed:>9}"
        lines.append(f"{run.run_id:12}  {run.env:{env_width}} {variant:{width}} {run.seed:4}  {cells}".rstrip())
        if state in ("failed", "diverged", "lost", "preempted") or (state == "running" and s["message"]):
            lines.append(f"{'':14}{printable(s['message'] or state)} (log: {run.folder / 'train.log'})")
    to_retry = may_retry(plan)
    if to_retry:
        lines.append(f"{len(to_retry)} to try again: python -m experiments.sweep retry {plan.typed}")
    return "\n".join(lines)


def may_retry(plan: Plan) -> list[Run]:
    """Runs that the machine made fail: killed, preempted, disk full; not those that diverged or met a bug."""
    chosen = []
    for run in plan.runs():
        status = read_status(run.folder)
        machine = status["state"] in ("lost", "preempted") or status.get("cause") == "infrastructure"
        if machine and status["state"] not in (*DONE, "running") and status.get("attempts", 0) < MAX_ATTEMPTS:
            chosen.append(run)
    return chosen
