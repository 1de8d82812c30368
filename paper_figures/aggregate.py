"""A figure over all its tasks and seeds, as Agarwal et al. (2021): `python -m paper_figures.aggregate fig3 ...`.

A run's score is its return over the last 0.1 M environment steps before 1 M, relative to the mean of
Stable-Baselines3's PPO on the same task at the same place; 1 is as good as that. Only tasks of which these curves are
kept (experiments.artefacts.peer_curves) take part, and only under the modern protocol, which is set up like it.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from analysis import stats
from analysis.runs import Results, scores
from paper_figures import command_line, curves, style

PEER = Path(__file__).parent / "data" / "studies" / "stable_baselines3.csv"
MARK, WINDOW = 1_000_000, 100_000  # environment steps
RESAMPLES = 2000


def return_at(steps: np.ndarray, returns: np.ndarray) -> float:
    """Mean return of the rows within WINDOW before MARK; NaN where a curve does not reach it."""
    inside = (steps > MARK - WINDOW) & (steps <= MARK)
    return float(np.nanmean(returns[inside])) if inside.any() and steps.max() >= 0.99 * MARK else float("nan")


def peer_scores(rows: pd.DataFrame) -> dict[str, np.ndarray]:
    """Task -> what every seed of Stable-Baselines3's PPO reaches."""
    of: dict[str, list[float]] = {}
    for (env, _), curve in rows.groupby(["env", "seed"]):
        reached = return_at(curve["env_steps"].to_numpy(), curve["return_mean"].to_numpy())
        of.setdefault(str(env), []).append(reached)
    return {env: np.array(values) for env, values in of.items()}


def matrices(results: Results, peer: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Variant -> (seeds, tasks) scores, of as many seeds as every task has; variants that miss a task are left out."""
    found = {}
    for variant in curves.unique(results, "variant"):
        columns = []
        for env, reached in peer.items():
            seeds, steps, table = scores(results.frame, env, variant)
            values = [return_at(np.array(steps), table[seed].to_numpy()) for seed in seeds]
            columns.append([value / reached.mean() for value in values if np.isfinite(value)])
        seeds_of_all = min(map(len, columns))
        if seeds_of_all > 1:
            found[variant] = np.array([column[:seeds_of_all] for column in columns]).T
    return found


def improvement(x: np.ndarray, y: np.ndarray) -> stats.Interval:
    """P(X > Y) for one run of each, mean over tasks, seeds of both resampled: (S, tasks), (R, tasks) -> scalars."""

    def probability(x: np.ndarray, y: np.ndarray) -> float:
        return float(np.mean([stats.probability_of_improvement(a, b) for a, b in zip(x.T, y.T, strict=True)]))

    rng = np.random.default_rng(stats.SEED)
    drawn = [
        probability(x[rng.integers(len(x), size=len(x))], y[rng.integers(len(y), size=len(y))])
        for _ in range(RESAMPLES)
    ]
    low, high = np.quantile(drawn, [(1 - stats.LEVEL) / 2, (1 + stats.LEVEL) / 2])
    return stats.Interval(np.array(probability(x, y)), low, high)


def draw(results: Results, out: Path, rows: pd.DataFrame) -> list[Path]:
    """Write <figure>.aggregate.png and its caption; returns the paths, none where nothing can be drawn."""
    peer = peer_scores(rows[rows["env"].isin(curves.unique(results, "env"))])
    found = matrices(results, peer) if peer else {}
    if not found:
        return []
    style.use()
    labels = curves.unique(results, "variant")
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(style.WIDTH, 2.5), layout="constrained")
    thresholds = np.linspace(0, max(2.0, max(float(matrix.max()) for matrix in found.values())), 201)
    base = found.get("ppo")
    for place, (variant, matrix) in enumerate(found.items()):
        color = style.color_of(variant, list(labels))
        iqm = stats.stratified_bootstrap_iqm(matrix)
        left.plot([iqm.low, iqm.high], [place, place], color=color, linewidth=5, alpha=0.35)
        left.plot(iqm.point, place, "o", color=color, markersize=4)
        middle.plot(thresholds, stats.performance_profile(matrix, thresholds), color=color)
        if base is not None and variant != "ppo":
            chance = improvement(matrix, base)
            right.plot([chance.low, chance.high], [place, place], color=color, linewidth=5, alpha=0.35)
            right.plot(chance.point, place, "o", color=color, markersize=4)
    for axes in (left, right):
        axes.set_yticks(range(len(found)), [labels[variant] for variant in found])
        axes.invert_yaxis()
    right.set_yticklabels([])
    left.axvline(1, color="#555555", linewidth=0.8, linestyle=(0, (3, 2)))
    right.axvline(0.5, color="#555555", linewidth=0.8, linestyle=(0, (3, 2)))
    left.set_xlabel("interquartile mean of the score")
    middle.set_xlabel("score")
    middle.set_ylabel("share of runs above")
    right.set_xlabel("P(better than flat PPO)")
    right.set_xlim(0, 1)
    stem = results.stem(out)
    path = stem.with_name(f"{stem.name}.aggregate.png")
    style.save(figure, [path], f"{results.plan['figure']}, all tasks", results.provenance())
    plt.close(figure)
    text = path.with_suffix(".caption.txt")
    text.write_text(caption(results, found, peer))
    return [path, text]


def caption(results: Results, found: dict[str, np.ndarray], peer: dict[str, np.ndarray]) -> str:
    """What the picture shows and how it was computed."""
    labels, environments = curves.unique(results, "variant"), curves.unique(results, "env")
    counts = ", ".join(f"{labels[variant]} {len(matrix)}" for variant, matrix in found.items())
    reached = "; ".join(f"{environments[env]} {x.mean():.2f} ({len(x)} seeds)" for env, x in peer.items())
    return (
        f"{results.plan['title']}, all tasks at once, {results.edition}. A run's score is its return over the last "
        f"0.1 M steps before 1 M over the mean of Stable-Baselines3's PPO there ({reached}). Seeds: {counts}. Left: "
        "interquartile mean, seeds resampled within each task. Middle: share of runs whose score is above a threshold. "
        "Right: the probability that a run is better than one of flat PPO, mean over tasks. Bars: 95 % percentile "
        f"bootstrap intervals, {RESAMPLES} resamples; with few seeds these cover too little and decide nothing.\n"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw one figure's aggregate."""
    known = argparse.ArgumentParser("paper_figures.aggregate", description=__doc__.splitlines()[0], add_help=False)
    known.add_argument("figure")
    known.add_argument("--peer", type=Path, default=PEER, help="rows of Stable-Baselines3")
    own, others = known.parse_known_args(arguments)

    def write(results: Results, options: argparse.Namespace) -> str:
        rows = pd.read_csv(own.peer) if own.peer.exists() else pd.DataFrame(columns=["env", "seed"])
        paths = draw(results, options.out, rows)
        return "wrote " + " ".join(map(str, paths)) if paths else "nothing to compare yet: no task has both"

    return command_line.make(own.figure, others, ("return_mean",), write)


if __name__ == "__main__":
    sys.exit(main())
