"""The learning curves of a sweep of one's own, or of any runs, with a table: `python -m experiments.sweep compare`."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from experiments.choices import nearest
from experiments.own_sweep import names
from experiments.plan import Plan
from hippo.core.settings import ConfigError


def compare(options: argparse.Namespace, plan_of: Callable[[str], Plan]) -> int:
    """`compare NAME`, `compare runs/<run_id> ...`."""
    from analysis.runs import MissingData, load  # here, for drawing takes a second to import
    from paper_figures import command_line
    from paper_figures import compare as drawing

    out = options.out or drawing.OUT
    known = names(options.runs_dir)
    if len(options.targets) == 1 and (name := options.targets[0]) in known:
        plan = plan_of(name)
        plan.write(options.runs_dir)
        folders = {entry.run.run_id: entry.run.folder for entry in plan.entries}
        data = command_line.HERE / "data"
        edition = plan.edition
        try:
            results = load(name, edition.scale, options.runs_dir, data, ("return_mean",), edition.protocol)
        except MissingData as missing:
            print(f"not drawn: {missing}", file=sys.stderr)
            return command_line.NOTHING_YET
        except ValueError as error:
            raise ConfigError("compare", name, str(error)) from error
        drawing.show(results, folders, out)
        return 0
    if not options.targets:
        raise ConfigError(
            "compare", "", f"name a sweep of your own ({', '.join(known) or 'there is none'}) or run folders"
        )
    for target in options.targets:
        if not Path(target).is_dir():
            raise ConfigError("compare", target, f"is no run folder and no sweep of your own; {nearest(target, known)}")
    return drawing.main([*options.targets, "--out", str(out)])
