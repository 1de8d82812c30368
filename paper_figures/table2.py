"""Table 2: does Lemma 1's assumption hold? Cosine of the gradients, epsilon, and the actions' own probability.

Means over seeds of what each seed's batch gives; the standard deviation is over the batch, as in the paper. The paper
does not say what it calls the probability of a continuous action, so every definition is a row.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import yaml

from analysis.runs import Results
from paper_figures import command_line, tabular

HERE = Path(__file__).parent
COSINES = {
    "cosine_trajectory": "per trajectory, both weighted by A_k",
    "cosine_unweighted": "per trajectory, grad log P(tau)",
    "cosine_batch": "whole batch, both weighted by A_k",
    "cosine_authors": "whole batch, the authors' weights",
}
PROBABILITIES = {
    "density_per_dimension": "mean over dimensions of the 1-d density",
    "density_over_peak": "joint density over its peak",
    "peak_geometric": "geometric mean over dimensions of density over peak",
    "posterior": "posterior over skills, uniform manager",
    "density": "joint density",
}
OTHERS = 5  # skills beside the one that acts


def cell(values: pd.Series, name: str) -> str:
    """Mean over seeds, with the standard deviation over the batch where there is one."""
    if f"{name}_mean" in values:
        return f"{values[f'{name}_mean']:.3f} ± {values[f'{name}_std']:.3f}"
    return f"{values[name]:.3f}"


def rows(results: Results) -> list[dict[str, str]]:
    """One row per environment, variant and quantity."""
    frame = results.frame.groupby(["env", "variant", "metric"])["value"].mean()
    paper = yaml.safe_load((HERE / "paper_values.yaml").read_text())["table2"]
    labels = {(r["env"], r["variant"]): (r["env_label"], r["variant_label"]) for r in results.plan["runs"]}
    table = []
    measured = {(env, variant) for env, variant, _ in frame.index}
    for (env, variant), (env_label, variant_label) in labels.items():
        if (env, variant) not in measured:
            continue
        values, printed = frame.loc[env, variant], paper[env]["given" if variant.startswith("given") else "random"]
        seeds = results.frame.query("env == @env and variant == @variant")["seed"].nunique()
        common = {"environment": env_label, "run": variant_label, "n": str(seeds)}
        for name, what in COSINES.items():
            reported = "{} ± {}".format(*printed["cosine"])
            table.append(
                common | {"quantity": "cosine", "definition": what, "ours": cell(values, name), "paper": reported}
            )
        for quantity, prefix in (("max other", "other"), ("own", "own")):
            reported = "{} ± {}".format(*printed[prefix])
            for name, what in PROBABILITIES.items():
                ours = cell(values, f"{prefix}_{name}")
                table.append(common | {"quantity": quantity, "definition": what, "ours": ours, "paper": reported})
        # All six posteriors add up to one, so the mean of the others follows from the skill's own.
        average = f"{(1 - values['own_posterior_mean']) / OTHERS:.3f}"
        table.append(
            common
            | {"quantity": "mean other", "definition": PROBABILITIES["posterior"], "ours": average}
            | {"paper": "{} ± {}".format(*printed["other"])}
        )
        # What Lemma 1 neglects, at the paper's p = 10; its text puts 10^-10 for 0.1^9.
        for name, what in PROBABILITIES.items():
            other, own = values[f"other_{name}_mean"], values[f"own_{name}_mean"]
            table.append(
                common | {"quantity": "max other^9", "definition": what, "ours": f"{other**9:.1e}", "paper": ""}
            )
            ratio = f"{(other / own) ** 10:.1e}"
            table.append(common | {"quantity": "(max other / own)^10", "definition": what, "ours": ratio, "paper": ""})
    return table


def main(arguments: Sequence[str] | None = None) -> int:
    """Write table2.csv, .md and .tex, and print the table."""
    return command_line.make("table2", arguments, None, write)


def write(results: Results, options: argparse.Namespace) -> str:
    """Write the files; returns the table."""
    return tabular.publish(results, options, rows(results))


if __name__ == "__main__":
    sys.exit(main())
