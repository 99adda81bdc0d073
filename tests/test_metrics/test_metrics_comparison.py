"""Intervals, sign-flip test and ranks against SciPy, enumeration and closed forms."""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray
from statsmodels.stats.multitest import multipletests

from lagbench.errors import UsageError
from lagbench.metrics import (
    METRICS,
    Score,
    bootstrap_interval,
    compare,
    differ,
    holm,
    resample,
    sign_flip_p,
    standings,
)
from lagbench.metrics.metric import mean_of_rows
from lagbench.metrics.significance import mean_loss, rank_ranges

Floats = NDArray[np.float64]
NUMBERS = st.integers(-5, 5).map(float)
DIFFERENCES = st.lists(NUMBERS, min_size=1, max_size=9)


def score_of(*values: float, metric: str = "vorticity_mse", first: int = 0) -> Score:
    """Return a score with these values over consecutive scenarios."""
    count = len(values)
    scenarios = tuple(range(first, first + count))
    means = np.array(values)
    frames = (2,)
    undefined = (0,) * count
    return Score(
        METRICS[metric],
        scenarios,
        frames,
        means[:, None],
        means,
        undefined,
    )


def shifted_score(values: Sequence[float], shift: float) -> Score:
    """Return a score whose values are all larger by a shift."""
    return score_of(*(value + shift for value in values))


def enumerated(differences: list[float]) -> float:
    """Return the p-value by going through all sign patterns."""
    observed = abs(sum(differences))
    count = len(differences)
    patterns = list(itertools.product((1, -1), repeat=count))
    extreme_count = 0
    for pattern in patterns:
        terms = map(operator.mul, pattern, differences)
        total = sum(terms)
        if abs(total) >= observed:
            extreme_count += 1
    return extreme_count / len(patterns)


@given(DIFFERENCES)
def test_p_is_that_of_all_sign_patterns(differences: list[float]) -> None:
    """The sums over two halves count what going through all 2^n patterns counts, ties
    included.
    """
    assert sign_flip_p(differences) == enumerated(differences)


def test_ties_by_rounding_count() -> None:
    """0.1 + 0.2 - 0.3 is 5.6e-17, not 0: equal sums differ by rounding and are still
    equal.
    """
    # |sum| of 0.1 0.2 0.3 -0.6 is 0 up to rounding: every pattern is as extreme
    assert sign_flip_p([0.1, 0.2, 0.3, -0.6]) == 1.0
    # 1, 2, 3 with signs: |sum| >= 6 in 2 of 8 patterns, whatever the scale
    assert sign_flip_p([1.0, 2.0, 3.0]) == 0.25
    assert sign_flip_p([0.1, 0.2, 0.3]) == 0.25
    # of one sign only the pattern seen and its opposite are as extreme
    for n in (1, 2, 6, 13, 40):
        differences = np.linspace(1.0, 2.0, n)
        expected = 2.0 ** (1 - n)
        assert sign_flip_p(differences) == pytest.approx(expected, rel=1e-12)


INFINITE = [1.0, 2.0, math.inf, 4.0, 5.0, 6.0]


@pytest.mark.parametrize(
    "values",
    ["x", ["x", "y"], [[1.0], [1.0, 2.0]], [object()], np.ones((3, 12, 1)), INFINITE],
)
def test_what_is_no_array_of_seeds_and_scenarios_is_refused(values: Any) -> None:
    """Infinity is no evidence: its p-value of 0 would be below the least there is."""
    plain = np.ones((4, 6))
    for first, second in ((plain, values), (values, plain)):
        with pytest.raises(UsageError):
            differ(first, second)
        with pytest.raises(UsageError):
            bootstrap_interval(first, minus=second)
    for losses in (values, [], [1.0] * 41, [1.0, math.nan]):
        with pytest.raises(UsageError):
            sign_flip_p(losses)


def test_interval_is_scipys_percentile_bootstrap() -> None:
    """SciPy's percentiles about the mean, stretched by sqrt(n/(n-1)) and Student's
    quantile.
    """
    rng = np.random.default_rng(1)
    x = rng.gamma(2.0, size=12)
    low, high = bootstrap_interval(x)
    options = {
        "n_resamples": 20_000,
        "method": "percentile",
        "rng": np.random.default_rng(2),
    }
    bootstrap = scipy.stats.bootstrap((x,), np.mean, **options)
    theirs = bootstrap.confidence_interval
    student = scipy.stats.t.ppf(0.975, 11)
    normal = scipy.stats.norm.ppf(0.975)
    stretch = math.sqrt(12 / 11) * student / normal
    mean = x.mean()
    tolerance = 0.05 * (high - low)
    expected_low = mean + stretch * (theirs.low - mean)
    expected_high = mean + stretch * (theirs.high - mean)
    assert low == pytest.approx(expected_low, abs=tolerance)
    assert high == pytest.approx(expected_high, abs=tolerance)


