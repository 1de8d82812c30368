"""Verdicts: intervals and joined p-values by hand, error rates by simulation, wrong variants seen to fail."""

import numpy as np
import pytest
from scipy import stats

from analysis import verdicts
from analysis.verdicts import INCONCLUSIVE, NOT_REPRODUCED, REPRODUCED, UNDECIDABLE, compare, rule
from tests import ROOT


def around(mean, spread=0.1):
    """Five seeds."""
    return mean + spread * np.array([-1.0, -0.5, 0.0, 0.5, 1.0])


def test_welchs_bounds_worked_by_hand():
    # Means 2 and 0, variances 1 and 0, three seeds: standard error sqrt(1/3), 2 degrees of freedom, t(0.95) = 2.91999.
    x, y = np.array([1.0, 2.0, 3.0]), np.zeros(3)
    comparison = compare(x, y, 0.0)
    assert comparison.mean == 2
    assert comparison.low == pytest.approx(2 - 2.91999 / 3**0.5, abs=1e-5)
    assert comparison.high == pytest.approx(2 + 2.91999 / 3**0.5, abs=1e-5)
    # 2 / sqrt(1/3) = 3.4641 with 2 degrees of freedom leaves (1 - 3.4641 / sqrt(2 + 12)) / 2.
    assert comparison.better == pytest.approx((1 - 3.4641016 / 14**0.5) / 2, abs=1e-7)
    assert comparison.worse == pytest.approx(1 - comparison.better)


def test_without_any_spread_what_is_seen_is_certain():
    one, zero = np.ones(3), np.zeros(3)
    assert (compare(one, zero, 0.0).low, compare(one, zero, 0.0).verdict) == (1, REPRODUCED)
    assert compare(zero, one, 0.0).verdict == NOT_REPRODUCED
    assert compare(zero, zero, 0.0).verdict == INCONCLUSIVE


def test_joined_p_values_worked_by_hand():
    p = np.array([0.04, 0.01, 0.5, 0.02])
    assert verdicts.at_least(4, p) == 0.5  # all: the largest, without a correction
    assert verdicts.at_least(1, p) == pytest.approx(0.04)  # any: Bonferroni's 4 times the smallest
    assert verdicts.at_least(3, p) == pytest.approx(0.08)  # 3 of 4: 2 times the third
    assert verdicts.at_least(2, np.array([[0.3, 0.6], [0.5, 0.9]])).tolist() == [0.6, 0.9]  # along the last axis


def test_better_promises_a_tenth():
    y = around(10.0)
    assert compare(around(11.2), y, 0.1).verdict == REPRODUCED
    assert compare(around(10.5), y, 0.1).verdict == REPRODUCED  # little, but certain
    assert compare(around(10.0), y, 0.1).verdict == NOT_REPRODUCED  # certainly less than 11
    assert compare(around(10.0), y, 0.0).verdict == INCONCLUSIVE  # where any difference would do
    assert compare(around(10.0, 3.0), y, 0.1).verdict == INCONCLUSIVE
    assert compare(around(-9.0), -y, 0.1).verdict == REPRODUCED  # of a negative mean a tenth of its size


def test_the_noise_of_the_other_side_is_in_the_promise():
    # 1.1 y has 1.1 times the spread: against the mean alone, fixed, the same seeds would disprove it.
    x, y = around(10.0, 0.1), around(10.0, 1.4)
    fixed = stats.ttest_ind(x, y + 0.1 * y.mean(), equal_var=False, alternative="less").pvalue
    assert compare(x, y, 0.1).short > fixed


def test_all_needs_every_place_and_one_opposite_disproves_it():
    good, bad, noise = compare(around(12), around(10), 0.1), compare(around(8), around(10), 0.1), None
    noise = compare(around(10, 4), around(10, 4), 0.1)
    assert rule({"a": good, "b": good}, ("a", "b"), 2).verdict == REPRODUCED
    assert rule({"a": good, "b": noise}, ("a", "b"), 2).verdict == INCONCLUSIVE
    opposite = rule({"a": good, "b": bad}, ("a", "b"), 2)
    assert (opposite.verdict, opposite.why) == (NOT_REPRODUCED, "the opposite is shown")
    same = compare(around(10), around(10), 0.1)
    assert rule({"a": same, "b": same}, ("a", "b"), 2).why == "no difference of 10% or more"


def test_any_needs_one_and_is_disproved_by_all():
    good, bad = compare(around(12), around(10), 0.1), compare(around(8), around(10), 0.1)
    assert rule({"a": good, "b": bad}, ("a", "b"), 1).verdict == REPRODUCED
    assert rule({"a": bad, "b": bad}, ("a", "b"), 1).verdict == NOT_REPRODUCED
    assert rule({"a": bad}, ("a", "b"), 1).verdict == UNDECIDABLE  # the other might hold
    assert rule({"a": good}, ("a", "b"), 1).verdict == REPRODUCED  # whatever the other does


def test_three_of_four():
    places, good, bad = tuple("abcd"), compare(around(12), around(10), 0.1), compare(around(8), around(10), 0.1)
    assert rule({"a": good, "b": good, "c": good, "d": bad}, places, 3).verdict == REPRODUCED
    assert rule({"a": good, "b": good, "c": bad, "d": bad}, places, 3).verdict == NOT_REPRODUCED
    two = rule({"a": good, "b": good}, places, 3)
    assert (two.verdict, two.where_trained) == (UNDECIDABLE, REPRODUCED)
    assert rule({}, places, 3).comparisons == {}


@pytest.mark.parametrize("skewed", [False, True])
@pytest.mark.parametrize("seeds", [3, 5, 10])
def test_no_wrong_verdict_is_given_more_often_than_stated(seeds, skewed):
    measured = verdicts.rates(seeds, skewed)
    wrong = dict(list(measured.items())[:6])
    assert all(rate <= verdicts.ALPHA + 0.012 for rate in wrong.values()), wrong  # 4000 trials: 0.05 +- 0.0034


def test_the_uncorrected_rule_for_any_place_is_seen_to_err():
    rng = np.random.default_rng(0)
    p = np.stack([verdicts.t_test(*rng.normal(size=(2, 4000, 5)))[0] for _ in range(4)], -1)
    assert (p.min(-1) <= verdicts.ALPHA).mean() > 0.15
    assert (verdicts.at_least(1, p) <= verdicts.ALPHA).mean() < 0.06


def test_as_many_seeds_as_are_said_to_decide_do():
    x, y = around(1.0, 1.0), around(0.0, 1.0)
    n = int(verdicts.seeds_for(1.0, x, y))
    rng, spread = np.random.default_rng(0), np.std(x, ddof=1)

    def power(n):
        p, _ = verdicts.t_test(1.0 + spread * rng.normal(size=(8000, n)), spread * rng.normal(size=(8000, n)))
        return (p <= verdicts.ALPHA).mean()

    assert power(n) >= verdicts.POWER - 0.02
    assert power(n - 2) < verdicts.POWER
    assert np.isnan(verdicts.seeds_for(-1.0, x, y))
    assert np.isnan(verdicts.seeds_for(1e-9, x, y))


def test_the_page_states_the_rates_that_are_measured():
    page = (ROOT / "docs" / "verdicts.md").read_text()

    def numbers(lines):
        return np.array([[float(cell) for cell in line.split("|")[2:-1]] for line in lines[2:]])

    stated = [line for line in page.splitlines() if line.startswith("|")]
    measured = verdicts.table_of_rates()
    assert [line.split("|")[1] for line in stated] == [line.split("|")[1] for line in measured]
    assert np.abs(numbers(stated) - numbers(measured)).max() < 0.005
