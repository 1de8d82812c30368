"""Learning curves: a panel per environment, a line per method, every seed visible; shared by figures 3 to 9.

Only what is there is drawn: no panel, no entry of the legend and no count of seeds for what has no data.
"""

import argparse
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.offsetbox import AnchoredOffsetbox, HPacker, TextArea
from matplotlib.patheffects import withStroke

from analysis import stats
from analysis.edition import PAPER, Edition
from analysis.runs import Results, scores, write_rows
from paper_figures import command_line, style
from paper_figures.clock import CAPTION, SHORTEST, UNITS, by_clock

MOST_POINTS = 2000  # of a curve that are drawn, several for every pixel
SHORTER = 0.95  # methods whose budget is below this share of the longest have their last value held
EDGE = withStroke(linewidth=2.6, foreground="white")  # tells lines that cross or touch apart
NOT_A_RESULT = {"smoke": "smoke"}  # scales whose pictures say nothing about the methods


def unique(results: Results, key: str) -> dict[str, str]:
    """Environments or trained variants of the plan, in its order: name -> label."""
    return {run[key]: run[f"{key}_label"] for run in results.plan["runs"] if run["kind"] == "train"}


def watermark(edition: Edition) -> str:
    """What is written across a picture that is no result of the suite, and under which protocol; else nothing."""
    smoke, overridden = NOT_A_RESULT.get(edition.scale, ""), "overridden" if edition.overrides else ""
    protocol = "" if edition.protocol == PAPER else edition.protocol
    return "\n".join(line for line in (smoke, overridden, protocol) if line) if smoke or overridden else ""


def window_of(iterations: int, share: float) -> int:
    """Points of the moving mean: `share` of a method's planned iterations, to the next odd number from 1 on."""
    return 2 * round(share * iterations / 2) + 1


def bundle(results: Results, env: str, variant: str, share: float) -> tuple[np.ndarray, np.ndarray]:
    """What is drawn of one method in one environment: its steps (T,) and its seeds' smoothed curves (S, T)."""
    _, steps, table = scores(results.frame, env, variant)
    window = window_of(planned(results, env)[variant]["iterations"], share)
    for seed in table:  # where it has values; at its ends over what the window still covers
        table[seed] = table[seed].dropna().rolling(window, center=True, min_periods=1).mean()
    curves = table.interpolate(method="index", limit_area="inside").to_numpy().T
    chosen = thinned(len(steps))
    return np.array(steps)[chosen], curves[:, chosen]


def thinned(points: int) -> np.ndarray:
    """Which points of a curve are drawn: all, or MOST_POINTS evenly chosen ones, first and last among them."""
    return np.unique(np.linspace(0, points - 1, min(points, MOST_POINTS)).round().astype(int))


def draw_panel(axes: Axes, results: Results, env: str, unit: float, share: float) -> None:
    """Draw all methods of one environment.

    Args:
        unit: environment steps on the axis.
        share: of a method's iterations that the moving mean takes, 0 for none.
    """
    variants, seeds = list(unique(results, "variant")), seeds_behind(results, env)
    budget = budgets(results, env)
    end = max(budget[variant] for variant in seeds) / unit
    for place, variant in enumerate(seeds):
        color = style.color_of(variant, variants)
        steps, values = bundle(results, env, variant, share)
        x = steps / unit
        above = 3 + (len(seeds) - place) / len(seeds)  # the figure's first method lies on top
        marker = "." if len(x) < 4 else None  # so that a curve of one point is seen
        for curve in values:
            axes.plot(x, curve, color=color, alpha=0.35, linewidth=0.5, marker=marker, markersize=2, zorder=2)
        complete = ~np.isnan(values).any(0)  # the mean goes as far as every seed does
        interval = stats.bootstrap_mean(values[:, complete])
        axes.plot(x[complete], interval.point, color=color, marker=marker, zorder=above, path_effects=[EDGE])
        axes.fill_between(x[complete], interval.low, interval.high, color=color, alpha=0.1, linewidth=0)
        if budget[variant] / unit < SHORTER * end and complete.any():  # planned to end before the others
            last = x[complete][-1], interval.point[-1]
            axes.plot((last[0], end), (last[1],) * 2, color=color, linestyle=(0, (3, 2)), linewidth=0.9, zorder=above)


