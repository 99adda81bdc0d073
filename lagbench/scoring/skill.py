"""Skill: how much better than the best floor, ``1 - score / score of the best floor``.

Over the ranking metric, means over the scenarios that both have; the best floor is the one with
the least mean among those that count (see :mod:`lagbench.floors`). 1 is perfect, 0 says that
nothing was learned, below 0 it is worse than not learning.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lagbench.floors.table import FLOORS
from lagbench.metrics.aggregate import Score
from lagbench.metrics.metric import Direction

__all__ = ["Skill", "best_floor", "ratio_interval", "skill"]

RESAMPLES, SEED = 10_000, 0
LEVEL = 0.95


@dataclass(frozen=True, kw_only=True)
class Skill:
    """How much better a submission is than the best floor."""

    metric: str  # name of the ranking metric
    floor: str  # name of the best floor
    value: float  # 1 - score / score of that floor
    interval: tuple[float, float]  # 95 %, both resampled over the same scenarios


def best_floor(floors: Mapping[str, Score]) -> str | None:
    """Return the floor with the least mean; None where none that counts has a mean above 0."""
    means = {name: score.mean for name, score in floors.items() if name in FLOORS and FLOORS[name].counts}
    known = {name: value for name, value in means.items() if value > 0.0}
    return min(known, key=lambda name: known[name]) if known else None


def skill(score: Score, floors: Mapping[str, Score]) -> Skill | None:
    """Return the skill of a score beside those of the floors in the same metric.

    None without a floor that counts, without a scenario that both have, and for a metric of which
    less is not better.
    """
    name = best_floor(floors)
    if name is None or score.metric.direction is not Direction.LOWER:
        return None
    theirs = dict(zip(floors[name].scenarios, floors[name].values.tolist(), strict=True))
    pairs = np.array(
        [
            (own, theirs.get(i, math.nan))
            for i, own in zip(score.scenarios, score.values.tolist(), strict=True)
        ]
    )
    ours, base = pairs[~np.isnan(pairs).any(axis=1)].T
    if not ours.size or not base.any():
        return None
    low, high = ratio_interval(ours, base)
    return Skill(
        metric=score.metric.name,
        floor=name,
        value=1.0 - float(np.mean(ours) / np.mean(base)),
        interval=(1.0 - high, 1.0 - low),
    )


def ratio_interval(numerator: ArrayLike, denominator: ArrayLike) -> tuple[float, float]:
    """Return the 95 % percentile interval of a ratio of means, both over the same resampled scenarios.

    Args:
        numerator: one value per scenario, shape [scenario].
        denominator: likewise, not negative.

    Returns:
        Lower and upper bound; NaN with fewer than two scenarios.
    """
    above, below = np.asarray(numerator, np.float64), np.asarray(denominator, np.float64)
    if above.size < 2:
        return math.nan, math.nan
    # Generator.random is the one distribution whose stream NumPy keeps across versions
    uniform = np.random.Generator(np.random.PCG64(SEED)).random((RESAMPLES, above.size))
    draws = np.floor(uniform * above.size).astype(np.intp)
    ratios, totals = np.full(RESAMPLES, np.inf), np.sum(below[draws], axis=1)
    np.divide(np.sum(above[draws], axis=1), totals, out=ratios, where=totals > 0.0)
    low, high = np.quantile(ratios, [(1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0])
    return float(low), float(high)
