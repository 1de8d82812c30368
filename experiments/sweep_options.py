"""What is typed behind `python -m experiments.sweep`, and what of it is refused."""

import argparse
import math
import os
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

from experiments import own_sweep
from experiments.choices import check_choice, choices
from experiments.command_line import (
    Parser,
)
from hippo.core.settings import ConfigError

LAUNCHERS = ("local", "slurm")
ORDERS = ("longest", "seeds")
TARGETS = "a figure or table of conf/figure, or a sweep of your own; `plan` and `write` also take all"
CORE_HOURS = 2.0  # more than this is not started without being agreed to


def parse(arguments: Sequence[str] | None, actions: Iterable[str], description: str) -> argparse.Namespace:
    """The command line: one of `actions`, and what it is done to."""
    parser = Parser(prog="experiments.sweep", description=description, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("action", choices=tuple(actions))
    parser.add_argument("targets", nargs="*", metavar="figure", help=TARGETS)
    parser.add_argument("--scale", help="smoke (default), laptop or paper")
    parser.add_argument("--protocol", help="paper (default) or modern")
    parser.add_argument("--launcher", default="local", help=", ".join(LAUNCHERS))
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)), help="processes, one thread each")
    parser.add_argument("--profile", type=Path, help="slurm: what jobs ask for (default: conf/slurm/default.yaml)")
    parser.add_argument("--dry-run", action="store_true", help="train nothing; slurm: say what would be submitted")
    parser.add_argument("--wait", action="store_true", help="slurm: return when the jobs have ended, not at once")
    parser.add_argument("--runs-dir", type=Path, default=Path("runs"))
    parser.add_argument("--fresh", action="store_true", help="ignore committed results")
    parser.add_argument("--env", type=lambda text: text.split(","), metavar="NAME[,NAME...]", help="only in these")
    parser.add_argument(
        "--order",
        default=ORDERS[0],
        help="local: the longest run first, or seeds: all variants of seed 0, then of 1...",
    )
    parser.add_argument("--only", action="append", metavar="RUN_ID", help="nothing but this run and what it needs")
    parser.add_argument("--max-core-hours", type=float, default=CORE_HOURS, help="start no more than this unasked")
    parser.add_argument("--yes", action="store_true", help="start it all the same")
    parser.add_argument("--watch", action="store_true", help="status: again and again until nothing runs")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override in every run")
    own_sweep.add_options(parser)
    parser.add_argument("--out", type=Path, help="compare: where pictures and tables go")
    return parser.parse_intermixed_args(arguments)


def check_options(options: argparse.Namespace) -> None:
    """Raise ConfigError for what argparse does not check."""
    check_choice("launcher", options.launcher, LAUNCHERS)
    several = options.action in ("compare", "collect")
    if len(options.targets) > 1 and not several:
        raise ConfigError("figure", " ".join(options.targets), f"{options.action} takes one figure or sweep at a time")
    options.figure = options.targets[0] if options.targets else None
    check_choice("order", options.order, ORDERS if options.launcher == "local" else ORDERS[:1])
    if options.workers < 1:
        raise ConfigError("workers", options.workers, "must be at least 1")
    if not 0 <= options.max_core_hours < math.inf:  # nor nan, which is above nothing
        raise ConfigError("max-core-hours", options.max_core_hours, "must be 0 or more; --yes starts any number")


def check_runs_dir(folder: Path) -> None:
    """Raise ConfigError unless runs can be written in `folder`, which is made where it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ConfigError("runs-dir", folder, f"must be a folder that can be written ({error.strerror})") from None


def named(options: argparse.Namespace) -> list[str]:
    """The figures and tables that the command line names."""
    return choices("figure") if options.figure == "all" else [options.figure]