def seeds_behind(results: Results, env: str) -> dict[str, int]:
    """Number of seeds of every method that has data in one environment, in the plan's order."""
    counts = results.seeds_with_return
    return {v: counts[env, v] for v in unique(results, "variant") if (env, v) in counts}


def planned(results: Results, env: str) -> dict[str, dict[str, Any]]:
    """A planned run of every method that is trained in one environment."""
    return {run["variant"]: run for run in results.plan["runs"] if run["env"] == env and run["kind"] == "train"}


def budgets(results: Results, env: str) -> dict[str, float]:
    """Planned environment steps of every variant in one environment."""
    return {
        variant: float(run.get("env_steps", run["iterations"] * run["batch_size"]))
        for variant, run in planned(results, env).items()
    }


def write_seeds(axes: Axes, seeds: dict[str, int], variants: list[str]) -> None:
    """Print the number of seeds in a panel: one number, or one per method in its colour where they differ."""
    style_of: dict[str, Any] = {"fontsize": 6.5, "color": "#555555"}
    parts: list[Artist] = [TextArea("seeds:", textprops=style_of)]
    if len(set(seeds.values())) == 1:
        parts.append(TextArea(str(min(seeds.values())), textprops=style_of))
    else:
        for variant, count in seeds.items():
            color = {"color": style.color_of(variant, variants), "fontweight": "bold"}
            parts.append(TextArea(str(count), textprops=style_of | color))
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
        seeds, steps, table = scores(results.frame, env, variant)
        if seeds:
            cycle = results.rows_per_cycle(env, variant, steps[0])
            final = np.array([stats.final_performance(table[seed].dropna().to_numpy(), cycle) for seed in seeds])
            spread = f" ± {stats.standard_deviation(final):.3g}" if len(seeds) > 1 else ""
            words.append(f"{label} {final.mean():.3g}{spread}")
    return "; ".join(words)


def how_smoothed(results: Results, share: float) -> str:
    """The rule of the moving mean in words."""
    iterations = {run["iterations"] for run in results.plan["runs"] if run["kind"] == "train"}
    windows = {str(n): window_of(n, share) for n in sorted(iterations)}
    if max(windows.values()) == 1:
        return "not smoothed"
    points = ", ".join(f"{window} of {n}" for n, window in windows.items() if window > 1)
    return (
        f"each seed's curve smoothed before anything else by a centred moving mean over {share:.0%} of its iterations "
        f"({points}; at the ends over what is there), the csv file beside this is not"
    )


def left_out(results: Results, extra: "Extra | None") -> str:
    """One line on the environments that have no panel, and why; empty where all have."""
    reasons: dict[str, list[str]] = {}
    for env, label in unique(results, "env").items():
        if not seeds_behind(results, env):
            reasons.setdefault("no results yet", []).append(label)
        elif extra is not None and (reason := extra.absent(results, env)):
            reasons.setdefault(f"{extra.label}: {reason}", []).append(label)
    for label in dict.fromkeys(each["variant_label"] for each in results.plan.get("refused", [])):
        reasons.setdefault(f"not trained under the {results.edition.protocol} protocol", []).append(label)
    for each in results.plan.get("not_trained", []):
        reasons.setdefault("not trained at this scale", []).append(each["env_label"])
    return "; ".join(f"{', '.join(labels)} ({reason})" for reason, labels in reasons.items())


def without_value(results: Results) -> str:
    """How many points of the learning curves are not drawn since they are not finite, in words; empty where none."""
    frame = results.frame[results.frame["metric"] == "return_mean"]
    bad = frame[~np.isfinite(frame["value"].astype(float))]
    if bad.empty:
        return ""
    runs = [f"{run_id} ({count})" for run_id, count in bad.groupby("run_id").size().items()]
    return f"Not finite and so not drawn: {len(bad)} of {len(frame)} values, of runs {', '.join(runs)}."


