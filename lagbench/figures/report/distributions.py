"""Distributions at the key frame: bars, histograms and residuals of vorticity."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.figures.chart import (
    AxisScale,
    Bar,
    Plot,
    bar_chart,
    linear,
    spanning,
)
from lagbench.figures.html import (
    Markup,
    ReportFigure,
    draw_key,
    draw_table,
    format_quantity,
    join,
    sentence,
    tag,
    text,
    wrap_number,
)
from lagbench.metrics.frame import FramePair
from lagbench.metrics.metric import Direction, Metric, mean

from .subject import Gallery, Moment, ReportEntry, ReportRow, Subject

Floats = NDArray[np.float64]

BAR_FIGURES = (
    ("vorticity_pearson", "Correlation of vorticity", "Fig. 5.13"),
    ("vorticity_kl", "KL divergence of vorticity", "Fig. 5.16"),
    ("vorticity_w1", "Distance of vorticity distributions", "Fig. 5.16"),
)

MOST_BINS = 40
FEWEST_BINS = 10
BINS_PER_ROOT = 2.0  # bins per square root of the number of nodes

MOST_DOTS = 1600  # of more nodes evenly many are drawn
FAR_QUANTILE = 0.5  # axes leave out this share of the nodes at either end [%]
HUGE = 1e300  # values beyond are no numbers of a chart

SMALL_HEIGHT = 230  # of a chart beside others [pixel]


def bar_figures(subject: Subject) -> Iterator[ReportFigure]:
    """Yield one figure per metric that is defined in this split."""
    for name, title, thesis in BAR_FIGURES:
        rows = subject.rows_with(name)
        if rows:
            yield _bar_figure(subject, rows, name, title=title, thesis=thesis)


def _bar_figure(
    subject: Subject,
    rows: Sequence[ReportRow],
    name: str,
    *,
    title: str,
    thesis: str,
) -> ReportFigure:
    """Return a metric at the key frame, a bar per method from best to worst."""
    frame = subject.key_frame
    metric = rows[0].scores[name].metric
    bars = _sort_bars(subject, rows, name)

    if metric.direction is Direction.HIGHER:
        better = "Higher"
    else:
        better = "Lower"

    whole_title = f"{title} at frame {frame}"
    drawn = bar_chart(
        bars,
        _bar_axis(metric, bars),
        label=format_quantity(metric),
        title=whole_title,
        description="; ".join(f"{bar.label}: {bar.value_text}" for bar in bars),
    )
    return ReportFigure(
        name=f"bars-{name.replace('_', '-')}",
        title=whole_title,
        thesis=thesis,
        body=drawn,
        caption=f"{sentence(metric)} Mean over {len(subject.scenarios)} scenarios "
        f"at frame {frame}, dots are the scenarios of entries. {better} is better; "
        f"perfect is {metric.perfect:g}. A dash means undefined, as for a prediction "
        "at rest.",
        data=_bar_table(subject, bars, title),
    )


def _bar_axis(metric: Metric, bars: Sequence[Bar]) -> AxisScale:
    """Return an axis from 0, or from the lowest value of a metric whose best is 1."""
    numbers = []
    for bar in bars:
        numbers += [bar.value, *bar.dots]
    values = np.array(numbers)
    if metric.direction is Direction.HIGHER:
        lowest = np.min(values[np.isfinite(values)], initial=0.0)
        return linear(float(lowest), 1.0)
    return spanning([values], log=False)


def _sort_bars(subject: Subject, rows: Sequence[ReportRow], name: str) -> list[Bar]:
    """Return a bar per method, from best to worst; the best entry is bold."""
    metric = rows[0].scores[name].metric
    means = {}
    for row in rows:
        values = row.scores[name].at(subject.key_frame)
        means[row.name] = mean(values)

    def loss(row: ReportRow) -> float:
        return float(np.nan_to_num(metric.loss(means[row.name]), nan=np.inf))

    bars = []
    is_best_found = len(subject.entries) == 1  # a single entry is not bold
    for row in sorted(rows, key=loss):
        dots: tuple[float, ...] = ()
        is_best = False
        if row.entry is not None:
            dots = tuple(row.scores[name].at(subject.key_frame).tolist())
            is_best = not is_best_found
            is_best_found = True
        bar = Bar(
            label=row.name,
            value=means[row.name],
            value_text=text(means[row.name]),
            dots=dots,
            kind=row.kind,
            bold=is_best,
        )
        bars.append(bar)
    return bars


def _bar_table(subject: Subject, bars: Sequence[Bar], title: str) -> Markup:
    # of reference predictors only the mean is known
    unknown = [np.nan] * len(subject.scenarios)
    rows = []
    for bar in bars:
        scenario_values = bar.dots or unknown
        cells = map(wrap_number, scenario_values)
        rows.append([bar.label, wrap_number(bar.value), *cells])
    head = ["method", "mean"]
    for scenario in subject.scenarios:
        head.append(f"scenario {scenario}")
    return draw_table(head, rows, label=title)


def histogram_figure(subject: Subject, gallery: Gallery) -> ReportFigure:
    """Return the distribution of vorticity at the key frame (Fig. 5.12)."""
    scenario = subject.scenarios[0]
    moment = gallery.moments[scenario, subject.key_frame]
    values = "grid nodes"
    if subject.task.config.box.dimension == 3:
        values = "components of the vorticity at the grid nodes"
    return ReportFigure(
        name="histogram",
        title=f"Vorticity distribution at frame {subject.key_frame}",
        thesis="Fig. 5.12",
        body=join([_method_key(subject), _draw_histogram(subject, moment)]),
        caption=f"Share of the {values} per bin of vorticity [1/frame], scenario "
        f"{scenario}. The range of the truth sets the bins; the first and the last bin "
        "hold all that lies beyond.",
    )


def histograms_figure(subject: Subject, gallery: Gallery) -> ReportFigure:
    """Return the distribution of vorticity at several frames (Fig. 5.18)."""
    scenario = subject.scenarios[0]
    charts = []
    for moment in gallery.at(scenario, subject.histogram_frames):
        heading = tag("p", f"frame {moment.frame}", class_="panels-title")
        charts.append(tag("div", heading, _draw_histogram(subject, moment)))
    grid = tag("div", *charts, class_="figures small")
    return ReportFigure(
        name="histograms",
        title="Vorticity distribution over time",
        thesis="Fig. 5.18",
        body=join([_method_key(subject), grid]),
        caption=f"As the figure before, at other frames of scenario {scenario}; each "
        "frame has bins of its own.",
        wide=True,
    )


def _method_key(subject: Subject) -> Markup:
    items = [("truth", "truth")]
    for entry in subject.entries:
        items.append((entry.kind, entry.name))
    return draw_key(items)


def _draw_histogram(subject: Subject, moment: Moment) -> Markup:
    true_vorticity = moment.pairs[0].true_vorticity
    edges, true_shares = histogram_shares(true_vorticity, true_vorticity)
    lines = []
    for entry, pair in zip(subject.entries, moment.pairs, strict=True):
        _, shares = histogram_shares(pair.predicted_vorticity, true_vorticity)
        lines.append((entry.name, entry.kind, shares))
    lines.append(("truth", "truth", true_shares))  # on top

    all_shares = np.array([shares for _, _, shares in lines])
    plot = Plot(
        linear(float(edges[0]), float(edges[-1]), tight=True),
        linear(0.0, float(all_shares.max())),
        x_label="vorticity [1/frame]",
        y_label=f"share of {_name_values(moment.pairs[0])} [%]",
        height=SMALL_HEIGHT,
    )
    for name, kind, shares in lines:
        plot.steps(edges, shares, kind, name)
    names = ", ".join([*subject.names, "truth"])
    return plot.svg(
        f"Vorticity distribution at frame {moment.frame}",
        f"Histograms of {names} in scenario {moment.scenario}.",
    )


def histogram_shares(values: Floats, truth: Floats) -> tuple[Floats, Floats]:
    """Return edges of bins over the truth's range, and per cent of values in each.

    The first and the last bin hold all values beyond the truth's range.
    """
    # few bins where there are few nodes
    bin_count = BINS_PER_ROOT * np.sqrt(max(truth.size, 1))
    bin_count = int(np.clip(bin_count, FEWEST_BINS, MOST_BINS))
    low = -1.0
    high = 1.0
    if truth.size:
        low = float(truth.min())
        high = float(truth.max())
    if high <= low:
        low -= 1.0
        high += 1.0
    edges = np.linspace(low, high, bin_count + 1)
    bins = np.searchsorted(edges[1:-1], values, side="right")
    counts = np.bincount(bins, minlength=bin_count)
    return edges, 100.0 * counts / max(1, values.size)


@dataclass(frozen=True, kw_only=True)
class ResidualAxis:
    """What residuals are drawn against."""

    name: str  # part of the figure's identifier
    against: str
    thesis: str  # the figure of the thesis that it corresponds to
    axis: AxisScale
    label: str
    hint: str  # how to read the figure


def residual_figures(subject: Subject, gallery: Gallery) -> Iterator[ReportFigure]:
    """Yield residuals against the truth (5.14) and against the node's number (5.15)."""
    scenario = subject.scenarios[0]
    pairs = gallery.moments[scenario, subject.key_frame].pairs
    if not pairs[0].node_count:
        return
    y_axis = _residual_axis(pairs)
    for x_axis in _describe_axes(pairs[0]):
        title = f"Residual against {x_axis.against}"
        charts = []
        for entry, pair in zip(subject.entries, pairs, strict=True):
            chart = _draw_residuals(entry, pair, x_axis, y_axis, title=title)
            charts.append(chart)
        yield ReportFigure(
            name=f"residuals-{x_axis.name}",
            title=title,
            thesis=x_axis.thesis,
            body=tag("div", *charts, class_="figures small"),
            caption="Residual r = predicted − true vorticity [1/frame] at the grid "
            f"nodes, scenario {scenario}, frame {subject.key_frame}. {x_axis.hint}"
            f"{_omission_note(pairs[0])}",
            wide=len(charts) > 1,
        )


