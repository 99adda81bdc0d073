"""Intervals, sign-flip test and ranks against SciPy, enumeration and closed forms."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from lagbench.errors import UsageError
from lagbench.metrics import METRICS, Score, bootstrap_interval, compare, shared_ranks, sign_flip_p

DIFFERENCES = st.lists(st.integers(-5, 5).map(float), min_size=1, max_size=9)


def score_of(*values: float, metric: str = "vorticity_mse", first: int = 0) -> Score:
    """Return a score with these values over consecutive scenarios."""
    scenarios = tuple(range(first, first + len(values)))
    x = np.array(values)
    return Score(METRICS[metric], scenarios, (2,), x[:, None], x, (0,) * len(values))


def enumerated(differences: list[float]) -> float:
    """Return the p-value by going through all sign patterns."""
    seen = abs(sum(differences))
    signs = itertools.product((1, -1), repeat=len(differences))
    sums = [sum(s * d for s, d in zip(pattern, differences, strict=True)) for pattern in signs]
    return sum(abs(total) >= seen for total in sums) / len(sums)


@settings(deadline=None)
@given(DIFFERENCES)
def test_p_is_that_of_all_sign_patterns(differences: list[float]) -> None:
    """The sums over two halves count what going through all 2^n patterns counts, ties included."""
    assert sign_flip_p(differences) == enumerated(differences)


@pytest.mark.parametrize("n", [1, 2, 6, 13, 40])
def test_differences_of_one_sign_have_the_smallest_p(n: int) -> None:
    """Only the pattern seen and its opposite are as extreme: p = 2^(1-n)."""
    assert sign_flip_p(np.linspace(1.0, 2.0, n)) == pytest.approx(2.0 ** (1 - n), rel=1e-12)


def test_p_is_scipys_paired_permutation_test() -> None:
    """SciPy's exact test of paired samples swaps pairs, which flips signs."""
    d = np.random.default_rng(4).standard_normal(8) + 0.5
    found = scipy.stats.permutation_test(
        (d, np.zeros(8)),
        lambda x, y: np.mean(x - y),
        permutation_type="samples",
        n_resamples=2**8,
        vectorized=False,
    )
    assert sign_flip_p(d) == pytest.approx(found.pvalue)


def test_ties_by_rounding_count() -> None:
    """0.1 + 0.2 - 0.3 is 5.6e-17, not 0: equal sums differ by rounding and are still equal."""
    # |sum| of 0.1 0.2 0.3 -0.6 is 0 up to rounding: every pattern is as extreme
    assert sign_flip_p([0.1, 0.2, 0.3, -0.6]) == 1.0
    # 1, 2, 3 with signs: |sum| >= 6 in 2 of 8 patterns, whatever the scale
    assert sign_flip_p([0.1, 0.2, 0.3]) == sign_flip_p([1.0, 2.0, 3.0]) == 0.25


@pytest.mark.parametrize("differences", [[], [1.0] * 41])
def test_too_few_or_too_many_scenarios(differences: list[float]) -> None:
    """Nothing to compare, or more than can be enumerated, is refused."""
    with pytest.raises(UsageError, match="sign-flip"):
        sign_flip_p(differences)


def test_interval_is_scipys_percentile_bootstrap() -> None:
    """The same interval as scipy.stats.bootstrap but for its draws: within 5 % of the width."""
    x = np.random.default_rng(1).gamma(2.0, size=12)
    low, high = bootstrap_interval(x)
    theirs = scipy.stats.bootstrap(
        (x,), np.mean, n_resamples=20_000, method="percentile", rng=np.random.default_rng(2)
    ).confidence_interval
    assert [low, high] == pytest.approx([theirs.low, theirs.high], abs=0.05 * (high - low))


def test_interval_of_two_by_enumeration() -> None:
    """Of values 0 and 1 a quarter of the resamples are all 0, a quarter all 1: the interval is [0, 1]."""
    assert bootstrap_interval([0.0, 1.0]) == (0.0, 1.0)


def test_intervals_repeat_and_scale() -> None:
    """The draws are seeded and depend on the number of scenarios alone; NaN values are left out."""
    x = [3.0, 1.0, 4.0, 1.0, 5.0, 9.0]
    low, high = bootstrap_interval(x)
    assert (low, high) == bootstrap_interval(x)
    assert bootstrap_interval([2 * v + 1 for v in x]) == pytest.approx((2 * low + 1, 2 * high + 1))
    assert bootstrap_interval([*x[:2], math.nan, *x[2:]]) == (low, high)
    assert low < np.mean(x) < high


@pytest.mark.parametrize("values", [[], [1.0], [math.nan, 2.0]])
def test_one_scenario_has_no_interval(values: list[float]) -> None:
    """Nothing can be said of spread from fewer than two scenarios."""
    assert all(math.isnan(bound) for bound in bootstrap_interval(values))


def test_comparison_over_common_scenarios() -> None:
    """Scenarios 1 to 6 are in both; a scenario that is NaN in one is left out."""
    one = score_of(9.0, *range(1, 7))
    two = score_of(*range(2, 8), 99.0, first=1)
    found = compare(one, two)
    assert found.scenarios == (1, 2, 3, 4, 5, 6)
    assert found.difference == -1.0
    assert found.interval == (-1.0, -1.0)
    assert found.p == 2.0**-5
    assert found.significant
    assert compare(one, score_of(math.nan, 1.0)).scenarios == (1,)


def test_fewer_than_six_scenarios_claim_nothing() -> None:
    """With five the smallest p is 0.0625: no p-value is given, however clear the difference."""
    found = compare(score_of(*[1.0] * 5), score_of(*[2.0] * 5))
    assert math.isnan(found.p)
    assert not found.significant
    assert found.difference == -1.0


def test_direction_decides_who_is_better() -> None:
    """A higher correlation and an energy ratio nearer 1 are smaller losses."""
    higher = compare(*(score_of(v, v, metric="vorticity_pearson") for v in (0.9, 0.8)))
    nearer = compare(*(score_of(v, v, metric="energy_ratio") for v in (0.9, 1.3)))
    assert higher.difference == pytest.approx(-0.1)
    assert nearer.difference == pytest.approx(-0.2)


def test_ranks_are_shared_with_the_leader_only() -> None:
    """Method b differs from a in two scenarios only (p = 0.5): it shares rank 1; c and d are 3 and 4."""
    a = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    scores = {
        "d": score_of(*(v + 2.001 for v in a)),
        "c": score_of(*(v + 2 for v in a)),
        "b": score_of(*a[:4], 5.5, 6.5),
        "a": score_of(*a),
    }
    assert shared_ranks(scores) == {"a": 1, "b": 1, "c": 3, "d": 4}


def test_ranks_without_significance_or_values() -> None:
    """With two scenarios all share the lead; a method without a value comes last."""
    scores = {"x": score_of(1.0, 1.0), "y": score_of(5.0, 5.0), "none": score_of(math.nan, math.nan)}
    assert shared_ranks(scores) == {"x": 1, "y": 1, "none": 3}


def test_observables_and_different_metrics_are_not_compared() -> None:
    """Nothing is won by divergence of its own, and metrics do not mix."""
    with pytest.raises(UsageError, match="observable"):
        compare(score_of(1.0, metric="energy_true"), score_of(1.0, metric="energy_true"))
    with pytest.raises(UsageError, match="different metrics"):
        compare(score_of(1.0), score_of(1.0, metric="vorticity_mae"))
