"""Curves over frames: of every scenario, and means of every method."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.figures.chart import AxisScale, Plot, linear, spanning
from lagbench.figures.html import (
    Markup,
    ReportFigure,
    draw_key,
    draw_table,
    format_quantity,
    join,
    sentence,
    tag,
    words,
    wrap_number,
)
from lagbench.metrics.aggregate import (
    FEWEST_FOR_INTERVAL,
    Score,
    mean_over_seeds,
)
from lagbench.metrics.metric import Metric
from lagbench.metrics.vorticity import STABLE_PEARSON

from .subject import ReportRow, Subject, series_kind

Floats = NDArray[np.float64]

# the axis of energies reaches so many times the truth's greatest energy; what is beyond
# is cut off
TOLERATED = 3.0

CORRELATION = "vorticity_pearson"
POSITION_ERROR = "position_rmse"


@dataclass(frozen=True, eq=False)
class Series:
    """One line of a chart."""

    label: str
    kind: str  # classes of the mark
    values: Floats  # shape [frame]


@dataclass(frozen=True, kw_only=True)
class CurveTexts:
    """The texts of a figure of curves."""

    name: str  # identifier, unique on the page
    title: str
    thesis: str  # the figure of the thesis that it corresponds to
    caption: str
    series: str = "method"  # what a line stands for


def error_curves(subject: Subject) -> Iterator[ReportFigure]:
    """Yield errors over frames in all test scenarios, by entry (Fig. 5.10)."""
    for entry in subject.entries:
        for name in (_main_error(subject), POSITION_ERROR):
            if name in entry.card.submission:
                yield _draw_scenarios(subject, entry.number, name)


def _draw_scenarios(subject: Subject, number: int, name: str) -> ReportFigure:
    """Return a metric of one entry, a line per test scenario."""
    entry = subject.entries[number]
    score = entry.card.submission[name]
    series = []
    for i, scenario in enumerate(score.scenarios):
        label = f"scenario {scenario}"
        series.append(Series(label, series_kind(i), score.per_frame[i]))

    # the axis holds the curves of all entries
    every = []
    for other in subject.entries:
        every.append(other.card.submission[name].per_frame)
    x_axis = _frame_axis(subject)
    y_label = format_quantity(score.metric)
    plot = Plot(x_axis, spanning(every), x_label="frame", y_label=y_label)
    for line in series:
        plot.line(subject.frames, line.values, line.kind, line.label)
    first = subject.frames[0]
    last = subject.frames[-1]
    drawn = plot.svg(
        f"{score.metric.name} over frames",
        f"Lines of {len(series)} scenarios of {entry.name} from frame {first} to "
        f"{last}.",
    )

    title = f"{words(name, capital=True)}, every scenario"
    caption = f"{sentence(score.metric)} One line per scenario."
    if len(subject.entries) > 1:
        title += f": {entry.name}"
        caption += " The axis is shared by all files."
    texts = CurveTexts(
        name=f"scenarios-{name.replace('_', '-')}-{number}",
        title=title,
        thesis="Fig. 5.10",
        caption=caption,
        series="scenario",
    )
    return _compose_figure(subject, texts, series, drawn)


def method_curves(subject: Subject) -> Iterator[ReportFigure]:
    """Yield means over scenarios with their intervals, by method (Fig. 5.11)."""
    note = f"Mean over {len(subject.scenarios)} scenarios"
    if len(subject.scenarios) >= FEWEST_FOR_INTERVAL:
        note += "; the bands are 95 % bootstrap intervals over scenarios"
    note += ". Grey: reference predictors, which learn nothing."
    figures = {
        _main_error(subject): "Fig. 5.11",
        POSITION_ERROR: "Fig. 5.11",
        "velocity_rmse": "Fig. 5.11",
        CORRELATION: "Fig. 5.13",
    }
    for name, thesis in figures.items():
        rows = subject.rows_with(name)
        if not rows:
            continue
        metric = rows[0].scores[name].metric
        series = _mean_series(rows, name)
        perturbed = _perturbed_run(subject, name)
        y_axis = _error_axis(name, [*series, *perturbed])
        y_label = format_quantity(metric)
        plot = Plot(_frame_axis(subject), y_axis, x_label="frame", y_label=y_label)
        for row in rows:
            if row.entry is not None:
                low, high = _frame_intervals(row.scores[name])
                plot.band(subject.frames, low, high, row.kind)
        _draw_lines(subject, plot, series)
        for line in perturbed:
            title = "the solver after a perturbation of 2^-20"
            plot.line(subject.frames, line.values, line.kind, title)
        if name == CORRELATION:
            plot.level(STABLE_PEARSON, f"stable above {STABLE_PEARSON}")

        texts = CurveTexts(
            name=f"methods-{name.replace('_', '-')}",
            title=f"{words(name, capital=True)} over frames",
            thesis=thesis,
            caption=f"{sentence(metric)} {note}",
        )
        drawn = plot.svg(f"{name} over frames", _describe_lines(metric, rows))
        yield _compose_figure(subject, texts, series, drawn, unlisted=perturbed)


def body_curves(subject: Subject) -> Iterator[ReportFigure]:
    """Yield how elastic bodies keep their shape and hold together (section 4.8.2)."""
    for name in ("shape_error", "connectivity"):
        rows = subject.rows_with(name)
        if not rows:
            continue
        metric = rows[0].scores[name].metric
        series = _mean_series(rows, name)
        if name == "connectivity":
            y_axis = linear(0.0, 1.0)
        else:
            y_axis = spanning(_values_of(series), log=False)
        y_label = format_quantity(metric)
        plot = Plot(_frame_axis(subject), y_axis, x_label="frame", y_label=y_label)
        _draw_lines(subject, plot, series)
        texts = CurveTexts(
            name=f"bodies-{name.replace('_', '-')}",
            title=f"{words(name, capital=True)} of jelly and rope",
            thesis="section 4.8.2",
            caption=f"{sentence(metric)} Mean over the scenarios with an elastic body.",
        )
        drawn = plot.svg(f"{name} over frames", _describe_lines(metric, rows))
        yield _compose_figure(subject, texts, series, drawn)


def _main_error(subject: Subject) -> str:
    if subject.is_full_box:
        return "vorticity_mse"
    return "attribute_mse"


def _mean_series(rows: Sequence[ReportRow], name: str) -> list[Series]:
    """Return the mean over scenarios of each method, after the truth's own value."""
    series = []
    true_score = rows[0].scores.get(f"{name}_true")
    if true_score is not None:
        true_values = _mean_over_scenarios(true_score)
        series.append(Series("truth", "truth", true_values))
    for row in rows:
        values = _mean_over_scenarios(row.scores[name])
        series.append(Series(row.name, row.kind, values))
    return series


