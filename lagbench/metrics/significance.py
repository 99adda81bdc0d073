"""Do two methods differ? Scenarios are the sample, and so are seeds where there are
several.

Frames of one rollout are not independent, so a scenario is one value. With several
seeds on either side the mean difference is held against its two-way bootstrap error
(:func:`lagbench.metrics.aggregate.resample`); with one seed on both, scenarios alone
can be drawn: the exact sign-flip test then compares these weights, and says nothing of
the methods.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lagbench.errors import UsageError

from .aggregate import Score, mean_over_seeds, resample
from .frame import Floats
from .metric import mean

SIGNIFICANCE = 0.05
"""Level at which two methods are told apart."""

FEWEST_SCENARIOS = 6
"""Under this no p-value can reach 5 % (2^(1-5) = 0.0625), so none is claimed."""

MOST_SCENARIOS = 40
"""Above this the exact test would need more than 2^20 partial sums."""

ROUNDING = 1e-12
"""Sums that differ by less than this share of sum(|d|) are equal."""


def sign_flip_p(differences: ArrayLike) -> float:
    """Return the exact two-sided p-value of the sign-flip test, ``2^(1-n) <= p <= 1``.

    If neither is better, each difference is as likely as its negative: the share of all
    2^n sign patterns whose mean is at least as far from 0 as the one seen. Zero
    differences count: they are the same under either sign. All zero gives 1. None, or
    more than 40, are refused, as are differences that are not finite.
    """
    d = np.abs(np.asarray(differences, np.float64).ravel())
    if not np.isfinite(d).all():
        raise UsageError(
            "differences are not finite", expected="numbers", got="NaN or infinity"
        )
    if not 1 <= d.size <= MOST_SCENARIOS:
        raise UsageError(
            "the exact sign-flip test does not fit",
            expected=f"1 to {MOST_SCENARIOS} scenarios",
            got=d.size,
        )
    seen = abs(float(np.sum(np.asarray(differences, np.float64)))) - ROUNDING * float(
        np.sum(d)
    )
    if seen <= 0.0:
        return 1.0
    # a sum over all scenarios is a sum over one half plus one over the other
    left = _signed_sums(d[: d.size // 2])
    right = np.sort(_signed_sums(d[d.size // 2 :]))
    above = right.size - np.searchsorted(right, seen - left, side="left")
    return float(2.0 * int(np.sum(above)) / 2.0**d.size)


def _signed_sums(d: Floats) -> Floats:
    """Return the sums under all sign patterns, shape [2^n]."""
    sums = np.zeros(1)
    for value in d:
        sums = np.concatenate([sums + value, sums - value])
    return sums


def differ(first: ArrayLike, second: ArrayLike) -> float:
    """Return the two-sided p-value of no difference between two methods.

    With one seed each it is the exact sign-flip test over scenarios, of these weights.
    Otherwise ``t = mean difference / two-way bootstrap error`` against Student's t with
    Satterthwaite's degrees of freedom; no p-value is below the sign-flip test's least,
    ``2^(1-n)``.

    Losses are NaN where undefined, shape [seed, scenario] or [scenario]. With fewer
    than six scenarios in which both have a value the answer is NaN: none is claimed.
    """
    a, b = (np.atleast_2d(np.asarray(side, np.float64)) for side in (first, second))
    if a.shape[1] != b.shape[1]:
        raise UsageError(
            "methods over different scenarios", expected=a.shape[1], got=b.shape[1]
        )
    both = ~(np.isnan(a).all(axis=0) | np.isnan(b).all(axis=0))
    a = a[:, both]
    b = b[:, both]
    scenarios = a.shape[1]
    if scenarios >= FEWEST_SCENARIOS:
        found = resample(a, b)
    else:
        found = None
    if found is None:
        return math.nan
    if len(a) == len(b) == 1 and scenarios <= MOST_SCENARIOS:
        return sign_flip_p(a[0] - b[0])
    least = float(2.0 ** (1 - scenarios))
    if not found.error:
        if found.mean:
            return least
        return 1.0
    from scipy.special import stdtr

    return max(least, 2.0 * float(stdtr(found.freedom, -abs(found.mean) / found.error)))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values corrected for their number by Holm's steps; NaN, where none is
    claimed, stays.

    >>> holm([0.01, 0.04, 0.03])
    [0.03, 0.06, 0.06]
    """
    known = sorted((p, i) for i, p in enumerate(p_values) if not math.isnan(p))
    corrected = [math.nan] * len(p_values)
    least = 0.0
    for step, (p, i) in enumerate(known):
        least = max(least, min(1.0, (len(known) - step) * p))
        corrected[i] = least
    return corrected


