"""What the committed results say: `make results` writes docs/results.md, its pictures and the README's verdicts.

Only rows under paper_figures/data count, never what happens to be trained here; scales and protocols are never
pooled.
"""

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from analysis import stats
from analysis.claims import CLAIMS, in_words, paper_values, ruled, tally, verdict_of
from analysis.command_line import PROTOCOLS, ROOT, bad_input
from analysis.edition import PAPER, Edition
from analysis.runs import MissingData, Results, load, scores
from analysis.verdicts import NOT_REPRODUCED, REPRODUCED, Ruling

DATA = ROOT / "paper_figures" / "data"
CALIBRATION = ROOT / "docs" / "environments" / "calibration.md"
SCALES = ("laptop", "paper")  # the larger one last
HEAD = """# Results

Written by `make results` from the committed rows under `paper_figures/data/`; do not edit. What is not here has not
been trained. `python -m analysis.explain paper_figures/data/laptop/fig3.csv` lists the runs behind a file, and
[reproduce.md](reproduce.md) says how to train any of them again.
"""
NUMBERS = """Final: return over the last 10 % of iterations, mean ± standard deviation over seeds. Gain: that less the
first 10 %, for methods do not start alike. Area: mean return over all iterations. The pictures' curves are smoothed
([reproduce.md](reproduce.md)), the numbers are not; MLSH's are of whole cycles.
"""
MARK = re.compile(r"(<!-- verdicts -->\n).*?(<!-- end -->)", re.DOTALL)
CALLED = {PAPER: "as printed"}  # protocols, in the table of verdicts


def performance(results: Results, env: str) -> list[str]:
    """Rows of all methods in one environment, the best final performance first."""
    label = {run["variant"]: run["variant_label"] for run in results.plan["runs"]}
    rows = []
    for variant in label:
        seeds, steps, table = scores(results.frame, env, variant)
        if not seeds:
            continue
        curves = [table[seed].dropna().to_numpy() for seed in seeds]
        cycle = results.rows_per_cycle(env, variant, steps[0])
        final = np.array([stats.final_performance(curve, cycle) for curve in curves])
        gain = final - [stats.initial_performance(curve, cycle) for curve in curves]
        area = np.array([stats.whole_cycles(curve, cycle).mean() for curve in curves])
        cells = " | ".join(map(stats.with_deviation, (final, gain, area)))
        row = f"| {label[variant]} | {len(seeds)} | {steps[-1] / 1e6:.1f} M | {cells} |"
        rows.append((-final.mean(), row))
    return [row for _, row in sorted(rows)]


def picture(results: Results, pictures: Path) -> list[str]:
    """The pictures of one figure that are there: its curves, and all tasks at once."""
    plan = results.plan
    stem = "_".join([*results.edition.folder.parts, plan["figure"]])
    there = [name for name in (f"{stem}.png", f"{stem}.aggregate.png") if (pictures / name).exists()]
    if not there:
        return []
    lines = [f"**{plan['title']}** ({plan['figure']}, {results.edition.called})", ""]
    return lines + [line for name in there for line in (f"![{plan['title']}](pictures/{name})", "")]


def section(results: Results) -> list[str]:
    """One figure in numbers."""
    plan = results.plan
    lines = [f"### {plan['title']} ({plan['figure']}, {results.edition.called})", ""]
    labels = {run["env"]: (run["env_label"], run["physics"]) for run in plan["runs"]}
    for env, (label, physics) in labels.items():
        rows = performance(results, env)
        if rows:
            head = f"| {label}, {physics} physics | seeds | steps | final | gain | area |"
            lines += [head, "|---|---|---|---|---|---|", *rows, ""]
    if results.missing:
        lines += ["Planned and not trained: " + "; ".join(untrained(results)) + ".", ""]
    return lines


def untrained(results: Results) -> list[str]:
    """What is missing, an entry per environment and set of seeds: methods, or `all`, and which seeds if not all."""
    planned, missing = (seeds_of(runs) for runs in (results.plan["runs"], results.missing))
    entries = []
    for env, variants in missing.items():
        alike: dict[str, list[str]] = {}
        for variant, seeds in variants.items():
            which = "" if seeds == planned[env][variant] else f", seed {', '.join(map(str, sorted(seeds)))}"
            alike.setdefault(which, []).append(variant)
        for which, names in alike.items():
            entries.append(f"{env}: {'all' if len(names) == len(planned[env]) else ', '.join(sorted(names))}{which}")
    return entries


def seeds_of(runs: Sequence[dict[str, Any]]) -> dict[str, dict[str, set[int]]]:
    """Environment -> method -> seeds of planned runs."""
    found: dict[str, dict[str, set[int]]] = {}
    for run in runs:
        found.setdefault(run["env_label"], {}).setdefault(run["variant_label"], set()).add(run["seed"])
    return found


def table_section(results: Results) -> list[str]:
    """One table of the paper: the mean over seeds of every quantity, as measured."""
    plan = results.plan
    lines = [f"### {plan['title']} ({plan['figure']}, {results.edition.called})", ""]
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


Everything = dict[Edition, dict[str, Results]]  # by edition, then by figure
Rulings = dict[str, list[tuple[Ruling, Edition | None]]]  # by protocol, in the order of CLAIMS


