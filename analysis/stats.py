"""Statistics over seeds: means, interquartile means, bootstrap intervals, comparisons (Agarwal et al. 2021).

Score matrices are (seeds,), (seeds, T) or (seeds, tasks). Every interval names its method; a percentile bootstrap of
three seeds covers far less than it says, so such intervals are drawn but decide nothing.
"""

from dataclasses import dataclass

import numpy as np
from scipy import stats

RESAMPLES = 2000
LEVEL = 0.95
AT_ONCE = 4_000_000  # numbers that a bootstrap holds
SEED = 0  # of the resampling, so that a figure drawn twice is the same


@dataclass(frozen=True)
class Interval:
    """A point estimate with its interval; the interval is NaN where one seed gives none."""

    point: np.ndarray
    low: np.ndarray
    high: np.ndarray


def mean(scores: np.ndarray) -> np.ndarray:
    """Mean over seeds: (S, ...) -> (...)."""
    return np.mean(scores, axis=0)


def standard_deviation(scores: np.ndarray) -> np.ndarray:
    """Sample standard deviation over seeds, the spread the paper shows: (S, ...) -> (...); NaN for one seed."""
    if len(scores) < 2:
        return np.full(scores.shape[1:], np.nan)
    return np.std(scores, axis=0, ddof=1)


def with_deviation(scores: np.ndarray) -> str:
    """Mean ± sample standard deviation of scores (S,) as tables have it, the mean alone for one seed."""
    return f"{scores.mean():.2f}" + (f" ± {standard_deviation(scores):.2f}" if len(scores) > 1 else "")


def interquartile_mean(scores: np.ndarray, axis: int | None = None) -> np.ndarray:
    """Mean of the middle half: a quarter of the sorted scores (rounded down) is cut at either end."""
    return stats.trim_mean(scores, 0.25, axis=axis)


def bootstrap_mean(scores: np.ndarray, resamples: int = RESAMPLES) -> Interval:
    """95 % percentile bootstrap over seeds of the mean, pointwise: (S, ...) -> intervals of (...)."""
    scores = np.asarray(scores, float)
    point = mean(scores)
    if len(scores) < 2:
        nothing = np.full(point.shape, np.nan)
        return Interval(point, nothing, nothing)
    columns = scores.reshape(len(scores), -1)
    width = max(1, AT_ONCE // (len(scores) * resamples))
    parts = [
        _bootstrap(columns[:, first : first + width], resamples) for first in range(0, max(1, columns.shape[1]), width)
    ]
    low, high = (np.concatenate(ends).reshape(point.shape) for ends in zip(*parts, strict=True))
    return Interval(point, low, high)


def _bootstrap(scores: np.ndarray, resamples: int) -> tuple[np.ndarray, np.ndarray]:
    """Both ends of the interval of a few columns; every column is resampled with the same draws."""
    result = stats.bootstrap(
        (scores,),
        np.mean,
        axis=0,
        vectorized=True,
        n_resamples=resamples,
        confidence_level=LEVEL,
        method="percentile",
        rng=np.random.default_rng(SEED),
    )
    return result.confidence_interval.low, result.confidence_interval.high


def stratified_bootstrap_iqm(scores: np.ndarray, resamples: int = RESAMPLES) -> Interval:
    """Interquartile mean over all runs and tasks, seeds resampled within each task: (S, tasks) -> scalars."""

    def statistic(*tasks: np.ndarray, axis: int) -> np.ndarray:
        return interquartile_mean(np.concatenate(tasks, axis=axis), axis=axis)

    result = stats.bootstrap(
        tuple(scores.T),
        statistic,
        vectorized=True,
        n_resamples=resamples,
        confidence_level=LEVEL,
        method="percentile",
        rng=np.random.default_rng(SEED),
    )
    low, high = result.confidence_interval
    return Interval(interquartile_mean(scores), np.asarray(low), np.asarray(high))


def probability_of_improvement(x: np.ndarray, y: np.ndarray) -> float:
    """P(X > Y) for a run of each method drawn at random, ties counted half: (S,), (R,) -> [0, 1]."""
    difference = np.sign(x[:, None] - y[None, :])
    return float(np.mean((difference + 1) / 2))


def performance_profile(scores: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """Share of runs above each threshold: (S, tasks), (K,) -> (K,)."""
    return (scores[..., None] > thresholds).mean(axis=tuple(range(scores.ndim)))


# A method that starts over every so many iterations (MLSH) has a saw-tooth for a curve, whose mean over a stretch
# depends on where in a cycle the stretch falls. So every number of such a curve is of whole cycles. `cycle` is in rows,
# 1 for all other methods; a curve that is shorter than one cycle is taken as it is.


def whole_cycles(curve: np.ndarray, cycle: int = 1) -> np.ndarray:
    """The curve without the cycle that its end cuts short: (..., T) -> (..., up to T)."""
    rows = curve.shape[-1]
    return curve[..., : rows // cycle * cycle or rows]


def window(rows: int, cycle: int = 1) -> int:
    """A tenth of a curve's rows, at least one, and of a saw-tooth the fewest whole cycles that hold as many."""
    tenth = max(1, round(0.1 * rows))
    return min(-(-tenth // cycle), rows // cycle) * cycle or tenth


def final_performance(curve: np.ndarray, cycle: int = 1) -> np.ndarray:
    """Mean over the last 10 % of iterations, at least one: (S, T) -> (S,)."""
    return whole_cycles(curve, cycle)[..., -window(curve.shape[-1], cycle) :].mean(axis=-1)


def initial_performance(curve: np.ndarray, cycle: int = 1) -> np.ndarray:
    """Mean over the first 10 % of iterations, at least one: (S, T) -> (S,)."""
    return curve[..., : window(curve.shape[-1], cycle)].mean(axis=-1)
