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
    means: tuple[float, ...]  # mean over scenarios of each seed
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
    statistics = set(_statistics_of(seeds[0]))
    for tallies in seeds[1:]:
        statistics.intersection_update(_statistics_of(tallies))
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
            combined[name] = _combine([seed_scores[name] for seed_scores in scores])
    return combined


def _statistics_of(tallies: Mapping[int, Tally]) -> Sequence[str]:
    first_tally = next(iter(tallies.values()))
    return first_tally.names


def _combine(seeds: Sequence[Score]) -> CombinedScore:
    score = seeds[0]
    if len(seeds) > 1:
        undefined = np.sum([seed.undefined for seed in seeds], axis=0)
        score = replace(
            score,
            per_frame=mean_over_seeds([seed.per_frame for seed in seeds]),
            values=mean_over_seeds([seed.values for seed in seeds]),
            undefined=tuple(undefined.tolist()),
        )

    means = tuple(seed.mean for seed in seeds)
    defined_means = [value for value in means if not math.isnan(value)]
    std = math.nan
    if len(defined_means) > 1:
        std = float(np.std(defined_means, ddof=1))
    return CombinedScore(score=score, std=std, means=means, seeds=tuple(seeds))


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
    flags = []
    for flag in card.flags:
        if flag.raised:
            flags.append(_entry_flag(flag.name, flag.reasons))
    warnings = []
    for issue in card.warnings:
        reason = f"{issue.where}: {issue.what}"
        warnings.append(_entry_flag(issue.check, [reason], share=issue.share))
    return ScoredFile(
        sha256=file_sha256(path),
        predictions_sha256=card.predictions_sha256,
        diverged_at=dict(sorted(card.header.diverged_at.items())),
        flags=tuple(flags),
        warnings=tuple(warnings),
    )


def _entry_flag(
    name: str, reasons: Sequence[str], *, share: float | None = None
) -> EntryFlag:
    short_reasons = tuple(reason[:LONGEST_TEXT] for reason in reasons)
    return EntryFlag(name=name, reasons=short_reasons, share=share)
