"""Curves over frames, of scenarios and of methods; bars, histograms and residuals at
the key frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from lagbench.metrics.aggregate import (
    FEWEST_FOR_INTERVAL,
    Score,
    bootstrap_interval,
    mean_over_seeds,
)
from lagbench.metrics.metric import Direction, mean
from lagbench.metrics.vorticity import STABLE_PEARSON

from .chart import Bar, Plot, Scale, bar_chart, linear, spanning
from .html import (
    Figure,
    Markup,
    clipped,
    html,
    join,
    key,
    quantity,
    sentence,
    table,
    tag,
    text,
    words,
)
from .subject import Gallery, Moment, Subject, kind_of

Floats = NDArray[np.float64]

# label, classes and values over frames of each line
Series = Sequence[tuple[str, str, Floats]]
# the axis of energies reaches so many times the truth's greatest; what is beyond is cut
# off
TOLERATED = 3.0


def error_curves(subject: Subject) -> Iterator[Figure]:
    """Yield the error over frames for all test scenarios, two figures per entry (Fig.
    5.10).
    """
    several = len(subject.entries) > 1
    if several:
        shared = " The axis is shared by all files."
    else:
        shared = ""
    first = subject.frames[0]
    last = subject.frames[-1]
    for entry in subject.entries:
        for name in (
            "vorticity_mse" if subject.full_box else "attribute_mse",
            "position_rmse",
        ):
            score = entry.card.submission.get(name)
            if score is None:
                continue
            y = spanning(
                [other.card.submission[name].per_frame for other in subject.entries]
            )
            scenarios = enumerate(zip(score.scenarios, score.per_frame, strict=True))
            series = [
                (f"scenario {number}", kind_of(i), values)
                for i, (number, values) in scenarios
            ]
            plot = Plot(
                _frame_axis(subject), y, x_label="frame", y_label=quantity(score.metric)
            )
            for label, kind, values in series:
                plot.line(subject.frames, values, kind, label)
            said = f"Lines of {len(series)} test scenarios of {entry.name} from frame {first} to {last}."
            yield _figure(
                subject,
                f"scenarios-{name.replace('_', '-')}-{entry.number}",
                f"{words(name, capital=True)}, every test scenario"
                + (f": {entry.name}" if several else ""),
                "Fig. 5.10",
                series,
                plot.svg(f"{score.metric.name} over frames", said),
                f"{sentence(score.metric)} One line per test scenario.{shared}",
                what="scenario",
            )


def method_curves(subject: Subject) -> Iterator[Figure]:
    """Yield the methods side by side: mean over scenarios with its interval (Fig.
    5.11).
    """
    said = f"Mean over {len(subject.scenarios)} test scenarios"
    if len(subject.scenarios) >= FEWEST_FOR_INTERVAL:
        said += "; the bands are 95 % bootstrap intervals over scenarios"
    said += ". Grey: floors that cost nothing."
    for name, thesis in (
        ("vorticity_mse" if subject.full_box else "attribute_mse", "Fig. 5.11"),
        ("position_rmse", "Fig. 5.11"),
        ("velocity_rmse", "Fig. 5.11"),
        ("vorticity_pearson", "Fig. 5.13"),
    ):
        yield from _by_method(subject, name, "methods", "over frames", thesis, said)


def body_curves(subject: Subject) -> Iterator[Figure]:
    """Yield how elastic bodies keep their shape and hold together (section 4.8.2)."""
    said = "Mean over the scenarios with an elastic body."
    for name in ("shape_error", "connectivity"):
        yield from _by_method(
            subject, name, "bodies", "of jelly and rope", "section 4.8.2", said
        )


def _by_method(
    subject: Subject, name: str, part: str, of: str, thesis: str, said: str
) -> Iterator[Figure]:
    """Yield the mean over scenarios of a metric, a line per method, where methods have
    it.
    """
    rows = [row for row in subject.rows if name in row.scores]
    bodies = part == "bodies"
    if not rows:
        return
    metric = rows[0].scores[name].metric
    series = [(row.name, row.kind, _mean(row.scores[name])) for row in rows]
    if (true := rows[0].scores.get(f"{name}_true")) is not None:
        series.insert(0, ("truth", "truth", _mean(true)))
    twin = np.asarray(subject.task.predictability_limit if name == "position_rmse" else ())
    twinned = len(twin) == len(subject.frames)
    drawn = [*(values for _, _, values in series), *([twin] if twinned else [])]
    if name == "connectivity":
        y = linear(0.0, 1.0)
    else:
        y = spanning(drawn, log=False if bodies else None)
    if name == "vorticity_pearson":
        y = linear(
            min(float(np.min(line[np.isfinite(line)], initial=0.0)) for line in drawn),
            1.0,
        )
    plot = Plot(_frame_axis(subject), y, x_label="frame", y_label=quantity(metric))
    for row in rows:
        if row.entry is not None and not bodies:
            low, high = np.array(
                [*map(bootstrap_interval, row.scores[name].per_frame.T)]
            ).T
            plot.band(subject.frames, low, high, row.kind)
    _draw(subject, plot, series)
    if twinned:
        plot.line(subject.frames, twin, "twin", "the solver after a nudge of 2^-20")
    if name == "vorticity_pearson":
        plot.level(STABLE_PEARSON, f"stable above {STABLE_PEARSON}")
    methods = ", ".join(row.name for row in rows)
    yield _figure(
        subject,
        f"{part}-{name.replace('_', '-')}",
        f"{words(name, capital=True)} {of}",
        thesis,
        series,
        plot.svg(
            f"{name} over frames", f"{metric.summary}, one line each for {methods}."
        ),
        f"{sentence(metric)} {said}",
        more=[("twin", "twin of the solver")] if twinned else [],
    )


def energy_curves(subject: Subject) -> Iterator[Figure]:
    """Yield kinetic energy: what is kept of it (Fig. 5.19), and its value (Fig.
    5.28).
    """
    first = subject.entries[0].card.submission
    scenario = subject.scenarios[0]
    true = ("truth", "truth", 100.0 * _mean(first["energy_retention_true"]))
    yield _energy_figure(
        subject,
        "energy-kept",
        "Kinetic energy kept",
        "Fig. 5.19",
        [
            true,
            *(
                (r.name, r.kind, 100.0 * _mean(r.scores["energy_retention"]))
                for r in subject.rows
            ),
        ],
        "kinetic energy [% of the last given frame]",
        f"Kinetic energy relative to the last given frame, mean over "
        f"{len(subject.scenarios)} test scenarios."
        " A surrogate that damps falls below the truth, one that blows up rises "
        "above it;"
        " more energy than the truth is no merit.",
    )
    raw = [
        (e.name, e.kind, e.card.submission["energy_predicted"].per_frame[0])
        for e in subject.entries
    ]
    yield _energy_figure(
        subject,
        "energy-raw",
        f"Kinetic energy, scenario {scenario}",
        "Fig. 5.28",
        [("truth", "truth", first["energy_true"].per_frame[0]), *raw],
        "kinetic energy [mass length²/frame²]",
        f"E = Σ m |u|² / 2 with u the displacement per frame, in scenario {scenario}.",
    )


def _energy_figure(
    subject: Subject,
    name: str,
    title: str,
    thesis: str,
    series: Series,
    label: str,
    said: str,
) -> Figure:
    top = np.nanmax(series[0][2], initial=0.0)
    cut = [
        np.minimum(values, TOLERATED * top) if top > 0.0 else values
        for _, _, values in series
    ]
    plot = Plot(
        _frame_axis(subject), spanning(cut, log=False), x_label="frame", y_label=label
    )
    _draw(subject, plot, series)
    beyond = (
        any(np.any(values > TOLERATED * top) for _, _, values in series) and top > 0.0
    )
    if beyond:
        more = f" What exceeds {TOLERATED:g} times the truth's maximum is cut off."
    else:
        more = ""
    drawn = plot.svg(
        title,
        f"Kinetic energy over frames of "
        f"{', '.join(method for method, _, _ in series)}.",
    )
    return _figure(subject, name, title, thesis, series, drawn, said + more)


def _draw(subject: Subject, plot: Plot, series: Series) -> None:
    """Draw lines, the first on top."""
    for label, kind, values in reversed(series):
        plot.line(subject.frames, values, kind, label)


def _figure(
    subject: Subject,
    name: str,
    title: str,
    thesis: str,
    series: Series,
    drawn: Markup,
    caption: str,
    *,
    more: Sequence[tuple[str, str]] = (),
    what: str = "method",
) -> Figure:
    """Return a chart of lines with its key, and their values at the frames of interest
    and the last one.
    """
    frames = sorted({*subject.frames_of_interest, int(subject.frames[-1])})
    column = {int(frame): i for i, frame in enumerate(subject.frames)}
    rows = [
        [label, *(html(values[column[frame]]) for frame in frames)]
        for label, _, values in series
    ]
    return Figure(
        name=name,
        title=title,
        thesis=thesis,
        body=join([key([*((kind, label) for label, kind, _ in series), *more]), drawn]),
        caption=caption,
        data=table(
            [what, *(tag("span", f"frame {frame}") for frame in frames)],
            rows,
            label="Numbers",
        ),
    )


def _frame_axis(subject: Subject) -> Scale:
    return linear(
        float(subject.frames[0]), float(subject.frames[-1]), count=6, tight=True
    )


def _mean(score: Score) -> Floats:
    return mean_over_seeds(
        np.where(np.isfinite(score.per_frame), score.per_frame, np.nan)
    )


SHOWN = (
    ("vorticity_pearson", "Correlation of vorticity", "Fig. 5.13"),
    ("vorticity_kl", "KL divergence of vorticity", "Fig. 5.16"),
    ("vorticity_w1", "Distance of vorticity distributions", "Fig. 5.16"),
)


def bar_figures(subject: Subject) -> Iterator[Figure]:
    """Yield one figure per metric that is defined in this split."""
    frame = subject.key_frame
    unknown = [np.nan] * len(subject.scenarios)  # of shipped floors the mean is kept
    for name, title, thesis in SHOWN:
        rows = [row for row in subject.rows if name in row.scores]
        if not rows:
            continue
        metric = rows[0].scores[name].metric
        values = {row.name: row.scores[name].at(frame) for row in rows}
        rows.sort(
            key=lambda row: float(
                np.nan_to_num(metric.loss(mean(values[row.name])), nan=np.inf)
            )
        )
        best = next((row for row in rows if row.entry is not None), None)
        bars = [
            Bar(
                label=clipped(row.name),
                value=mean(values[row.name]),
                written=text(mean(values[row.name])),
                dots=tuple(values[row.name].tolist()) if row.entry is not None else (),
                kind=row.kind,
                bold=row is best and len(subject.entries) > 1,
            )
            for row in rows
        ]
        known = [
            value
            for bar in bars
            for value in (bar.value, *bar.dots)
            if np.isfinite(value)
        ]
        higher = metric.direction is Direction.HIGHER
        if higher:
            scale = linear(min(0.0, *known, 0.0), 1.0)
        else:
            scale = spanning([np.array(known)], log=False)
        whole = f"{title} at frame {frame}"
        said = "; ".join(f"{bar.label}: {bar.written}" for bar in bars)
        cells = [
            [row.name, *map(html, (bar.value, *(bar.dots or unknown)))]
            for row, bar in zip(rows, bars, strict=True)
        ]
        yield Figure(
            name=f"bars-{name.replace('_', '-')}",
            title=whole,
            thesis=thesis,
            body=bar_chart(bars, scale, quantity(metric), whole, said),
            caption=f"{sentence(metric)} Mean over {len(subject.scenarios)} test "
            f"scenarios at frame {frame},"
            f" dots are the scenarios of entries. {'Higher' if higher else 'Lower'} "
            f"is better;"
            f" perfect is {metric.perfect:g}. A dash means undefined, as for a "
            f"prediction at rest.",
            data=table(
                ["method", "mean", *(f"scenario {i}" for i in subject.scenarios)],
                cells,
                label=title,
            ),
        )


BINS = 40
FEWEST_BINS = 10

MOST_DOTS = 1600  # Of more nodes evenly many are drawn
FAR_QUANTILE = 0.5  # axes leave out this share of the nodes at either end [%]


def histogram_figures(subject: Subject, gallery: Gallery) -> Iterator[Figure]:
    """Yield the distribution of vorticity at the key frame (5.12) and at several
    (5.18).
    """
    scenario = subject.scenarios[0]
    items = [
        ("truth", "truth"),
        *((entry.kind, entry.name) for entry in subject.entries),
    ]
    moment = gallery.moments[scenario, subject.key_frame]
    yield Figure(
        name="histogram",
        title=f"Vorticity distribution at frame {subject.key_frame}",
        thesis="Fig. 5.12",
        body=join([key(items), _histogram(subject, moment)]),
        caption=f"Share of the grid nodes per bin of vorticity [1/frame], scenario "
        f"{scenario}. Black: the"
        " truth, whose range sets the bins; the first and the last bin hold all that "
        "lies beyond.",
    )
    charts = [
        tag(
            "div",
            tag("p", f"frame {held.frame}", class_="panels-title"),
            _histogram(subject, held),
        )
        for held in gallery.at(scenario, subject.histogram_frames)
    ]
    yield Figure(
        name="histograms",
        title="Vorticity distribution over time",
        thesis="Fig. 5.18",
        body=join([key(items), tag("div", *charts, class_="figures small")]),
        caption=f"As the figure before, at other frames of scenario {scenario}; each "
        f"frame has bins of its"
        " own.",
        wide=True,
    )


def _histogram(subject: Subject, moment: Moment) -> Markup:
    true = moment.pairs[0].true_vorticity
    edges, heights = shares_of(true, true)
    shares = [("truth", "truth", heights)]
    for entry, pair in zip(subject.entries, moment.pairs, strict=True):
        shares.append(
            (entry.name, entry.kind, shares_of(pair.predicted_vorticity, true)[1])
        )
    top = max(float(heights.max()) for _, _, heights in shares)
    plot = Plot(
        linear(float(edges[0]), float(edges[-1]), tight=True),
        linear(0.0, top),
        x_label="vorticity [1/frame]",
        y_label="share of nodes [%]",
        height=230,
    )
    for name, kind, heights in [*shares[1:], shares[0]]:
        plot.steps(edges, heights, kind, name)
    return plot.svg(
        f"Vorticity distribution at frame {moment.frame}",
        f"Histograms of {', '.join(name for name, _, _ in shares)} in scenario "
        f"{moment.scenario}.",
    )


def shares_of(values: Floats, truth: Floats) -> tuple[Floats, Floats]:
    """Return edges of bins over the truth's range, and per cent of the values in
    each.
    """
    # few where there are few nodes
    bins = int(np.clip(2.0 * np.sqrt(max(truth.size, 1)), FEWEST_BINS, BINS))
    low, high = (float(truth.min()), float(truth.max())) if truth.size else (-1.0, 1.0)
    if high > low:
        edges = np.linspace(low, high, bins + 1)
    else:
        edges = np.linspace(low - 1.0, high + 1.0, bins + 1)
    # the end bins are open
    count = np.bincount(
        np.searchsorted(edges[1:-1], values, side="right"), minlength=bins
    )
    return edges, 100.0 * count / max(1, values.size)


def residual_figures(subject: Subject, gallery: Gallery) -> Iterator[Figure]:
    """Yield residuals against the truth (5.14) and against the node's number (5.15)."""
    scenario = subject.scenarios[0]
    pairs = gallery.moments[scenario, subject.key_frame].pairs
    if not pairs[0].node_count:  # nodes are the truth's
        return
    # axes leave out the farthest nodes
    reach = float(
        max(
            np.percentile(np.abs(pair.vorticity_residual), 100.0 - FAR_QUANTILE)
            for pair in pairs
        )
    )
    if np.isfinite(reach) and 0.0 < reach < 1e300:
        reach = reach
    else:
        reach = 1.0
    y = linear(-reach, reach)
    true = pairs[0].true_vorticity
    low, high = np.percentile(true, [FAR_QUANTILE, 100.0 - FAR_QUANTILE])
    room = 0.05 * (high - low)
    by_truth = linear(float(low - room), float(high + room), tight=True)
    by_number = linear(0.0, float(pairs[0].nodes.size), tight=True)
    if len(true) > MOST_DOTS:
        drawn = f" {min(len(true), MOST_DOTS)} of {len(true)} nodes are drawn."
    else:
        drawn = ""
    said = (
        f"Residual r = predicted − true vorticity [1/frame] at the grid nodes, "
        f"scenario {scenario}, frame"
        f" {subject.key_frame}."
    )
    slope = "A cloud without slope around 0 is good; slope −1 means that no rotation is predicted."
    places = (
        "Nodes are numbered column by column from the lower left: clusters are places."
    )
    for name, against, thesis, axis, label, told in (
        (
            "truth",
            "true vorticity",
            "Fig. 5.14",
            by_truth,
            "true vorticity [1/frame]",
            slope,
        ),
        ("node", "node number", "Fig. 5.15", by_number, "node", places),
    ):
        title = f"Residual against {against}"
        charts = []
        for entry, pair in zip(subject.entries, pairs, strict=True):
            if name == "truth":
                x = pair.true_vorticity
            else:
                x = np.flatnonzero(pair.nodes).astype(np.float64)
            every = -(-len(x) // MOST_DOTS)
            plot = Plot(
                axis, y, x_label=label, y_label="residual [1/frame]", height=230
            )
            plot.dots(x[::every], pair.vorticity_residual[::every], entry.kind)
            plot.level(0.0, "")
            spread = text(float(np.sqrt(np.mean(pair.vorticity_residual**2))))
            rms = tag("span", f"RMS {spread}", class_="muted n")
            heading = tag("p", entry.name, "  ", rms, class_="panels-title")
            cloud = plot.svg(
                f"{title}, {entry.name}",
                f"{len(x)} nodes, RMS residual {spread} per frame.",
            )
            charts.append(tag("div", heading, cloud))
        yield Figure(
            name=f"residuals-{name}",
            title=title,
            thesis=thesis,
            body=tag("div", *charts, class_="figures small"),
            caption=f"{said} {told}{drawn}",
            wide=len(charts) > 1,
        )
