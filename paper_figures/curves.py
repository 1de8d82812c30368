"""Learning curves: a panel per environment, a line per method, every seed visible; shared by figures 3 to 9."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.offsetbox import AnchoredOffsetbox, HPacker, TextArea

from analysis import stats
from analysis.runs import MissingData, Results, load, scores
from paper_figures import command_line, style

SHORTER = 0.95  # methods whose budget is below this share of the longest have their last value held
NOT_A_RESULT = {"smoke": "smoke"}  # scales whose pictures say nothing about the methods


def unique(results: Results, key: str) -> dict[str, str]:
    """Environments or trained variants of the plan, in its order: name -> label."""
    return {run[key]: run[f"{key}_label"] for run in results.plan["runs"] if run["kind"] == "train"}


def draw_panel(axes: Axes, results: Results, env: str, unit: float) -> dict[str, int]:
    """Draw all methods of one environment; returns the number of seeds behind each."""
    variants, seeds_drawn = unique(results, "variant"), {}
    budget = budgets(results, env)
    end = max(budget.values(), default=0.0) / unit
    for place, variant in enumerate(variants):
        seeds, steps, table = scores(results.frame, env, variant)
        if not seeds:
            continue
        color = style.color_of(variant, list(variants))
        x = np.array(steps) / unit
        values = table.interpolate(method="index", limit_area="inside").to_numpy().T  # (S, T)
        above = 3 + (len(variants) - place) / len(variants)  # the figure's first method lies on top
        marker = "." if len(x) < 4 else None  # so that a curve of one point is seen
        for curve in values:
            axes.plot(x, curve, color=color, alpha=0.3, linewidth=0.7, marker=marker, markersize=2, zorder=2)
        complete = ~np.isnan(values).any(0)  # the mean goes as far as every seed does
        interval = stats.bootstrap_mean(values[:, complete])
        axes.plot(x[complete], interval.point, color=color, marker=marker, zorder=above)
        axes.fill_between(x[complete], interval.low, interval.high, color=color, alpha=0.15, linewidth=0)
        if budget[variant] / unit < SHORTER * end and complete.any():  # planned to end before the others
            last = x[complete][-1], interval.point[-1]
            axes.plot((last[0], end), (last[1],) * 2, color=color, linestyle=(0, (3, 2)), linewidth=0.9, zorder=above)
        seeds_drawn[variant] = len(seeds)
    return seeds_drawn


def budgets(results: Results, env: str) -> dict[str, float]:
    """Planned environment steps of every variant in one environment."""
    runs = [run for run in results.plan["runs"] if run["env"] == env and run["kind"] == "train"]
    return {run["variant"]: float(run["iterations"] * run["batch_size"]) for run in runs}


def write_seeds(axes: Axes, seeds: dict[str, int], variants: list[str]) -> None:
    """Print the number of seeds in a panel: one number, or one per method in its colour where they differ.

    A method that is in the legend but not in this panel counts 0.
    """
    style_of: dict[str, Any] = {"fontsize": 6.5, "color": "#555555"}
    parts: list[Artist] = [TextArea("seeds:", textprops=style_of)]
    counts = {seeds.get(variant, 0) for variant in variants}
    if len(counts) == 1:
        parts.append(TextArea(str(min(counts)), textprops=style_of))
    else:
        for variant in variants:
            color = {"color": style.color_of(variant, variants), "fontweight": "bold"}
            parts.append(TextArea(str(seeds.get(variant, 0)), textprops=style_of | color))
    box = AnchoredOffsetbox("upper left", child=HPacker(children=parts, pad=0, sep=3), pad=0.1, borderpad=0.3)
    box.patch.set(facecolor="white", edgecolor="none", alpha=0.75)
    box.set(in_layout=False, zorder=5)
    axes.add_artist(box)


def legend_shape(labels: list[str], width: float) -> tuple[int, int]:
    """Rows and columns of a legend on a figure of `width` inches, as even as can be."""
    # An entry takes about 0.47 in and 0.055 in a letter; more columns than fit would be cut at the edges.
    fitting = max(1, min(5, int(width / (0.47 + 0.055 * max(map(len, labels))))))
    rows = -(-len(labels) // fitting)
    return rows, -(-len(labels) // rows)


def final_line(results: Results, env: str) -> str:
    """The paper's own statistic in words: final performance of every method, mean ± standard deviation over seeds."""
    words = []
    for variant, label in unique(results, "variant").items():
        seeds, _, table = scores(results.frame, env, variant)
        if seeds:
            final = np.array([stats.final_performance(table[seed].dropna().to_numpy()) for seed in seeds])
            spread = f" ± {stats.standard_deviation(final):.3g}" if len(seeds) > 1 else ""
            words.append(f"{label} {final.mean():.3g}{spread}")
    return "; ".join(words)


