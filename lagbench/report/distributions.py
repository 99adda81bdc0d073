"""Histograms of vorticity, and the residuals node by node."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from lagbench.metrics.frame import FramePair

from .chart import Plot, Scale, linear
from .html import Markup, join, tag, text
from .page import Figure, key
from .subject import Gallery, Moment, Subject

__all__ = [
    "histogram_figures",
    "residual_figures",
]


Floats = NDArray[np.float64]

BINS = 40
FEWEST_BINS = 10

MOST_DOTS = 1600
"""Of more nodes evenly many are drawn."""

FAR_QUANTILE = 0.5
"""Axes leave out this share of the nodes at either end [%]."""


def histogram_figures(subject: Subject, gallery: Gallery) -> Iterator[Figure]:
    """Yield the distribution of vorticity at the key frame (5.12) and at several (5.18)."""
    scenario = subject.scenarios[0]
    items = [("truth", "truth"), *((entry.kind, entry.name) for entry in subject.entries)]
    moment = gallery.moments[scenario, subject.key_frame]
    yield Figure(
        name="histogram",
        title=f"Vorticity distribution at frame {subject.key_frame}",
        thesis="Fig. 5.12",
        body=join([key(items), _histogram(subject, moment)]),
        caption=join(
            [
                "Share of the grid nodes per bin of vorticity [1/frame], scenario"
                f" {scenario}. Black: the truth, whose range sets the bins; the first and the last bin hold"
                " all that lies beyond."
            ]
        ),
    )
    others = gallery.at(scenario, subject.histogram_frames)
    charts = [
        tag("div", tag("p", f"frame {held.frame}", class_="panels-title"), _histogram(subject, held))
        for held in others
    ]
    yield Figure(
        name="histograms",
        title="Vorticity distribution over time",
        thesis="Fig. 5.18",
        body=join([key(items), tag("div", *charts, class_="figures small")]),
        caption=join(
            [f"As the figure before, at other frames of scenario {scenario}; each frame has bins of its own."]
        ),
        wide=True,
    )


def _histogram(subject: Subject, moment: Moment) -> Markup:
    series = [("truth", "truth", moment.pairs[0].true_vorticity)]
    for entry, pair in zip(subject.entries, moment.pairs, strict=True):
        series.append((entry.name, entry.kind, pair.predicted_vorticity))
    edges = _edges(series[0][2])
    shares = [(name, kind, _shares(values, edges)) for name, kind, values in series]
    top = max((float(heights.max()) for _, _, heights in shares), default=1.0)
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
        f"Histograms of {', '.join(name for name, _, _ in shares)} in scenario {moment.scenario}.",
    )


def _edges(truth: Floats) -> Floats:
    """Return the edges of bins over the truth's range, few where there are few nodes."""
    bins = int(np.clip(2.0 * np.sqrt(max(truth.size, 1)), FEWEST_BINS, BINS))
    low, high = (float(truth.min()), float(truth.max())) if truth.size else (-1.0, 1.0)
    if not high > low:
        low, high = low - 1.0, high + 1.0
    return np.linspace(low, high, bins + 1)


def _shares(values: Floats, edges: Floats) -> Floats:
    """Return per cent of the values per bin; end bins are open."""
    place = np.searchsorted(edges[1:-1], values, side="right")
    count = np.bincount(place, minlength=len(edges) - 1)
    return 100.0 * count / max(1, values.size)


def residual_figures(subject: Subject, gallery: Gallery) -> Iterator[Figure]:
    """Yield residuals against the truth (5.14) and against the node's number (5.15)."""
    scenario = subject.scenarios[0]
    moment = gallery.moments[scenario, subject.key_frame]
    pairs = [pair for pair in moment.pairs if pair.node_count]
    if not pairs:
        return
    residuals = [pair.vorticity_residual for pair in pairs]
    y = _symmetric(residuals)
    x = _covering(pairs[0].true_vorticity)
    count = len(pairs[0].true_vorticity)
    drawn = f" {min(count, MOST_DOTS)} of {count} nodes are drawn." if count > MOST_DOTS else ""
    said = (
        f"Residual r = predicted − true vorticity [1/frame] at the grid nodes, scenario {scenario}, frame"
        f" {subject.key_frame}."
    )
    yield _residual_figure(
        subject,
        pairs,
        "residuals-truth",
        "Residual against true vorticity",
        "Fig. 5.14",
        f"{said} A cloud without slope around 0 is good; slope −1 means that no rotation is"
        f" predicted.{drawn}",
        (x, y),
        by_truth=True,
    )
    yield _residual_figure(
        subject,
        pairs,
        "residuals-node",
        "Residual against node number",
        "Fig. 5.15",
        f"{said} Nodes are numbered column by column from the lower left: clusters are places.{drawn}",
        (linear(0.0, float(pairs[0].nodes.size), tight=True), y),
        by_truth=False,
    )


def _residual_figure(
    subject: Subject,
    pairs: Sequence[FramePair],
    name: str,
    title: str,
    thesis: str,
    caption: str,
    scales: tuple[Scale, Scale],
    *,
    by_truth: bool,
) -> Figure:
    charts = []
    for entry, pair in zip(subject.entries, pairs, strict=False):
        x = pair.true_vorticity if by_truth else np.flatnonzero(pair.nodes).astype(np.float64)
        every = -(-len(x) // MOST_DOTS)
        label = "true vorticity [1/frame]" if by_truth else "node"
        plot = Plot(*scales, x_label=label, y_label="residual [1/frame]", height=230)
        plot.dots(x[::every], pair.vorticity_residual[::every], entry.kind)
        plot.level(0.0, "")
        spread = text(float(np.sqrt(np.mean(pair.vorticity_residual**2))))
        drawn = plot.svg(f"{title}, {entry.name}", f"{len(x)} nodes, RMS residual {spread} per frame.")
        rms = tag("span", f"RMS {spread}", class_="muted n")
        heading = tag("p", entry.name, "  ", rms, class_="panels-title")
        charts.append(tag("div", heading, drawn))
    return Figure(
        name=name,
        title=title,
        thesis=thesis,
        body=tag("div", *charts, class_="figures small"),
        caption=join([caption]),
        wide=len(charts) > 1,
    )


def _covering(values: Floats) -> Scale:
    low, high = np.percentile(values, [FAR_QUANTILE, 100.0 - FAR_QUANTILE])
    room = 0.05 * (high - low)
    return linear(float(low - room), float(high + room), tight=True)


def _symmetric(residuals: Sequence[Floats]) -> Scale:
    """Return an axis around 0 for all but the farthest residuals."""
    reach = max(float(np.percentile(np.abs(r), 100.0 - FAR_QUANTILE)) for r in residuals)
    reach = reach if np.isfinite(reach) and 0.0 < reach < 1e300 else 1.0
    return linear(-reach, reach)
