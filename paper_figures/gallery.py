"""The skills that Figure 6 and Table 2 start from: where each goes, beside skills that nobody trained.

    python -m paper_figures.gallery [--out paper_figures/out] [--table]

draws a picture per robot from what `experiments.gallery` measured; --table prints the measures as Markdown instead.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from paper_figures import style

SKILLS = Path(__file__).parent / "data" / "skills"
LABELS = {"ant": "Ant", "snake": "Snake", "hopper": "Hopper", "half_cheetah": "Half-Cheetah"}
PLANAR = ("hopper", "half_cheetah")  # they walk along a line: x over time tells all
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C564B")
MEASURES = {
    "information": "I(z; cell), nat",
    "information_permuted": "the same, skills permuted",
    "information_corrected": "difference",
    "accuracy": "held-out accuracy",
    "action_distance": "distance of action distributions",
    "distance": "distance from the start, m",
    "cells": "cells of 10 cm visited",
    "action_std": "action noise",
}


def read(robot: str, folder: Path) -> dict[str, pd.DataFrame]:
    """The tables metrics, paths and visits of a robot."""
    return {name: pd.read_csv(folder / f"{robot}.{name}.csv") for name in ("metrics", "paths", "visits")}


def value(metrics: pd.DataFrame, group: str, metric: str) -> float:
    """One measure of all skills together."""
    rows = metrics[(metrics["group"] == group) & (metrics["metric"] == metric) & metrics["skill"].isna()]
    return float(rows["value"].iloc[0])


def draw_paths(axes: Axes, paths: pd.DataFrame, planar: bool) -> None:
    """A line per path in its skill's colour."""
    for _, path in paths.groupby(["skill", "path"]):
        skill = int(path["skill"].iloc[0])
        x, y = (path["step"], path["x"]) if planar else (path["x"], path["y"])
        axes.plot(x, y, color=COLORS[skill % len(COLORS)], linewidth=0.8, alpha=0.8)


def draw_visits(axes: Axes, visits: pd.DataFrame, planar: bool, color: str) -> None:
    """Where one skill was: a dot per cell, the more steps the larger; for planar robots a histogram of x."""
    if planar:
        by_x = visits.groupby("x")["steps"].sum()
        axes.fill_between(by_x.index, by_x / by_x.sum(), step="mid", color=color, alpha=0.7, linewidth=0)
        axes.set_ylim(bottom=0)
    else:
        share = visits["steps"] / visits["steps"].max()
        axes.scatter(visits["x"], visits["y"], s=0.4 + 5 * share**0.5, color=color, linewidths=0)


def draw(robot: str, tables: dict[str, pd.DataFrame], out: Path) -> list[Path]:
    """Write <out>/gallery/<robot>.pdf, .png and .caption.txt; returns the paths."""
    style.use()
    metrics, paths, visits = tables["metrics"], tables["paths"], tables["visits"]
    planar, skills = robot in PLANAR, sorted(paths["skill"].unique())
    figure = plt.figure(figsize=(style.WIDTH, 4.6), layout="constrained")
    grid = figure.add_gridspec(2, 2 * len(skills), height_ratios=(2.2, 1))
    left = figure.add_subplot(grid[0, : len(skills)])
    right = figure.add_subplot(grid[0, len(skills) :], sharex=left, sharey=left)
    trained = metrics.iloc[0]
    title = {"trained": f"{LABELS[robot]}: {trained['algo'].upper()}", "random": "random skills"}
    for axes, group in ((left, "trained"), (right, "random")):
        draw_paths(axes, paths[paths["group"] == group], planar)
        numbers = f"I(z; cell) = {value(metrics, group, 'information_corrected'):.2f} nat above chance\n"
        numbers += f"accuracy {value(metrics, group, 'accuracy'):.2f}, {value(metrics, group, 'distance'):.2f} m far"
        axes.set_title(f"{title[group]}\n{numbers}", fontsize=8)
        axes.set_xlabel("step" if planar else "x (m)")
        if not planar:
            reach = 1.05 * visits[["x", "y"]].abs().to_numpy().max()
            axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    left.set_ylabel("x (m)" if planar else "y (m)")
    handles = [Line2D([], [], color=COLORS[z % len(COLORS)], label=f"skill {z}") for z in skills]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(skills))
    for place, skill in enumerate(skills):
        axes = figure.add_subplot(grid[1, 2 * place : 2 * place + 2])
        mine = visits[(visits["group"] == "trained") & (visits["skill"] == skill)]
        draw_visits(axes, mine, planar, COLORS[skill % len(COLORS)])
        axes.set_title(f"where skill {skill} was", fontsize=7)
        axes.set_xlabel("x (m)", fontsize=7)
        axes.tick_params(labelsize=6)
        if planar:
            axes.set_xlim(1.05 * visits["x"].min(), 1.05 * visits["x"].max())
        else:
            axes.set(xlim=left.get_xlim(), ylim=left.get_ylim(), aspect="equal")
        if place == 0:
            axes.set_ylabel("share of steps" if planar else "y (m)", fontsize=7)

    stem = out / "gallery" / robot
    written = style.save(
        figure, stem, f"Skills of the {LABELS[robot]}", f"1 runs, set {trained['run_id']}: {trained['run_id']}"
    )
    plt.close(figure)
    caption = stem.with_suffix(".caption.txt")
    count, steps = value(metrics, "trained", "paths"), value(metrics, "trained", "steps_per_path")
    drawn = paths.groupby(["group", "skill"])["path"].nunique().max()
    caption.write_text(
        f"Six skills of the {LABELS[robot]}, pre-trained by {trained['algo'].upper()} for {trained['env_steps']:,} "
        f"steps under {trained['trained_physics']} physics (run {trained['run_id']}), measured on {count:.0f} fresh "
        f"paths of {steps:.0f} steps under {trained['measured_physics']} physics; {drawn} paths per skill are drawn. "
        "Right: a network of the same shape as it is initialised, on as many paths.\n"
    )
    return [*written, caption]


def as_markdown(tables: dict[str, dict[str, pd.DataFrame]]) -> str:
    """The measures of all robots: trained / random."""
    lines = ["| | " + " | ".join(LABELS[robot] for robot in tables) + " |", "|---" * (len(tables) + 1) + "|"]
    for metric, label in MEASURES.items():
        pairs = [
            " / ".join(f"{value(of['metrics'], group, metric):.3g}" for group in ("trained", "random"))
            for of in tables.values()
        ]
        lines.append(f"| {label} | " + " | ".join(pairs) + " |")
    further = [f"{value(of['metrics'], 'trained', 'skills_further_than_random'):.0f}" for of in tables.values()]
    lines.append("| skills that get further than the best of six random ones | " + " | ".join(further) + " |")
    return "\n".join(lines)


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