def caption(results: Results, share: float, extra: "Extra | None") -> str:
    """What the picture shows and how it was computed, for a reader who sees nothing else."""
    plan = results.plan
    seeds = {env: seeds_behind(results, env) for env in unique(results, "env")}
    counts = sorted({n for of in seeds.values() for n in of.values()})
    n = f"{counts[0]} seeds" if len(counts) == 1 else f"{counts[0]} to {counts[-1]} seeds (printed in each panel)"
    drawn = [run for run in plan["runs"] if seeds.get(run["env"])]
    kinds = dict.fromkeys(run["physics"] for run in drawn)
    where = {kind: dict.fromkeys(r["env_label"] for r in drawn if r["physics"] == kind) for kind in kinds}
    physics = "; ".join(f"{kind} physics ({', '.join(labels)})" for kind, labels in where.items())
    lines = [
        f"{plan['title']}. Scale: {plan['scale']}.",
        f"Mean undiscounted return of the episodes that open an iteration, against environment steps. n = {n}; "
        f"line: mean over seeds, as far as every seed goes; thin lines: single seeds; {how_smoothed(results, share)}. "
        "Where seeds report at different steps, they are interpolated linearly.",
        f"Shaded: {stats.LEVEL:.0%} percentile bootstrap interval of the mean over seeds, {stats.RESAMPLES} resamples, "
        "pointwise. With fewer than about ten seeds it covers less than it says and decides nothing.",
        f"Simulated with {physics}.",
        f"Drawn from {results.origin()}.",
    ]
    steps = [[budgets(results, env)[variant] for variant in of] for env, of in seeds.items() if of]
    if any(min(of) < SHORTER * max(of) for of in steps):
        lines.append("Dashed: the last value of a method with a smaller budget, held.")
    if extra is not None:
        lines.append(extra.caption)
    if plan["scale"] in NOT_A_RESULT:
        lines.append("Smoke scale runs every code path in minutes; it says nothing about the methods.")
    if without := left_out(results, extra):
        lines.append(f"Not shown: {without}.")
    labels = unique(results, "env")
    if saws := {run["variant_label"]: run["cycle"] for run in plan["runs"] if run.get("cycle", 1) > 1}:
        what = ", ".join(f"{label} ({cycle})" for label, cycle in saws.items())
        lines.append(f"Numbers of methods that start over are of whole cycles, in iterations: {what}.")
    for env in (env for env, of in seeds.items() if of):
        final = final_line(results, env)
        lines.append(f"Last 10 % of iterations, mean ± standard deviation over seeds, {labels[env]}: {final}.")
    if bad := without_value(results):
        lines.append(bad)
    lines += [f"Missing or incomplete: {what}." for what in results.missing_lines()]
    return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Extra:
    """A panel more per environment, under its learning curves."""

    metrics: tuple[str, ...]
    absent: Callable[[Results, str], str]  # why one environment has no such panel, empty where it has
    draw: Callable[[Axes, Results, str], None]  # fills the panel of one environment
    label: str  # of the first panel's y axis
    caption: str


