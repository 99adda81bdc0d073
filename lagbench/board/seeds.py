"""Several seeds of one method become one score: the mean over seeds, and its spread.

The mean over seeds is taken per scenario (and per frame) first, over the seeds that have a
value there; what follows, the mean over scenarios, its interval and the tests, then takes
the scenarios as its sample, as with a single seed.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.metrics import METRICS, Score, aggregate
from lagbench.scoring.card import digits
from lagbench.scoring.score_file import StoredScores

from .entry import Summary

__all__ = ["Combined", "combine", "summarise"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Combined:
    """A metric of all seeds of a method."""

    score: Score  # mean over seeds, per frame and per scenario
    std: float  # sample standard deviation over seeds of the mean over scenarios; NaN for one seed
    means: tuple[float, ...]  # mean over scenarios of each seed


def combine(seeds: Sequence[StoredScores]) -> dict[str, Combined]:
    """Return the scores of a method by metric, in the table's order.

    Metrics are ours, whatever other packages are installed here, and those that all seeds have.
    """
    names = set.intersection(*(set(next(iter(held.tallies.values())).names) for held in seeds))
    metrics = [metric for metric in METRICS.values() if names.issuperset(metric.of)]
    scores = [aggregate(metrics, held.tallies) for held in seeds]
    common = [m.name for m in metrics if all(m.name in held for held in scores)]
    return {name: _combined([held[name] for held in scores]) for name in common}


def _combined(scores: Sequence[Score]) -> Combined:
    first, means = scores[0], tuple(held.mean for held in scores)
    if len(scores) == 1:
        return Combined(score=first, std=math.nan, means=means)
    score = Score(
        metric=first.metric,
        scenarios=first.scenarios,
        frames=first.frames,
        per_frame=mean_defined([held.per_frame for held in scores]),
        values=mean_defined([held.values for held in scores]),
        undefined=tuple(sum(counts) for counts in zip(*(held.undefined for held in scores), strict=True)),
    )
    defined = [value for value in means if not math.isnan(value)]
    std = float(np.std(defined, ddof=1)) if len(defined) > 1 else math.nan
    return Combined(score=score, std=std, means=means)


def mean_defined(arrays: Sequence[Floats]) -> Floats:
    """Return the mean over the arrays that have a value, NaN where none has, shape of one."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a mean of nothing is NaN, as it should be
        return np.asarray(np.nanmean(np.stack(arrays), axis=0), np.float64)


def summarise(scores: Mapping[str, Combined]) -> dict[str, Summary]:
    """Return what the score block of an entry says of the metrics: nine digits, null where undefined."""
    found = {}
    for name, held in scores.items():
        low, high = held.score.interval
        found[name] = Summary(
            mean=digits(held.score.mean), std=digits(held.std), low=digits(low), high=digits(high)
        )
    return found
