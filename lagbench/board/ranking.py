"""From score files to one score per method, reference predictors included.

The mean over seeds is taken per scenario (and per frame) first, over the seeds that
have a value there; intervals and tests resample scenarios and seeds together.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lagbench.data.checksums import file_sha256
from lagbench.data.registry import Size
from lagbench.errors import UnreadableFileError
from lagbench.metrics.aggregate import (
    Score,
    Tally,
    aggregate,
    interval_in_range,
    mean_over_seeds,
)
from lagbench.metrics.table import METRICS
from lagbench.references.shipped import ReferenceScores, shipped
from lagbench.references.table import REFERENCES as KNOWN
from lagbench.scoring.card import ScoreCard, digits
from lagbench.scoring.scenario import SUBMISSION, Preview
from lagbench.scoring.score_file_checks import read_score_file
from lagbench.scoring.score_file_writer import write_statistics

from .entry import OUTSIDE, DataSet, EntryFlag, ScoredFile, Summary
from .fields import LONGEST_TEXT
from .folder import REFERENCES, Folder
from .selection import is_current

NO_PREDICTIONS = "0" * 64  # hash in score files of reference predictors


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


def read_references(folder: Folder, size: Size) -> tuple[ReferenceScores, ...]:
    """Return the reference predictors of a split and size.

    The package ships their scores on our splits. On other splits the scorer measures
    them beside a submission, and :func:`write_references` keeps them in the folder:
    they are equal whoever submits. Scores on another data set are left out, and so are
    scores of a predictor that is no longer in the table.
    """
    shipped_scores = shipped(size)
    if shipped_scores:
        known_references = []
        for reference in shipped_scores.values():
            if reference.name in KNOWN:
                known_references.append(reference)
        return tuple(known_references)

    references = []
    for path in folder.reference_files(size.split, size.name):
        file = folder.path / path
        stored = read_score_file(file).scores
        dataset = dataset_of(stored.identity)
        if path.stem not in KNOWN or not is_current(dataset, size):
            continue
        read_score_file(file, size)  # refuses scores that do not fit the task
        combined = combine([stored.tallies])
        scores = {}
        for name, combined_score in combined.items():
            scores[name] = combined_score.score
        references.append(
            ReferenceScores(
                name=path.stem,
                scores=scores,
                seconds_per_frame=math.nan,
                correlation=np.empty(0),
            )
        )
    return tuple(references)


def dataset_of(identity: Mapping[str, str]) -> DataSet:
    """Return the data set that scores say they belong to."""
    return DataSet.model_construct(
        version=identity["dataset_version"], sha256=identity["dataset_sha256"]
    )


def write_references(card: ScoreCard, folder: Folder) -> tuple[Path, ...]:
    """Write the reference predictors of a score card that the folder lacks.

    Their pictures show the truth alone.

    Returns:
        Paths of the files that were written.
    """
    header = card.header
    data_set_folder = folder.path / REFERENCES / header.split / header.size
    preview = _truth_alone(card.preview)
    written = []
    for name in card.tallies.keys() - {SUBMISSION}:
        path = data_set_folder / f"{name}.nc"
        if _is_scored_on(path, header.dataset_sha256):
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        reference_card = replace(
            card,
            header=replace(header, method=name),
            predictions_sha256=NO_PREDICTIONS,
            tallies={SUBMISSION: card.tallies[name]},
            preview=preview,
        )
        write_statistics(reference_card, path, option="--board")
        written.append(path)
    return tuple(sorted(written))


def _truth_alone(preview: Preview) -> Preview:
    true_vorticity = preview.vorticity[0]
    true_histogram = preview.histogram[0]
    true_film = preview.film[0]
    no_vorticity = np.full_like(true_vorticity, np.nan)
    no_histogram = np.full_like(true_histogram, np.nan)
    return replace(
        preview,
        vorticity=np.stack([true_vorticity, no_vorticity]),
        histogram=np.stack([true_histogram, no_histogram]),
        film=np.stack([true_film, true_film]),
    )


def _is_scored_on(path: Path, dataset_sha256: str) -> bool:
    with suppress(UnreadableFileError):
        identity = read_score_file(path).scores.identity
        return identity["dataset_sha256"] == dataset_sha256
    return False


def scored_file(
    card: ScoreCard, path: Path, outside_share: float | None = None
) -> ScoredFile:
    """Return the description of a card's score file in an entry.

    Args:
        card: scores of predictions.
        path: the score file.
        outside_share: share of positions beyond the box, where the validation warns.
    """
    flags = []
    for flag in card.flags:
        if flag.raised:
            flags.append(_entry_flag(flag.name, flag.reasons))
    warnings = []
    for issue in card.warnings:
        share = outside_share if issue.check == OUTSIDE else None
        reason = f"{issue.what}: {issue.got}"
        warnings.append(_entry_flag(issue.check, [reason], share=share))
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
