"""Bars at the key frame: correlation (Fig. 5.13), divergence (Fig. 5.16), distance."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lagbench.metrics import Direction, Metric
from lagbench.metrics.reductions import mean

from .chart import Bar, bar_chart
from .markup import join
from .numbers import html, text
from .page import Figure, table
from .scale import Scale, linear, spanning
from .subject import Row, Subject
from .wording import clipped, quantity, sentence

__all__ = ["bar_figures"]

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
                f" dots are the scenarios. {better};"
                f" perfect is {metric.perfect:g}. A dash means undefined, as for a prediction at rest."
            ]
        ),
        data=table(
            ["method", "mean", *(f"scenario {i}" for i in subject.scenarios)],
            [
                [row.name, html(bar.value), *(html(v) for v in bar.dots)]
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
        dots=tuple(values.tolist()),
        kind=row.kind,
        bold=best,
    )


def _scale(metric: Metric, bars: list[Bar]) -> Scale:
    values = [value for bar in bars for value in (bar.value, *bar.dots) if np.isfinite(value)]
    if metric.direction is Direction.HIGHER:
        return linear(min(0.0, *values, 0.0), 1.0)
    return spanning([np.array(values)], log=False)