def _perturbed_run(subject: Subject, name: str) -> list[Series]:
    """Return the error of a perturbed run of the solver, where there is one."""
    if name != POSITION_ERROR:
        return []
    values = np.asarray(subject.task.predictability_limit)
    if len(values) != len(subject.frames):
        return []
    return [Series("perturbed run of the solver", "twin", values)]


def _error_axis(name: str, series: Sequence[Series]) -> AxisScale:
    lines = _values_of(series)
    if name == CORRELATION:
        values = np.concatenate(lines)
        lowest = np.min(values[np.isfinite(values)], initial=0.0)
        return linear(float(lowest), 1.0)
    return spanning(lines)


def _frame_intervals(score: Score) -> tuple[Floats, Floats]:
    """Return low and high end of the interval of each frame, shape [frame] each."""
    bounds = [score.interval_at(frame) for frame in score.frames]
    low, high = np.array(bounds).T
    return low, high


def _describe_lines(metric: Metric, rows: Sequence[ReportRow]) -> str:
    methods = ", ".join(row.name for row in rows)
    return f"{metric.summary}, one line each for {methods}."


def energy_curves(subject: Subject) -> Iterator[ReportFigure]:
    """Yield the retained kinetic energy (Fig. 5.19), and its value (Fig. 5.28)."""
    yield _retained_energy(subject)
    yield _raw_energy(subject)