def rulings_of(everything: Everything, protocol: str) -> list[tuple[Ruling, Edition | None]]:
    """Every claim's verdict under a protocol and the edition it is from: the largest scale with data on its figure."""
    paper, result = paper_values(), []
    for claim in CLAIMS:
        there = [e for e, results in everything.items() if e.protocol == protocol and claim.figure in results]
        edition = there[-1] if there else None
        results = everything[edition][claim.figure] if edition and claim.figure else None
        result.append((ruled(claim, results, paper), edition))
    return result


def called(protocol: str) -> str:
    """A protocol, as tables have it."""
    return CALLED.get(protocol, protocol)


def verdicts(rulings: Rulings, only_decided: bool = False) -> list[str]:
    """All claims at a glance: a line per protocol and a table with a row per claim.

    Args:
        only_decided: rows of claims that some protocol decides, in every environment or where it was trained.
    """
    lines = [f"* **{called(protocol)}**: {tally([r for r, _ in of])}." for protocol, of in rulings.items()]
    names = [called(protocol) for protocol in rulings]
    lines += ["", f"| sentence | where | {' | '.join(names)} |", "|---|---|" + "---|" * len(names)]
    for i, claim in enumerate(CLAIMS):
        of_claim = [of[i][0] for of in rulings.values()]
        if only_decided and not any({r.verdict, r.where_trained} & {REPRODUCED, NOT_REPRODUCED} for r in of_claim):
            continue
        lines.append(f"| {claim.sentence} | {claim.source} | {' | '.join(map(verdict_of, of_claim))} |")
    return [*lines, ""]


def differences(rulings: Rulings) -> list[str]:
    """What the verdicts are drawn from."""
    lines = [
        "## Differences",
        "",
        "Favoured side minus the other, with its 90 % interval (two one-sided 95 % bounds).",
        "",
    ]
    lines += ["| sentence | from | differences |", "|---|---|---|"]
    for of_protocol in rulings.values():
        for claim, (ruling, edition) in zip(CLAIMS, of_protocol, strict=True):
            if ruling.comparisons and edition:
                lines.append(f"| {claim.sentence} | {claim.figure}, {edition.called} | {in_words(ruling)} |")
    return [*lines, ""]


def ends_of_the_scale() -> list[str]:
    """What random policies, a blind gait and trained policies clear on the Block tasks: the first two tables there."""
    tables = re.findall(r"(?:^\|.*\n)+", CALIBRATION.read_text(), re.MULTILINE)[:2]
    where = "From [environments/calibration.md](environments/calibration.md), which says how it is measured."
    return ["## How much the Block tasks allow", "", where, "", *tables]


def load_all(runs_dir: Path, data: Path) -> Everything:
    """All committed rows, from plans in `runs_dir` (for names only) and rows in `data`."""
    everything: Everything = {}
    for edition in (Edition(scale, protocol) for protocol in PROTOCOLS for scale in SCALES):
        for path in sorted((data / edition.folder).glob("*.csv")):
            if "." in path.stem:  # where the runs come from
                continue
            try:
                results = load(path.stem, edition.scale, runs_dir, data, None, edition.protocol)
            except MissingData as error:
                raise ValueError(f"{path}: {error}") from error
            everything.setdefault(edition, {})[path.stem] = results
    return everything


def pages(everything: Everything, pictures: Path) -> tuple[str, str]:
    """The results page, and what the README says of it."""
    if not everything:
        return f"{HEAD}\nNo results are committed yet.\n", "No results are committed yet.\n"
    rulings = {e.protocol: rulings_of(everything, e.protocol) for e in everything}
    rule = ["How a verdict is drawn, and how often it errs: [verdicts.md](verdicts.md).", ""]
    lines = [HEAD, "## Verdicts", "", *rule, *verdicts(rulings), "## Pictures", ""]
    for of_edition in everything.values():
        for results in of_edition.values():
            lines += picture(results, pictures)
    lines += ends_of_the_scale()
    for edition, of_edition in everything.items():
        lines += [f"## Numbers, {edition.called}", ""]
        curves = {name for name in of_edition if name.startswith("fig")}
        lines += [NUMBERS] if curves else []
        for name, results in of_edition.items():
            lines += section(results) if name in curves else table_section(results)
    lines += differences(rulings)
    return "\n".join(lines).rstrip() + "\n", "\n".join(verdicts(rulings, only_decided=True))


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the page."""
    parser = argparse.ArgumentParser(prog="analysis.results", description=__doc__.splitlines()[0])
    parser.add_argument("--runs-dir", type=Path, required=True, help="folder of the plans, without runs")
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--docs", type=Path, default=ROOT / "docs")
    parser.add_argument("--readme", type=Path, default=ROOT / "README.md", help="with a part for the verdicts")
    options = parser.parse_args(arguments)
    try:
        text, summary = pages(load_all(options.runs_dir, options.data), options.docs / "pictures")
    except ValueError as error:
        return bad_input(error)
    (options.docs / "results.md").write_text(text)
    options.readme.write_text(MARK.sub(lambda m: f"{m[1]}{summary}{m[2]}", options.readme.read_text()))
    print(f"wrote {options.docs / 'results.md'} and the verdicts of {options.readme}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