def _residual_axis(pairs: Sequence[FramePair]) -> AxisScale:
    """Return an axis for the residuals of all entries, without the farthest nodes."""
    reaches = []
    for pair in pairs:
        magnitudes = np.abs(pair.vorticity_residual)
        reaches.append(np.percentile(magnitudes, 100.0 - FAR_QUANTILE))
    reach = float(max(reaches))
    if not 0.0 < reach < HUGE:
        reach = 1.0
    return linear(-reach, reach)


def _describe_axes(pair: FramePair) -> list[ResidualAxis]:
    vorticity = pair.true_vorticity
    low, high = np.percentile(vorticity, [FAR_QUANTILE, 100.0 - FAR_QUANTILE])
    rim = 0.05 * (high - low)
    return [
        ResidualAxis(
            name="truth",
            against="true vorticity",
            thesis="Fig. 5.14",
            axis=linear(float(low - rim), float(high + rim), tight=True),
            label="true vorticity [1/frame]",
            hint="A cloud without slope around 0 is good; slope −1 means that no "
            "rotation is predicted.",
        ),
        ResidualAxis(
            name="node",
            against="node number",
            thesis="Fig. 5.15",
            axis=linear(0.0, float(pair.nodes.size), tight=True),
            label="node",
            hint="Nodes are numbered column by column from the lower left: clusters "
            "are places.",
        ),
    ]