@given(
    arrays(
        np.float64,
        array_shapes(min_dims=2, max_dims=2, max_side=40),
        elements=st.floats(-1e9, 1e9) | st.just(math.nan),
    ),
    st.booleans(),
)
def test_means_of_rows_are_those_of_numpy(values: Floats, has_same_gaps: bool) -> None:
    """Bit by bit, with gaps and without; a row without a value has NaN."""
    if has_same_gaps:
        values[:, np.isnan(values[0])] = math.nan
        values[:, ~np.isnan(values[0])] = np.nan_to_num(values[:, ~np.isnan(values[0])])
    expected = []
    for row in values:
        defined = row[~np.isnan(row)]
        expected.append(np.mean(defined) if defined.size else math.nan)
    np.testing.assert_array_equal(mean_of_rows(values), expected)
    np.testing.assert_array_equal(mean_of_rows(np.asfortranarray(values)), expected)


def test_the_two_way_bootstrap_of_a_closed_case() -> None:
    """For value = a_s + b_i the variance is var(a)/S + var(b)/N.

    That of the draws is the same, and the degrees of freedom are Satterthwaite's.
    """
    seeds = np.array([0.0, 1.0, 5.0])
    scenarios = np.array([1.0, 2.0, 4.0, 4.0, 9.0, 10.0])
    resampling = resample(seeds[:, None] + scenarios)

    seed_variance = np.var(seeds, ddof=1) / 3
    scenario_variance = np.var(scenarios, ddof=1) / 6
    variance = seed_variance + scenario_variance
    assert resampling.mean == pytest.approx(2.0 + 5.0)
    assert resampling.error**2 == pytest.approx(variance)
    variance_of_draws = np.var(resampling.deviations)
    assert variance_of_draws == pytest.approx(variance, rel=0.03)

    squares = seed_variance**2 / 2 + scenario_variance**2 / 5
    assert resampling.freedom == pytest.approx(variance**2 / squares)


def test_intervals_repeat_and_scale() -> None:
    """The draws are seeded and depend on the number of scenarios alone.

    NaN values are left out. With one seed the scenarios alone are drawn, in either
    shape; fewer than four have no interval.
    """
    x = [3.0, 1.0, 4.0, 1.0, 5.0, 9.0]
    low, high = bootstrap_interval(x)
    assert low < np.mean(x) < high
    assert bootstrap_interval(x) == (low, high)
    assert bootstrap_interval([x]) == (low, high)

    shifted = bootstrap_interval(x, minus=[1.0] * 6)
    assert shifted == pytest.approx((low - 1.0, high - 1.0))
    twice_and_one = [2 * value + 1 for value in x]
    scaled = bootstrap_interval(twice_and_one)
    assert scaled == pytest.approx((2 * low + 1, 2 * high + 1))
    with_nan = [*x[:2], math.nan, *x[2:]]
    assert bootstrap_interval(with_nan) == (low, high)

    for few in (
        [],
        [1.0],
        [1.0, 2.0, 4.0],
        [math.nan, 2.0, 1.0, 1.0],
    ):
        low, high = bootstrap_interval(few)
        assert math.isnan(low)
        assert math.isnan(high)


def test_differ_is_a_t_test_or_the_sign_flip_test() -> None:
    """Methods whose seeds alone scatter: Welch's test of their means, by SciPy.

    Three equal seeds of each: SciPy's paired test over scenarios. One seed, weights
    against weights: exact over scenarios; a missing scenario is left out, five claim
    nothing.
    """
    a = np.array([1.0, 1.2, 1.5])
    b = np.array([2.0, 2.6, 2.1, 2.9])
    a_seeds = np.repeat(a[:, None], 12, axis=1)
    b_seeds = np.repeat(b[:, None], 12, axis=1)
    welch = scipy.stats.ttest_ind(a, b, equal_var=False)
    assert differ(a_seeds, b_seeds) == pytest.approx(welch.pvalue)

    rng = np.random.default_rng(3)
    a, b = rng.gamma(3.0, size=(2, 9))
    a_seeds = np.tile(a, (3, 1))
    b_seeds = np.tile(b, (3, 1))
    equal_seeds = differ(a_seeds, b_seeds)
    paired = scipy.stats.ttest_rel(a, b)
    assert equal_seeds == pytest.approx(paired.pvalue)

    exact = sign_flip_p(a - b)
    assert differ(a, b) == exact
    assert differ([a], [b]) == exact

    a[2] = math.nan
    without = np.delete(a - b, 2)
    assert differ(a, b) == sign_flip_p(without)
    assert math.isnan(differ(a[3:8], b[3:8]))
    with pytest.raises(UsageError):
        differ(a, b[:4])


