"""Curves over frames: errors, correlation and energy, of scenarios and of methods.

Bars at the key frame: correlation (Fig. 5.13), divergence (Fig. 5.16), distance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from lagbench.metrics.aggregate import Score, bootstrap_interval
from lagbench.metrics.metric import Direction, Metric, mean

from .chart import Bar, Plot, Scale, bar_chart, linear, spanning
from .html import Markup, clipped, html, join, quantity, sentence, tag, text, words
from .page import Figure, key, table
from .subject import Row, Subject, kind_of

__all__ = [
    "body_curves",
    "energy_curves",
    "error_curves",
    "method_curves",
    "bar_figures",
]


Floats = NDArray[np.float64]

STABLE = 0.8
"""Correlation below which a rollout no longer counts as stable."""

TOLERATED = 3.0
"""The axis of energies reaches so many times the truth's greatest; what is beyond is cut off."""


def error_curves(subject: Subject) -> Iterator[Figure]:
    """Yield the error over frames for all test scenarios, two figures per entry (Fig. 5.10)."""
    for row in subject.rows:
        for name in ("vorticity_mse" if subject.full_box else "attribute_mse", "position_rmse"):
            if row.entry is not None and name in row.scores:
                yield _scenario_figure(subject, row, name)


def _scenario_figure(subject: Subject, row: Row, name: str) -> Figure:
    score = row.scores[name]
    number = row.entry.number if row.entry else 0
    several = len(subject.entries) > 1
    y = spanning([r.scores[name].per_frame for r in subject.rows if r.entry is not None])
    shared = " The axis is shared by all files." if several else ""
    return Figure(
        name=f"scenarios-{name.replace('_', '-')}-{number}",
        title=f"{words(name, capital=True)}, every test scenario" + (f": {row.name}" if several else ""),
        thesis="Fig. 5.10",
        body=join([key(_scenario_key(score)), _scenario_chart(subject, score, y, row.name)]),
        caption=join([f"{sentence(score.metric)} One line per test scenario.{shared}"]),
        data=_numbers(subject, [(f"scenario {i}", values) for i, values in _by_scenario(score)], "scenario"),
    )


def _scenario_key(score: Score) -> list[tuple[str, str]]:
    return [(kind_of(i), f"scenario {number}") for i, number in enumerate(score.scenarios)]


def _by_scenario(score: Score) -> Iterator[tuple[int, Floats]]:
    yield from zip(score.scenarios, score.per_frame, strict=True)


def _scenario_chart(subject: Subject, score: Score, y: Scale, name: str) -> Markup:
    plot = Plot(_frame_axis(subject), y, x_label="frame", y_label=quantity(score.metric))
    for i, (scenario, values) in enumerate(_by_scenario(score)):
        plot.line(subject.frames, values, kind_of(i), f"scenario {scenario}")
    return plot.svg(
        f"{score.metric.name} over frames",
        f"Lines of {len(score.scenarios)} test scenarios of {name} from frame {subject.frames[0]}"
        f" to {subject.frames[-1]}.",
    )


def method_curves(subject: Subject) -> Iterator[Figure]:
    """Yield the methods side by side: mean over scenarios with its interval (Fig. 5.11)."""
    for name, thesis in (
        ("vorticity_mse" if subject.full_box else "attribute_mse", "Fig. 5.11"),
        ("position_rmse", "Fig. 5.11"),
        ("velocity_rmse", "Fig. 5.11"),
        ("vorticity_pearson", "Fig. 5.13"),
    ):
        rows = [row for row in subject.rows if name in row.scores]
        if rows:
            yield _method_figure(subject, rows, name, thesis)


def _method_figure(subject: Subject, rows: Sequence[Row], name: str, thesis: str) -> Figure:
    metric = rows[0].scores[name].metric
    series = [(row, _mean(row.scores[name])) for row in rows]
    correlation = name == "vorticity_pearson"
    twin = np.asarray(subject.task.twin_floor)
    twinned = name == "position_rmse" and len(twin) == len(subject.frames)
    y = spanning([*(values for _, values in series), *([twin] if twinned else [])])
    if correlation:
        y = linear(min(0.0, _least(values for _, values in series)), 1.0)
    plot = Plot(_frame_axis(subject), y, x_label="frame", y_label=quantity(metric))
    for row, _ in series:
        if row.entry is not None:
            plot.band(subject.frames, *_interval(row.scores[name]), row.kind)
    for row, values in reversed(series):
        plot.line(subject.frames, values, row.kind, row.name)
    items = [(row.kind, row.name) for row in rows]
    if twinned:
        plot.line(subject.frames, twin, "twin", "the solver after a nudge of 2^-20")
        items.append(("twin", "twin of the solver"))
    if correlation:
        plot.level(STABLE, f"stable above {STABLE}")
    return Figure(
        name=f"methods-{name.replace('_', '-')}",
        title=f"{words(metric.name, capital=True)} over frames",
        thesis=thesis,
        body=join([key(items), _chart(plot, metric, rows)]),
        caption=join(
            [
                f"{sentence(metric)} Mean over {len(subject.scenarios)} test scenarios; the bands are 95 %"
                " bootstrap intervals over scenarios. ",
                "Grey: floors that cost nothing.",
            ]
        ),
        data=_numbers(subject, [(row.name, values) for row, values in series], "method"),
    )


