"""The score card: what the scorer says of one submission, and its form as scores.json.

It holds no time, host or path, and reductions run in id order: the same predictions give the
same bytes. Numbers have nine significant digits; what is undefined is null.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from .atomic import write_atomically
from .flags import Flag
from .metrics import Comparison, Metric, Score, Setting, Tally, bootstrap_interval, compare
from .metrics.reductions import mean
from .preview import Preview
from .sitting import SUBMISSION
from .statistics import round_digits
from .submission import Finding, Header

__all__ = ["FORMAT", "IDENTITY", "JSON_NAME", "ScoreCard", "digits", "write_json"]

FORMAT = 1
"""Number of the layout of scores.json and scores.nc; stored as ``lagbench_scores``."""

JSON_NAME = "scores.json"

IDENTITY = ("split", "size", "dataset_version", "dataset_sha256", "method")
"""What says which data set was predicted, and by what."""

LABELS = ("seconds_per_frame", "device", "seed", "parameters", "training")


@dataclass(frozen=True, kw_only=True, eq=False)
class ScoreCard:
    """What the scorer says of one submission.

    Attributes:
        header: what the predictions say about themselves.
        predictions_sha256: content hash of the predicted positions.
        setting: the task, as metrics see it.
        ranking: name of the metric that ranks.
        tallies: statistics by row (submission, persistence, constant-velocity) and scenario.
        scores: scores by row and metric.
        flags: what a reader should know.
        warnings: findings of the validation that do not reject.
        preview: pictures of the first scenario.
        files: scores.json and scores.nc, where they were written.
    """

    header: Header
    predictions_sha256: str
    setting: Setting
    ranking: str
    tallies: Mapping[str, Mapping[int, Tally]]
    scores: Mapping[str, Mapping[str, Score]]
    flags: tuple[Flag, ...]
    warnings: tuple[Finding, ...]
    preview: Preview
    files: tuple[Path, ...] = ()

    @property
    def scenarios(self) -> tuple[int, ...]:
        """Ids of the scenarios, ascending."""
        return tuple(sorted(self.tallies[SUBMISSION]))

    @property
    def reported_frames(self) -> tuple[int, ...]:
        """Frames of interest, and the last one."""
        return tuple(sorted(self.setting.slow_frames.intersection(self.setting.predicted_frames)))

    @property
    def submission(self) -> Mapping[str, Score]:
        """Scores of the submission, by metric."""
        return self.scores[SUBMISSION]

    def against(self, row: str) -> Comparison:
        """Compare the submission with a floor in the ranking metric."""
        return compare(self.submission[self.ranking], self.scores[row][self.ranking])

    def at(self, path: Path, *more: Path) -> ScoreCard:
        """Return this card with the files that it was written to."""
        return replace(self, files=(path, *more))

    def as_json(self) -> dict[str, Any]:
        """Return the card as what scores.json holds."""
        header, setting = self.header, self.setting
        used = [score.metric for score in self.submission.values()]
        floors = [row for row in self.scores if row != SUBMISSION]
        return {
            "lagbench_scores": FORMAT,
            **{name: getattr(header, name) for name in IDENTITY},
            "predictions_sha256": self.predictions_sha256,
            **{name: getattr(header, name) for name in LABELS if getattr(header, name) is not None},
            "diverged_at": {str(i): frame for i, frame in sorted(header.diverged_at.items())},
            "task": {
                "input_frames": setting.input_frames,
                "horizon": setting.horizon,
                "frames": list(self.reported_frames),
                "scenarios": list(self.scenarios),
            },
            "ranking_metric": self.ranking,
            "metrics": {metric.name: _described(metric) for metric in used},
            "rows": {
                row: {name: self._score(score, row) for name, score in scores.items()}
                for row, scores in self.scores.items()
            },
            "against": {row: _comparison(self.against(row)) for row in floors},
            "flags": {flag.name: _flag(flag) for flag in self.flags},
            "warnings": [{"check": f.check, "what": f.what, "got": f.got} for f in self.warnings],
        }

    def _score(self, score: Score, row: str) -> dict[str, Any]:
        said: dict[str, Any] = {
            "mean": digits(score.mean),
            "interval": [digits(bound) for bound in score.interval],
            "values": [digits(value) for value in score.values.tolist()],
            "undefined": list(score.undefined),
        }
        if score.metric.per_frame:
            said["at"] = {str(frame): _at(score, frame, row) for frame in self.reported_frames}
        return said


def digits(value: float) -> float | None:
    """Return a number with nine significant digits, None where it is none.

    >>> digits(2 / 3)
    0.666666667
    """
    return round_digits(value) if math.isfinite(value) else None


def _at(score: Score, frame: int, row: str) -> dict[str, Any]:
    values = score.at(frame)
    said: dict[str, Any] = {"mean": digits(mean(values))}
    if row == SUBMISSION:
        said["interval"] = [digits(bound) for bound in bootstrap_interval(values)]
    return said


def _described(metric: Metric) -> dict[str, Any]:
    return {
        "family": metric.family,
        "unit": metric.unit,
        "direction": str(metric.direction),
        "perfect": metric.perfect,
        "source": metric.source,
        "summary": metric.summary,
    }


def _comparison(found: Comparison) -> dict[str, Any]:
    return {
        "metric": found.metric,
        "difference": digits(found.difference),
        "interval": [digits(bound) for bound in found.interval],
        "p": digits(found.p),
    }


def _flag(flag: Flag) -> dict[str, Any]:
    numbers = {name: digits(value) for name, value in flag.evidence.items()}
    return {"raised": flag.raised, "reasons": list(flag.reasons), "evidence": numbers}


def write_json(card: ScoreCard, path: Path) -> None:
    """Write scores.json, whole or not at all.

    Raises:
        WorkFailedError: the operating system refused.
    """
    text = json.dumps(card.as_json(), indent=1, allow_nan=False, ensure_ascii=False)
    write_atomically(path, f"{text}\n".encode(), option="--output")
