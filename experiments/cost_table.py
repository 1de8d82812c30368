"""The README's table of costs: runs and core-hours of every figure and table at every scale, measured on this machine.

python -m experiments.cost_table    # renews README.md between its marks
"""

import re
import sys
import time
from pathlib import Path

from experiments import costs
from experiments.command_line import duration
from experiments.config import choices
from experiments.plan import make_plan, unique

README = Path(__file__).parent.parent / "README.md"
SCALES = ("smoke", "laptop", "paper")
MARK = re.compile(r"(<!-- costs -->\n).*?(<!-- end -->)", re.DOTALL)


def table() -> str:
    """A row per figure and table; what several of them share is counted in each, and once in the last row."""
    plans = {
        (figure, scale): make_plan(figure, scale, [], True, Path("no-such-folder"))
        for figure in choices("figure")
        for scale in SCALES
    }
    known = costs.calibrate([run for plan in plans.values() for run in plan.runs()])
    lines = [f"| target | what | {' | '.join(SCALES)} |", "|---|---|" + "---|" * len(SCALES)]
    for figure in choices("figure"):
        title = plans[figure, "smoke"].description["title"]
        cells = [_cell(plans[figure, scale].todo(), known) for scale in SCALES]
        lines.append(f"| `make {figure}` | {title} | {' | '.join(cells)} |")
    together = [unique([r for (_, s), plan in plans.items() if s == scale for r in plan.todo()]) for scale in SCALES]
    lines.append(f"| `make all` | every run once | {' | '.join(_cell(todo, known) for todo in together)} |")
    where = f"One core of {costs.cpu_name().partition(' x ')[2]}, {time.strftime('%Y-%m-%d')}."
    return "\n".join(
        [*lines, "", f"{where} `make plan-fig3 SCALE=paper` measures yours and says what is left to do here."]
    )


def _cell(todo: list, known: dict) -> str:
    if not todo:
        return "not trained"
    return f"{len(todo)} runs, {duration(sum(costs.seconds(run, known) for run in todo))}"


def main() -> int:
    """Renew the README."""
    README.write_text(MARK.sub(lambda m: f"{m[1]}{table()}\n{m[2]}", README.read_text()))
    print(f"wrote {README}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
