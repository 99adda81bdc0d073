"""From score files to one score per method.

The mean over seeds is taken per scenario (and per frame) first, over the seeds that have a
value there; intervals and tests resample scenarios and seeds together.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lagbench.data.layout import major_of
from lagbench.data.registry import Size
from lagbench.metrics.aggregate import Score, aggregate, bootstrap_interval, mean_over_seeds
from lagbench.metrics.table import METRICS
from lagbench.scoring.card import digits
from lagbench.scoring.score_file import StoredScores

from .entry import DataSet, Summary

__all__ = ["Combined", "combine", "is_current", "summarise"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Combined:
    """A metric of all seeds of a method."""

    score: Score  # mean over seeds, per frame and per scenario
    std: float  # sample standard deviation over seeds of the mean over scenarios; NaN for one seed
    means: tuple[float, ...]  # mean over scenarios of each seed
    seeds: tuple[Score, ...]  # of each seed, in the order of the files

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the mean: over scenarios and seeds together, one seed: over scenarios."""
        return bootstrap_interval(np.stack([seed.values for seed in self.seeds]))


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
        return Combined(score=first, std=math.nan, means=means, seeds=tuple(scores))
    score = Score(
        metric=first.metric,
        scenarios=first.scenarios,
        frames=first.frames,
        per_frame=mean_over_seeds([held.per_frame for held in scores]),
        values=mean_over_seeds([held.values for held in scores]),
        undefined=tuple(sum(counts) for counts in zip(*(held.undefined for held in scores), strict=True)),
    )
    defined = [value for value in means if not math.isnan(value)]
    std = float(np.std(defined, ddof=1)) if len(defined) > 1 else math.nan
    return Combined(score=score, std=std, means=means, seeds=tuple(scores))


def summarise(scores: Mapping[str, Combined]) -> dict[str, Summary]:
    """Return what the score block of an entry says of the metrics: nine digits, null where undefined."""
    found = {}
    for name, held in scores.items():
        low, high = held.interval
        found[name] = Summary(
            mean=digits(held.score.mean), std=digits(held.std), low=digits(low), high=digits(high)
        )
    return found


def is_current(dataset: DataSet, size: Size) -> bool:
    """Tell whether a data set is that of today: same MAJOR version, same hash where one is recorded."""
    recorded = size.measured.dataset_sha256 if size.measured else dataset.sha256
    return major_of(dataset.version) == size.major and dataset.sha256 == recorded
