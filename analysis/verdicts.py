"""From scores per seed to a verdict on a sentence: one-sided tests per place, joined by how many places must hold.

The rule, its reasons and its measured error rates stand in docs/verdicts.md. A sentence names n places and holds if at
least k of them do ("in all", "in 3 of 4", "in any"). Benjamini and Heller (2008) join one-sided p-values for that: k of
n hold is shown by (n - k + 1) times the k-th smallest, which for k = n is the intersection-union test without any
correction, and for k = 1 Bonferroni's. It is disproved if n - k + 1 places are shown not to hold.
"""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy import stats

ALPHA = 0.05  # of every verdict, either way
POWER = 0.8  # at which the seeds that a difference needs are counted
FEWEST_SEEDS = 3
NOTABLE = 0.1  # share of the other side's mean that "better" promises at the least
NUMBERS = np.arange(FEWEST_SEEDS, 1001)  # of seeds per side that are worth counting
QUANTILES = stats.t.ppf(1 - ALPHA, 2 * NUMBERS - 2) + stats.t.ppf(POWER, 2 * NUMBERS - 2)
REPRODUCED, NOT_REPRODUCED, INCONCLUSIVE = "reproduced", "not reproduced", "inconclusive"
UNDECIDABLE = "undecidable here"


@dataclass(frozen=True)
class Comparison:
    """Favoured minus other in one place; low and high are the two one-sided 95 % bounds, a 90 % interval."""

    mean: float
    low: float
    high: float
    better: float  # p of "not above nothing": small where the sentence is shown to hold
    short: float  # p of "notably above": small where it is shown not to hold
    worse: float  # p of "not below nothing": small where the opposite is shown
    seeds: tuple[int, int]
    needed: float  # seeds per side that would decide a difference of this size, NaN where none would

    @property
    def verdict(self) -> str:
        """Of this place alone."""
        if self.better <= ALPHA:
            return REPRODUCED
        return NOT_REPRODUCED if self.short <= ALPHA else INCONCLUSIVE


