"""Do two methods differ? The sample are scenarios, and seeds if there are several.

Frames of one rollout are not independent, so a scenario is one value. With several
seeds of either method the mean difference is tested against its two-way bootstrap error
(:func:`lagbench.metrics.aggregate.resample`); with one seed of both, only scenarios can
be drawn: the exact sign-flip test then compares these weights, and says nothing about
the methods.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lagbench.errors import UsageError

from .aggregate import (
    RESAMPLES,
    Resampling,
    Score,
    as_method,
    mean_over_seeds,
    resample,
)
from .frame import Floats
from .metric import mean

SIGNIFICANCE = 0.05
"""Level of significance of a difference."""

FEWEST_SCENARIOS = 6
"""Under this no p-value can reach 5 % (2^(1-5) = 0.0625), so none is claimed."""

MOST_SCENARIOS = 40
"""Above this the exact test would need more than 2^20 partial sums."""

ROUNDING = 1e-12
"""Losses that differ by less than this share are equal, and so are sums that differ by
less than this share of sum(|d|)."""


def sign_flip_p(differences: ArrayLike) -> float:
    """Return the exact two-sided p-value of the sign-flip test, ``2^(1-n) <= p <= 1``.

    If neither method is better, each difference is as likely as its negative: the share
    of all 2^n sign patterns whose mean is at least as far from 0 as the observed one.
    Zero differences count: they are the same under either sign. All zero gives 1.

    Raises:
        UsageError: no difference, more than 40, or one that is no finite number.
    """
    signed = as_method(differences)
    d = np.abs(signed.ravel())
    if np.isnan(d).any() or not 1 <= d.size <= MOST_SCENARIOS:
        raise UsageError(
            f"the sign-flip test takes 1 to {MOST_SCENARIOS} finite numbers"
        )

    # Sums of numbers near the largest float would be infinite. The factor is a power of
    # two, so that no digit changes.
    _, exponent = np.frexp(np.max(d))
    signed = np.ldexp(signed, -exponent)
    d = np.ldexp(d, -exponent)

    observed = abs(float(np.sum(signed))) - ROUNDING * float(np.sum(d))
    if observed <= 0.0:
        return 1.0

    # a sum over all scenarios is a sum over one half plus one over the other
    middle = d.size // 2
    left = _signed_sums(d[:middle])
    right = np.sort(_signed_sums(d[middle:]))
    extreme = right.size - np.searchsorted(right, observed - left, side="left")
    return float(2.0 * int(np.sum(extreme)) / 2.0**d.size)


def _signed_sums(d: Floats) -> Floats:
    """Return the sums under all sign patterns, shape [2^n]."""
    sums = np.zeros(1)
    for value in d:
        sums = np.concatenate([sums + value, sums - value])
    return sums


def differ(first: ArrayLike, second: ArrayLike) -> float:
    """Return the two-sided p-value of no difference between two methods.

    With one seed each it is the exact sign-flip test over scenarios, of two trainings.
    Otherwise ``t = mean difference / two-way bootstrap error`` against Student's t with
    Satterthwaite's degrees of freedom; no p-value is below the sign-flip test's least,
    ``2^(1-n)``.

    Losses are NaN where undefined, shape [seed, scenario] or [scenario]. With fewer
    than six scenarios in which both have a value the result is NaN.

    Raises:
        UsageError: the methods have different scenarios, or losses are infinite, no
            numbers, or of another shape.
    """
    a = as_method(first)
    b = as_method(second)
    if a.shape[1] != b.shape[1]:
        raise UsageError(f"{a.shape[1]} and {b.shape[1]} scenarios; give the same")
    is_undefined = np.isnan(a).all(axis=0) | np.isnan(b).all(axis=0)
    a = a[:, ~is_undefined]
    b = b[:, ~is_undefined]
    scenario_count = a.shape[1]
    if scenario_count < FEWEST_SCENARIOS:
        return math.nan
    resampling = resample(a, b)
    if resampling is None:
        return math.nan

    has_one_seed = len(a) == len(b) == 1
    if has_one_seed and scenario_count <= MOST_SCENARIOS:
        return sign_flip_p(a[0] - b[0])

    least = float(2.0 ** (1 - scenario_count))
    if not resampling.error:
        if resampling.mean:
            return least
        return 1.0

    # commands that compare nothing save its import
    from scipy.special import stdtr

    t = abs(resampling.mean) / resampling.error
    return max(least, 2.0 * float(stdtr(resampling.freedom, -t)))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values corrected for their number by Holm's steps; NaN stays NaN.

    >>> holm([0.01, 0.04, 0.03])
    [0.03, 0.06, 0.06]
    """
    defined = [i for i, p_value in enumerate(p_values) if not math.isnan(p_value)]
    defined.sort(key=lambda i: (p_values[i], i))

    corrected = [math.nan] * len(p_values)
    largest_so_far = 0.0
    for step, i in enumerate(defined):
        stepped = min(1.0, (len(defined) - step) * p_values[i])
        largest_so_far = max(largest_so_far, stepped)
        corrected[i] = largest_so_far
    return corrected