def _draw_residuals(
    entry: ReportEntry,
    pair: FramePair,
    x_axis: ResidualAxis,
    y_axis: AxisScale,
    *,
    title: str,
) -> Markup:
    """Return the residuals of an entry as a cloud, with their root mean square."""
    residual = pair.vorticity_residual
    if x_axis.name == "truth":
        x = pair.true_vorticity
    else:
        x = np.flatnonzero(pair.nodes).astype(np.float64)
        # in three dimensions a node has three components
        x = np.repeat(x, len(residual) // max(1, len(x)))
    plot = Plot(
        x_axis.axis,
        y_axis,
        x_label=x_axis.label,
        y_label="residual [1/frame]",
        height=SMALL_HEIGHT,
    )
    step = -(-len(x) // MOST_DOTS)
    plot.dots(x[::step], residual[::step], entry.kind)
    plot.level(0.0, "")
    spread = text(float(np.sqrt(np.mean(residual**2))))
    label = tag("span", f"RMS {spread}", class_="muted n")
    heading = tag("p", entry.name, "  ", label, class_="panels-title")
    cloud = plot.svg(
        f"{title}, {entry.name}",
        f"{len(x)} {_name_values(pair)}, RMS residual {spread} per frame.",
    )
    return tag("div", heading, cloud)


def _name_values(pair: FramePair) -> str:
    """Return what the vorticities are counted in."""
    if len(pair.true_vorticity) == pair.node_count:
        return "nodes"
    return "components of the vorticity"  # in three dimensions


def _omission_note(pair: FramePair) -> str:
    count = len(pair.true_vorticity)
    step = -(-count // MOST_DOTS)
    if step <= 1:
        return ""
    drawn_count = len(range(0, count, step))
    return f" {drawn_count} of {count} {_name_values(pair)} are drawn."