def test_seeds_of_one_method_seldom_differ() -> None:
    """Of 400 pairs of draws of 3 seeds of one method at most 5 % differ, by chance."""
    rng = np.random.default_rng(11)
    count = 0
    for _ in range(400):
        scenario = rng.normal(0, 1, 16)
        draws = []
        for _ in range(2):
            seeds = rng.normal(0, 0.2, (3, 1))
            rest = rng.normal(0, 0.2, (3, 16))
            draws.append(scenario + seeds + rest)
        count += differ(*draws) < 0.05
    assert count / 400 <= 0.05


@pytest.mark.parametrize(
    "p",
    [
        [0.03],
        [0.0, 1.0],
        # the third is held up by the second: 0.06, 0.03, 0.06, 0.02
        [0.04, 0.01, 0.03, 0.005],
        [0.2, 0.01, 0.01, 0.2, 1.0, 0.6],
        np.random.default_rng(0).beta(0.5, 3.0, 9).tolist(),
    ],
)
def test_holm_is_that_of_statsmodels(p: list[float]) -> None:
    """The corrected p-values are those of statsmodels' step-down method, with ties, 0
    and 1.
    """
    _, corrected, *_ = multipletests(p, method="holm")
    assert holm(p) == pytest.approx(corrected.tolist())
    # NaN is not counted as a comparison and stays
    *others, claimed_none = holm([*p, math.nan])
    assert others == holm(p)
    assert math.isnan(claimed_none)


def test_comparison_over_common_scenarios() -> None:
    """Scenarios 1 to 6 are in both; one that is NaN on a side is left out. Five common
    scenarios claim nothing.
    """
    one = score_of(9.0, *range(1, 7))
    found = compare(one, score_of(*range(2, 8), 99.0, first=1))
    assert found.scenarios == (1, 2, 3, 4, 5, 6)
    assert (found.difference, found.interval) == (-1.0, (-1.0, -1.0))
    assert found.p == 2.0**-5
    assert found.significant
    assert compare(one, score_of(math.nan, 1.0)).scenarios == (1,)
    five = compare(score_of(*[1.0] * 5), score_of(*[2.0] * 5))
    assert math.isnan(five.p)
    assert not five.significant


@pytest.mark.parametrize(
    ("metric", "better", "worse", "gain"),
    [("vorticity_pearson", 0.9, 0.8, 0.1), ("energy_ratio", 0.9, 1.3, 0.2)],
)
def test_direction_decides_who_is_better(
    metric: str, better: float, worse: float, gain: float
) -> None:
    """A higher correlation and an energy ratio nearer 1 are smaller losses."""
    found = compare(score_of(better, metric=metric), score_of(worse, metric=metric))
    assert found.difference == pytest.approx(-gain)


@pytest.mark.parametrize("other", ["energy_true", "vorticity_mae"])
def test_observables_and_different_metrics_are_not_compared(other: str) -> None:
    first = "energy_true" if other == "energy_true" else "vorticity_mse"
    with pytest.raises(UsageError):
        compare(score_of(1.0, metric=first), score_of(1.0, metric=other))


def test_ranks_are_numbers_in_order() -> None:
    """B differs from a in two scenarios only (p = 0.5): it is tied with the leader. The
    others win no scenario: p = 2/512, times the comparisons left. One without a value
    comes last.
    """
    a = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]
    scores = {
        "none": score_of(*[math.nan] * 9),
        "d": shifted_score(a, 2.001),
        "c": shifted_score(a, 2.0),
        "b": score_of(*a[:7], 8.5, 9.5),
        "a": score_of(*a),
    }
    places = standings(scores)
    assert list(places) == ["a", "b", "c", "d", "none"]
    assert [place.rank for place in places.values()] == [1, 2, 3, 4, 5]
    assert [name for name, place in places.items() if place.tied] == ["b"]
    assert math.isnan(places["a"].p)
    assert places["b"].p == pytest.approx(0.5)
    assert places["c"].p == places["d"].p == pytest.approx(3 * 2.0**-8)


def test_ranks_follow_the_mean_over_seeds_then_scenarios() -> None:
    """A seed lacks a scenario in which the other has 4: 2.5, not the mean of all."""
    gappy = [score_of(1.0, math.nan), score_of(1.0, 4.0)]
    assert mean_loss(gappy) == 2.5
    ranked = standings({"gappy": gappy, "even": [score_of(2.2, 2.2)]})
    assert list(ranked) == ["even", "gappy"]


