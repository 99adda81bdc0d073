"""Scores as a scores.json tells them, which may come from anybody: checked before they are used."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .errors import UnreadableFileError
from .metrics import Metric, Score, available
from .score_card import FORMAT, IDENTITY
from .submission.format_checks import MAX_NAME

__all__ = ["PublishedScores", "parse_scores", "read_scores", "unreadable_scores"]


@dataclass(frozen=True, kw_only=True, eq=False)
class PublishedScores:
    """What a scores.json says, as far as another submission can be compared with it.

    Attributes:
        identity: split, size, version and hash of the data set, and the method.
        predictions_sha256: content hash of the predicted positions.
        ranking: name of the metric that ranks.
        scores: scores by row and metric, over the horizon; values per frame are not in the file.
    """

    identity: Mapping[str, str]
    predictions_sha256: str
    ranking: str
    scores: Mapping[str, Mapping[str, Score]]


def read_scores(path: Path) -> PublishedScores:
    """Read a scores.json; metrics that are not installed here are left out.

    Raises:
        UnreadableFileError: it is not one.
    """
    try:
        return parse_scores(json.loads(path.read_bytes()))
    except (OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError) as error:
        raise unreadable_scores(path, error) from error
    except RecursionError as error:
        # its own trace is a thousand frames long and says no more
        raise unreadable_scores(path, error) from None


def unreadable_scores(path: Path, error: Exception) -> UnreadableFileError:
    """Return the error for a file that is not the scores.json or scores.nc that its name promises.

    Args:
        path: the file.
        error: what went wrong when it was read.
    """
    return UnreadableFileError(
        f"not a scores{path.suffix} of lagbench",
        where=str(path),
        expected="what `lagbench score` writes beside the predictions",
        got=f"{type(error).__name__}: {str(error)[:MAX_NAME]}",
        fix="score the predictions again: lagbench score predictions.nc",
    )


def parse_scores(held: Mapping[str, Any]) -> PublishedScores:
    """Return what a score card as JSON says: :meth:`ScoreCard.as_json`, or a scores.json.

    Raises:
        ValueError: another layout, text that no terminal should print, or ids and values that
            do not fit; likewise LookupError, TypeError, AttributeError and ArithmeticError where
            keys are missing or of another kind.
    """
    if held["lagbench_scores"] != FORMAT:
        raise ValueError(f"layout {str(held['lagbench_scores'])[:MAX_NAME]!r}, not {FORMAT}")
    ids = tuple(_integer(i, "an id") for i in held["task"]["scenarios"])
    if len(set(ids)) < len(ids):
        raise ValueError("scenario ids that occur twice")
    known = available()
    return PublishedScores(
        identity={name: _text(held, name) for name in IDENTITY},
        predictions_sha256=_text(held, "predictions_sha256"),
        ranking=_text(held, "ranking_metric"),
        scores={
            row: {n: _read_score(known[n], ids, said) for n, said in scores.items() if n in known}
            for row, scores in held["rows"].items()
        },
    )


def _text(held: Mapping[str, Any], name: str) -> str:
    """Return text under the rule for attributes of predictions: it goes to terminals as it is."""
    text = held[name]
    if not isinstance(text, str) or not text.strip() or len(text) > MAX_NAME or not text.isprintable():
        raise ValueError(f"{name} is not printable text of 1 to {MAX_NAME} characters")
    return text


def _read_score(metric: Metric, ids: tuple[int, ...], said: Mapping[str, Any]) -> Score:
    values = _floats(said["values"])
    undefined = tuple(_integer(count, "a number of frames") for count in said["undefined"])
    for numbers in (values, undefined):
        if len(numbers) != len(ids):
            raise ValueError(f"{metric.name}: {len(numbers)} values of {len(ids)} scenarios")
    return Score(
        metric=metric,
        scenarios=ids,
        frames=(),
        per_frame=np.empty((len(ids), 0)),
        values=np.array(values),
        undefined=undefined,
    )


def _integer(number: object, what: str) -> int:
    if not isinstance(number, int) or not 0 <= number < 2**31:
        raise ValueError(f"{what} is no integer from 0 to 2^31 - 1")
    return int(number)


def _floats(values: Iterable[float | None]) -> list[float]:
    found = [math.nan if value is None else float(value) for value in values]
    if any(math.isinf(value) for value in found):
        raise ValueError("an infinite value")
    return found
