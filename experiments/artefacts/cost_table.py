"""What every figure and table costs: the committed seconds per step, and the README's table that follows from them.

python -m experiments.artefacts.cost_table              # renews README.md between its marks from reference_costs.json
python -m experiments.artefacts.cost_table --measure    # first renews reference_costs.json on this machine
"""

import json
import re
from collections.abc import Sequence
from pathlib import Path

from experiments import costs
from experiments.choices import ROOT, choices
from experiments.command_line import Parser, duration, run_command
from experiments.config import Run
from experiments.plan import Plan, make_plan, unique
from experiments.status import write_atomically

README = ROOT / "README.md"
SCALES = ("smoke", "laptop", "paper")
MARK = re.compile(r"(<!-- costs -->\n).*?(<!-- end -->)", re.DOTALL)


def all_plans() -> dict[tuple[str, str], Plan]:
    """Plans by figure and scale, as if nothing were trained or committed."""
    return {
        (figure, scale): make_plan(figure, scale, [], True, Path("no-such-folder"))
        for figure in choices("figure")
        for scale in SCALES
    }


def table(plans: dict[tuple[str, str], Plan]) -> str:
    """A row per figure and table; what several of them share is counted in each, and once in the last row."""
    lines = [f"| target | what | {' | '.join(SCALES)} |", "|---|---|" + "---|" * len(SCALES)]
    for figure in choices("figure"):
        title = plans[figure, "smoke"].description["title"]
        cells = [_cell(plans[figure, scale].todo()) for scale in SCALES]
        lines.append(f"| `make {figure}` | {title} | {' | '.join(cells)} |")
    together = [unique([r for (_, s), plan in plans.items() if s == scale for r in plan.todo()]) for scale in SCALES]
    lines.append(f"| `make all` | every run once | {' | '.join(map(_cell, together))} |")
    source = costs.reference_source()
    return "\n".join(
        [
            *lines,
            "",
            f"Core-hours on {source}. `make plan-fig3 SCALE=paper` measures yours and says what is left to do.",
        ]
    )


def _cell(todo: Sequence[Run]) -> str:
    if not todo:
        return "not trained"
    return f"{len(todo)} runs, {duration(sum(map(costs.reference_seconds, todo)))}"


def measure(plans: dict[tuple[str, str], Plan]) -> None:
    """Write reference_costs.json from what this machine has measured, measuring what it has not."""
    runs = unique([run for plan in plans.values() for run in plan.runs()])
    known = costs.calibrate(runs)
    here = {costs.kind(run): costs.cost(run, known) for run in runs}
    content = {
        "cpu": costs.cpu_name().partition(" x ")[2],
        "day": max(cost.measured for cost in here.values()),
        "seconds_per_step": {kind: float(f"{here[kind].seconds_per_step:.3g}") for kind in sorted(here)},
    }
    write_atomically(costs.REFERENCE, json.dumps(content, indent=1) + "\n")
    costs.reference.cache_clear()
    print(f"wrote {costs.REFERENCE}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Renew the README, and the costs behind it if asked to."""
    parser = Parser(prog="experiments.artefacts.cost_table", description=__doc__.splitlines()[0])
    parser.add_argument("--measure", action="store_true", help="first renew reference_costs.json on this machine")
    options, plans = parser.parse_args(arguments), all_plans()
    if options.measure:
        measure(plans)
    README.write_text(MARK.sub(lambda m: f"{m[1]}{table(plans)}\n{m[2]}", README.read_text()))
    print(f"wrote {README}")
    return 0


if __name__ == "__main__":
    run_command(main)