@dataclass(frozen=True)
class Comparison:
    """How far one method is from another in one metric."""

    metric: str  # its name
    scenarios: tuple[int, ...]  # for which both have a value
    # mean of first minus second, in the metric's loss: negative if the first is better
    difference: float
    interval: tuple[float, float]  # 95 % bootstrap interval of that mean
    p: float  # two-sided, NaN with fewer than six scenarios: none is claimed
    # of either side; one on both: these weights, not the methods
    seeds: tuple[int, int] = 1, 1

    @property
    def significant(self) -> bool:
        """Whether the two differ at 5 %."""
        return self.p < SIGNIFICANCE


Seeds = Score | Sequence[Score]
"""Score of one seed, or of each seed of a method."""


def compare(first: Seeds, second: Seeds, *, paired: bool = False) -> Comparison:
    """Compare two methods in one metric over the scenarios that both have.

    Args:
        first: scores of a method's seeds.
        second: those of another.
        paired: whether seed s of both is one training, used in two ways: its scatter
            then cancels, and the differences seed by seed are tested.

    Raises:
        UsageError: the scores are of different metrics, or paired of different numbers
            of seeds.
    """
    sides = [_listed(first), _listed(second)]
    names = {score.metric.name for side in sides for score in side}
    if len(names) != 1:
        raise UsageError("scores of different metrics", got=" and ".join(sorted(names)))
    losses = [[_losses(score) for score in side] for side in sides]
    defined = [set().union(*side) for side in losses]
    common = tuple(sorted(defined[0] & defined[1]))
    one, two = (_table(side, common) for side in losses)
    if paired and len(one) != len(two):
        raise UsageError(
            "pairs of different numbers of seeds", got=f"{len(one)} and {len(two)}"
        )
    if paired:
        tested = (one - two, np.zeros((1, len(common))))
    else:
        tested = (one, two)
    if common:
        found = resample(*tested)
    else:
        found = None
    return Comparison(
        metric=names.pop(),
        scenarios=common,
        difference=mean(mean_over_seeds(tested[0]) - mean_over_seeds(tested[1])),
        interval=(math.nan, math.nan) if found is None else found.interval,
        p=differ(*tested) if common else math.nan,
        seeds=(len(one), len(two)),
    )


def _listed(seeds: Seeds) -> Sequence[Score]:
    if isinstance(seeds, Score):
        return [seeds]
    return seeds


def _losses(score: Score) -> dict[int, float]:
    """Return the loss of each scenario that has a value, by id."""
    values = zip(score.scenarios, score.values.tolist(), strict=True)
    return {i: score.metric.loss(value) for i, value in values if not math.isnan(value)}


def _table(seeds: Sequence[Mapping[int, float]], scenarios: Sequence[int]) -> Floats:
    """Return losses, NaN where undefined, shape [seed, scenario]."""
    return np.array([[loss.get(i, math.nan) for i in scenarios] for loss in seeds])


def mean_loss(seeds: Seeds) -> float:
    """Return the loss of the mean over seeds, then scenarios, as tables show it;
    infinite without any.
    """
    losses = [_losses(score) for score in _listed(seeds)]
    found = mean(mean_over_seeds(_table(losses, sorted(set().union(*losses)))))
    if math.isnan(found):
        return math.inf
    return found


@dataclass(frozen=True, kw_only=True)
class Standing:
    """Where a method stands among those that are ranked."""

    rank: int  # from 1, in the order of the mean
    # against the leader, Holm-corrected for all who are compared with it; NaN without a
    # claim
    p: float
    # whether it cannot be told from the leader at 5 %; False for the leader itself
    tied: bool


def standings(scores: Mapping[str, Seeds]) -> dict[str, Standing]:
    """Return where each method stands, best first; methods without any value come
    last.
    """
    loss = {name: mean_loss(seeds) for name, seeds in scores.items()}
    order = sorted(scores, key=lambda name: (loss[name], name))
    p = [
        math.nan,
        *holm([compare(scores[name], scores[order[0]]).p for name in order[1:]]),
    ]
    tied = [
        i > 0 and loss[name] < math.inf and not p[i] < SIGNIFICANCE
        for i, name in enumerate(order)
    ]
    return {
        name: Standing(rank=i + 1, p=p[i], tied=tied[i]) for i, name in enumerate(order)
    }
