"""From score files to one score per method.

The mean over seeds is taken per scenario (and per frame) first, over the seeds that
have a value there; intervals and tests resample scenarios and seeds together.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lagbench.data.checksums import file_sha256
from lagbench.metrics.aggregate import (
    Score,
    Tally,
    aggregate,
    interval_in_range,
    mean_over_seeds,
)
from lagbench.metrics.table import METRICS
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.front import digits

from .entry import LONGEST_TEXT, EntryFlag, ScoredFile, Summary


@dataclass(frozen=True, kw_only=True, eq=False)
class CombinedScore:
    """A metric of all seeds of a method."""

    score: Score  # mean over seeds, per frame and per scenario
    # sample standard deviation over seeds of the mean over scenarios; NaN for one seed
    std: float
    seeds: tuple[Score, ...]  # of each seed, in the order of the files

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the mean, over scenarios and seeds together."""
        values = np.array([seed.values for seed in self.seeds])
        return interval_in_range(values, self.score.value_range)


def combine(
    seeds: Sequence[Mapping[int, Tally]], names: Collection[str] | None = None
) -> dict[str, CombinedScore]:
    """Return the scores of a method by metric, from tallies by scenario of each seed.

    Metrics of packages are left out, and so are metrics that a seed lacks and metrics
    that are formed only when they are named. With names, these metrics alone are
    formed.
    """
    statistics = set.intersection(
        *(set(next(iter(tallies.values())).names) for tallies in seeds)
    )
    metrics = []
    for metric in METRICS.values():
        if names is None:
            is_needed = not metric.is_on_request
        else:
            is_needed = metric.name in names
        if is_needed and statistics.issuperset(metric.of):
            metrics.append(metric)

    scores = [aggregate(metrics, tallies) for tallies in seeds]
    combined = {}
    for metric in metrics:
        name = metric.name
        if all(name in seed_scores for seed_scores in scores):
            combined[name] = combine_seeds(
                [seed_scores[name] for seed_scores in scores]
            )
    return combined


def combine_seeds(seeds: Sequence[Score]) -> CombinedScore:
    """Return the score of a method from those of its seeds, in one metric."""
    score = seeds[0]
    if len(seeds) > 1:
        undefined = np.sum([seed.undefined for seed in seeds], axis=0)
        score = replace(
            score,
            per_frame=mean_over_seeds([seed.per_frame for seed in seeds]),
            values=mean_over_seeds([seed.values for seed in seeds]),
            undefined=tuple(undefined.tolist()),
        )

    means = [seed.mean for seed in seeds if not math.isnan(seed.mean)]
    std = float(np.std(means, ddof=1)) if len(means) > 1 else math.nan
    return CombinedScore(score=score, std=std, seeds=tuple(seeds))


def summarise(scores: Mapping[str, CombinedScore]) -> dict[str, Summary]:
    """Return the metrics of a score block: nine digits, null where undefined."""
    summaries = {}
    for name, combined in scores.items():
        low, high = combined.interval
        summaries[name] = Summary(
            mean=digits(combined.score.mean),
            std=digits(combined.std),
            low=digits(low),
            high=digits(high),
        )
    return summaries


def scored_file(card: ScoreCard, path: Path) -> ScoredFile:
    """Return the description of a card's score file in an entry."""

    def as_flag(
        name: str, reasons: Sequence[str], share: float | None = None
    ) -> EntryFlag:
        texts = tuple(reason[:LONGEST_TEXT] for reason in reasons)
        return EntryFlag(name=name, reasons=texts, share=share)

    flags = [as_flag(one.name, one.reasons) for one in card.flags if one.raised]
    warnings = []
    for issue in card.warnings:
        reason = f"{issue.where}: {issue.what}"
        warnings.append(as_flag(issue.check, [reason], issue.share))
    return ScoredFile(
        sha256=file_sha256(path),
        predictions_sha256=card.predictions_sha256,
        diverged_at=dict(sorted(card.header.diverged_at.items())),
        flags=tuple(flags),
        warnings=tuple(warnings),
    )
