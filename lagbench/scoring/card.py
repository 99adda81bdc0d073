"""The score card: all scores of one submission, and its form as scores.json.

It holds no time, host or path, and reductions run in id order: the same predictions
give the same bytes. Numbers have nine significant digits; undefined ones are null.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lagbench.errors import UsageError, suggest_name
from lagbench.metrics.aggregate import Score, Tally
from lagbench.metrics.frame import TaskConfig
from lagbench.metrics.metric import mean
from lagbench.metrics.significance import Comparison, compare
from lagbench.metrics.table import CHOSEN
from lagbench.submission.format import IDENTITY, Header
from lagbench.submission.issues import ValidationIssue

from .flags import Flag
from .front import NoSpeedup, Speedup, digits
from .skill import Skill
from .task import SUBMISSION

if TYPE_CHECKING:
    import pandas as pd

JSON_NAME = "scores.json"

FORMAT = 1
"""Number of the layout of scores.json and scores.nc; stored as ``lagbench_scores``."""

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
    files: tuple[Path, ...] = ()  # scores.json and scores.nc, where they were written

    def __repr__(self) -> str:
        """Return method, ranking metric and skill; the values are too many."""
        header = self.header
        subject = f"{header.method!r} on {self.data_name}"
        ranking = f"{self.ranking} {self.submission[self.ranking].mean:.4g}"
        return f"<{type(self).__name__}: {subject}, {ranking}, skill {self.skill}>"

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
                f"no reference {row!r} beside the submission; "
                f"{suggest_name(str(row), references)}"
            )
        return compare(self.submission[self.ranking], self.scores[row][self.ranking])

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

        content["diverged_at"] = {
            str(i): frame for i, frame in sorted(self.header.diverged_at.items())
        }
        content["task"] = {
            "input_frames": self.config.input_frames,
            "horizon": self.config.horizon,
            "frames": list(self.reported_frames),
            "scenarios": list(self.scenarios),
        }
        content["ranking_metric"] = self.ranking
        content["skill"] = None
        if self.skill is not None:
            content["skill"] = {
                "floor": self.skill.reference,
                "value": digits(self.skill.value),
                "interval": _bounds(self.skill.interval),
            }
        content["speedup"] = None
        if isinstance(self.speedup, Speedup):
            content["speedup"] = self.speedup.as_json()
        else:
            content["why_no_speedup"] = str(self.speedup)

        content["metrics"] = {}
        for score in self.submission.values():
            metric = score.metric
            content["metrics"][metric.name] = {
                "family": metric.family,
                "unit": metric.unit,
                "direction": str(metric.direction),
                "perfect": metric.perfect,
                "source": metric.source,
                "summary": metric.summary,
            }
        content["rows"] = {}
        content["against"] = {}
        for row, scores in self.scores.items():
            lines: dict[str, dict[str, Any]] = {}
            content["rows"][row] = lines
            for name, score in scores.items():
                lines[name] = {
                    "mean": digits(score.mean),
                    "interval": _bounds(score.interval),
                    "values": [digits(value) for value in score.values.tolist()],
                    "undefined": list(score.undefined),
                }
                if not score.metric.per_frame:
                    continue
                lines[name]["at"] = {}
                for frame in self.reported_frames:
                    at: dict[str, Any] = {"mean": digits(mean(score.at(frame)))}
                    if row == SUBMISSION:
                        at["interval"] = _bounds(score.interval_at(frame))
                    lines[name]["at"][str(frame)] = at
            if row != SUBMISSION:
                comparison = self.against(row)
                content["against"][row] = {
                    "metric": comparison.metric,
                    "difference": digits(comparison.difference),
                    "interval": _bounds(comparison.interval),
                    "p": digits(comparison.p),
                }
        content["flags"] = {}
        for flag in self.flags:
            evidence = {name: digits(value) for name, value in flag.evidence.items()}
            content["flags"][flag.name] = {
                "raised": flag.raised,
                "reasons": list(flag.reasons),
                "evidence": evidence,
            }
        content["warnings"] = [
            {"check": one.check, "where": one.where, "what": one.what}
            for one in self.warnings
        ]
        return content


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


def _bounds(interval: tuple[float, float]) -> list[float | None]:
    return [digits(bound) for bound in interval]


def format_scores(card: ScoreCard) -> bytes:
    """Return the bytes of scores.json."""
    text = json.dumps(card.as_json(), indent=1, allow_nan=False, ensure_ascii=False)
    return f"{text}\n".encode()
