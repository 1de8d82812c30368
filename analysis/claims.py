"""The paper's comparative sentences as predicates over the data: `python -m analysis.claims --scale laptop`.

The sentences stand in claims.yaml, what each compares in predicates.py, how a verdict is drawn in verdicts.py. All of
them are listed, with the state of every place that they name; seeds below three decide nothing.
"""

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from analysis import predicates, verdicts
from analysis.command_line import ROOT, bad_input, parser
from analysis.edition import PAPER, chosen
from analysis.predicates import KINDS, Kind, Pairs, Printed, Spec
from analysis.runs import MissingData, Results, load
from analysis.verdicts import FEWEST_SEEDS, INCONCLUSIVE, NOT_REPRODUCED, REPRODUCED, UNDECIDABLE, Ruling

NO_DATA, SMOKE = "no data", "smoke: no verdicts"
NO_RUN = "by the sizes printed, no run needed"
MOST_PLACES = 4  # that are named in a table's cell
COUNT_SEEDS, RESAMPLES = 5, 4000  # fewest seeds of a count's bootstrap, and its resamples


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


def judge(claim: Claim, results: Results) -> Ruling:
    """The verdict on a claim; places with fewer than three seeds on a side are left out and show nothing.

    Where one side has a smaller budget than the other, as HIRO has, a second one reads both where that budget ends.
    """
    ruling = _judge(claim, claim.kind.pairs(claim.compare, results))
    shorter = predicates.shorter_side(claim.compare, results) if claim.kind.of_curves else None
    if shorter is None:
        return ruling
    early = _judge(claim, claim.kind.pairs(claim.compare | {"common_steps": True}, results))
    where = f"at the {shorter[1] / 1e6:.3g} M steps of {shorter[0]}"
    return dataclasses.replace(ruling, at=where, at_these_steps=early)


def _judge(claim: Claim, pairs: Pairs) -> Ruling:
    enough = {place: both for place, both in pairs.items() if min(map(len, both)) >= FEWEST_SEEDS}
    notable = verdicts.NOTABLE if claim.kind.notable(claim.compare) else 0.0
    comparisons = {place: verdicts.compare(*both, notable) for place, both in enough.items()}
    if "share_of_cells" in claim.compare:
        return count_of_cells(claim, enough, comparisons)
    return verdicts.rule(comparisons, claim.places, claim.needed or len(claim.places))


def count_of_cells(claim: Claim, pairs: Pairs, comparisons: dict[str, verdicts.Comparison]) -> Ruling:
    """The verdict on "in so many of the cells": their number by point differences, seeds of each side resampled."""
    needed = int(np.ceil(claim.compare["share_of_cells"] * len(claim.places) - 1e-9))
    words = f"{needed} of {len(claim.places)} cells needed"
    if len(pairs) < len(claim.places) or min(min(map(len, both)) for both in pairs.values()) < COUNT_SEEDS:
        return Ruling(UNDECIDABLE, f"fewer than {COUNT_SEEDS} seeds; {words}", comparisons)
    rng = np.random.default_rng(0)
    above = np.zeros(RESAMPLES, int)
    for x, y in pairs.values():
        drawn = [rng.choice(side, (RESAMPLES, len(side))).mean(1) for side in (x, y)]
        above += drawn[0] > drawn[1]
    low, high = np.quantile(above, [verdicts.ALPHA, 1 - verdicts.ALPHA], method="inverted_cdf")
    observed = sum(c.mean > 0 for c in comparisons.values())
    why = f"{observed} cells [{low}, {high}]; {words}"
    if low >= needed:
        return Ruling(REPRODUCED, why, comparisons)
    return Ruling(NOT_REPRODUCED if high < needed else INCONCLUSIVE, why, comparisons)


def ruled(claim: Claim, results: Results | None, paper: dict[str, Any]) -> Ruling:
    """The verdict on a claim by whatever there is of its figure; without one it is a matter of arithmetic."""
    if claim.figure is None:
        printed = claim.printed(paper)
        assert printed is not None, f"{claim.name}: nothing can decide it"
        holds = printed.holds >= (claim.needed or printed.places)
        return Ruling(REPRODUCED if holds else NOT_REPRODUCED, NO_RUN, {})
    if results is None:
        return Ruling(NO_DATA, "", {})
    ruling = judge(claim, results)
    return ruling if ruling.comparisons else Ruling(NO_DATA, f"fewer than {FEWEST_SEEDS} seeds everywhere", {})


