"""The paper's comparative sentences as predicates over the data: `python -m analysis.claims --scale laptop`.

A verdict is drawn from Welch's t interval of a difference over seeds (95 %, Holm over the environments or cells a
sentence names): reproduced only if it holds in all of them, not reproduced if the interval excludes it in any, else
inconclusive; never from fewer than three seeds. "Faster" is the area under the curve to the common budget, "better" is
the mean of the last 10 % of iterations.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy import stats as scipy_stats

from analysis import stats
from analysis.runs import MissingData, Results, load

ROOT = Path(__file__).parent.parent
ALL = ("block_hopper", "block_half_cheetah", "snake_gather", "ant_gather")
GATHER = ("snake_gather", "ant_gather")
CHANGES = ("mass", "damping", "inertia", "friction")
ALPHA = 0.05
FEWEST_SEEDS = 3
PIPE = r"\|"  # a pipe within a Markdown table's cell
ALMOST_ONE = 0.9  # what "almost 1" is taken to mean; the paper's own cells are 0.94 to 0.98
ORDER_OF_A_TENTH = (10**-1.5, 10**-0.5)
REPRODUCED, NOT_REPRODUCED, INCONCLUSIVE = "reproduced", "not reproduced", "inconclusive at this budget"
Pairs = dict[str, tuple[np.ndarray, np.ndarray]]  # place (environment or cell) -> scores per seed: favoured, other


@dataclass(frozen=True)
class Claim:
    """One sentence: the favoured side must exceed the other by more than nothing in `needed` of `places`."""

    name: str
    sentence: str
    source: str  # section, caption or appendix
    figure: str
    places: tuple[str, ...]
    pairs: Callable[[Results], Pairs]
    needed: int | None = None  # None: in all places
    printed: Callable[[dict[str, Any]], tuple[int, int]] | None = None  # the paper's own numbers: holds in, of


@dataclass(frozen=True)
class Difference:
    """Favoured minus other in one place, and its interval at the level that Holm's procedure tests it at."""

    mean: float
    low: float
    high: float
    p: float  # two-sided, unadjusted
    seeds: tuple[int, int]


def welch(x: np.ndarray, y: np.ndarray, level: float = 1 - ALPHA) -> Difference:
    """Welch's t interval of mean(x) - mean(y); without any spread the interval is the point."""
    mean, counts = float(np.mean(x) - np.mean(y)), (len(x), len(y))
    if np.ptp(x) == np.ptp(y) == 0:
        return Difference(mean, mean, mean, 1.0 if mean == 0 else 0.0, counts)
    result = scipy_stats.ttest_ind(x, y, equal_var=False)
    low, high = result.confidence_interval(level)
    return Difference(mean, float(low), float(high), float(result.pvalue), counts)


def holm(pairs: Pairs) -> dict[str, Difference]:
    """Welch's intervals, stepped down: smallest p at 1 - alpha/m, next at 1 - alpha/(m - 1), until one fails."""
    ordered = sorted(pairs, key=lambda place: welch(*pairs[place]).p)
    result, divisor = {}, len(pairs)
    for place in ordered:
        result[place] = welch(*pairs[place], level=1 - ALPHA / divisor)
        if result[place].p < ALPHA / divisor:
            divisor -= 1  # a failure keeps the level for all that follow, none of which can then exclude nothing
    return {place: result[place] for place in pairs}


def verdict(claim: Claim, differences: dict[str, Difference]) -> str:
    """What the differences say about the sentence; places without enough seeds are simply not in `differences`."""
    needed = len(claim.places) if claim.needed is None else claim.needed
    if sum(d.high < 0 for d in differences.values()) > len(claim.places) - needed:
        return NOT_REPRODUCED
    return REPRODUCED if sum(d.low > 0 for d in differences.values()) >= needed else INCONCLUSIVE


