"""From score files to one score per method, and from scores to ranks.

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

from lagbench.data.layout import major_of
from lagbench.data.registry import Size
from lagbench.metrics import METRICS, Score, aggregate, compare
from lagbench.metrics.comparison import SIGNIFICANCE
from lagbench.scoring.card import digits
from lagbench.scoring.score_file import StoredScores

from .entry import DataSet, Summary

__all__ = ["Combined", "Standing", "combine", "holm", "is_current", "mean_loss", "standings", "summarise"]


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
        per_frame=_mean_defined([held.per_frame for held in scores]),
        values=_mean_defined([held.values for held in scores]),
        undefined=tuple(sum(counts) for counts in zip(*(held.undefined for held in scores), strict=True)),
    )
    defined = [value for value in means if not math.isnan(value)]
    std = float(np.std(defined, ddof=1)) if len(defined) > 1 else math.nan
    return Combined(score=score, std=std, means=means)


def _mean_defined(arrays: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
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


def is_current(dataset: DataSet, size: Size) -> bool:
    """Tell whether a data set is that of today: same MAJOR version, same hash where one is recorded."""
    recorded = size.measured.dataset_sha256 if size.measured else dataset.sha256
    return major_of(dataset.version) == size.major and dataset.sha256 == recorded


@dataclass(frozen=True, kw_only=True)
class Standing:
    """Where a method stands among those that are ranked."""

    rank: int  # from 1, in the order of the mean
    p: float  # against the leader, corrected for all who are compared with it; NaN without a claim

    @property
    def tied(self) -> bool:
        """Whether it cannot be told from the leader at 5 %."""
        return self.p >= SIGNIFICANCE


def mean_loss(score: Score) -> float:
    """Return the mean over scenarios of the loss; infinite where nothing is defined."""
    losses = [score.metric.loss(value) for value in score.values.tolist() if not math.isnan(value)]
    return float(np.mean(losses)) if losses else math.inf


def standings(scores: Mapping[str, Score]) -> dict[str, Standing]:
    """Return where each method stands, from its score of the ranking metric."""
    order = sorted(scores, key=lambda name: (mean_loss(scores[name]), name))
    against = [compare(scores[name], scores[order[0]]).p for name in order[1:]]
    corrected = [math.nan, *holm(against)]
    return {name: Standing(rank=i, p=p) for i, (name, p) in enumerate(zip(order, corrected, strict=False), 1)}


def holm(p: Sequence[float]) -> list[float]:
    """Return p-values corrected for their number by Holm's steps; NaN, where none is claimed, stays.

    >>> holm([0.01, 0.04, 0.03])
    [0.03, 0.06, 0.06]
    """
    known = sorted(range(len(p)), key=lambda i: (math.isnan(p[i]), p[i]))
    found, least, count = [math.nan] * len(p), 0.0, sum(not math.isnan(value) for value in p)
    for step, i in enumerate(known[:count]):
        least = max(least, min(1.0, (count - step) * p[i]))
        found[i] = least
    return found
