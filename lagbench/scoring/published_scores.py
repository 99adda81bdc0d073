"""Scores read from a scores.json or scores.nc, which may come from anybody."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from lagbench.data.checksums import round_digits
from lagbench.data.field_errors import describe_faults
from lagbench.errors import check_regular
from lagbench.metrics.aggregate import LARGEST, Score
from lagbench.metrics.table import available
from lagbench.submission.format import IDENTITY, Name

from .score_file import read_statistics, unreadable_scores
from .task import SUBMISSION

MAX_BYTES = 64 << 20
"""Longest scores.json that is read [bytes]; those of ours take less than 2 MB."""

LARGEST_IN_FILE = float(f"{LARGEST:.9g}")
"""Largest value of a score, as rounded in the file."""


def _require_ascending(ids: list[int]) -> list[int]:
    if not ids or not all(first < second for first, second in itertools.pairwise(ids)):
        raise ValueError("scenario ids that do not ascend, or none")
    return ids


Count = Annotated[int, Field(ge=0, lt=2**31)]
Value = Annotated[float, Field(ge=-LARGEST_IN_FILE, le=LARGEST_IN_FILE)]


class _Content(BaseModel):
    """A part of a scores.json; further keys are ignored."""

    model_config = ConfigDict(strict=True, extra="ignore")


class _TaskContent(_Content):
    scenarios: Annotated[list[Count], AfterValidator(_require_ascending)]


class _ScoreContent(_Content):
    values: list[Value | None]  # by scenario, null where undefined
    undefined: list[Count]  # frames without a value by scenario


class _SpeedupContent(_Content):
    value: float
    interval: Annotated[list[float | None], Field(min_length=2, max_length=2)]
    at_least: bool
    classical_seconds: float

    def __str__(self) -> str:
        low, high = self.interval
        interval = "" if low is None else f" [{low:.3g}, {high:.3g}]"
        return f"{'> ' if self.at_least else ''}{self.value:.3g}{interval}"


class _ScoresContent(_Content):
    lagbench_scores: Literal[1]
    split: Name
    size: Name
    dataset_version: Name
    dataset_sha256: Name
    method: Name
    subset: Name = "test"  # absent where it is test
    predictions_sha256: Name
    ranking_metric: Name
    task: _TaskContent
    rows: dict[str, dict[str, _ScoreContent]]  # by row and metric
    speedup: _SpeedupContent | None = None
    why_no_speedup: Annotated[str, Field(max_length=200, pattern=r"^[ -~]*$")] = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class PublishedScores:
    """Scores of a submission, as far as another one can be compared with it."""

    # split, size, version and hash of the data set, and the method
    identity: Mapping[str, str]
    subset: str  # subset that was predicted
    predictions_sha256: str  # content hash of the predicted positions
    ranking: str  # name of the metric that ranks
    # scores by row and metric, over the horizon, without values per frame
    scores: Mapping[str, Mapping[str, Score]]
    # over the classical side, or why there is none; "" where the file does not say
    speedup: str = ""


def read_scores(path: Path) -> PublishedScores:
    """Read a scores.json; metrics that are not installed here are left out.

    Raises:
        UnreadableFileError: it is no scores.json.
    """
    check_regular(path, longest=MAX_BYTES, fix="`lagbench score` writes it")
    try:
        return parse_scores(json.loads(path.read_bytes()))
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise unreadable_scores(path, error) from None


def parse_scores(content: Mapping[str, Any]) -> PublishedScores:
    """Return the scores of a :meth:`.card.ScoreCard.as_json`, or of a scores.json.

    Raises:
        ValueError: the content does not have the form of a scores.json.
    """
    try:
        checked = _ScoresContent.model_validate(content)
    except ValidationError as error:
        raise ValueError(describe_faults(error)) from error

    metrics = available()
    ids = checked.task.scenarios
    rows: dict[str, dict[str, Score]] = {}
    for row, scores in checked.rows.items():
        rows[row] = {}
        for name, score in scores.items():
            if not len(score.values) == len(score.undefined) == len(ids):
                raise ValueError(f"{name}: not one value for each of {len(ids)} ids")
            if name in metrics:
                values = [
                    math.nan if value is None else value for value in score.values
                ]
                rows[row][name] = Score(
                    metric=metrics[name],
                    scenarios=tuple(ids),
                    frames=(),
                    per_frame=np.empty((len(ids), 0)),
                    values=np.array(values, np.float64),
                    undefined=tuple(score.undefined),
                )
    return PublishedScores(
        identity={name: getattr(checked, name) for name in IDENTITY},
        subset=checked.subset,
        predictions_sha256=checked.predictions_sha256,
        ranking=checked.ranking_metric,
        scores=rows,
        speedup=str(checked.speedup or checked.why_no_speedup),
    )


def read_published_scores(path: Path) -> PublishedScores:
    """Return the scores of a scores.nc in the form of scores.json, with its digits.

    The only reference is the best one, and it has the ranking metric only.

    Raises:
        UnreadableFileError: it is no scores.nc.
    """
    statistics = read_statistics(path)
    submission: dict[str, Score] = {}
    for name, score in statistics.scores().items():
        values = [round_digits(value) for value in score.values.tolist()]
        submission[name] = replace(score, values=np.array(values))

    rows = {SUBMISSION: submission}
    ranking = statistics.ranking
    if statistics.best_reference is not None and ranking in submission:
        reference = replace(
            submission[ranking], values=statistics.best_reference_values
        )
        rows[statistics.best_reference] = {ranking: reference}
    return PublishedScores(
        identity=statistics.identity,
        subset=statistics.subset,
        predictions_sha256=statistics.predictions_sha256,
        ranking=ranking,
        scores=rows,
    )
