"""Figure 4: HiPPO with and without the skill-conditioned baseline, and what each baseline does to the variance.

The second row measures what section 4.2 suggests: the total variance over trajectories of the skills' policy gradient,
at the policy that the random-p run ended with, relative to no baseline.
"""

import functools
import sys

import numpy as np
from matplotlib.axes import Axes

from analysis.runs import Results
from paper_figures import curves

KINDS = {"none": "#999999", "single": "#E69F00", "skill": "#0072B2"}


def relative_variance(results: Results, env: str) -> tuple[np.ndarray, str]:
    """(seeds, kinds) the skills' gradient variance over that without a baseline; or why there is none."""
    chosen = results.frame.query("env == @env and variant == 'gradient_variance'")
    if chosen.empty:
        return np.empty((0, len(KINDS))), "not measured"
    table = chosen.pivot_table(index="seed", columns="metric", values="value")
    table = table[table["variance_none"] > 0]
    columns = [f"variance_{kind}" for kind in KINDS]
    relative = table[columns].to_numpy() / table[["variance_none"]].to_numpy()
    return relative, "" if len(table) else "no reward in the batch"


def draw_variance(axes: Axes, results: Results, env: str) -> None:
    """Bars of the mean over seeds, a dot per seed."""
    relative, _ = relative_variance(results, env)
    axes.bar(list(KINDS), relative.mean(0), color=list(KINDS.values()), width=0.6)
    for row in relative:
        axes.plot(np.arange(len(KINDS)), row, ".", color="black", markersize=3)
    axes.set_ylim(bottom=0, top=1.15 * relative.max())
    curves.write_seeds(axes, {"skill": len(relative)}, ["skill"])
    axes.set_xlabel("baseline of the skills")


EXTRA = curves.Extra(
    tuple(f"variance_{kind}" for kind in KINDS),
    lambda results, env: relative_variance(results, env)[1],
    draw_variance,
    "relative gradient variance",
    "Bottom: total variance over trajectories of the skills' policy gradient at the final policy of the random-p run, "
    "relative to no baseline; baselines fitted on one batch and used on another; bars: mean over seeds, dots: seeds.",
)

main = functools.partial(curves.main, "fig4", extra=EXTRA)

if __name__ == "__main__":
    sys.exit(main())
