"""Two submissions compared over scenarios: exact sign-flip test and shared ranks.

The scenarios are the sample: frames of one rollout are not independent. If neither method
is better, each difference is as likely as its negative; the p-value is the share of all
2^n sign patterns whose mean is at least as far from 0 as the one seen.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lagbench.errors import UsageError

from .aggregate import Score
from .frame import Floats
from .intervals import bootstrap_interval

__all__ = [
    "FEWEST_SCENARIOS",
    "MOST_SCENARIOS",
    "SIGNIFICANCE",
    "Comparison",
    "compare",
    "shared_ranks",
    "sign_flip_p",
]

SIGNIFICANCE = 0.05
"""Methods that differ from the leader at this level do not share its rank."""

FEWEST_SCENARIOS = 6
"""Under this no p-value can reach 5 % (2^(1-5) = 0.0625), so none is claimed."""

MOST_SCENARIOS = 40
"""Above this the exact test would need more than 2^20 partial sums."""

ROUNDING = 1e-12
"""Sums that differ by less than this share of sum(|d|) are equal."""


def sign_flip_p(differences: ArrayLike) -> float:
    """Return the exact two-sided p-value of the sign-flip test, ``2^(1-n) <= p <= 1``.

    Zero differences count: they are the same under either sign. All zero gives 1.

    Args:
        differences: paired differences, one per scenario, shape [scenario].

    Raises:
        UsageError: no differences, or more than 40.
    """
    d = np.abs(np.asarray(differences, np.float64))
    if not 1 <= d.size <= MOST_SCENARIOS:
        raise UsageError(
            "the exact sign-flip test does not fit", expected=f"1 to {MOST_SCENARIOS} scenarios", got=d.size
        )
    seen = abs(float(np.sum(np.asarray(differences, np.float64)))) - ROUNDING * float(np.sum(d))
    if seen <= 0.0:
        return 1.0
    # a sum over all scenarios is a sum over one half plus one over the other
    left, right = _signed_sums(d[: d.size // 2]), np.sort(_signed_sums(d[d.size // 2 :]))
    above = right.size - np.searchsorted(right, seen - left, side="left")
    return 2.0 * int(np.sum(above)) / 2.0**d.size


def _signed_sums(d: Floats) -> Floats:
    """Return the sums under all sign patterns, shape [2^n]."""
    sums = np.zeros(1)
    for value in d:
        sums = np.concatenate([sums + value, sums - value])
    return sums


@dataclass(frozen=True)
class Comparison:
    """How far one submission is from another in one metric."""

    metric: str  # name of the metric
    scenarios: tuple[int, ...]  # ids of the scenarios for which both have a value
    # mean of first minus second, in the metric's loss: negative says that the first is better
    difference: float
    interval: tuple[float, float]  # 95 % bootstrap interval of that mean
    p: float  # two-sided p-value, NaN with fewer than six scenarios: none is claimed

    @property
    def significant(self) -> bool:
        """Whether the two differ at 5 %."""
        return self.p < SIGNIFICANCE


def compare(first: Score, second: Score) -> Comparison:
    """Compare two scores of one metric over the scenarios that both have."""
    if first.metric.name != second.metric.name:
        raise UsageError("scores of different metrics", got=f"{first.metric.name} and {second.metric.name}")
    one, two = _losses(first), _losses(second)
    common = tuple(i for i in one if i in two)
    differences = np.array([one[i] - two[i] for i in common])
    return Comparison(
        metric=first.metric.name,
        scenarios=common,
        difference=float(np.mean(differences)) if common else math.nan,
        interval=bootstrap_interval(differences),
        p=sign_flip_p(differences) if len(common) >= FEWEST_SCENARIOS else math.nan,
    )


def _losses(score: Score) -> dict[int, float]:
    """Return the loss of each scenario that has a value, by id."""
    values = zip(score.scenarios, score.values.tolist(), strict=True)
    return {i: score.metric.loss(value) for i, value in values if not math.isnan(value)}


def shared_ranks(scores: Mapping[str, Score]) -> dict[str, int]:
    """Return the rank of each method; those not different from the leader at 5 % share rank 1.

    No other grouping: the rest are numbered by their mean. With fewer than six scenarios
    nothing can be told from the leader and all share its rank. Methods without any value
    come last.
    """
    losses = {name: _losses(score) for name, score in scores.items()}
    mean = {name: float(np.mean(list(loss.values()))) if loss else math.inf for name, loss in losses.items()}
    order = sorted(scores, key=lambda name: (mean[name], name))
    tied = [n for n in order if losses[n] and not compare(scores[n], scores[order[0]]).significant]
    rest = [n for n in order if n not in tied]
    return dict.fromkeys(tied, 1) | {name: place for place, name in enumerate(rest, start=len(tied) + 1)}