def picture(results: Results, share: float, extra: Extra | None, columns: int, width: float) -> Figure:
    """The whole figure, `columns` panels beside each other on `width` inches."""
    environments = {env: label for env, label in unique(results, "env").items() if seeds_behind(results, env)}
    everything = list(unique(results, "variant"))
    drawn = {variant for env in environments for variant in seeds_behind(results, env)}
    variants = {variant: label for variant, label in unique(results, "variant").items() if variant in drawn}
    with_extra = [env for env in environments if extra is not None and not extra.absent(results, env)]
    curve_rows, extra_rows = (-(-len(envs) // columns) for envs in (environments, with_extra))
    legend_rows, legend_columns = legend_shape(list(variants.values()), width)
    sentences = [*results.edition.marks, *([f"not shown: {text}"] if (text := left_out(results, extra)) else [])]
    letters = int(width * 19)
    note = [line for each in sentences for line in textwrap.wrap(f"{each[0].upper()}{each[1:]}.", letters)]
    height = (curve_rows + extra_rows) * (2.6 if columns < 3 else 2.25) + 0.2 + 0.16 * (legend_rows + len(note))
    figure, grid = plt.subplots(
        curve_rows + extra_rows, columns, figsize=(width, height), squeeze=False, layout="constrained"
    )
    for axes in grid.flat:
        axes.patch.set_visible(False)  # a watermark shows from behind
        axes.set_axis_off()
    for place, (env, label) in enumerate(environments.items()):
        axes = grid.flat[place]
        axes.set_axis_on()
        axes.set_title(label)
        draw_curves(axes, results, env, share)
        write_seeds(axes, seeds_behind(results, env), everything)
        if place % columns == 0:
            axes.set_ylabel("return")
    for place, env in enumerate(with_extra):
        assert extra is not None
        axes = grid[curve_rows:].flat[place]
        axes.set_axis_on()
        axes.set_title(environments[env])
        extra.draw(axes, results, env)
        if place % columns == 0:
            axes.set_ylabel(extra.label)
    handles = [Line2D([], [], color=style.color_of(v, everything), label=label) for v, label in variants.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=legend_columns, columnspacing=1.2)
    if note:
        figure.supxlabel("\n".join(note), fontsize=6.5, color="#555555")
    if stamp := watermark(results.edition):
        style.watermark(figure, stamp)
    return figure


def draw_curves(axes: Axes, results: Results, env: str, share: float) -> None:
    """The learning curves of one environment with their axes."""
    steps = results.frame.loc[results.frame["env"] == env, "env_steps"]
    unit, name = (1e6, "million env. steps") if steps.max() >= 5e5 else (1e3, "thousand env. steps")
    if results.plan.get("by_clock"):
        name, unit = next(((what, hours) for what, hours in UNITS.items() if steps.max() >= 2 * hours), SHORTEST)
    draw_panel(axes, results, env, unit, share)
    axes.set_xlabel(name)
    axes.set_xlim(left=0)
    low, high = axes.dataLim.intervaly
    if low == high:  # lines that all coincide look like one line
        axes.set_ylim(low - 1, low + 1)
        text = f"every run: {low:g} throughout"
        axes.text(0.5, 0.55, text, transform=axes.transAxes, ha="center", fontsize=6.5, color="#555555")


def draw(
    results: Results,
    out: Path,
    extra: Extra | None = None,
    share: float = command_line.SMOOTH,
    clocked: Results | None = None,
) -> list[Path]:
    """Draw and write <figure>.csv, .pdf, .svg, .png and .caption.txt under `out`/<scale>/; returns the paths.

    With more than one panel also <figure>.narrow.png, the panels below each other, as a phone shows them; where the
    runs' clocks are there (`clocked`), <figure>.clock.png, by wall-clock.
    """
    style.use()
    plan = results.plan
    panels = sum(bool(seeds_behind(results, env)) for env in unique(results, "env"))
    stem = results.stem(out)
    columns = min(4, panels)
    wide = picture(results, share, extra, columns, style.WIDTH * min(1, (columns + 1) / 3))
    title = f"{plan['figure']}: {plan['title']}"
    paths = style.save(wide, style.formats(stem), title, results.provenance())
    plt.close(wide)
    clock = stem.with_name(f"{stem.name}.clock.png")
    clock.unlink(missing_ok=True)
    if clocked is not None:
        figure = picture(clocked, share, None, columns, style.WIDTH * min(1, (columns + 1) / 3))
        paths += style.save(figure, [clock], f"{title}, by wall-clock", results.provenance())
        plt.close(figure)
    narrow = style.narrow(stem)
    narrow.unlink(missing_ok=True)
    if panels > 1:
        figure = picture(results, share, extra, 1, style.NARROW)
        paths += style.save(figure, [narrow], title, results.provenance())
        plt.close(figure)
    csv, text_path = stem.with_suffix(".csv"), stem.with_suffix(".caption.txt")
    write_rows(results.frame, csv)
    text_path.write_text(caption(results, share, extra) + (f"{CAPTION}\n" if clocked is not None else ""))
    return [csv, *paths, text_path]


def main(figure: str, arguments: Sequence[str] | None = None, extra: Extra | None = None) -> int:
    """Draw one figure from the command line."""

    def write(results: Results, options: argparse.Namespace) -> str:
        paths = draw(results, options.out, extra, options.smooth, by_clock(results, options.runs_dir))
        return "wrote " + " ".join(map(str, paths))

    metrics = ("return_mean", *(extra.metrics if extra is not None else ()))
    return command_line.make(figure, arguments, metrics, write)
