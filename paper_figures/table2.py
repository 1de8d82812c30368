"""Table 2: does Lemma 1's assumption hold? Cosine of the gradients, epsilon, and the actions' own probability.

Means over seeds of what each seed's batch gives; the standard deviation is over the batch, as in the paper. The paper
does not say what it calls the probability of a continuous action, so every definition is a row.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import yaml

from analysis.runs import MissingData, Results, load
from paper_figures import command_line

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
        values, printed = frame.loc[env, variant], paper[env]["random"]
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
        # What Lemma 1 neglects, at the paper's p = 10; its text puts 10^-10 for 0.1^9.
        for name, what in PROBABILITIES.items():
            other, own = values[f"other_{name}_mean"], values[f"own_{name}_mean"]
            table.append(
                common | {"quantity": "max other^9", "definition": what, "ours": f"{other**9:.1e}", "paper": ""}
            )
            ratio = f"{(other / own) ** 10:.1e}"
            table.append(common | {"quantity": "(max other / own)^10", "definition": what, "ours": ratio, "paper": ""})
    return table


def markdown(table: list[dict[str, str]]) -> str:
    """The table as Markdown."""
    head = list(table[0])
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row.values()) + " |" for row in table)]) + "\n"


def latex(table: list[dict[str, str]], results: Results) -> str:
    """The table as a LaTeX document that compiles alone (booktabs)."""

    def escaped(text: str) -> str:
        return text.replace("_", r"\_").replace("^", r"\^{}").replace("±", r"$\pm$")

    ids = " ".join(sorted(set(results.frame["run_id"])))
    lines = [
        f"% runs: {ids}",
        r"\documentclass{article}\usepackage{booktabs}\usepackage[margin=1cm,landscape]{geometry}",
        r"\begin{document}\small",
        rf"\begin{{tabular}}{{{'l' * len(table[0])}}}\toprule",
        " & ".join(table[0]) + r" \\ \midrule",
        *(" & ".join(escaped(v) for v in row.values()) + r" \\" for row in table),
        r"\bottomrule\end{tabular}\end{document}",
    ]
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Write table2.csv, .md and .tex, and print the table."""
    options = command_line.parse("table2", arguments)
    try:
        results = load("table2", options.scale, options.runs_dir, options.data, metrics=None)
    except (MissingData, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    table, stem = rows(results), options.out / options.scale / "table2"
    stem.parent.mkdir(parents=True, exist_ok=True)
    results.frame.to_csv(stem.with_suffix(".csv"), index=False, lineterminator="\n")
    note = f"Scale: {options.scale}." + (" It says nothing about the methods." if options.scale == "smoke" else "")
    text = f"{results.plan['title']}. {note}\n\n{markdown(table)}"
    stem.with_suffix(".md").write_text(text)
    stem.with_suffix(".tex").write_text(latex(table, results))
    for what in results.missing_lines():
        print(f"missing or incomplete: {what}")
    print(text)
    print(f"wrote {stem}.csv {stem}.md {stem}.tex")
    return 0


if __name__ == "__main__":
    sys.exit(main())
