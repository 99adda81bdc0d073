"""The score card: all scores of one submission, and its form as scores.json.

It holds no time, host or path, and reductions run in id order: the same predictions
give the same bytes. Numbers have nine significant digits; undefined ones are null.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lagbench.data.checksums import round_digits
from lagbench.errors import UsageError, suggest_name
from lagbench.metrics.aggregate import Score, Tally
from lagbench.metrics.frame import TaskConfig
from lagbench.metrics.metric import Metric, mean
from lagbench.metrics.significance import Comparison, compare
from lagbench.metrics.table import CHOSEN
from lagbench.submission.format import Header
from lagbench.submission.issues import ValidationIssue

from .flags import Flag
from .front import NoSpeedup, Speedup
from .published_scores import FORMAT, IDENTITY
from .scenario import SUBMISSION, Preview
from .skill import Skill

if TYPE_CHECKING:
    import pandas as pd

JSON_NAME = "scores.json"

BRIEF_ROWS = 5
"""Metrics that a short table shows."""

LABELS = ("seconds_per_frame", "device", "seed", "parameters", "training")
"""Fields that scores.json has where the predictions state them."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class ScoreCard:
    """All scores of one submission."""

    header: Header  # of the predictions
    predictions_sha256: str  # content hash of the predicted positions
    config: TaskConfig  # of the split and size
    ranking: str  # name of the metric that ranks
    # statistics by row and scenario: of the submission, and of references that were
    # measured beside it
    tallies: Mapping[str, Mapping[int, Tally]]
    # scores by row (submission, then references) and metric
    scores: Mapping[str, Mapping[str, Score]]
    # as scored: it does not follow a replaced `scores`; None where no reference that
    # counts has a score
    skill: Skill | None
    speedup: Speedup | NoSpeedup  # over the classical side, or why there is none
    flags: tuple[Flag, ...]  # hints for the reader of a score
    warnings: tuple[ValidationIssue, ...]  # of the validation; they do not reject
    preview: Preview  # pictures of the first scenario
    files: tuple[Path, ...] = ()  # scores.json and scores.nc, where they were written

    def __repr__(self) -> str:
        """Return method, ranking metric and skill; the values are too many."""
        header = self.header
        subject = f"{header.method!r} on {self.data_name}"
        ranking = f"{self.ranking} {self.submission[self.ranking].mean:.4g}"
        return f"<{type(self).__name__}: {subject}, {ranking}, skill {self.skill}>"

    def _repr_html_(self) -> str:
        """Return a table of the skill and the first metrics, for notebooks; escaped."""
        header = self.header
        lines = [("skill", "-" if self.skill is None else str(self.skill))]
        for name in self.chosen_metrics[:BRIEF_ROWS]:
            score = self.submission[name]
            low, high = score.interval
            cell = f"{score.mean:.4g}"
            if not math.isnan(low):
                cell += f" [{low:.3g}, {high:.3g}]"
            lines.append((f"{name} [{score.metric.unit}]", cell))
        rows = []
        for line in lines:
            cells = "".join(f"<td>{escape(cell)}</td>" for cell in line)
            rows.append(f"<tr>{cells}</tr>")
        caption = escape(f"{header.method} on {self.data_name}")
        return f"<table><caption>{caption}</caption>{''.join(rows)}</table>"

    @property
    def data_name(self) -> str:
        """Split and size of the predictions, and their subset if it is not test."""
        name = f"{self.header.split} {self.header.size}"
        if self.header.subset != "test":
            name += f" {self.header.subset}"
        return name

    @property
    def chosen_metrics(self) -> list[str]:
        """Names of the most important metrics, the ranking one first."""
        names = []
        for name in dict.fromkeys((self.ranking, *CHOSEN)):
            if name in self.submission:
                names.append(name)
        return names

    def to_dataframe(self) -> pd.DataFrame:
        """Return all values over the horizon as a table with a line for each.

        Columns: ``row`` (``submission``, or the name of a reference), ``metric``,
        ``unit``, ``direction`` (``lower``, ``higher``, ``target`` or ``none``),
        ``scenario``, ``value`` (NaN where undefined), ``undefined`` (frames without a
        value). References have their ranking metric at least.
        """
        import pandas as pd

        lines = []
        for row, scores in self.scores.items():
            for name, score in scores.items():
                for scenario, value, undefined in zip(
                    score.scenarios, score.values.tolist(), score.undefined, strict=True
                ):
                    line = {
                        "row": row,
                        "metric": name,
                        "unit": score.metric.unit,
                        "direction": str(score.metric.direction),
                        "scenario": scenario,
                        "value": value,
                        "undefined": undefined,
                    }
                    lines.append(line)
        return pd.DataFrame(lines)

    @property
    def scenarios(self) -> tuple[int, ...]:
        """Ids of the scenarios, ascending."""
        return tuple(sorted(self.tallies[SUBMISSION]))

    @property
    def reported_frames(self) -> tuple[int, ...]:
        """Frames of interest, and the last one."""
        predicted = self.config.predicted_frames
        return tuple(sorted(self.config.slow_frames.intersection(predicted)))

    @property
    def submission(self) -> Mapping[str, Score]:
        """Scores of the submission, by metric."""
        return self.scores[SUBMISSION]

    def against(self, row: str) -> Comparison:
        """Compare the submission with a reference in the ranking metric.

        Args:
            row: name of the reference, as in ``scores``.

        Raises:
            UsageError: no reference of that name was scored beside the submission.
        """
        references = [name for name in self.scores if name != SUBMISSION]
        if row not in references:
            raise UsageError(
                f"no reference {row!r} beside the submission",
                where="against, row",
                expected="the name of a reference that was scored beside it",
                got=ascii(row),
                fix=suggest_name(str(row), references),
            )
        return compare(self.submission[self.ranking], self.scores[row][self.ranking])

    def at(self, path: Path, *more: Path) -> ScoreCard:
        """Return this card with the files that it was written to."""
        return replace(self, files=(path, *more))

    def as_json(self) -> dict[str, Any]:
        """Return the content of scores.json."""
        content: dict[str, Any] = {"lagbench_scores": FORMAT}
        for name in IDENTITY:
            content[name] = getattr(self.header, name)
        if self.header.subset != "test":
            content["subset"] = self.header.subset
        content["predictions_sha256"] = self.predictions_sha256
        for name in LABELS:
            label = getattr(self.header, name)
            if label is not None:
                content[name] = label

        diverged_at = sorted(self.header.diverged_at.items())
        diverged = {}
        for i, frame in diverged_at:
            diverged[str(i)] = frame
        content["diverged_at"] = diverged
        content["task"] = {
            "input_frames": self.config.input_frames,
            "horizon": self.config.horizon,
            "frames": list(self.reported_frames),
            "scenarios": list(self.scenarios),
        }
        content["ranking_metric"] = self.ranking
        content["skill"] = _skill_as_json(self.skill)
        content["speedup"] = None
        if isinstance(self.speedup, Speedup):
            content["speedup"] = _speedup_as_json(self.speedup)
        else:
            content["why_no_speedup"] = str(self.speedup)

        metrics = {}
        for score in self.submission.values():
            metrics[score.metric.name] = _metric_as_json(score.metric)
        content["metrics"] = metrics

        rows = {}
        for row in self.scores:
            rows[row] = self._row_as_json(row)
        content["rows"] = rows

        comparisons = {}
        for row in self.scores:
            if row != SUBMISSION:
                comparisons[row] = _comparison_as_json(self.against(row))
        content["against"] = comparisons

        flags = {}
        for flag in self.flags:
            flags[flag.name] = _flag_as_json(flag)
        content["flags"] = flags
        warnings = []
        for warning in self.warnings:
            warnings.append(
                {"check": warning.check, "what": warning.what, "got": warning.got}
            )
        content["warnings"] = warnings
        return content

    def _row_as_json(self, row: str) -> dict[str, Any]:
        """Return the scores of a row, by metric."""
        scores = {}
        for name, score in self.scores[row].items():
            scores[name] = _score_as_json(score)
            if score.metric.per_frame:
                at = {}
                for frame in self.reported_frames:
                    at[str(frame)] = _frame_as_json(score, frame, row)
                scores[name]["at"] = at
        return scores


