"""Table 1: zero-shot transfer to changed dynamics - the return of one policy before and after, without training.

The same estimator for both: the same episodes (object positions, poses, noise) in the original and in every changed
environment. Bold: the best return of a column's cell, as in the paper.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import yaml

from analysis.runs import MissingData, Results, load
from paper_figures import command_line, tabular

HERE = Path(__file__).parent
ORIGINAL = "return:none:original"
CANNOT_CHANGE = {("snake_gather", "damping"), ("snake_gather", "friction")}  # docs/environments/perturbations.md
NOTE = (
    "Mean over seeds of the mean return of each seed's episodes, and the standard deviation over seeds; in brackets "
    "the change of the return in percent of the original's absolute value. =: the change cannot alter the dynamics. "
    "Bold: the best return in a changed environment."
)


def per_seed(results: Results) -> pd.Series:
    """Mean return over episodes, indexed by (env, variant, metric, seed)."""
    return results.frame.groupby(["env", "variant", "metric", "seed"])["value"].mean()


def cell(values: pd.Series, original: float | None) -> str:
    """Mean ± standard deviation over seeds, with the change."""
    text = f"{values.mean():.2f} ± {np.std(values):.2f}"
    if original is None:
        return text
    if original == 0:
        return f"{text} (n/a)"
    return f"{text} ({100 * (values.mean() - original) / abs(original):+.0f} %)"


def rows(results: Results) -> list[tabular.Row]:
    """A row per environment, strength and method."""
    means = per_seed(results)
    paper = yaml.safe_load((HERE / "paper_values.yaml").read_text())["table1"]
    labels = {(r["env"], r["variant"]): (r["env_label"], r["variant_label"]) for r in results.plan["runs"]}
    measured = [key for key in labels if key in {(env, variant) for env, variant, *_ in means.index}]
    metrics = [m for m in dict.fromkeys(results.frame["metric"]) if m != ORIGINAL]
    strengths = list(dict.fromkeys(m.split(":")[2] for m in metrics))
    changes = list(dict.fromkeys(m.split(":")[1] for m in metrics))
    table = []
    for strength in strengths:
        best = {}
        for env in {env for env, _ in measured}:
            for change in changes:
                of = {v: means[e, v, f"return:{change}:{strength}"].mean() for e, v in measured if e == env}
                best[env, change] = max(of, key=lambda variant: of[variant])
        for env, variant in measured:
            env_label, variant_label = labels[env, variant]
            original = means[env, variant, ORIGINAL]
            row = {"environment": env_label, "changed": strength, "method": variant_label, "n": str(len(original))}
            row["original"] = cell(original, None)
            for change in changes:
                text = cell(means[env, variant, f"return:{change}:{strength}"], float(original.mean()))
                mark = " =" if (env, change) in CANNOT_CHANGE else ""
                row[change] = (f"**{text}**" if best[env, change] == variant else text) + mark
            printed = paper.get(env, {}).get(variant) if strength == "original" else None
            row["paper"] = "" if printed is None else _printed(printed)
            table.append(row)
    return table


def _printed(values: dict) -> str:
    """The paper's row."""
    changes = ", ".join(f"{name} {v[0]} ({v[1]:+d} %)" for name, v in values.items() if name != "initial")
    return f"{values['initial']}; {changes}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Write table1.csv, .md and .tex, and print the table."""
    options = command_line.parse("table1", arguments)
    try:
        results = load("table1", options.scale, options.runs_dir, options.data, metrics=None)
    except (MissingData, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    stem = options.out / options.scale / "table1"
    episodes = results.frame.groupby(["run_id", "metric"]).size().max()
    scale = " It says nothing about the methods." if options.scale == "smoke" else ""
    note = f"Scale: {options.scale}.{scale} {episodes} stochastic episodes per seed. {NOTE}"
    comment = results.provenance()
    text = tabular.write(stem, results.plan["title"], note, rows(results), comment)
    results.frame.to_csv(stem.with_suffix(".csv"), index=False, lineterminator="\n")
    for what in results.missing_lines():
        print(f"missing or incomplete: {what}")
    print(text)
    print(f"wrote {stem}.csv {stem}.md {stem}.tex")
    return 0


if __name__ == "__main__":
    sys.exit(main())