@dataclass(frozen=True)
class Comparison:
    """Difference of two methods in one metric."""

    metric: str  # its name
    scenarios: tuple[int, ...]  # in which both have a value
    # mean of first minus second, in the metric's loss: negative if the first is better
    difference: float
    interval: tuple[float, float]  # 95 % bootstrap interval of that mean
    p: float  # two-sided, NaN with fewer than six scenarios
    # of each method; one of both: these weights are compared, not the methods
    seeds: tuple[int, int] = 1, 1

    @property
    def significant(self) -> bool:
        """Whether the two differ at 5 %."""
        return self.p < SIGNIFICANCE


Seeds = Score | Sequence[Score]
"""Score of one seed, or of each seed of a method."""


def compare(first: Seeds, second: Seeds) -> Comparison:
    """Compare two methods in one metric over the scenarios that both have.

    Args:
        first: scores of a method's seeds.
        second: scores of another method's seeds.

    Raises:
        UsageError: the scores are of different metrics.
    """
    first_scores = _as_sequence(first)
    second_scores = _as_sequence(second)
    names = {score.metric.name for score in (*first_scores, *second_scores)}
    if len(names) != 1:
        raise UsageError(f"scores of different metrics: {', '.join(sorted(names))}")

    first_losses = [_losses(score) for score in first_scores]
    second_losses = [_losses(score) for score in second_scores]
    first_defined = set().union(*first_losses)
    second_defined = set().union(*second_losses)
    common = tuple(sorted(first_defined & second_defined))

    a = _table(first_losses, common)
    b = _table(second_losses, common)
    if len(a) == len(b) == 1:
        # Sums in another order differ in their last digits: no method is better by it.
        is_equal = np.isclose(a, b, rtol=ROUNDING, atol=0.0)
        b = np.where(is_equal, a, b)
    interval = (math.nan, math.nan)
    p = math.nan
    if common:
        p = differ(a, b)
        resampling = resample(a, b)
        if resampling is not None:
            interval = resampling.interval
    return Comparison(
        metric=names.pop(),
        scenarios=common,
        difference=mean(mean_over_seeds(a) - mean_over_seeds(b)),
        interval=interval,
        p=p,
        seeds=(len(a), len(b)),
    )


def _as_sequence(seeds: Seeds) -> Sequence[Score]:
    if isinstance(seeds, Score):
        return [seeds]
    return seeds


def _losses(score: Score) -> dict[int, float]:
    """Return the loss of each scenario that has a value, by id."""
    losses = {}
    for i, value in zip(score.scenarios, score.values.tolist(), strict=True):
        if not math.isnan(value):
            losses[i] = score.metric.loss(value)
    return losses


def _table(seeds: Sequence[Mapping[int, float]], scenarios: Sequence[int]) -> Floats:
    """Return losses, NaN where undefined, shape [seed, scenario]."""
    return np.array([[one.get(i, math.nan) for i in scenarios] for one in seeds])


