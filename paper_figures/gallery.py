"""The skills that Figure 6 and Table 2 start from: where each goes, beside skills that nobody trained.

    python -m paper_figures.gallery [--out paper_figures/out] [--table]

draws a picture per robot from what `experiments.artefacts.gallery` measured; --table prints the measures as Markdown.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from paper_figures import style

SKILLS = Path(__file__).parent / "data" / "skills"
LABELS = {"ant": "Ant", "snake": "Snake", "hopper": "Hopper", "half_cheetah": "Half-Cheetah"}
PLANAR = ("hopper", "half_cheetah")  # they walk along a line: x over time tells all
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C564B")
GRID = 2e-3  # m; places of cells are written to the millimetre
MEASURES = {
    "information": "I(z; cell), nat",
    "information_permuted": "the same, skills permuted",
    "information_corrected": "difference",
    "accuracy": "held-out accuracy",
    "action_distance": "distance of action distributions",
    "distance": "distance from the start, m",
    "cells": "cells of 10 cm visited",
    "action_std": "action noise",
    "paths_ended_early": "paths that ended early",
}


def read(robot: str, folder: Path) -> dict[str, pd.DataFrame]:
    """The tables metrics, paths and visits of a robot."""
    return {name: pd.read_csv(folder / f"{robot}.{name}.csv") for name in ("metrics", "paths", "visits")}


def value(metrics: pd.DataFrame, group: str, metric: str) -> float:
    """One measure of all skills together, mean over networks where there are several (random skills)."""
    rows = metrics[(metrics["group"] == group) & (metrics["metric"] == metric) & metrics["skill"].isna()]
    return float(rows["value"].mean())


def draw_paths(axes: Axes, paths: pd.DataFrame, planar: bool) -> None:
    """A line per path in its skill's colour."""
    for _, path in paths.groupby(["skill", "path"]):
        skill = int(path["skill"].iloc[0])
        x, y = (path["step"], path["x"]) if planar else (path["x"], path["y"])
        axes.plot(x, y, color=COLORS[skill % len(COLORS)], linewidth=0.8, alpha=0.8)


def draw_visits(axes: Axes, visits: pd.DataFrame, planar: bool, color: str) -> None:
    """Where one skill was: cells, the more steps the darker; for planar robots a histogram of x."""
    if planar:
        by_x = visits.groupby("x")["steps"].sum()
        axes.bar(by_x.index, by_x / by_x.sum(), width=spacing(visits["x"]), color=color)
    else:
        side = spacing(pd.concat([visits["x"], visits["y"]]))
        corners = visits[["x", "y"]].to_numpy() - side / 2
        squares = [Rectangle((x, y), side, side) for x, y in corners]
        share = (visits["steps"] / visits["steps"].max()).to_numpy()
        shades = [to_rgba(color, 0.25 + 0.75 * float(s) ** 0.5) for s in share]
        axes.add_collection(PatchCollection(squares, facecolors=shades, edgecolors="none"))


def spacing(middles: pd.Series) -> float:
    """Side of the cells, in m, from the places of their middles."""
    gaps = np.diff(np.unique(middles))
    gaps = gaps[gaps > GRID]
    if not len(gaps):
        return 1.0  # a single cell
    extent = middles.max() - middles.min()
    return float(extent / round(extent / gaps.min()))  # gaps are rounded, the extent makes up for it


def limits(places: pd.Series) -> tuple[float, float]:
    """What an axis shows: every place and the start, with a margin."""
    low, high = min(float(places.min()), 0.0), max(float(places.max()), 0.0)
    margin = max(0.06 * (high - low), 0.05)
    return low - margin, high + margin


def words(metrics: pd.DataFrame, group: str) -> str:
    """The measures that a picture states of its trained or random skills."""
    of = {name: value(metrics, group, name) for name in MEASURES}
    return (
        f"I(z; cell) {of['information']:.2f} - {of['information_permuted']:.2f} by chance = "
        f"{of['information_corrected']:.2f} nat\n"
        f"held-out accuracy {of['accuracy']:.2f}; {of['cells']:,.0f} cells; {of['distance']:.2f} m from the start\n"
        f"action distributions {of['action_distance']:.2f} apart; action noise {of['action_std']:.2f}"
    )


