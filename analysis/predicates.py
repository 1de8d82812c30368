"""What each kind of sentence in claims.yaml compares: scores per seed of the favoured and the other side, by place.

A place is an environment, a cell of Table 1 or a setting of Table 2. "Faster" is the area under the curve to the common
budget, "final" the mean of the last 10 % of iterations (whole cycles, where a method starts over: analysis/stats.py).
Every kind that can be is also run on the paper's own numbers.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis import stats
from analysis.runs import Results

ALL = ("block_hopper", "block_half_cheetah", "snake_gather", "ant_gather")
GATHER = ("snake_gather", "ant_gather")
CHANGES = ("mass", "damping", "inertia", "friction")
CANNOT_CHANGE = {("snake_gather", "damping"), ("snake_gather", "friction")}  # docs/environments/perturbations.md
CHANGEABLE = [(env, what) for env in GATHER for what in CHANGES if (env, what) not in CANNOT_CHANGE]
ALMOST_ONE = 0.9  # what "almost 1" is taken to mean; the paper's own cells are 0.94 to 0.98
ORDER_OF_A_TENTH = (10**-1.5, 10**-0.5)
NEGLECTED, EXPONENT = 10**-9.5, 9  # 10^-10 to the nearest power of ten; p - 1 at p = 10
EARLY = 0.2  # share of the common budget that "initially" means
SAME_BUDGET = 0.95  # share of the other's environment steps from which two budgets count as one
SAME_SIZE = 1.25  # factor within which networks have "roughly the same" number of parameters
Spec = dict[str, Any]  # `compare` of a claim
Scores = tuple[np.ndarray, np.ndarray]  # per seed: favoured, other
Pairs = dict[str, Scores]  # by place


@dataclass(frozen=True)
class Printed:
    """In how many places a sentence holds by the paper's own numbers, and in how many the opposite does."""

    holds: int
    opposite: int
    places: int
    words: str = ""


@dataclass(frozen=True)
class Kind:
    """One way to compare."""

    places: Callable[[Spec], tuple[str, ...]]
    pairs: Callable[[Spec, Results], Pairs]
    printed: Callable[[Spec, str | None, dict[str, Any]], Printed | None]  # of the claim's figure; paper_values.yaml
    notable: Callable[[Spec], bool] = lambda spec: False  # whether "above" promises more than any difference at all
    of_curves: bool = False  # compares ends of learning curves, which depend on where they are read


def environments(spec: Spec) -> tuple[str, ...]:
    """The environments a sentence names."""
    return tuple(spec.get("environments", ALL))


def nothing_printed(_spec: Spec, _figure: str | None, _paper: dict[str, Any]) -> None:
    """Figures print no numbers."""


def count(differences: list[float] | np.ndarray, words: str = "") -> Printed:
    """How many differences are above and below 0; rounding of the decimals printed decides nothing."""
    rounded = np.round(differences, 9)
    return Printed(int((rounded > 0).sum()), int((rounded < 0).sum()), len(rounded), words)


# ------------------------------------------------------------------------------------------------------ learning curves


def complete_curves(results: Results, env: str, variant: str) -> list[np.ndarray]:
    """(T, 2) environment steps and returns per seed; runs cut short do not count: their last rows are not final."""
    incomplete = [run["run_id"] for run in results.missing]
    frame = results.frame.query("env == @env and variant == @variant and metric == 'return_mean'")
    frame = frame[~frame["run_id"].isin(incomplete)]
    return [run.sort_values("env_steps")[["env_steps", "value"]].to_numpy(float) for _, run in frame.groupby("seed")]


def cycle_of(results: Results, env: str, variant: str, curves: list[np.ndarray]) -> int:
    """Rows after which the method starts over, 1 for one that never does."""
    return results.rows_per_cycle(env, variant, curves[0][0, 0]) if curves else 1