def mean_loss(seeds: Seeds) -> float:
    """Return the mean of the losses over seeds, then scenarios; infinite without any.

    Of a metric with a target it is not the loss of the mean: errors to both sides do
    not cancel.
    """
    losses = [_losses(score) for score in _as_sequence(seeds)]
    scenarios = sorted(set().union(*losses))
    loss = mean(mean_over_seeds(_table(losses, scenarios)))
    if math.isnan(loss):
        return math.inf
    return loss


@dataclass(frozen=True, kw_only=True)
class Standing:
    """Rank of a method, and whether it differs from the leader."""

    rank: int  # from 1, in the order of the mean
    # against the leader, Holm-corrected for all methods that are compared with it; NaN
    # without a claim
    p: float
    # whether it does not differ from the leader at 5 %; False for the leader itself
    tied: bool


def standings(scores: Mapping[str, Seeds]) -> dict[str, Standing]:
    """Return the standing of each method, best first, those without values last."""
    losses = {name: mean_loss(seeds) for name, seeds in scores.items()}
    order = sorted(scores, key=lambda name: (losses[name], name))

    p_values = [compare(scores[name], scores[order[0]]).p for name in order[1:]]
    corrected = [math.nan, *holm(p_values)]

    ranked = {}
    for i, name in enumerate(order):
        differs = corrected[i] < SIGNIFICANCE
        ranked[name] = Standing(
            rank=i + 1,
            p=corrected[i],
            tied=i > 0 and losses[name] < math.inf and not differs,
        )
    return ranked


RANK_SHARE = 0.95
"""Share of the resamples in which a rank lies within its range."""


def rank_ranges(
    losses: Mapping[str, Sequence[Floats]],
) -> dict[str, tuple[int, int]]:
    """Return the best and the worst rank of each method in 95 % of the resamples.

    Methods are ordered by the mean of their mean losses over data sets. All methods of
    a data set get the same draw of scenarios, so that what makes a scenario hard for
    everybody moves no rank; the seeds of each method are drawn apart
    (:func:`lagbench.metrics.aggregate.resample`). A method whose losses are undefined
    in some scenarios draws from its own.

    Args:
        losses: by method, for each data set in the same order, the losses of shape
            [seed, scenario], NaN where undefined.

    Returns:
        Empty where a data set has fewer than six scenarios: nothing is claimed there.
        Methods without a value in some data set share the last ranks.
    """
    names = sorted(losses)
    means = []  # of each method, shape [method]
    resampled = []  # shape [method, resample]
    for number, name in enumerate(names):
        tables = losses[name]
        if any(table.shape[1] < FEWEST_SCENARIOS for table in tables):
            return {}
        mean_over_sets = 0.0
        deviations = np.zeros(RESAMPLES)
        for data_set, table in enumerate(tables):
            resampling = None
            if not np.isinf(table).any():
                resampling = resample(table)
            if resampling is None:
                mean_over_sets = math.inf
                continue
            parts = {}
            for stream, part in resampling.parts.items():
                if stream:
                    # each method has seeds of its own
                    stream = len(tables) * (1 + number)
                parts[stream + data_set] = part
            own = Resampling(mean=resampling.mean, parts=parts)
            mean_over_sets += own.mean / len(tables)
            if parts:
                deviations += own.deviations / len(tables)
        means.append(mean_over_sets)
        resampled.append(mean_over_sets + deviations)

    ranges = {}
    table = np.array(resampled)
    tail = (1.0 - RANK_SHARE) / 2.0
    for number, name in enumerate(names):
        better = np.count_nonzero(table < table[number], axis=0)
        as_good = np.count_nonzero(table <= table[number], axis=0)
        # the smallest rank that ties allow, and the greatest
        low = float(np.quantile(1 + better, tail, method="inverted_cdf"))
        high = float(np.quantile(as_good, 1.0 - tail, method="inverted_cdf"))
        own_rank = 1 + sum(mean < means[number] for mean in means)
        ranges[name] = (min(int(low), own_rank), max(int(high), own_rank))
    return ranges
