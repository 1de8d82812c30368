"""The paper's comparative sentences as predicates over the data: `python -m analysis.claims --scale laptop`.

The sentences stand in claims.yaml, what each compares in predicates.py. A verdict is drawn from Welch's t interval of a
difference over seeds (95 %, Holm over the places a sentence names): reproduced only if it holds in all of them (or in
as many as the sentence says), not reproduced if the interval excludes it in any, else inconclusive; never from fewer
than three seeds.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy import stats as scipy_stats

from analysis.command_line import parser
from analysis.edition import PAPER, chosen
from analysis.predicates import KINDS, Kind, Pairs, Printed, Spec
from analysis.runs import MissingData, Results, load

ROOT = Path(__file__).parent.parent
ALPHA = 0.05
FEWEST_SEEDS = 3
REPRODUCED, NOT_REPRODUCED, INCONCLUSIVE = "reproduced", "not reproduced", "inconclusive at this budget"
NO_DATA, NO_RUNS, SMOKE = "no data", "no run can decide it", "smoke: no verdicts"


@dataclass(frozen=True)
class Claim:
    """One sentence: the favoured side must exceed the other by more than nothing in `needed` of its places."""

    name: str
    sentence: str
    source: str  # section, caption or appendix
    compare: Spec
    figure: str | None = None  # None: no run can decide it
    needed: int | None = None  # None: in all places

    @property
    def kind(self) -> Kind:
        """How it compares."""
        return KINDS[self.compare["kind"]]

    @property
    def places(self) -> tuple[str, ...]:
        """Environments, cells or settings that the sentence names."""
        return self.kind.places(self.compare)

    def printed(self, paper: dict[str, Any]) -> Printed | None:
        """The sentence by the paper's own numbers, None where it prints none."""
        return self.kind.printed(self.compare, self.figure, paper)


CLAIMS = tuple(Claim(**entry) for entry in yaml.safe_load(Path(__file__).with_name("claims.yaml").read_text()))


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


def judge(claim: Claim, results: Results) -> tuple[str, dict[str, Difference]]:
    """Verdict and differences; places with fewer than three seeds on a side are left out and decide nothing."""
    pairs = claim.kind.pairs(claim.compare, results)
    differences = holm({place: both for place, both in pairs.items() if min(map(len, both)) >= FEWEST_SEEDS})
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


def ruled(claim: Claim, results: Results | None) -> tuple[str, str]:
    """Verdict and differences of one claim in words."""
    if claim.figure is None:
        return NO_RUNS, ""
    if results is None:
        return NO_DATA, ""
    ruling, differences = judge(claim, results)
    shown = [
        f"{place} {d.mean:+.3g} [{d.low:.3g}, {d.high:.3g}] n = {d.seeds[0]}, {d.seeds[1]}"
        for place, d in differences.items()
    ]
    left_out = [place for place in claim.places if place not in differences]
    if left_out:
        shown.append(f"fewer than {FEWEST_SEEDS} seeds: {', '.join(left_out)}")
    return ruling, "; ".join(shown)


def own_numbers(claim: Claim, paper: dict[str, Any]) -> str:
    """What the paper's own numbers say about its sentence, in words."""
    printed = claim.printed(paper)
    if printed is None:
        return ""
    needed = "" if claim.needed is None else f" ({claim.needed} needed)"
    opposite = f", the opposite in {printed.opposite}" if printed.opposite else ""
    return f"holds in {printed.holds} of {printed.places}{needed}{opposite}: {printed.words}"


def lines(scale: str, runs_dir: Path, data_dir: Path, protocol: str = PAPER) -> list[str]:
    """The table as Markdown lines."""
    paper = yaml.safe_load((ROOT / "paper_figures" / "paper_values.yaml").read_text())
    out = [SMOKE, ""] if scale == "smoke" else []
    out += [
        "| claim | where | sentence | verdict | differences [interval] | the paper's own numbers |",
        "|---|---|---|---|---|---|",
    ]
    results: dict[str, Results | None] = {}
    for figure in {claim.figure for claim in CLAIMS if claim.figure is not None and scale != "smoke"}:
        try:
            results[figure] = load(figure, scale, runs_dir, data_dir, None, protocol)
        except MissingData:
            results[figure] = None
    for claim in CLAIMS:
        ruling, shown = (SMOKE, "") if scale == "smoke" else ruled(claim, results.get(claim.figure or ""))
        row = (claim.name, claim.source, claim.sentence, ruling, shown, own_numbers(claim, paper))
        out.append(f"| {' | '.join(row)} |")
    measured_coverage = "; ".join(
        f"n = {n}: {coverage(n, False):.3f} normal, {coverage(n, True):.3f} log-normal" for n in (3, 5, 10)
    )
    return [*out, "", f"Measured coverage of Welch's 95 % interval, spreads 1 and 3: {measured_coverage}."]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table and write claims.md."""
    options = parser("analysis.claims", __doc__.splitlines()[0]).parse_args(arguments)
    try:
        text = "\n".join(lines(options.scale, options.runs_dir, options.data, options.protocol)) + "\n"
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    path = options.out / chosen(options).folder / "claims.md"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
