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
    positive = [name for name, score in references.items() if score.mean > 0.0]
    return min(positive, key=lambda name: references[name].mean, default=None)


def compute_skill(
    seeds: Sequence[Score], references: Mapping[str, Score]
) -> Skill | None:
    """Return the skill of a method over naive predictors in the same metric.

    The interval is that of the ratio of means r = A / B, by the linear part of its
    logarithm: with e the two-way bootstrap of (a_si - r b_i) / (r B), where a_si is the
    score of seed s and b_i that of the reference in scenario i, it is r exp(e). So the
    skill never passes 1, and is one point where the ratio is the same everywhere. Two
    seeds say little: its lower end may lie far down.

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
    if seeds[0].metric.direction is not Direction.LOWER:
        return None
    reference = references[name]
    known = dict(zip(reference.scenarios, reference.values.tolist(), strict=True))
    # shapes [scenario] and [seed, scenario]
    base = np.array([known.get(i, math.nan) for i in seeds[0].scenarios])
    method = np.stack([score.values for score in seeds])
    has_both = ~np.isnan(base) & ~np.isnan(method).all(axis=0)
    base = base[has_both]
    method = method[:, has_both]
    if not base.any():
        return None

    scale = float(np.mean(base))
    ratio = float(np.mean(mean_over_seeds(method))) / scale
    # of a perfect method zeros, which are certain
    relative = method / ratio - base if ratio > 0.0 else method
    low, high = bootstrap_interval(relative / scale)
    complete = method[~np.isnan(method).any(axis=1)]
    std = math.nan
    if len(complete) > 1:
        std = float(np.std(np.mean(complete, axis=1) / scale, ddof=1))
    return Skill(
        metric=seeds[0].metric.name,
        reference=name,
        value=1.0 - ratio,
        interval=(1.0 - ratio * math.exp(high), 1.0 - ratio * math.exp(low)),
        std=std,
    )
