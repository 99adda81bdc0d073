"""From score files to one score per method, floors included.

The mean over seeds is taken per scenario (and per frame) first, over the seeds that
have a value there; intervals and tests resample scenarios and seeds together.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lagbench.data.checksums import file_sha256
from lagbench.data.layout import major_of
from lagbench.data.registry import Size
from lagbench.errors import UnreadableFileError
from lagbench.metrics.aggregate import (
    Score,
    aggregate,
    bootstrap_interval,
    mean_over_seeds,
)
from lagbench.metrics.table import METRICS
from lagbench.references.shipped import ReferenceScores, shipped
from lagbench.references.table import REFERENCES as KNOWN
from lagbench.scoring.card import SUBMISSION, ScoreCard, digits
from lagbench.scoring.score_file import SubmissionStatistics, write_statistics
from lagbench.scoring.score_file_checks import read_score_file

from .entry import LONGEST_TEXT, OUTSIDE, DataSet, Flag, ScoredFile, Summary
from .folder import REFERENCES, Folder


@dataclass(frozen=True, kw_only=True, eq=False)
class Combined:
    """A metric of all seeds of a method."""

    score: Score  # mean over seeds, per frame and per scenario
    # sample standard deviation over seeds of the mean over scenarios; NaN for one seed
    std: float
    means: tuple[float, ...]  # mean over scenarios of each seed
    seeds: tuple[Score, ...]  # of each seed, in the order of the files

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the mean: over scenarios and seeds together, one seed: over
        scenarios.
        """
        return bootstrap_interval(np.stack([seed.values for seed in self.seeds]))


def combine(seeds: Sequence[SubmissionStatistics]) -> dict[str, Combined]:
    """Return the scores of a method by metric: those of ours, not of packages, that all
    seeds have.
    """
    names = set.intersection(
        *(set(next(iter(held.tallies.values())).names) for held in seeds)
    )
    metrics = [metric for metric in METRICS.values() if names.issuperset(metric.of)]
    scores = [aggregate(metrics, held.tallies) for held in seeds]
    common = [m.name for m in metrics if all(m.name in held for held in scores)]
    return {name: _combined(tuple(held[name] for held in scores)) for name in common}


def _combined(seeds: tuple[Score, ...]) -> Combined:
    score = seeds[0]
    means = tuple(held.mean for held in seeds)
    if len(seeds) > 1:
        score = replace(
            score,
            per_frame=mean_over_seeds([held.per_frame for held in seeds]),
            values=mean_over_seeds([held.values for held in seeds]),
            undefined=tuple(
                map(sum, zip(*(held.undefined for held in seeds), strict=True))
            ),
        )
    defined = [value for value in means if not math.isnan(value)]
    if len(defined) > 1:
        std = float(np.std(defined, ddof=1))
    else:
        std = math.nan
    return Combined(score=score, std=std, means=means, seeds=seeds)


def summarise(scores: Mapping[str, Combined]) -> dict[str, Summary]:
    """Return what the score block of an entry says of the metrics: nine digits, null
    where undefined.
    """
    found = {}
    for name, held in scores.items():
        mean, std, low, high = map(digits, (held.score.mean, held.std, *held.interval))
        found[name] = Summary(mean=mean, std=std, low=low, high=high)
    return found


def is_current(dataset: DataSet, size: Size) -> bool:
    """Tell whether a data set is that of today: same MAJOR version, same hash where one
    is recorded.
    """
    if size.measured:
        recorded = size.measured.dataset_sha256
    else:
        recorded = dataset.sha256
    return major_of(dataset.version) == size.major and dataset.sha256 == recorded


def read_references(folder: Folder, size: Size) -> tuple[ReferenceScores, ...]:
    """Return the floors of a split and size, those of another data set left out.

    What ours score, the package ships. Those of a split of somebody's own the scorer
    measures beside a submission, and :func:`write_references` keeps them in the folder:
    they are equal whoever submits.
    """
    if known := shipped(size):
        return tuple(known.values())
    found = []
    for path in folder.reference_files(size.split, size.name):
        scores = read_score_file(folder.path / path).scores
        if path.stem not in KNOWN or not is_current(dataset_of(scores.identity), size):
            continue
        read_score_file(folder.path / path, size)
        held = {name: made.score for name, made in combine([scores]).items()}
        found.append(
            ReferenceScores(
                name=path.stem,
                scores=held,
                seconds_per_frame=math.nan,
                correlation=np.empty(0),
            )
        )
    return tuple(found)


def dataset_of(identity: Mapping[str, str]) -> DataSet:
    """Return the data set that scores say they belong to."""
    return DataSet.model_construct(
        version=identity["dataset_version"], sha256=identity["dataset_sha256"]
    )


def write_references(card: ScoreCard, folder: Folder) -> tuple[Path, ...]:
    """Write the floors of a card that the folder lacks, pictures of the truth alone;
    return their paths.
    """
    written = []
    header = card.header
    preview = card.preview
    nothing = np.full_like(preview.vorticity[0], np.nan)
    truth = replace(
        preview,
        vorticity=np.stack([preview.vorticity[0], nothing]),
        histogram=np.stack(
            [preview.histogram[0], np.full_like(preview.histogram[0], np.nan)]
        ),
        film=np.stack([preview.film[0], preview.film[0]]),
    )
    for name in card.tallies.keys() - {SUBMISSION}:
        path = folder.path / REFERENCES / header.split / header.size / f"{name}.nc"
        with suppress(UnreadableFileError):
            if (
                read_score_file(path).scores.identity["dataset_sha256"]
                == header.dataset_sha256
            ):
                continue
        path.parent.mkdir(parents=True, exist_ok=True)
        tallies = {SUBMISSION: card.tallies[name]}
        named = replace(header, method=name)
        nobody = "0" * 64
        floor = replace(
            card,
            header=named,
            predictions_sha256=nobody,
            tallies=tallies,
            preview=truth,
        )
        write_statistics(floor, path, option="--board")
        written.append(path)
    return tuple(sorted(written))


def scored_file(
    card: ScoreCard, path: Path, outside: float | None = None
) -> ScoredFile:
    """Return what an entry says of a card's score file; ``outside``: share of positions
    beyond the box.
    """

    def flag(name: str, reasons: Sequence[str], share: float | None = None) -> Flag:
        return Flag(
            name=name,
            reasons=tuple(said[:LONGEST_TEXT] for said in reasons),
            share=share,
        )

    return ScoredFile(
        sha256=file_sha256(path),
        predictions_sha256=card.predictions_sha256,
        diverged_at=dict(sorted(card.header.diverged_at.items())),
        flags=tuple(flag(one.name, one.reasons) for one in card.flags if one.raised),
        warnings=tuple(
            flag(
                one.check,
                (f"{one.what}: {one.got}",),
                outside if one.check == OUTSIDE else None,
            )
            for one in card.warnings
        ),
    )