def _chart(plot: Plot, metric: Metric, rows: Sequence[Row]) -> Markup:
    names = ", ".join(row.name for row in rows)
    return plot.svg(f"{metric.name} over frames", f"{metric.summary}, one line each for {names}.")


def energy_curves(subject: Subject) -> Iterator[Figure]:
    """Yield kinetic energy: what is kept of it (Fig. 5.19), and its value (Fig. 5.28)."""
    first = subject.entries[0].card.submission
    kept = [(row, _mean(row.scores["energy_retention"])) for row in subject.rows]
    true = _mean(first["energy_retention_true"])
    yield _energy_figure(
        subject,
        "energy-kept",
        "Kinetic energy kept",
        "Fig. 5.19",
        [("truth", "truth", 100.0 * true)] + [(row.name, row.kind, 100.0 * values) for row, values in kept],
        "kinetic energy [% of the last given frame]",
        f"Kinetic energy relative to the last given frame, mean over {len(subject.scenarios)} test scenarios."
        " A surrogate that damps falls below the truth, one that blows up rises above it;"
        " more energy than the truth is no merit.",
    )
    scenario = subject.scenarios[0]
    yield _energy_figure(
        subject,
        "energy-raw",
        f"Kinetic energy, scenario {scenario}",
        "Fig. 5.28",
        [("truth", "truth", first["energy_true"].per_frame[0])]
        + [(e.name, e.kind, e.card.submission["energy_predicted"].per_frame[0]) for e in subject.entries],
        "kinetic energy [mass length²/frame²]",
        f"E = Σ m |u|² / 2 with u the displacement per frame, in scenario {scenario}.",
    )


def _energy_figure(
    subject: Subject,
    name: str,
    title: str,
    thesis: str,
    series: Sequence[tuple[str, str, Floats]],
    quantity: str,
    text: str,
) -> Figure:
    top = np.nanmax(series[0][2], initial=0.0)
    cut = [np.minimum(values, TOLERATED * top) if top > 0.0 else values for _, _, values in series]
    plot = Plot(_frame_axis(subject), spanning(cut, log=False), x_label="frame", y_label=quantity)
    for label, kind, values in reversed(series):
        plot.line(subject.frames, values, kind, label)
    beyond = any(np.any(values > TOLERATED * top) for _, _, values in series) and top > 0.0
    more = f" What exceeds {TOLERATED:g} times the truth's maximum is cut off." if beyond else ""
    names = ", ".join(label for label, _, _ in series)
    return Figure(
        name=name,
        title=title,
        thesis=thesis,
        body=join(
            [
                key([(kind, label) for label, kind, _ in series]),
                plot.svg(title, f"Kinetic energy over frames of {names}."),
            ]
        ),
        caption=join([text, more]),
        data=_numbers(subject, [(label, values) for label, _, values in series], "method"),
    )


def body_curves(subject: Subject) -> Iterator[Figure]:
    """Yield how elastic bodies keep their shape and hold together (section 4.8.2)."""
    for name in ("shape_error", "connectivity"):
        rows = [row for row in subject.rows if name in row.scores]
        if rows:
            yield _body_figure(subject, rows, name)


def _body_figure(subject: Subject, rows: Sequence[Row], name: str) -> Figure:
    metric = rows[0].scores[name].metric
    series = [(row.name, row.kind, _mean(row.scores[name])) for row in rows]
    true = rows[0].scores.get(f"{name}_true")
    if true is not None:
        series.insert(0, ("truth", "truth", _mean(true)))
    y = linear(0.0, 1.0) if name == "connectivity" else spanning([s for _, _, s in series], log=False)
    plot = Plot(_frame_axis(subject), y, x_label="frame", y_label=quantity(metric))
    for label, kind, values in reversed(series):
        plot.line(subject.frames, values, kind, label)
    return Figure(
        name=f"bodies-{name.replace('_', '-')}",
        title=f"{words(metric.name, capital=True)} of jelly and rope",
        thesis="section 4.8.2",
        body=join([key([(kind, label) for label, kind, _ in series]), _chart(plot, metric, rows)]),
        caption=join([f"{sentence(metric)} Mean over the scenarios with an elastic body."]),
        data=_numbers(subject, [(label, values) for label, _, values in series], "method"),
    )