def caption(results: Results, seeds: dict[str, dict[str, int]]) -> str:
    """What the picture shows and how it was computed, for a reader who sees nothing else."""
    plan = results.plan
    counts = sorted({n for env in seeds.values() for n in env.values()})
    n = f"{counts[0]} seeds" if len(counts) == 1 else f"{counts[0]} to {counts[-1]} seeds (printed in each panel)"
    kinds = dict.fromkeys(run["physics"] for run in plan["runs"])
    where = {kind: dict.fromkeys(r["env_label"] for r in plan["runs"] if r["physics"] == kind) for kind in kinds}
    physics = "; ".join(f"{kind} physics ({', '.join(labels)})" for kind, labels in where.items())
    lines = [
        f"{plan['title']}. Scale: {plan['scale']}.",
        f"Mean undiscounted return of the episodes that open an iteration, against environment steps. n = {n}; "
        "line: mean over seeds, as far as every seed goes; thin lines: single seeds; no smoothing. "
        "Where seeds report at different steps, they are interpolated linearly.",
        f"Shaded: {stats.LEVEL:.0%} percentile bootstrap interval of the mean over seeds, {stats.RESAMPLES} resamples, "
        "pointwise. With fewer than about ten seeds it covers less than it says and decides nothing.",
        f"Simulated with {physics}.",
    ]
    steps = [budgets(results, env) for env in unique(results, "env")]
    if any(min(of.values()) < SHORTER * max(of.values()) for of in steps):
        lines.append("Dashed: the last value of a method with a smaller budget, held.")
    if plan["scale"] in NOT_A_RESULT:
        lines.append("Smoke scale runs every code path in minutes; it says nothing about the methods.")
    if plan.get("not_trained"):
        lines.append(f"Not trained at this scale: {', '.join(e['env_label'] for e in plan['not_trained'])}.")
    for env, label in unique(results, "env").items():
        if final := final_line(results, env):
            lines.append(f"Last 10 % of iterations, mean ± standard deviation over seeds, {label}: {final}.")
    lines += [f"Missing or incomplete: {what}." for what in results.missing_lines()]
    return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Extra:
    """A second row of panels under the learning curves."""

    metrics: tuple[str, ...]
    draw: Callable[[Axes, Results, str], None]  # fills the panel of one environment
    label: str  # of the first panel's y axis
    caption: str


def draw(results: Results, out: Path, extra: Extra | None = None) -> list[Path]:
    """Draw and write <figure>.csv, .pdf, .svg, .png and .caption.txt under `out`/<scale>/; returns the paths."""
    style.use()
    plan = results.plan
    environments, variants = unique(results, "env"), unique(results, "variant")
    environments |= {left_out["env"]: left_out["env_label"] for left_out in plan.get("not_trained", [])}
    columns = min(4, len(environments))
    rows = -(-len(environments) // columns) + (extra is not None)
    width = style.WIDTH * min(1, (columns + 1) / 3)  # a single panel as wide as a page would be flat
    legend_rows, legend_columns = legend_shape(list(variants.values()), width)
    height = 2.25 * rows + 0.4 + 0.16 * legend_rows
    figure, grid = plt.subplots(rows, columns, figsize=(width, height), squeeze=False, layout="constrained")
    left_out_here = {left_out["env"] for left_out in plan.get("not_trained", [])}
    seeds = {}
    for axes, (env, label) in zip(grid.flat, environments.items(), strict=False):
        steps = results.frame.loc[results.frame["env"] == env, "env_steps"]
        unit, name = (1e6, "million") if len(steps) and steps.max() >= 5e5 else (1e3, "thousand")
        axes.patch.set_visible(False)  # a watermark shows from behind
        seeds[env] = draw_panel(axes, results, env, unit)
        axes.set_title(label)
        axes.set_xlabel(f"{name} env. steps")
        if not seeds[env]:
            reason = "not trained\nat this scale" if env in left_out_here else "no results yet"
            axes.text(0.5, 0.5, reason, transform=axes.transAxes, ha="center", va="center")
            axes.set_axis_off()
            continue
        axes.set_xlim(left=0)
        low, high = axes.dataLim.intervaly
        if low == high:  # lines that all coincide look like one line
            axes.set_ylim(low - 1, low + 1)
            text = f"every run: {low:g} throughout"
            axes.text(0.5, 0.55, text, transform=axes.transAxes, ha="center", fontsize=6.5, color="#555555")
        write_seeds(axes, seeds[env], list(variants))
    for axes in list(grid.flat)[len(environments) :]:
        axes.set_axis_off()
    for row in grid:
        drawn = [axes for axes in row if axes.axison]
        if drawn:
            drawn[0].set_ylabel("return")
    if extra is not None:
        for axes, env in zip(grid[-1], environments, strict=False):
            axes.set_axis_on()
            axes.patch.set_visible(False)
            extra.draw(axes, results, env)
        grid[-1, 0].set_ylabel(extra.label)
    handles = [Line2D([], [], color=style.color_of(v, list(variants)), label=label) for v, label in variants.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=legend_columns, columnspacing=1.2)
    if plan["scale"] in NOT_A_RESULT:
        style.watermark(figure, NOT_A_RESULT[plan["scale"]])
    stem = out / plan["scale"] / plan["figure"]
    paths = style.save(figure, stem, f"{plan['figure']}: {plan['title']}", results.provenance())
    plt.close(figure)
    csv, text_path = stem.with_suffix(".csv"), stem.with_suffix(".caption.txt")
    results.frame.to_csv(csv, index=False, lineterminator="\n")
    text_path.write_text(caption(results, seeds) + ("" if extra is None else extra.caption + "\n"))
    return [csv, *paths, text_path]


def main(figure: str, arguments: Sequence[str] | None = None, extra: Extra | None = None) -> int:
    """Draw one figure from the command line; exit code 2 where there is nothing to draw."""
    options = command_line.parse(figure, arguments)
    try:
        metrics = ("return_mean", *(extra.metrics if extra is not None else ()))
        results = load(figure, options.scale, options.runs_dir, options.data, metrics)
    except (MissingData, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for what in results.missing_lines():
        print(f"missing or incomplete: {what}")
    print("wrote " + " ".join(str(path) for path in draw(results, options.out, extra)))
    return 0
