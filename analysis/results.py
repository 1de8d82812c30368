"""What the committed results say, as a page: `make results` writes docs/results.md and the pictures beside it.

Only rows under paper_figures/data count, never what happens to be trained here; scales and protocols are never
pooled.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from analysis import stats
from analysis.claims import CLAIMS, NO_DATA, judge
from analysis.command_line import PROTOCOLS
from analysis.edition import Edition
from analysis.runs import MissingData, Results, load, scores

ROOT = Path(__file__).parent.parent
DATA = ROOT / "paper_figures" / "data"
SCALES = ("laptop", "paper")
HEAD = """# Results

Written by `make results` from the committed rows under `paper_figures/data/`; do not edit. What is not here has not
been trained. `python -m analysis.explain paper_figures/data/laptop/fig3.csv` lists the runs behind a file, and
[reproduce.md](reproduce.md) says how to train any of them again.
"""
FINAL = """Return over the last 10 % of iterations, mean ± standard deviation over seeds, and area under the curve (mean
return over all iterations). With three seeds these decide little: the verdicts below use intervals. The curves in the
pictures are smoothed ([reproduce.md](reproduce.md)), the numbers are not.
"""


def performance(results: Results, env: str) -> list[str]:
    """Rows of all methods in one environment, the best final performance first."""
    label = {run["variant"]: run["variant_label"] for run in results.plan["runs"]}
    rows = []
    for variant in label:
        seeds, steps, table = scores(results.frame, env, variant)
        if not seeds:
            continue
        curves = [table[seed].dropna().to_numpy() for seed in seeds]
        final = np.array([stats.final_performance(curve) for curve in curves])
        area = np.array([curve.mean() for curve in curves])
        spread = [f" ± {stats.standard_deviation(x):.2f}" if len(seeds) > 1 else "" for x in (final, area)]
        text = f"{final.mean():.2f}{spread[0]} | {area.mean():.2f}{spread[1]}"
        rows.append((-final.mean(), f"| {label[variant]} | {len(seeds)} | {steps[-1] / 1e6:.1f} M | {text} |"))
    return [row for _, row in sorted(rows)]


def section(results: Results, pictures: Path) -> list[str]:
    """One figure: its picture and its numbers."""
    plan = results.plan
    name = "_".join([*results.edition.folder.parts, f"{plan['figure']}.png"])
    lines = [f"## {plan['title']} ({plan['figure']}, {plan['scale']} scale)", ""]
    if (pictures / name).exists():
        lines += [f"![{plan['title']}](pictures/{name})", ""]
    labels = {run["env"]: (run["env_label"], run["physics"]) for run in plan["runs"]}
    for env, (label, physics) in labels.items():
        rows = performance(results, env)
        if rows:
            head = f"| {label}, {physics} physics | seeds | steps | final | area |"
            lines += [head, "|---|---|---|---|---|", *rows, ""]
    if results.missing:
        lines += ["Planned and not trained: " + "; ".join(untrained(results)) + ".", ""]
    return lines


def untrained(results: Results) -> list[str]:
    """What is missing, an entry per environment."""
    planned: dict[str, set[str]] = {}
    for run in results.missing:
        planned.setdefault(run["env_label"], set()).add(run["variant_label"])
    everything = {run["env_label"]: set[str]() for run in results.plan["runs"]}
    for run in results.plan["runs"]:
        everything[run["env_label"]].add(run["variant_label"])
    return [
        f"{env}: {'all' if variants == everything[env] else ', '.join(sorted(variants))}"
        for env, variants in planned.items()
    ]


def table_section(results: Results) -> list[str]:
    """One table of the paper: the mean over seeds of every quantity, as measured."""
    plan = results.plan
    lines = [f"## {plan['title']} ({plan['figure']}, {plan['scale']} scale)", ""]
    labels = {(run["env"], run["variant"]): f"{run['env_label']}, {run['variant_label']}" for run in plan["runs"]}
    shown = {
        key: label for key, label in labels.items() if key in set(results.frame.groupby(["env", "variant"]).groups)
    }
    lines += [f"| mean over seeds | {' | '.join(shown.values())} |", "|---|" + "---|" * len(shown)]
    means = results.frame.groupby(["metric", "env", "variant"])["value"].mean()
    for metric, values in means.groupby("metric", sort=False):
        cells = [f"{values[metric, env, variant]:.3g}" for env, variant in shown]
        lines.append(f"| {metric} | {' | '.join(cells)} |")
    seeds = results.frame.groupby(["env", "variant"])["seed"].nunique()
    command = f"`make draw-{plan['figure']} {results.edition.variables}`"
    lines += ["", f"{seeds.min()} seeds. {command} names each definition and puts the paper's values beside it.", ""]
    return lines


def verdicts(edition: Edition, results: dict[str, Results]) -> list[str]:
    """The claims that the committed figures of one edition can say something about."""
    lines = [
        f"## Verdicts, {edition.called}",
        "",
        "| sentence | where | verdict | difference [interval] |",
        "|---|---|---|---|",
    ]
    for claim in CLAIMS:
        if claim.figure not in results:
            continue
        ruling, differences = judge(claim, results[claim.figure])
        shown = "; ".join(f"{place} {d.mean:+.2f} [{d.low:.2f}, {d.high:.2f}]" for place, d in differences.items())
        lines.append(f"| {claim.sentence} | {claim.source} | {ruling if shown else NO_DATA} | {shown} |")
    return [*lines, ""]


def page(runs_dir: Path, data: Path, pictures: Path) -> str:
    """The whole page, from plans in `runs_dir` (for names only) and rows in `data`."""
    lines = [HEAD]
    for edition in (Edition(scale, protocol) for protocol in PROTOCOLS for scale in SCALES):
        results = {}
        for path in sorted((data / edition.folder).glob("*.csv")):
            try:
                results[path.stem] = load(path.stem, edition.scale, runs_dir, data, None, edition.protocol)
            except MissingData as error:
                raise ValueError(f"{path}: {error}") from error
        curves = {name: each for name, each in results.items() if name.startswith("fig")}
        if curves:
            lines.append(FINAL)
        for each in curves.values():
            lines += section(each, pictures)
        for name, each in results.items():
            if name not in curves:
                lines += table_section(each)
        if results:
            lines += verdicts(edition, results)
    if len(lines) == 1:
        lines.append("No results are committed yet.")
    return "\n".join(lines).rstrip() + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the page."""
    parser = argparse.ArgumentParser(prog="analysis.results", description=__doc__.splitlines()[0])
    parser.add_argument("--runs-dir", type=Path, required=True, help="folder of the plans, without runs")
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--docs", type=Path, default=ROOT / "docs")
    options = parser.parse_args(arguments)
    try:
        text = page(options.runs_dir, options.data, options.docs / "pictures")
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    (options.docs / "results.md").write_text(text)
    print(f"wrote {options.docs / 'results.md'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