def number_methods(methods: Sequence[str], taken: Collection[str] = ()) -> list[str]:
    """Return the methods; those that occur twice, or have a taken name, get a number.

    No two names are equal.

    >>> number_methods(["gns", "gat", "gns"])
    ['gns (1)', 'gat', 'gns (2)']
    >>> number_methods(["gns", "gns", "gns (1)"])
    ['gns (2)', 'gns (3)', 'gns (1)']
    """
    count = Counter([*methods, *taken])
    used = {*methods, *taken}
    numbers = Counter[str]()
    names = []
    for method in methods:
        name = method
        if count[method] > 1:
            while name in used:
                numbers[method] += 1
                name = f"{method} ({numbers[method]})"
            used.add(name)
        names.append(name)
    return names


def digits(value: float) -> float | None:
    """Return a number with nine significant digits, None where it is not finite.

    >>> digits(2 / 3)
    0.666666667
    """
    if math.isfinite(value):
        return round_digits(value)
    return None


def _interval_as_json(interval: tuple[float, float]) -> list[float | None]:
    return [digits(bound) for bound in interval]


def _score_as_json(score: Score) -> dict[str, Any]:
    return {
        "mean": digits(score.mean),
        "interval": _interval_as_json(score.interval),
        "values": [digits(value) for value in score.values.tolist()],
        "undefined": list(score.undefined),
    }


def _frame_as_json(score: Score, frame: int, row: str) -> dict[str, Any]:
    content: dict[str, Any] = {"mean": digits(mean(score.at(frame)))}
    if row == SUBMISSION:
        content["interval"] = _interval_as_json(score.interval_at(frame))
    return content


def _metric_as_json(metric: Metric) -> dict[str, Any]:
    """Return what a metric is, without any value: unit, direction, source."""
    return {
        "family": metric.family,
        "unit": metric.unit,
        "direction": str(metric.direction),
        "perfect": metric.perfect,
        "source": metric.source,
        "summary": metric.summary,
    }


def _skill_as_json(skill: Skill | None) -> dict[str, Any] | None:
    if skill is None:
        return None
    return {
        "floor": skill.reference,
        "value": digits(skill.value),
        "interval": _interval_as_json(skill.interval),
    }


def _speedup_as_json(speedup: Speedup) -> dict[str, Any]:
    return {
        "value": digits(speedup.value),
        "interval": _interval_as_json(speedup.interval),
        "at_least": speedup.at_least,
        "classical_seconds": digits(speedup.classical_seconds),
    }


def _comparison_as_json(comparison: Comparison) -> dict[str, Any]:
    return {
        "metric": comparison.metric,
        "difference": digits(comparison.difference),
        "interval": _interval_as_json(comparison.interval),
        "p": digits(comparison.p),
    }


def _flag_as_json(flag: Flag) -> dict[str, Any]:
    evidence = {}
    for name, value in flag.evidence.items():
        evidence[name] = digits(value)
    return {
        "raised": flag.raised,
        "reasons": list(flag.reasons),
        "evidence": evidence,
    }


def format_scores(card: ScoreCard) -> bytes:
    """Return the bytes of scores.json."""
    text = json.dumps(card.as_json(), indent=1, allow_nan=False, ensure_ascii=False)
    return f"{text}\n".encode()
