"""Skill: how much better than the best floor, ``1 - score / score of the best floor``.

Over the ranking metric. The best floor has the least mean over its own scenarios, among those that
count (see :mod:`lagbench.floors`); the ratio is over the scenarios that both have. 1 is perfect, 0 says that
nothing was learned, below 0 it is worse than not learning.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lagbench.floors.table import FLOORS
from lagbench.metrics.aggregate import Score, bootstrap_interval, mean_over_seeds
from lagbench.metrics.metric import Direction


@dataclass(frozen=True, kw_only=True)
class Skill:
    """How much better a submission is than the best floor."""

    metric: str  # name of the ranking metric
    floor: str  # name of the best floor
    value: float  # 1 - score / score of that floor
    # 95 %: scenarios, those of the floor with them, and seeds are resampled; NaN of few scenarios
    interval: tuple[float, float]
    std: float = math.nan  # sample standard deviation over seeds; NaN for one

    def __str__(self) -> str:
        """Return the value, its interval where it has one, and the floor, as in a table."""
        low, high = self.interval
        interval = "" if math.isnan(low) else f" [{low:.3f}, {high:.3f}]"
        return f"{self.value:.3f}{interval} over {self.floor}"


def best_floor(floors: Mapping[str, Score]) -> str | None:
    """Return the floor with the least mean; None where none that counts has a mean above 0."""
    means = {name: score.mean for name, score in floors.items() if name in FLOORS and FLOORS[name].counts}
    known = {name: value for name, value in means.items() if value > 0.0}
    return min(known, key=lambda name: known[name]) if known else None


def skill(seeds: Sequence[Score], floors: Mapping[str, Score]) -> Skill | None:
    """Return the skill of a method beside the scores of the floors in the same metric.

    The interval is that of the ratio of means r = A / B, by the linear part of its logarithm: with
    e the two-way bootstrap of (a_si - r b_i) / (r B), where a_si is the score of seed s and b_i that of
    the floor in scenario i, it is 1 - r exp(e). So it never passes 1, and is one point where the ratio is
    the same everywhere. Two seeds say little: its lower end may lie far down.

    Args:
        seeds: score of each seed, over the same scenarios.
        floors: scores of the floors by name.

    Returns:
        None without a floor that counts, without a scenario that both have, and for a metric of
        which less is not better.
    """
    name, metric, scenarios = best_floor(floors), seeds[0].metric, seeds[0].scenarios
    if name is None or metric.direction is not Direction.LOWER:
        return None
    theirs = dict(zip(floors[name].scenarios, floors[name].values.tolist(), strict=True))
    base = np.array([theirs.get(i, math.nan) for i in scenarios])
    own = np.stack([score.values for score in seeds])
    both = ~np.isnan(base) & ~np.isnan(own).all(axis=0)
    own, base = own[:, both], base[both]
    if not base.any():
        return None
    scale = float(np.mean(base))
    ratio = float(np.mean(mean_over_seeds(own))) / scale
    relative = own / ratio - base if ratio > 0.0 else own  # zeros, and certain
    low, high = bootstrap_interval(relative / scale)
    with_all = own[~np.isnan(own).any(axis=1)]
    return Skill(
        metric=metric.name,
        floor=name,
        value=1.0 - ratio,
        interval=(1.0 - ratio * math.exp(high), 1.0 - ratio * math.exp(low)),
        std=float(np.std(np.mean(with_all, axis=1) / scale, ddof=1)) if len(with_all) > 1 else math.nan,
    )