def _frame_axis(subject: Subject) -> Scale:
    return linear(float(subject.frames[0]), float(subject.frames[-1]), count=6, tight=True)


def _mean(score: Score) -> Floats:
    """Return the mean over scenarios per frame, NaN where none has a value, shape [frame]."""
    known = np.isfinite(score.per_frame)
    count = known.sum(axis=0)
    total = np.where(known, score.per_frame, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _interval(score: Score) -> tuple[Floats, Floats]:
    """Return the 95 % bootstrap interval of the mean per frame."""
    bounds = np.array([bootstrap_interval(column) for column in score.per_frame.T])
    return bounds[:, 0], bounds[:, 1]


def _least(series: Iterator[Floats]) -> float:
    return float(min((np.min(s[np.isfinite(s)], initial=0.0) for s in series), default=0.0))


def _numbers(subject: Subject, series: Sequence[tuple[str, Floats]], what: str) -> Markup:
    """Return the values at the frames of interest and the last one."""
    frames = sorted({*subject.frames_of_interest, int(subject.frames[-1])})
    column = {int(frame): i for i, frame in enumerate(subject.frames)}
    rows = [[name, *(html(values[column[frame]]) for frame in frames)] for name, values in series]
    return table([what, *(tag("span", f"frame {frame}") for frame in frames)], rows, label="Numbers")


SHOWN = (
    ("vorticity_pearson", "Correlation of vorticity", "Fig. 5.13"),
    ("vorticity_kl", "KL divergence of vorticity", "Fig. 5.16"),
    ("vorticity_w1", "Distance of vorticity distributions", "Fig. 5.16"),
)


def bar_figures(subject: Subject) -> Iterator[Figure]:
    """Yield one figure per metric that is defined in this split."""
    for name, title, thesis in SHOWN:
        rows = [row for row in subject.rows if name in row.scores]
        if rows:
            yield _figure(subject, rows, name, title, thesis)


def _figure(subject: Subject, rows: list[Row], name: str, title: str, thesis: str) -> Figure:
    frame = subject.key_frame
    metric = rows[0].scores[name].metric
    ordered = sorted(rows, key=lambda row: _loss(metric, mean(row.scores[name].at(frame))))
    best = next((row for row in ordered if row.entry is not None), None)
    bars = [_bar(row, name, frame, best=row is best and len(subject.entries) > 1) for row in ordered]
    unknown = [np.nan] * len(subject.scenarios)  # of shipped floors the mean is kept
    drawn = bar_chart(
        bars,
        _scale(metric, bars),
        quantity(metric),
        f"{title} at frame {frame}",
        "; ".join(f"{bar.label}: {bar.written}" for bar in bars),
    )
    better = "Higher is better" if metric.direction is Direction.HIGHER else "Lower is better"
    return Figure(
        name=f"bars-{name.replace('_', '-')}",
        title=f"{title} at frame {frame}",
        thesis=thesis,
        body=drawn,
        caption=join(
            [
                f"{sentence(metric)} Mean over {len(subject.scenarios)} test scenarios at frame {frame},"
                f" dots are the scenarios of entries. {better};"
                f" perfect is {metric.perfect:g}. A dash means undefined, as for a prediction at rest."
            ]
        ),
        data=table(
            ["method", "mean", *(f"scenario {i}" for i in subject.scenarios)],
            [
                [row.name, html(bar.value), *(html(v) for v in bar.dots or unknown)]
                for row, bar in zip(ordered, bars, strict=True)
            ],
            label=title,
        ),
    )


def _loss(metric: Metric, value: float) -> float:
    return float(np.nan_to_num(metric.loss(value), nan=np.inf))


def _bar(row: Row, name: str, frame: int, *, best: bool) -> Bar:
    values = row.scores[name].at(frame)
    middle = mean(values)
    return Bar(
        label=clipped(row.name),
        value=middle,
        written=text(middle),
        dots=tuple(values.tolist()) if row.entry is not None else (),
        kind=row.kind,
        bold=best,
    )


def _scale(metric: Metric, bars: list[Bar]) -> Scale:
    values = [value for bar in bars for value in (bar.value, *bar.dots) if np.isfinite(value)]
    if metric.direction is Direction.HIGHER:
        return linear(min(0.0, *values, 0.0), 1.0)
    return spanning([np.array(values)], log=False)