def draw(robot: str, tables: dict[str, pd.DataFrame], out: Path) -> list[Path]:
    """Write <out>/gallery/<robot>.pdf, .svg, .png and .caption.txt; returns the paths."""
    style.use()
    metrics, paths, visits = tables["metrics"], tables["paths"], tables["visits"]
    planar, skills = robot in PLANAR, sorted(paths["skill"].unique())
    about = metrics.iloc[0]
    places = {axis: pd.concat([paths[axis], visits.loc[visits["group"] == "trained", axis]]) for axis in ("x", "y")}
    shown = {axis: limits(of) for axis, of in places.items()}
    wide, high = (end - start for start, end in shown.values())
    upper, lower = (2.3, 1.15) if planar else (0.43 * style.WIDTH * high / wide, 0.125 * style.WIDTH * high / wide)
    figure = plt.figure(figsize=(style.WIDTH, min(upper, 4.2) + min(lower, 1.4) + 1.75), layout="constrained")
    grid = figure.add_gridspec(2, 2 * len(skills), height_ratios=(upper + 0.75, lower + 0.45))
    left = figure.add_subplot(grid[0, : len(skills)])
    right = figure.add_subplot(grid[0, len(skills) :], sharex=left, sharey=left)
    title = {"trained": f"{LABELS[robot]}: {about['algo'].upper()} skills", "random": "random skills (untrained)"}
    for axes, group in ((left, "trained"), (right, "random")):
        draw_paths(axes, paths[paths["group"] == group], planar)
        axes.set_title(title[group], fontsize=9, fontweight="bold", pad=34)
        axes.annotate(
            words(metrics, group), (0.5, 1), (0, 5), "axes fraction", "offset points",
            ha="center", va="bottom", fontsize=6.5, color="#444444",
        )  # fmt: skip
        axes.set_xlabel("step" if planar else "x (m)")
    if planar:
        left.set(xlim=(0, paths["step"].max()), ylim=shown["x"])
    else:
        left.set(xlim=shown["x"], ylim=shown["y"])
        for axes in (left, right):
            axes.set_aspect("equal", "box")
    left.set_ylabel("x (m)" if planar else "y (m)")
    right.tick_params(labelleft=False)
    handles = [Line2D([], [], color=COLORS[z % len(COLORS)], label=f"skill {z}") for z in skills]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(skills))
    for place, skill in enumerate(skills):
        axes = figure.add_subplot(grid[1, 2 * place : 2 * place + 2])
        mine = visits[(visits["group"] == "trained") & (visits["skill"] == skill)]
        draw_visits(axes, mine, planar, COLORS[skill % len(COLORS)])
        axes.set_title(f"visits of skill {skill}", fontsize=7)
        axes.set_xlabel("x (m)", fontsize=7)
        axes.tick_params(labelsize=6)
        axes.xaxis.set_major_locator(MaxNLocator(3))
        axes.set_xlim(shown["x"])
        if planar:
            axes.yaxis.set_major_locator(MaxNLocator(3))
        else:
            axes.set(ylim=shown["y"], aspect="equal")
            axes.yaxis.set_major_locator(MaxNLocator(4))
            axes.tick_params(labelleft=place == 0)
        if place == 0:
            axes.set_ylabel("share of steps" if planar else "y (m)", fontsize=7)

    stem = out / "gallery" / robot
    written = style.save(
        figure,
        style.formats(stem),
        f"Skills of the {LABELS[robot]}",
        f"1 runs, set {about['run_id']}: {about['run_id']}",
    )
    plt.close(figure)
    caption = stem.with_suffix(".caption.txt")
    caption.write_text(caption_of(robot, metrics, paths))
    return [*written, caption]


def caption_of(robot: str, metrics: pd.DataFrame, paths: pd.DataFrame) -> str:
    """What a picture shows, for a reader who sees nothing else."""
    about, random = metrics.iloc[0], metrics[metrics["group"] == "random"]
    count, steps = value(metrics, "trained", "paths"), value(metrics, "trained", "steps_per_path")
    drawn = paths.groupby(["group", "skill"])["path"].nunique().max()
    further = value(metrics, "trained", "skills_further_than_random")
    return (
        f"The skills of the {LABELS[robot]}, pre-trained by {about['algo'].upper()} for {about['env_steps']:,} steps "
        f"under {about['trained_physics']} physics (run {about['run_id']}), measured on {count:.0f} fresh paths of "
        f"{steps:.0f} steps under {about['measured_physics']} physics; {drawn} paths per skill are drawn, all are "
        "counted. Below: where each trained skill was, darker for more steps (a histogram for robots on a line). "
        f"Right: one network as it is initialised; its numbers are means over {random['network'].nunique()} such "
        f"networks, as many paths each. Trained skills that end further from the start than every random one: "
        f"{further:.0f}.\n"
    )


def as_markdown(tables: dict[str, dict[str, pd.DataFrame]]) -> str:
    """The measures of all robots: trained / mean over random networks."""
    lines = ["| | " + " | ".join(LABELS[robot] for robot in tables) + " |", "|---" * (len(tables) + 1) + "|"]
    for metric, label in MEASURES.items():
        pairs = [
            " / ".join(short(value(of["metrics"], group, metric)) for group in ("trained", "random"))
            for of in tables.values()
        ]
        lines.append(f"| {label} | " + " | ".join(pairs) + " |")
    further = [f"{value(of['metrics'], 'trained', 'skills_further_than_random'):.0f}" for of in tables.values()]
    lines.append("| skills that get further than every random one | " + " | ".join(further) + " |")
    return "\n".join(lines)


def short(number: float) -> str:
    """Three digits, or all before the point."""
    return f"{number:,.0f}" if abs(number) >= 100 else f"{number:.3g}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw what has been measured; exit code 2 where there is nothing."""
    parser = argparse.ArgumentParser(prog="paper_figures.gallery", description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=SKILLS, help="folder of the measured tables")
    parser.add_argument("--out", type=Path, default=Path("paper_figures/out"))
    parser.add_argument("--table", action="store_true", help="print the measures as Markdown, draw nothing")
    options = parser.parse_args(arguments)
    robots = [robot for robot in LABELS if (options.data / f"{robot}.metrics.csv").exists()]
    if not robots:
        print(f"error: --data={options.data}: no measured skills; run `make skills-gallery`", file=sys.stderr)
        return 2
    tables = {robot: read(robot, options.data) for robot in robots}
    if options.table:
        print(as_markdown(tables))
        return 0
    for robot in robots:
        print("wrote " + " ".join(str(path) for path in draw(robot, tables[robot], options.out)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