def in_words(ruling: Ruling) -> str:
    """Every place with its difference, its 90 % interval and its own verdict."""
    words = "; ".join(
        f"{place} {c.mean:+.3g} [{c.low:.3g}, {c.high:.3g}] n = {c.seeds[0]}, {c.seeds[1]}: {c.verdict}"
        for place, c in ruling.comparisons.items()
    )
    return words if ruling.at_these_steps is None else f"{words}; {ruling.at}: {in_words(ruling.at_these_steps)}"


def verdict_of(ruling: Ruling) -> str:
    """The verdict with its reason; where some places were not trained, with those of the others.

    Where budgets differ, that at the smaller one stands behind.
    """
    if ruling.at_these_steps is not None:
        alone = dataclasses.replace(ruling, at_these_steps=None)
        return f"{verdict_of(alone)}; {ruling.at}: {verdict_of(ruling.at_these_steps)}"
    if ruling.verdict != UNDECIDABLE or len(ruling.comparisons) > MOST_PLACES:
        return ruling.verdict + (f" ({ruling.why})" if ruling.why else "")
    by_place = ", ".join(f"{place} {c.verdict}" for place, c in ruling.comparisons.items())
    return f"{ruling.verdict} ({ruling.why}); {by_place}"


def tally(rulings: Sequence[Ruling]) -> str:
    """How many claims are decided, in one line."""
    good, bad = (sum(r.verdict == verdict for r in rulings) for verdict in (REPRODUCED, NOT_REPRODUCED))
    partly = {v: sum(r.where_trained == v for r in rulings) for v in (REPRODUCED, NOT_REPRODUCED)}
    line = f"{len(rulings)} claims: {good} reproduced, {bad} not reproduced, {len(rulings) - good - bad} undecided"
    return line + (
        f" (of these, where they were trained: {partly[REPRODUCED]} reproduced, {partly[NOT_REPRODUCED]} not)"
        if any(partly.values())
        else ""
    )


def paper_values() -> dict[str, Any]:
    """Numbers printed in the paper."""
    return yaml.safe_load((ROOT / "paper_figures" / "paper_values.yaml").read_text())


def load_figures(scale: str, runs_dir: Path, data_dir: Path, protocol: str) -> dict[str, Results]:
    """The results of every figure that a claim is about, as far as there are any."""
    results = {}
    for figure in dict.fromkeys(claim.figure for claim in CLAIMS if claim.figure is not None):
        try:
            results[figure] = load(figure, scale, runs_dir, data_dir, None, protocol)
        except MissingData:
            continue
    return results


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
    paper = paper_values()
    results = {} if scale == "smoke" else load_figures(scale, runs_dir, data_dir, protocol)
    smoke = scale == "smoke"
    rulings = [Ruling(SMOKE, "", {}) if smoke else ruled(c, results.get(c.figure or ""), paper) for c in CLAIMS]
    out = [
        SMOKE if smoke else tally(rulings),
        "",
        "| claim | where | sentence | verdict | why | differences [90 % interval] | the paper's own numbers |",
        "|---|---|---|---|---|---|---|",
    ]
    for claim, ruling in zip(CLAIMS, rulings, strict=True):
        early = f"{ruling.at}: {verdict_of(ruling.at_these_steps)}" if ruling.at_these_steps else ""
        why = "; ".join(part for part in (ruling.why, early) if part)
        words = (ruling.verdict, why, in_words(ruling), own_numbers(claim, paper))
        out.append(f"| {' | '.join((claim.name, claim.source, claim.sentence, *words))} |")
    return [*out, "", "The rule and its error rates: docs/verdicts.md."]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table and write claims.md."""
    options = parser("analysis.claims", __doc__.splitlines()[0]).parse_args(arguments)
    try:
        text = "\n".join(lines(options.scale, options.runs_dir, options.data, options.protocol)) + "\n"
    except ValueError as error:
        return bad_input(error)
    path = options.out / chosen(options).folder / "claims.md"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
