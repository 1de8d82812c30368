"""Table 1: zero-shot transfer to changed dynamics - the return of one policy before and after, without training.

The same estimator for both: the same episodes (object positions, poses, noise) in the original and in every changed
environment. Bold: the best return of a column's cell, as in the paper.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from analysis import stats
from analysis.predicates import CANNOT_CHANGE
from analysis.runs import Results
from paper_figures import command_line, tabular

HERE = Path(__file__).parent
ORIGINAL = "return:none:original"
NOTE = (
    "Mean over seeds of the mean return of each seed's episodes ± the standard deviation over seeds, its 95 % "
    "percentile bootstrap interval over seeds, and the change in percent of the original return's absolute value. "
    "=: the change cannot alter the dynamics. Bold: the best return in a changed environment. "
    "Rows called paper: as printed there, five seeds."
)


def per_seed(results: Results) -> pd.Series:
    """Mean return over episodes, indexed by (env, variant, metric, seed)."""
    return results.frame.groupby(["env", "variant", "metric", "seed"])["value"].mean()


def cell(values: pd.Series, original: float | None) -> str:
    """Mean ± standard deviation over seeds, interval, and the change; one seed has neither spread nor interval."""
    scores = values.to_numpy(float)
    text = f"{scores.mean():.2f}"
    if len(scores) > 1:
        interval = stats.bootstrap_mean(scores)
        text += f" ± {stats.standard_deviation(scores):.2f} [{interval.low:.2f}, {interval.high:.2f}]"
    if original is None:
        return text
    if original == 0:
        return f"{text} (n/a)"
    return f"{text} ({100 * (scores.mean() - original) / abs(original):+.0f} %)"


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
            table.append(row)
            if strength == "original" and variant in paper.get(env, {}):
                table.append(printed_row(row, paper[env][variant]))
    return table


def printed_row(row: tabular.Row, values: dict[str, Any]) -> tabular.Row:
    """The paper's numbers in the columns of `row`."""
    cells = {change: "{:.2f} ({:+d} %)".format(*values[change]) if change in values else "" for change in list(row)[5:]}
    return row | {"method": "paper: " + row["method"], "n": "5", "original": f"{values['initial']:.2f}"} | cells


def main(arguments: Sequence[str] | None = None) -> int:
    """Write table1.csv, .md and .tex, and print the table."""
    return command_line.make("table1", arguments, None, write)


def write(results: Results, options: argparse.Namespace) -> str:
    """Write the files; returns the table."""
    episodes = results.frame.groupby(["run_id", "metric"]).size().max()
    note = f"{episodes} stochastic episodes per seed. {NOTE} "
    return tabular.publish(results, options, rows(results), note)


if __name__ == "__main__":
    sys.exit(main())