def t_test(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Welch's one-sided p-values along the last axis, of "x is not above y" and of "x is not below y"."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # scores that are nearly alike are welcome here
        result = stats.ttest_ind(x, y, axis=-1, equal_var=False, alternative="greater")
    constant = (np.ptp(x, axis=-1) == 0) & (np.ptp(y, axis=-1) == 0)  # has no t: what is seen is certain
    difference = np.mean(x, axis=-1) - np.mean(y, axis=-1)
    above = np.where(constant, np.where(difference > 0, 0.0, 1.0), result.pvalue)
    below = np.where(constant, np.where(difference < 0, 0.0, 1.0), 1 - result.pvalue)
    return above, below


def notably(y: np.ndarray, notable: float) -> np.ndarray:
    """The score that is `notable` above y (..., S), as a share of its mean's size; scales y, and so its noise."""
    return y * (1 + notable * np.sign(y.mean(-1, keepdims=True)))


def compare(x: np.ndarray, y: np.ndarray, notable: float) -> Comparison:
    """Compare scores per seed x (S,) and y (R,); `notable` as for `notably`."""
    promised = notably(y, notable)
    (better, worse), (_, short) = t_test(x, y), t_test(x, promised)
    mean, counts = float(x.mean() - y.mean()), (len(x), len(y))
    low = high = mean
    if np.ptp(x) > 0 or np.ptp(y) > 0:
        interval = stats.ttest_ind(x, y, equal_var=False).confidence_interval(1 - 2 * ALPHA)
        low, high = float(interval.low), float(interval.high)
    needed = fewest([seeds_for(mean, x, y), seeds_for(float(promised.mean() - x.mean()), x, promised)])
    return Comparison(mean, low, high, float(better), float(short), float(worse), counts, needed)


def fewest(seeds: list[float]) -> float:
    """The smallest number that is there, NaN where none is."""
    there = [number for number in seeds if not np.isnan(number)]
    return min(there, default=float("nan"))


def seeds_for(difference: float, x: np.ndarray, y: np.ndarray) -> float:
    """Seeds per side with which a one-sided test finds a true `difference` with POWER, given the spreads of x and y.

    NaN if the difference is not above nothing, or more of them would be needed than are worth counting.
    """
    if difference <= 0:
        return float("nan")
    variance = np.var(x, ddof=1) + np.var(y, ddof=1)
    enough = np.flatnonzero(QUANTILES**2 * variance / NUMBERS <= difference**2)
    return float(NUMBERS[enough[0]]) if len(enough) else float("nan")


def at_least(needed: int, p: np.ndarray) -> np.ndarray:
    """p-value of "fewer than `needed` of the n hypotheses are false" from theirs (..., n) (Benjamini, Heller 2008)."""
    n = p.shape[-1]
    return np.minimum(1.0, (n - needed + 1) * np.sort(p, axis=-1)[..., needed - 1])


@dataclass(frozen=True)
class Ruling:
    """What the data say about a sentence: the verdict, why, and every place that has enough seeds."""

    verdict: str
    why: str
    comparisons: Mapping[str, Comparison]
    where_trained: str = ""  # verdict of the places that were trained, where others were not
    at: str = ""  # where one side has fewer environment steps: whose, and how many
    at_these_steps: "Ruling | None" = None  # what the data say if the other side is read there, too


def rule(comparisons: Mapping[str, Comparison], places: tuple[str, ...], needed: int) -> Ruling:
    """The verdict of a sentence that holds if `needed` of its places do; a place without a comparison shows nothing."""
    missing = [place for place in places if place not in comparisons]
    verdict, why = decide(comparisons, missing, needed)
    if not missing or verdict == NOT_REPRODUCED or not comparisons:
        return Ruling(verdict, why, comparisons)
    if verdict == REPRODUCED:
        return Ruling(verdict, f"already without {', '.join(named(missing))}", comparisons)
    there = min(needed, len(comparisons))
    where_trained, _ = decide(comparisons, [], there)
    return Ruling(
        UNDECIDABLE, f"fewer than {FEWEST_SEEDS} seeds in {', '.join(named(missing))}", comparisons, where_trained
    )


def named(places: list[str]) -> list[str]:
    """The places without the two sides that some of them are tested on."""
    return list(dict.fromkeys(place.removesuffix(" not below").removesuffix(" not above") for place in places))


def decide(comparisons: Mapping[str, Comparison], missing: list[str], needed: int) -> tuple[str, str]:
    """Verdict and why; `missing` places have p-values of 1."""

    def joined(p: Callable[[Comparison], float], number: int) -> float:
        return float(at_least(number, np.array([*map(p, comparisons.values()), *[1.0] * len(missing)])))

    against = len(comparisons) + len(missing) - needed + 1
    if joined(lambda c: c.better, needed) <= ALPHA:
        return REPRODUCED, ""
    if joined(lambda c: c.worse, against) <= ALPHA:
        return NOT_REPRODUCED, "the opposite is shown"
    if joined(lambda c: c.short, against) <= ALPHA:
        return NOT_REPRODUCED, f"no difference of {NOTABLE:.0%} or more"
    seeds = max((c.needed for c in comparisons.values() if c.verdict == INCONCLUSIVE), default=float("nan"))
    return INCONCLUSIVE, "" if np.isnan(seeds) else f"{seeds:.0f} seeds would decide a difference of the observed size"


# ------------------------------------------------------------------------------------------------- measured error rates


def scores(rng: np.random.Generator, shape: tuple[int, int], mean: float, spread: float, skewed: bool) -> np.ndarray:
    """Draws of standard deviation `spread` around `mean`: normal, or log-normal (skewness 6)."""
    normal = rng.normal(size=shape)
    unit = (np.exp(normal) - np.exp(0.5)) / np.sqrt((np.e - 1) * np.e) if skewed else normal
    return mean + spread * unit


def rates(seeds: int, skewed: bool, spreads: tuple[float, float] = (1.0, 1.0), trials: int = 4000) -> dict[str, float]:
    """How often a verdict is given, by simulation: the other side's mean is 10; `spreads` of favoured and other.

    Wrong verdicts first, each at the edge of what it may claim, then right ones.
    """
    rng = np.random.default_rng(0)

    def p(differences: list[float], notable: float = 0.0) -> np.ndarray:
        """(2, trials, places) p-values against "not above" and against "above"."""
        place = []
        for difference in differences:
            x = scores(rng, (trials, seeds), 10.0 + difference, spreads[0], skewed)
            y = scores(rng, (trials, seeds), 10.0, spreads[1], skewed)
            place.append(np.stack(t_test(x, notably(y, notable))))
        return np.stack(place, -1)

    def share(joined: np.ndarray) -> float:
        return float((joined <= ALPHA).mean())

    strong = 6.0
    return {
        "reproduced, one place, no difference": share(at_least(1, p([0.0])[0])),
        "reproduced in all 4, one has no difference": share(at_least(4, p([strong] * 3 + [0.0])[0])),
        "reproduced in 3 of 4, two have none": share(at_least(3, p([strong] * 2 + [0.0] * 2)[0])),
        "reproduced in any of 4, none has one": share(at_least(1, p([0.0] * 4)[0])),
        "not reproduced, one place, a difference of 10 %": share(at_least(1, p([1.0], NOTABLE)[1])),
        "not reproduced in all 4, each has 10 %": share(at_least(1, p([1.0] * 4, NOTABLE)[1])),
        "reproduced, one place, 2 standard deviations": share(at_least(1, p([2.0])[0])),
        "reproduced in all 4, 2 standard deviations each": share(at_least(4, p([2.0] * 4)[0])),
        "not reproduced, one place, no difference": share(at_least(1, p([0.0], NOTABLE)[1])),
        "not reproduced in all 4, no difference in any": share(at_least(1, p([0.0] * 4, NOTABLE)[1])),
    }


def table_of_rates() -> list[str]:
    """The table of docs/verdicts.md as Markdown lines."""
    columns = [(n, skewed) for skewed in (False, True) for n in (3, 5, 10)]
    heads = [f"{'log-normal' if skewed else 'normal'}, n = {n}" for n, skewed in columns]
    lines = [f"| verdict | {' | '.join(heads)} |", "|---|" + "---|" * len(heads)]
    measured = [rates(*column) for column in columns]
    return lines + [f"| {name} | {' | '.join(f'{of[name]:.3f}' for of in measured)} |" for name in measured[0]]


if __name__ == "__main__":
    print("\n".join(table_of_rates()))
