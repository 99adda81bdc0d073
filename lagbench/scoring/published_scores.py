"""Scores read from a scores.json, which may come from anybody: checked before use."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from lagbench.data.field_errors import describe_faults
from lagbench.errors import UnreadableFileError, check_regular
from lagbench.metrics.aggregate import LARGEST, Score
from lagbench.metrics.metric import Metric
from lagbench.metrics.table import available
from lagbench.submission.format import MAX_NAME, require_name

FORMAT = 1
"""Number of the layout of scores.json and scores.nc; stored as ``lagbench_scores``."""

IDENTITY = ("split", "size", "dataset_version", "dataset_sha256", "method")
"""Fields that identify the predicted data set and the method."""

MAX_BYTES = 64 << 20
"""Longest scores.json that is read [bytes]; those of ours take less than 2 MB."""

LARGEST_IN_FILE = float(f"{LARGEST:.9g}")
"""Largest value of a score, as rounded in the file."""


def _require_known_format(number: int) -> int:
    if number != FORMAT:
        raise ValueError(f"layout {number}, not {FORMAT}")
    return number


def _require_ascending(ids: list[int]) -> list[int]:
    if not ids:
        raise ValueError("no scenario ids")
    if not all(first < second for first, second in itertools.pairwise(ids)):
        raise ValueError("scenario ids that do not ascend")
    return ids


Text = Annotated[str, AfterValidator(require_name)]
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


class _ScoresContent(_Content):
    lagbench_scores: Annotated[int, AfterValidator(_require_known_format)]
    split: Text
    size: Text
    dataset_version: Text
    dataset_sha256: Text
    method: Text
    subset: Text = "test"  # absent where it is test
    predictions_sha256: Text
    ranking_metric: Text
    task: _TaskContent
    rows: dict[str, dict[str, _ScoreContent]]  # by row and metric


@dataclass(frozen=True, kw_only=True, eq=False)
class PublishedScores:
    """Scores of a submission, as far as another one can be compared with it."""

    # split, size, version and hash of the data set, and the method
    identity: Mapping[str, str]
    subset: str  # subset that was predicted
    predictions_sha256: str  # content hash of the predicted positions
    ranking: str  # name of the metric that ranks
    # scores by row and metric, over the horizon; values per frame are not in the file
    scores: Mapping[str, Mapping[str, Score]]


def read_scores(path: Path) -> PublishedScores:
    """Read a scores.json; metrics that are not installed here are left out.

    Raises:
        UnreadableFileError: it is no scores.json.
    """
    check_regular(path, longest=MAX_BYTES, fix="`lagbench score` writes it")
    try:
        return parse_scores(json.loads(path.read_bytes()))
    except (OSError, ValueError, TypeError) as error:
        raise unreadable_scores(path, error) from error
    except RecursionError as error:
        # its own trace is a thousand frames long and says no more
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
    rows = {}
    for row, scores in checked.rows.items():
        row_scores = {}
        for name, score in scores.items():
            if name in metrics:
                row_scores[name] = _make_score(
                    metrics[name], checked.task.scenarios, score
                )
        rows[row] = row_scores
    identity = {}
    for name in IDENTITY:
        identity[name] = getattr(checked, name)
    return PublishedScores(
        identity=identity,
        subset=checked.subset,
        predictions_sha256=checked.predictions_sha256,
        ranking=checked.ranking_metric,
        scores=rows,
    )


def _make_score(metric: Metric, ids: list[int], content: _ScoreContent) -> Score:
    """Return the score of a metric, without values per frame."""
    for numbers in (content.values, content.undefined):
        if len(numbers) != len(ids):
            raise ValueError(
                f"{metric.name}: {len(numbers)} values of {len(ids)} scenarios"
            )
    values = []
    for value in content.values:
        values.append(math.nan if value is None else value)
    return Score(
        metric=metric,
        scenarios=tuple(ids),
        frames=(),
        per_frame=np.empty((len(ids), 0)),
        values=np.array(values, np.float64),
        undefined=tuple(content.undefined),
    )


def unreadable_scores(path: Path, error: Exception) -> UnreadableFileError:
    """Return the error for a file that is no scores.json or scores.nc."""
    return UnreadableFileError(
        f"not a scores{path.suffix} of lagbench",
        where=str(path),
        expected="what `lagbench score` writes beside the predictions",
        got=f"{type(error).__name__}: {str(error)[:MAX_NAME]}",
        fix="score the predictions again: lagbench score predictions.nc",
    )
