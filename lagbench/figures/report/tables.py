"""Tables of the report as plain cells; the template draws them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.figures.numbers import format_unit, text, words
from lagbench.metrics.metric import Direction, Metric, mean
from lagbench.metrics.table import CHOSEN, FAMILIES, METRICS

from .subject import Subject

Floats = NDArray[np.float64]

AT_FRAME_FULL_BOX = (
    "vorticity_mae",
    "vorticity_mse",
    "vorticity_rmse",
    "vorticity_pearson",
    "vorticity_kl",
)
"""Metrics of Table 5.4 of the thesis."""

AT_FRAME_FREE_SURFACE = (
    "sliced_w2",
    "position_rmse",
    "attribute_mse",
    "velocity_rmse",
    "energy_ratio",
)

AIMS = {
    Direction.LOWER: "lower is better",
    Direction.HIGHER: "higher is better",
    Direction.NONE: "observable",
}

UNDEFINED = "*"
"""Behind a mean that leaves out undefined values."""


@dataclass(frozen=True)
class ReportCell:
    """One cell of a table."""

    text: str
    note: str = ""  # smaller, below the text
    is_best: bool = False


@dataclass(frozen=True)
class ReportTable:
    """One table of the page; the first cell of a row is its heading."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[ReportCell]]
    note: str = ""


def score_tables(subject: Subject) -> list[ReportTable]:
    """Return the tables of the chosen metrics, of a frame, of the scenarios."""
    names = dict.fromkeys((subject.ranking.name, *CHOSEN))
    return [
        _horizon_table(subject, "Mean over the horizon", _measured(subject, names)),
        _frame_table(subject),
        _scenario_table(subject),
    ]


def metric_tables(subject: Subject) -> list[ReportTable]:
    """Return all metrics over the horizon, a table per family."""
    tables = []
    for family, metrics in FAMILIES.items():
        names = _measured(subject, [metric.name for metric in metrics])
        if names:
            tables.append(_horizon_table(subject, family.capitalize(), names))
    submission = subject.entries[0].card.submission
    names = [name for name in submission if name not in METRICS]
    if names:
        tables.append(_horizon_table(subject, "Of other packages", names))
    return tables


def _measured(subject: Subject, names: Iterable[str]) -> list[str]:
    """Return the metrics that all entries have, of some names."""
    submissions = [entry.card.submission for entry in subject.entries]
    measured = []
    for name in names:
        if all(name in submission for submission in submissions):
            measured.append(name)
    return measured


def _horizon_table(subject: Subject, title: str, names: Sequence[str]) -> ReportTable:
    """Return means over the horizon, a row per metric and a column per method."""
    rows = []
    has_undefined = False
    for name in names:
        scores = [row.scores.get(name) for row in subject.rows]
        metric = subject.entries[0].card.submission[name].metric
        values = []
        for score in scores:
            values.append(np.array([]) if score is None else score.values)
        best = _find_best(metric, values)
        if metric.direction in AIMS:
            note = f"{metric.summary}; {AIMS[metric.direction]}"
        else:
            note = f"{metric.summary}; aims at {metric.perfect:g}"
        cells = [ReportCell(f"{metric.name}{format_unit(metric)}", note)]
        for column, score in enumerate(scores):
            if score is None:
                cells.append(ReportCell(""))
                continue
            shown = text(score.mean)
            if sum(score.undefined):
                shown += UNDEFINED
                has_undefined = True
            interval = format_interval(score.interval)
            cells.append(ReportCell(shown, interval, column in best))
        rows.append(cells)
    note = ""
    if has_undefined:
        note = f"{UNDEFINED} Some frames have no value; the mean leaves them out."
    head = ["metric", *(row.name for row in subject.rows)]
    return ReportTable(title, head, rows, note)


def format_interval(bounds: tuple[float, float]) -> str:
    """Return an interval; nothing where there is none.

    >>> format_interval((0.25, 1.0)), format_interval((math.nan, math.nan))
    ('0.250 … 1', '')
    """
    low, high = bounds
    if math.isnan(low) or math.isnan(high):
        return ""
    return f"{text(low)} … {text(high)}"


def _find_best(metric: Metric, values: Sequence[Floats]) -> frozenset[int]:
    """Return which methods are best by the mean of their scenarios' losses.

    Losses that read the same are equal. An observable, or a metric that nobody has, has
    no best. Values above and below a target do not cancel, as losses are averaged.
    """
    if metric.direction is Direction.NONE:
        return frozenset()
    losses = []
    for method_values in values:
        scenario_losses = [metric.loss(value) for value in method_values]
        losses.append(mean(np.array(scenario_losses)))
    if not np.isfinite(losses).any():
        return frozenset()
    least = text(float(np.nanmin(losses)))
    return frozenset(i for i, loss in enumerate(losses) if text(loss) == least)


def _frame_table(subject: Subject) -> ReportTable:
    """Return the metrics of Tables 5.4 and 5.5 at the key frame, by method."""
    frame = subject.key_frame
    wanted = AT_FRAME_FREE_SURFACE
    if subject.is_full_box:
        wanted = AT_FRAME_FULL_BOX
    names = _measured(subject, wanted)
    rows = []
    for row in subject.rows:
        cells = [ReportCell(row.name)]
        for name in names:
            score = row.scores.get(name)
            cells.append(
                ReportCell("" if score is None else text(mean(score.at(frame))))
            )
        rows.append(cells)
    head = ["method", *(words(name) for name in names)]
    return ReportTable(f"At frame {frame}", head, rows)


def _scenario_table(subject: Subject) -> ReportTable:
    """Return the ranking metric of every scenario, by method."""
    metric = subject.ranking
    rows = []
    for row in subject.rows:
        values = row.scores[metric.name].values.tolist()
        rows.append(
            [ReportCell(row.name), *(ReportCell(text(value)) for value in values)]
        )
    title = f"{words(metric.name, capital=True)} per scenario"
    return ReportTable(title, ["method", *map(str, subject.scenarios)], rows)