def curve_scores(results: Results, env: str, variants: tuple[str, str], measure: str) -> list[np.ndarray]:
    """Per seed of both variants, area (mean height up to the common budget) or final performance.

    Runs cut short do not count: their last rows are not the final ones.
    """
    incomplete = [run["run_id"] for run in results.missing]
    frame = results.frame.query("env == @env and metric == 'return_mean'")
    frame = frame[~frame["run_id"].isin(incomplete)]
    curves = [
        [run.sort_values("env_steps")[["env_steps", "value"]].to_numpy(float) for _, run in of.groupby("seed")]
        for of in (frame[frame["variant"] == variant] for variant in variants)
    ]
    both = [curve for of in curves for curve in of]
    if not both:
        return [np.array([]), np.array([])]
    if measure == "final":
        return [np.array([stats.final_performance(curve[:, 1]) for curve in of]) for of in curves]
    start, budget = max(curve[0, 0] for curve in both), min(curve[-1, 0] for curve in both)
    grid = np.linspace(start, budget, 1000)
    return [np.array([np.interp(grid, curve[:, 0], curve[:, 1]).mean() for curve in of]) for of in curves]


def compare(favoured: str, other: str, measure: str, environments: Sequence[str]) -> Callable[[Results], Pairs]:
    """Pairs of a sentence about two methods in learning curves."""

    def pairs(results: Results) -> Pairs:
        both = {env: curve_scores(results, env, (favoured, other), measure) for env in environments}
        return {env: (x, y) for env, (x, y) in both.items()}

    return pairs


def change(favoured: str, other: str, relative: bool) -> Callable[[Results], Pairs]:
    """Pairs of a sentence about Table 1: relative change, or return, in the eight changed environments."""

    def pairs(results: Results) -> Pairs:
        means = results.frame.groupby(["env", "variant", "metric", "seed"])["value"].mean().to_dict()
        seeds = sorted(set(results.frame["seed"]))

        def score(env: str, variant: str, what: str) -> np.ndarray:
            cells = [
                (means[env, variant, f"return:{what}:original", s], means[env, variant, "return:none:original", s])
                for s in seeds
                if (env, variant, f"return:{what}:original", s) in means
            ]
            if not relative:
                return np.array([new for new, _ in cells])
            # Relative to the mean over seeds: one seed's return may be near nothing, which a ratio would blow up.
            scale = abs(np.mean([old for _, old in cells])) if cells else 0.0
            return np.array([(new - old) / scale for new, old in cells]) if scale > 0 else np.array([])

        return {
            f"{env} {what}": (score(env, favoured, what), score(env, other, what)) for env in GATHER for what in CHANGES
        }

    return pairs


def printed_change(favoured: str, other: str, column: int) -> Callable[[dict[str, Any]], tuple[int, int]]:
    """The same count over the paper's Table 1; column 0 is the return, 1 the relative change."""

    def count(paper: dict[str, Any]) -> tuple[int, int]:
        table = paper["table1"]
        wins = [table[e][favoured][c][column] > table[e][other][c][column] for e in GATHER for c in CHANGES]
        return sum(wins), len(wins)

    return count


def measured(margin: Callable[[np.ndarray], np.ndarray], metric: str) -> Callable[[Results], Pairs]:
    """Pairs of a sentence about Table 2: how far inside its bound a quantity is, against nothing."""

    def pairs(results: Results) -> Pairs:
        frame = results.frame[results.frame["metric"] == metric]
        result = {}
        for env in GATHER:
            for kind in ("given", "random"):
                values = frame.query("env == @env and variant == @kind + '_skills_p10'")["value"].to_numpy(float)
                result[f"{env} {kind}"] = (margin(values), np.zeros(len(values)))
        return result

    return pairs


def near_one(cosine: np.ndarray) -> np.ndarray:
    """Above 0 where a cosine is almost 1."""
    return np.asarray(cosine) - ALMOST_ONE


def near_a_tenth(epsilon: np.ndarray) -> np.ndarray:
    """Above 0 where a probability is of the order of 0.1, in powers of ten."""
    low, high = np.log10(ORDER_OF_A_TENTH)
    with np.errstate(divide="ignore"):
        value = np.log10(np.asarray(epsilon, float))
    return np.clip(np.minimum(value - low, high - value), -10, None)


def printed_table2(margin: Callable[[np.ndarray], np.ndarray], key: str) -> Callable[[dict[str, Any]], tuple[int, int]]:
    """The same over the means printed in the paper's Table 2."""

    def count(paper: dict[str, Any]) -> tuple[int, int]:
        values = np.array([paper["table2"][env][kind][key][0] for env in GATHER for kind in ("given", "random")])
        return int((margin(values) > 0).sum()), len(values)

    return count