def final(curve: np.ndarray, cycle: int = 1) -> float:
    """Mean of the last 10 % of iterations."""
    return float(stats.final_performance(curve[:, 1], cycle))


def gain(curve: np.ndarray, cycle: int = 1) -> float:
    """Mean of the last 10 % of iterations less that of the first 10 %."""
    return final(curve, cycle) - float(stats.initial_performance(curve[:, 1], cycle))


def steadiness(curve: np.ndarray, cycle: int = 1) -> float:
    """Final performance less the best mean over as many iterations in a row; 0 where nothing was lost again."""
    width = stats.window(len(curve), cycle)
    windows = np.lib.stride_tricks.sliding_window_view(curve[:, 1], width).mean(1)
    return final(curve, cycle) - float(windows.max())


PER_CURVE: dict[str, Callable[[np.ndarray, int], float]] = {"final": final, "gain": gain, "steadiness": steadiness}
AREAS = {"area": 1.0, "early": EARLY}  # share of the common budget


def curve_scores(
    results: Results, env: str, variants: tuple[str, str], measure: str, common_steps: bool = False
) -> Scores:
    """Per seed of both variants, a measure of PER_CURVE or an area (the mean height up to the common budget).

    Args:
        common_steps: curves end where the shortest of them does, as areas always do.
    """
    curves = [complete_curves(results, env, variant) for variant in variants]
    cycles = [cycle_of(results, env, variant, of) for variant, of in zip(variants, curves, strict=True)]
    both = [curve for of in curves for curve in of]
    if not both:
        return np.array([]), np.array([])
    start, budget = max(curve[0, 0] for curve in both), min(curve[-1, 0] for curve in both)
    if measure in PER_CURVE:
        end = max(start, budget) if common_steps else np.inf
        x, y = (
            np.array([PER_CURVE[measure](curve[curve[:, 0] <= end], cycle) for curve in of])
            for of, cycle in zip(curves, cycles, strict=True)
        )
        return x, y
    end = start + AREAS[measure] * (budget - start)
    for of, cycle in zip(curves, cycles, strict=True):
        if cycle > 1 and of and (steps := of[0][min(cycle, len(of[0])) - 1, 0]) <= budget:
            end = steps * min(max(1, round(end / steps)), budget // steps)
    grid = np.linspace(start, end, 1000)
    x, y = (np.array([np.interp(grid, curve[:, 0], curve[:, 1]).mean() for curve in of]) for of in curves)
    return x, y


def shorter_side(spec: Spec, results: Results) -> tuple[str, float] | None:
    """The side that has notably fewer environment steps than the other and their number, None where none has."""
    if spec.get("measure", "gain") not in PER_CURVE or "other" not in spec:
        return None
    for env in environments(spec):
        ends = {}
        for variant in (spec["favoured"], spec["other"]):
            if curves := complete_curves(results, env, variant):
                ends[variant] = min(curve[-1, 0] for curve in curves)
        if len(ends) == 2 and min(ends.values()) < SAME_BUDGET * max(ends.values()):
            shorter = min(ends, key=lambda variant: ends[variant])
            return shorter, ends[shorter]
    return None


def margin(spec: Spec, results: Results, env: str) -> float:
    """How far the favoured side may be off: a share of the other's mean final performance, whose noise is left out."""
    curves = complete_curves(results, env, spec["other"])
    cycle = cycle_of(results, env, spec["other"], curves)
    return spec["margin"] * abs(float(np.mean([final(curve, cycle) for curve in curves]))) if curves else 0.0


def curve(spec: Spec, results: Results) -> Pairs:
    """The favoured method is above the other, or at most a margin, a share of the other's mean, below it."""
    pairs = {}
    for env in environments(spec):
        x, y = curve_scores(results, env, (spec["favoured"], spec["other"]), spec["measure"], "common_steps" in spec)
        pairs[env] = (x, y * (1 - spec.get("margin", 0.0) * np.sign(y.mean())) if len(y) else y)
    return pairs


def printed_curve(spec: Spec, figure: str | None, paper: dict[str, Any]) -> Printed | None:
    """Final performance from scratch stands in Table 1's first column, for three methods on Gather."""
    table = paper["table1"]
    named = [
        env for env in environments(spec) if env in GATHER and {spec["favoured"], spec["other"]} <= set(table[env])
    ]
    if figure != "fig3" or spec["measure"] != "final" or not named:
        return None
    initial = {env: [table[env][spec[side]]["initial"] for side in ("favoured", "other")] for env in named}
    return count([x + spec.get("margin", 0.0) * abs(y) - y for x, y in initial.values()], "Table 1, initial, Gather")


def same_places(spec: Spec) -> tuple[str, ...]:
    """Two one-sided comparisons per environment."""
    return tuple(f"{env} {side}" for env in environments(spec) for side in ("not below", "not above"))


def same(spec: Spec, results: Results) -> Pairs:
    """Neither method is above the other by more than the margin."""
    pairs: Pairs = {}
    for env in environments(spec):
        x, y = curve_scores(results, env, (spec["favoured"], spec["other"]), spec["measure"])
        tolerated = margin(spec, results, env)
        pairs |= {f"{env} not below": (x + tolerated, y), f"{env} not above": (y + tolerated, x)}
    return pairs


def learns(spec: Spec, results: Results) -> Pairs:
    """The method ends above where it began."""
    gains = {env: curve_scores(results, env, (spec["favoured"],) * 2, "gain")[0] for env in environments(spec)}
    return {env: (of, np.zeros(len(of))) for env, of in gains.items()}


def fails(spec: Spec, results: Results) -> Pairs:
    """The other method gains less than a share of what the favoured one does."""
    pairs = {}
    for env in environments(spec):
        x, y = curve_scores(results, env, (spec["favoured"], spec["other"]), "gain", "common_steps" in spec)
        pairs[env] = (spec["share"] * x, y)
    return pairs


def variance(spec: Spec, results: Results) -> Pairs:
    """The favoured baseline leaves less variance than the other, both relative to none."""
    frame = results.frame[results.frame["variant"] == "gradient_variance"]
    pairs: Pairs = {}
    for env in environments(spec):
        table = frame[frame["env"] == env].pivot_table(index="seed", columns="metric", values="value")
        table = table[table["variance_none"] > 0] if "variance_none" in table else table
        empty = table.empty
        favoured, other = (
            np.array([]) if empty else (table[spec[side]] / table["variance_none"]).to_numpy()
            for side in ("favoured", "other")
        )
        pairs[env] = (other, favoured)  # less is better
    return pairs


# --------------------------------------------------------------------------------------------------------------- tables


def cells(_spec: Spec) -> tuple[str, ...]:
    """The changed environments of Table 1 that can differ from the original."""
    return tuple(f"{env} {what}" for env, what in CHANGEABLE)


def change(spec: Spec, results: Results) -> Pairs:
    """The favoured method's relative change, or return, is above the other's in changed environments."""
    means = results.frame.groupby(["env", "variant", "metric", "seed"])["value"].mean().to_dict()
    seeds = sorted(set(results.frame["seed"]))

    def score(env: str, what: str, variant: str) -> np.ndarray:
        found = [
            (means[env, variant, f"return:{what}:original", s], means[env, variant, "return:none:original", s])
            for s in seeds
            if (env, variant, f"return:{what}:original", s) in means
        ]
        if not spec["relative"]:
            return np.array([new for new, _ in found])
        # Relative to the mean over seeds: one seed's return may be near nothing, which a ratio would blow up.
        scale = abs(np.mean([old for _, old in found])) if found else 0.0
        return np.array([(new - old) / scale for new, old in found]) if scale > 0 else np.array([])

    sides = spec["favoured"], spec["other"]
    return {f"{env} {what}": (score(env, what, sides[0]), score(env, what, sides[1])) for env, what in CHANGEABLE}


def printed_change(spec: Spec, _figure: str | None, paper: dict[str, Any]) -> Printed:
    """The same over the paper's Table 1: [return, change in %] per cell."""
    table, column = paper["table1"], 1 if spec["relative"] else 0
    cell = [
        [table[env][spec[side]][what][column] for side in ("favoured", "other")] for env in GATHER for what in CHANGES
    ]
    return count([x - y for x, y in cell], "Table 1")


def near_one(cosine: np.ndarray) -> np.ndarray:
    """Above 0 where a cosine is almost 1."""
    return np.asarray(cosine) - ALMOST_ONE


def near_a_tenth(epsilon: np.ndarray) -> np.ndarray:
    """Above 0 where a probability is of the order of 0.1, in powers of ten."""
    low, high = np.log10(ORDER_OF_A_TENTH)
    with np.errstate(divide="ignore"):
        value = np.log10(np.asarray(epsilon, float))
    return np.clip(np.minimum(value - low, high - value), -10, None)


def neglected(epsilon: np.ndarray) -> np.ndarray:
    """Above 0 where epsilon^(p-1) is as small as the paper puts it, in powers of ten."""
    with np.errstate(divide="ignore"):
        return np.clip(np.log10(NEGLECTED) - EXPONENT * np.log10(np.asarray(epsilon, float)), None, 10)


MARGINS = {"near_one": near_one, "near_a_tenth": near_a_tenth, "neglected": neglected}


def settings(_spec: Spec) -> tuple[str, ...]:
    """The four rows of Table 2."""
    return tuple(f"{env} {kind}" for env in GATHER for kind in ("given", "random"))


def quantity(spec: Spec, results: Results) -> Pairs:
    """A quantity of Table 2 lies inside its bound."""
    frame = results.frame[results.frame["metric"] == spec["metric"]]
    pairs = {}
    for env in GATHER:
        for kind in ("given", "random"):
            values = frame.query("env == @env and variant == @kind + '_skills_p10'")["value"].to_numpy(float)
            pairs[f"{env} {kind}"] = (MARGINS[spec["is"]](values), np.zeros(len(values)))
    return pairs


def printed_quantity(spec: Spec, _figure: str | None, paper: dict[str, Any]) -> Printed:
    """The same over the means printed in the paper's Table 2."""
    values = [paper["table2"][env][kind][spec["paper"]][0] for env in GATHER for kind in ("given", "random")]
    return count(MARGINS[spec["is"]](np.array(values)), "Table 2")


# ------------------------------------------------------------------------------------------------------ no runs at all


def no_pairs(_spec: Spec, _results: Results) -> Pairs:
    """A sentence that no run can decide."""
    return {}


def parameters(_spec: Spec, _figure: str | None, paper: dict[str, Any]) -> Printed:
    """Policy parameters of flat PPO and of HiPPO with random p, by the sizes of appendices A and B."""
    factors = {env: of["ppo"] / of["hippo"] for env, of in paper["parameters"].items()}
    sizes = [
        f"{env} {of['ppo']} against {of['hippo']}, {factors[env]:.2f} times" for env, of in paper["parameters"].items()
    ]
    return count([SAME_SIZE - factor for factor in factors.values()], "; ".join(sizes))


KINDS = {
    "curve": Kind(environments, curve, printed_curve, lambda spec: "margin" not in spec, of_curves=True),
    "same": Kind(same_places, same, nothing_printed),
    "learns": Kind(environments, learns, nothing_printed),
    "fails": Kind(environments, fails, nothing_printed, of_curves=True),
    "variance": Kind(environments, variance, nothing_printed, lambda spec: True),
    "change": Kind(cells, change, printed_change, lambda spec: not spec["relative"]),
    "quantity": Kind(settings, quantity, printed_quantity),
    "parameters": Kind(environments, no_pairs, parameters),
}