def _retained_energy(subject: Subject) -> ReportFigure:
    scores = subject.entries[0].card.submission
    true_values = 100.0 * _mean_over_scenarios(scores["energy_retention_true"])
    series = [Series("truth", "truth", true_values)]
    for row in subject.rows:
        values = 100.0 * _mean_over_scenarios(row.scores["energy_retention"])
        series.append(Series(row.name, row.kind, values))
    texts = CurveTexts(
        name="energy-kept",
        title="Kinetic energy kept",
        thesis="Fig. 5.19",
        caption="Kinetic energy relative to the last given frame, mean over "
        f"{len(subject.scenarios)} scenarios. A surrogate that damps falls below "
        "the truth, one that blows up rises above it; more energy than the truth is no "
        "merit.",
    )
    y_label = "kinetic energy [% of the last given frame]"
    return _energy_figure(subject, texts, series, y_label=y_label)


def _raw_energy(subject: Subject) -> ReportFigure:
    scenario = subject.scenarios[0]
    scores = subject.entries[0].card.submission
    series = [Series("truth", "truth", scores["energy_true"].per_frame[0])]
    for entry in subject.entries:
        values = entry.card.submission["energy_predicted"].per_frame[0]
        series.append(Series(entry.name, entry.kind, values))
    texts = CurveTexts(
        name="energy-raw",
        title=f"Kinetic energy, scenario {scenario}",
        thesis="Fig. 5.28",
        caption="E = Σ m |u|² / 2 with u the displacement per frame, in scenario "
        f"{scenario}.",
    )
    y_label = "kinetic energy [mass length²/frame²]"
    return _energy_figure(subject, texts, series, y_label=y_label)


def _energy_figure(
    subject: Subject, texts: CurveTexts, series: Sequence[Series], *, y_label: str
) -> ReportFigure:
    """Return energies over frames; the first series is the truth's."""
    highest = TOLERATED * float(np.nanmax(series[0].values, initial=0.0))
    lines = np.array(_values_of(series))  # shape [series, frame]
    caption_note = ""
    if highest > 0.0:
        if (lines > highest).any():
            caption_note = (
                f" Energies beyond {TOLERATED:g} times the truth's maximum are cut off."
            )
        lines = np.minimum(lines, highest)
    y_axis = spanning([lines], log=False)
    plot = Plot(_frame_axis(subject), y_axis, x_label="frame", y_label=y_label)
    _draw_lines(subject, plot, series)
    methods = ", ".join(line.label for line in series)
    drawn = plot.svg(texts.title, f"Kinetic energy over frames of {methods}.")
    return _compose_figure(subject, texts, series, drawn, note=caption_note)


def _draw_lines(subject: Subject, plot: Plot, series: Sequence[Series]) -> None:
    """Draw lines, the first on top."""
    for line in reversed(series):
        plot.line(subject.frames, line.values, line.kind, line.label)


def _compose_figure(
    subject: Subject,
    texts: CurveTexts,
    series: Sequence[Series],
    drawn: Markup,
    *,
    unlisted: Sequence[Series] = (),
    note: str = "",
) -> ReportFigure:
    """Return a chart of lines with its key and a table of values at some frames.

    The table has the frames of interest and the last one. Unlisted series stand in the
    key alone.
    """
    frames = sorted({*subject.frames_of_interest, int(subject.frames[-1])})
    columns = np.searchsorted(subject.frames, frames)
    head: list[object] = [texts.series]
    for frame in frames:
        head.append(tag("span", f"frame {frame}"))
    rows = []
    for line in series:
        values = line.values[columns].tolist()
        rows.append([line.label, *map(wrap_number, values)])

    key_items = []
    for line in (*series, *unlisted):
        key_items.append((line.kind, line.label))
    key = draw_key(key_items)
    return ReportFigure(
        name=texts.name,
        title=texts.title,
        thesis=texts.thesis,
        body=join([key, drawn]),
        caption=texts.caption + note,
        data=draw_table(head, rows, label="Numbers"),
    )


def _values_of(series: Sequence[Series]) -> list[Floats]:
    return [line.values for line in series]


def _frame_axis(subject: Subject) -> AxisScale:
    first = float(subject.frames[0])
    last = float(subject.frames[-1])
    return linear(first, last, count=6, tight=True)


def _mean_over_scenarios(score: Score) -> Floats:
    is_finite = np.isfinite(score.per_frame)
    return mean_over_seeds(np.where(is_finite, score.per_frame, np.nan))