CELLS = tuple(f"{env} {what}" for env in GATHER for what in CHANGES)
SETTINGS = tuple(f"{env} {kind}" for env in GATHER for kind in ("given", "random"))


def curve(name: str, sentence: str, source: str, figure: str, sides: tuple[str, str], measure: str) -> Claim:
    """A claim about two methods in all four environments."""
    return Claim(name, sentence, source, figure, ALL, compare(*sides, measure, ALL))


def scratch(other: str) -> tuple[str, str]:
    """HiPPO with random p against `other`."""
    return ("hippo_random", other)


CLAIMS = (
    curve("faster_than_ppo", "HiPPO learns faster than flat PPO", "section 5.2", "fig3", scratch("ppo"), "area"),
    curve("better_than_ppo", "HiPPO performs better than flat PPO", "section 5.2", "fig3", scratch("ppo"), "final"),
    curve(
        "action_repeat_lower",
        "PPO with action repeat converges at a lower performance than HiPPO",
        "section 5.2",
        "fig3",
        scratch("ppo_repeat"),
        "final",
    ),
    curve(
        "p1_poor",
        "HiPPO with p = 1 performs worse than with commitment",
        "section 5.2",
        "fig3",
        scratch("hippo_p1"),
        "final",
    ),
    curve(
        "random_p_final",
        "Random time-commitment helps the final performance",
        "section 1",
        "fig3",
        scratch("hippo_p10"),
        "final",
    ),
    curve(
        "baseline_improves",
        "The skill-conditioned baseline improves the performance of HiPPO from scratch",
        "section 5.2, Figure 4's caption ('generally')",
        "fig4",
        scratch("hippo_random_single"),
        "final",
    ),
    curve(
        "faster_baseline",
        "The skill-conditioned baseline converges faster",
        "section 1",
        "fig4",
        scratch("hippo_random_single"),
        "area",
    ),
    curve(
        "beats_option_critic",
        "Option-Critic fails to learn; HiPPO learns",
        "section 5.3",
        "fig5",
        scratch("option_critic"),
        "final",
    ),
    curve(
        "beats_mlsh",
        "MLSH's training scheme provides no benefit over HiPPO",
        "section 5.3",
        "fig5",
        scratch("mlsh"),
        "final",
    ),
    curve(
        "beats_hier_vpg",
        "HierVPG is unstable without PPO's trust region",
        "section 5.3",
        "fig5",
        scratch("hier_vpg"),
        "final",
    ),
    Claim(
        "six_of_eight",
        "In the drop of performance, random p outperforms fixed p on 6 of 8 changed tasks",
        "section 5.4",
        "table1",
        CELLS,
        change("hippo_random", "hippo_p10", relative=True),
        6,
        printed_change("hippo_random", "hippo_p10", 1),
    ),
    Claim(
        "zero_shot_return",
        "HiPPO with random p outperforms non-hierarchical methods on zero-shot transfer (as return)",
        "section 6",
        "table1",
        CELLS,
        change("hippo_random", "ppo", relative=False),
        printed=printed_change("hippo_random", "ppo", 0),
    ),
    Claim(
        "zero_shot_drop",
        "HiPPO with random p is more robust than flat PPO on zero-shot transfer (as relative change)",
        "abstract, section 6",
        "table1",
        CELLS,
        change("hippo_random", "ppo", relative=True),
        printed=printed_change("hippo_random", "ppo", 1),
    ),
    curve(
        "adapting_beats_fixed",
        "Training manager and skills together ends higher than fixing the skills",
        "section 5.5",
        "fig6",
        ("adapted_p10", "fixed_p10"),
        "final",
    ),
    curve(
        "adapting_beats_scratch",
        "Adapting given skills learns better than learning from scratch",
        "Figure 6's caption",
        "fig6",
        ("adapted_p10", "hippo_p10"),
        "area",
    ),
    curve(
        "adapts_beyond_mlsh",
        "HiPPO fine-tunes given skills better than MLSH",
        "section 5.5",
        "fig6",
        ("adapted_p10", "mlsh"),
        "final",
    ),
    curve(
        "adapts_beyond_option_critic",
        "HiPPO fine-tunes given skills better than Option-Critic",
        "section 5.5",
        "fig6",
        ("adapted_p10", "option_critic"),
        "final",
    ),
    Claim(
        "epsilon_a_tenth",
        "The largest probability under another skill is of the order of 0.1 in all settings",
        "section 5.6",
        "table2",
        SETTINGS,
        measured(near_a_tenth, "other_density_per_dimension_mean"),
        printed=printed_table2(near_a_tenth, "other"),
    ),
    Claim(
        "cosine_almost_one",
        "The cosine similarity of the approximate and the full gradient is almost 1",
        "section 5.6",
        "table2",
        SETTINGS,
        measured(near_one, "cosine_trajectory_mean"),
        printed=printed_table2(near_one, "cosine"),
    ),
)


