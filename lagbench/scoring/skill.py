"""Skill: improvement of a method over the best reference predictor.

``1 - score / score of the best reference``, over the ranking metric. The best reference
has the least mean over its own scenarios, among those that count (see
:mod:`lagbench.references`); the ratio is over the scenarios that both have. 1 is
perfect, 0 means that nothing was learned, below 0 the method is worse than not
learning.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lagbench.metrics.aggregate import Score, bootstrap_interval, mean_over_seeds
from lagbench.metrics.frame import Floats
from lagbench.metrics.metric import Direction


@dataclass(frozen=True, kw_only=True)
class Skill:
    """Improvement of a submission over the best reference predictor."""

    metric: str  # name of the ranking metric
    reference: str  # name of the best reference predictor
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
    """Return the name of the reference with the least mean, None if none is above 0."""
    means = {name: score.mean for name, score in references.items()}
    positive = [name for name, mean in means.items() if mean > 0.0]
    if positive:
        return min(positive, key=lambda name: means[name])
    return None


def compute_skill(
    seeds: Sequence[Score], references: Mapping[str, Score]
) -> Skill | None:
    """Return the skill of a method over references in the same metric.

    The interval is that of the ratio of means r = A / B, by the linear part of its
    logarithm: with e the two-way bootstrap of (a_si - r b_i) / (r B), where a_si is the
    score of seed s and b_i that of the reference in scenario i, it is 1 - r exp(e). So
    it never passes 1, and is one point where the ratio is the same everywhere. Two
    seeds say little: its lower end may lie far down.

    Args:
        seeds: score of each seed, over the same scenarios.
        references: scores of the reference predictors that count, by name.

    Returns:
        None without a reference that counts, without a scenario that both have, and for
        a metric of which less is not better.
    """
    name = best_reference(references)
    metric = seeds[0].metric
    if name is None or metric.direction is not Direction.LOWER:
        return None

    base = _values_in(references[name], seeds[0].scenarios)  # shape [scenario]
    method = np.stack([score.values for score in seeds])  # shape [seed, scenario]
    has_both = ~np.isnan(base) & ~np.isnan(method).all(axis=0)
    base = base[has_both]
    method = method[:, has_both]
    if not base.any():
        return None

    scale = float(np.mean(base))
    ratio = float(np.mean(mean_over_seeds(method))) / scale
    if ratio > 0.0:
        relative = method / ratio - base
    else:
        relative = method  # zeros, and certain
    low, high = bootstrap_interval(relative / scale)
    return Skill(
        metric=metric.name,
        reference=name,
        value=1.0 - ratio,
        interval=(1.0 - ratio * math.exp(high), 1.0 - ratio * math.exp(low)),
        std=_std_over_seeds(method, scale),
    )


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