def test_seeds_of_a_method_are_compared_together() -> None:
    """Two seeds against one: means over seeds, number of seeds stated, p of the two-way
    test.
    """
    first = np.arange(1.0, 8.0).tolist()
    seeds = [score_of(*first), shifted_score(first, 1.0)]
    other = shifted_score(first, 10.0)
    found = compare(seeds, other)
    values = [score.values for score in seeds]
    assert found.seeds == (2, 1)
    assert found.difference == pytest.approx(-9.5)
    assert found.p == differ(values, other.values)
    assert found.interval == bootstrap_interval(values, minus=other.values)


SKEWED = (0.0, 0.0, 0.0, 0.0, 0.0, 8.0)


@pytest.mark.parametrize(
    ("metric", "values", "ends"),
    [
        ("vorticity_mse", SKEWED, (0.0, None)),
        ("energy_ratio", SKEWED, (0.0, None)),
        ("stable_frames", SKEWED, (0.0, None)),
        ("stable_frames", [8.0 - value for value in SKEWED], (None, 8.0)),
        ("vorticity_pearson", [1.0 - value / 4 for value in SKEWED], (None, 1.0)),
        ("vorticity_pearson", [value / 4 - 1.0 for value in SKEWED], (-1.0, None)),
        ("outside_share", [100.0 - value for value in SKEWED], (None, 100.0)),
        ("vorticity_residual_p50", SKEWED, (None, None)),
    ],
)
def test_an_interval_ends_where_the_metric_ends(
    metric: str, values: Sequence[float], ends: tuple[float | None, float | None]
) -> None:
    """The stretched bootstrap of few skewed values reaches beyond; it is cut off."""
    score = replace(score_of(*values, metric=metric), frames=tuple(range(8)))
    low, high = bootstrap_interval(values)
    least, greatest = ends
    if least is not None:
        assert low < least
        low = least
    if greatest is not None:
        assert high > greatest
        high = greatest
    assert score.interval == (low, high)


def test_ranges_of_ranks_are_those_of_all_draws() -> None:
    """The shares of ranks are counted over all 6^6 draws of six scenarios."""
    losses = {
        "a": np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]),
        "b": np.array([1.9, 1.4, 3.2, 4.1, 5.6, 5.2]),
        "c": np.array([2.1, 2.9, 3.1, 5.2, 5.9, 7.2]),
    }
    names = sorted(losses)
    # shape [method, scenario]
    values = np.array([losses[name] for name in names])
    stretch = math.sqrt(6 / 5)
    middle = values.mean(axis=1)[:, None]
    # shape [draw, scenario]
    draws = np.indices((6,) * 6).reshape(6, -1).T
    means_of_draws = values[:, draws].mean(axis=2)
    # shape [method, draw]
    means = middle + stretch * (means_of_draws - middle)
    is_better = means[None] < means[:, None]
    ranks = 1 + is_better.sum(axis=1)
    sorted_ranks = np.sort(ranks, axis=1)
    tail = int(0.025 * len(draws))
    expected = {}
    for name, ranks_of_name in zip(names, sorted_ranks, strict=True):
        low = ranks_of_name[tail]
        high = ranks_of_name[-1 - tail]
        expected[name] = (low, high)
    assert expected == {"a": (1, 2), "b": (1, 2), "c": (3, 3)}
    tables = {name: [table[None]] for name, table in losses.items()}
    assert rank_ranges(tables) == expected
    backwards = {name: tables[name] for name in reversed(names)}
    assert rank_ranges(backwards) == expected


def test_ranges_of_ranks_know_ties_gaps_and_few_scenarios() -> None:
    """Seeds that scatter widen a range; few scenarios claim nothing."""
    same = np.arange(1.0, 9.0)[None]
    nothing = np.full((1, 8), np.nan)
    scatter = np.array([[-2.0], [0.0], [2.0]])
    for tables, ranges in (
        (
            {"b": [same], "a": [same], "far": [9.0 + same], "none": [nothing]},
            {"a": (1, 2), "b": (1, 2), "far": (3, 3), "none": (4, 4)},
        ),
        ({"a": [same[:, :5]], "b": [same[:, :5]]}, {}),
        ({"a": [same], "b": [same + 0.5]}, {"a": (1, 1), "b": (2, 2)}),
        (
            {"a": [same + scatter], "b": [same + 0.5 + scatter]},
            {"a": (1, 2), "b": (1, 2)},
        ),
    ):
        assert rank_ranges(tables) == ranges
