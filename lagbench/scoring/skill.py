"""Skill: a method beside predictors that need no training.

``skill = 1 - score / score of the best naive predictor``, over the ranking metric. 1 is
perfect, 0 means that nothing was learned, below 0 the method is worse than not
learning. The best predictor has the least mean over its own scenarios (see
:mod:`lagbench.references`); the ratio is over the scenarios that both have.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lagbench.metrics.aggregate import (
    Score,
    bootstrap_interval,
    mean_over_seeds,
)
from lagbench.metrics.frame import Floats
from lagbench.metrics.metric import Direction


@dataclass(frozen=True, kw_only=True)
class Skill:
    """Improvement of a submission over the best naive predictor."""

    metric: str  # name of the ranking metric
    reference: str  # name of the best naive predictor
    value: float  # 1 - score / score of that reference
    # 95 %: scenarios, those of the reference with them, and seeds are resampled; NaN of
    # few scenarios
    interval: tuple[float, float]
    std: float = math.nan  # sample standard deviation over seeds; NaN for one

    def __str__(self) -> str:
        """Return value, interval (where there is one) and reference, as in a table."""
        low, high = self.interval
        if math.isnan(low):
            return f"{self.value:.3f} over {self.reference}"
        return f"{self.value:.3f} [{low:.3f}, {high:.3f}] over {self.reference}"


def best_reference(references: Mapping[str, Score]) -> str | None:
    """Return the name of the reference with the least mean above 0; None without one.

    Less must be better. A mean of 0 or NaN does not count, because nothing can be
    divided by it.
    """
    means = {}
    for name, score in references.items():
        means[name] = score.mean
    positive = []
    for name, mean in means.items():
        if mean > 0.0:
            positive.append(name)
    if positive:
        return min(positive, key=lambda name: means[name])
    return None


def compute_skill(
    seeds: Sequence[Score], references: Mapping[str, Score]
) -> Skill | None:
    """Return the skill of a method over naive predictors in the same metric.

    The interval never passes 1 (see :func:`_compute_ratio`).

    Args:
        seeds: score of each seed, over the same scenarios.
        references: scores of the naive predictors, by name.

    Returns:
        None without a naive predictor, without a scenario that both have, and for a
        metric of which less is not better.
    """
    name = best_reference(references)
    if name is None:
        return None
    ratio = _compute_ratio(seeds, references[name])
    if ratio is None:
        return None
    low, high = ratio.interval
    return Skill(
        metric=seeds[0].metric.name,
        reference=name,
        value=1.0 - ratio.value,
        interval=(1.0 - high, 1.0 - low),
        std=ratio.std,
    )


@dataclass(frozen=True, kw_only=True)
class ScoreRatio:
    """Score of a method over that of a reference."""

    value: float  # ratio of the means [1]
    interval: tuple[float, float]  # 95 % [1]; NaN of few scenarios
    std: float  # sample standard deviation over seeds [1]; NaN for one


def _compute_ratio(seeds: Sequence[Score], reference: Score) -> ScoreRatio | None:
    """Return the ratio of two scores over the scenarios that both have.

    The interval is that of the ratio of means r = A / B, by the linear part of its
    logarithm: with e the two-way bootstrap of (a_si - r b_i) / (r B), where a_si is the
    score of seed s and b_i that of the reference in scenario i, it is r exp(e). So it
    stays above 0, and is one point where the ratio is the same everywhere. Two seeds
    say little: its upper end may lie far up.
    """
    if seeds[0].metric.direction is not Direction.LOWER:
        return None
    base = _values_in(reference, seeds[0].scenarios)  # shape [scenario]
    method = np.stack([score.values for score in seeds])  # shape [seed, scenario]
    has_both = ~np.isnan(base) & ~np.isnan(method).all(axis=0)
    base = base[has_both]
    method = method[:, has_both]
    if not base.any():
        return None

    scale = float(np.mean(base))
    ratio = float(np.mean(mean_over_seeds(method))) / scale
    relative = _relative_to(base, method, ratio)
    low, high = bootstrap_interval(relative / scale)
    return ScoreRatio(
        value=ratio,
        interval=(ratio * math.exp(low), ratio * math.exp(high)),
        std=_std_over_seeds(method, scale),
    )


def _relative_to(base: Floats, method: Floats, ratio: float) -> Floats:
    """Return ``method / ratio - base``; of a perfect method zeros, which are certain.

    Args:
        base: scores of the reference, shape [scenario].
        method: scores of the method, shape [..., scenario].
        ratio: ratio of their means [1].
    """
    if ratio > 0.0:
        return method / ratio - base
    return method


def _values_in(score: Score, scenarios: Sequence[int]) -> Floats:
    """Return the values of a score in scenarios, NaN in others, shape [scenario]."""
    values = dict(zip(score.scenarios, score.values.tolist(), strict=True))
    return np.array([values.get(i, math.nan) for i in scenarios])


def _std_over_seeds(method: Floats, scale: float) -> float:
    """Return the standard deviation over the seeds that have a value in all scenarios.

    NaN with fewer than two such seeds. Scores have the shape [seed, scenario].
    """
    complete = method[~np.isnan(method).any(axis=1)]
    if len(complete) < 2:
        return math.nan
    means = np.mean(complete, axis=1) / scale
    return float(np.std(means, ddof=1))