def judge(claim: Claim, results: Results) -> tuple[str, dict[str, Difference]]:
    """Verdict and differences; places with fewer than three seeds on a side are left out and decide nothing."""
    pairs = {place: both for place, both in claim.pairs(results).items() if min(map(len, both)) >= FEWEST_SEEDS}
    differences = holm(pairs)
    return verdict(claim, differences), differences


def coverage(seeds: int, skewed: bool, trials: int = 4000) -> float:
    """Share of Welch's 95 % intervals that hold the true difference: spreads 1 and 3, normal or log-normal scores."""
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, trials, seeds))
    if skewed:
        x, y = np.exp(x) - np.exp(0.5), np.exp(y) - np.exp(0.5)
    result = scipy_stats.ttest_ind(x, 3 * y, axis=1, equal_var=False)
    low, high = result.confidence_interval(1 - ALPHA)
    return float(((low <= 0) & (high >= 0)).mean())


def lines(scale: str, runs_dir: Path, data_dir: Path) -> list[str]:
    """The table as Markdown lines."""
    paper = yaml.safe_load((ROOT / "paper_figures" / "paper_values.yaml").read_text())
    out = ["smoke: no verdicts", ""] if scale == "smoke" else []
    out += [
        "| claim | where | sentence | verdict | differences [interval] | the paper's own numbers |",
        "|---|---|---|---|---|---|",
    ]
    for claim in CLAIMS:
        ruling, shown = "smoke: no verdicts", ""
        if scale != "smoke":
            try:
                ruling, differences = judge(claim, load(claim.figure, scale, runs_dir, data_dir, metrics=None))
                shown = "; ".join(
                    f"{place} {d.mean:+.3g} [{d.low:.3g}, {d.high:.3g}] n = {d.seeds[0]}, {d.seeds[1]}"
                    for place, d in differences.items()
                )
                left_out = [place for place in claim.places if place not in differences]
                if left_out:
                    shown += f"{'; ' if shown else ''}fewer than {FEWEST_SEEDS} seeds: {', '.join(left_out)}"
            except MissingData:
                ruling = "no data"
        own = "" if claim.printed is None else "holds in {} of {}".format(*claim.printed(paper))
        if claim.printed is not None and claim.needed is not None:
            own += f" ({claim.needed} needed)"
        cells = (claim.name, claim.source, claim.sentence, ruling, shown, own)
        out.append(f"| {' | '.join(cell.replace('|', PIPE) for cell in cells)} |")
    measured_coverage = "; ".join(
        f"n = {n}: {coverage(n, False):.3f} normal, {coverage(n, True):.3f} log-normal" for n in (3, 5, 10)
    )
    return [*out, "", f"Measured coverage of Welch's 95 % interval, spreads 1 and 3: {measured_coverage}."]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table and write claims.md."""
    parser = argparse.ArgumentParser(prog="analysis.claims", description=__doc__.splitlines()[0])
    parser.add_argument("--scale", default="smoke", help="smoke, laptop or paper")
    parser.add_argument("--runs-dir", type=Path, default=Path("runs"))
    parser.add_argument("--data", type=Path, default=ROOT / "paper_figures" / "data", help="committed results")
    parser.add_argument("--out", type=Path, default=ROOT / "paper_figures" / "out")
    options = parser.parse_args(arguments)
    try:
        text = "\n".join(lines(options.scale, options.runs_dir, options.data)) + "\n"
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    path = options.out / options.scale / "claims.md"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
