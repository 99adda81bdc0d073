"""Accuracy against cost: time of a frame and error of entries, references, simulator.

Both axes are logarithmic. Times of reference predictors and simulator are those of the
tab: processor times on one core. The time of an entry that comes from elsewhere is
converted by its speed-up over the simulator, where one is known. The figure needs no
script; dots are links or can be focused, and say in words what they show.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from lagbench.data.registry import Size
from lagbench.errors import DataError
from lagbench.figures.chart import (
    WIDTH,
    KeyItem,
    Plot,
    Spot,
    close_logarithmic,
    key_height,
)
from lagbench.figures.html import Markup, tag
from lagbench.figures.numbers import text, words
from lagbench.metrics.table import METRICS, ranking_metric
from lagbench.references.shipped import shipped, solver_seconds
from lagbench.references.table import REFERENCES

from .columns import cost_of
from .entry import EntryCost
from .model import Board, Tab

HEIGHT = 400  # of the chart without its key [pixel]

# The axis of time reaches so many times the dearest, so that its name has a place
# beside it.
NAME_ROOM = 40.0

STYLE = """
.chart{background:#fff;font-family:system-ui,sans-serif}
.chart text{font-size:12px;fill:#1c2330}
.chart .tick,.chart .note{fill:#667085;font-size:11.5px}
.grid{stroke:#e4e7ec}
.axis,.mark{stroke:#98a2b3}
.level{stroke:#98a2b3;stroke-dasharray:5 4}
.front{fill:none;stroke:#2458d3;stroke-dasharray:4 4}
.end{text-anchor:end}
.middle{text-anchor:middle}
.dot circle{stroke-width:1.8}
.dot.learned circle{fill:#2458d3;stroke:#fff}
.dot.hybrid circle{fill:#c2410c;stroke:#fff}
.dot.classical circle{fill:#667085;stroke:#fff}
.dot.naive circle{fill:#fff;stroke:#667085}
.dot.best circle{stroke:#1c2330}
.classical-front{fill:none;stroke:#667085;stroke-width:1.5}
.dot circle.reach{fill:none;stroke:none}
.name{paint-order:stroke;stroke:#fff;stroke-width:4px}
"""
"""Colours of a picture on its own; on the page the style sheets have them."""

DESCRIPTIONS = {
    "learned": ", a learned model",
    "hybrid": ", a hybrid",
    "naive": ", a naive predictor",
    "classical": ", a classical solver",
}

# kinds of methods at the left, lines and what lies on them at the right
KEY = (
    KeyItem("dot learned", "learned model"),
    KeyItem("line front", "no faster method is as accurate"),
    KeyItem("dot hybrid", "hybrid"),
    KeyItem("dot naive best", "dark rim: on the dashed line"),
    KeyItem("dot classical", "classical solver"),
    KeyItem("line classical-front", "no faster solver is as accurate"),
    KeyItem("dot naive", "naive predictor"),
)


@dataclass(frozen=True, kw_only=True)
class CostPoint:
    """A dot of the figure."""

    name: str
    seconds: float  # processor time of a frame [s]
    error: float  # ranking metric
    kind: str  # "learned", "hybrid", "classical" or "naive"
    href: str | None = None

    @property
    def is_drawable(self) -> bool:
        """Whether it has a place on logarithmic axes."""
        return 0.0 < self.seconds < math.inf and 0.0 < self.error < math.inf


def points_of(tab: Tab) -> list[CostPoint]:
    """Return active entries of known cost, then reference predictors."""
    points = []
    for row in tab.rows:
        cost = cost_of(row)
        if not row.active or cost is None or tab.ranking not in row.values:
            continue
        point = CostPoint(
            name=row.entry.name,
            seconds=_seconds_here(cost, tab.solver_seconds),
            error=row.values[tab.ranking].mean,
            kind=str(row.entry.kind),
            href=f"#tab={tab.id}&entry={row.id}",
        )
        points.append(point)
    for reference in tab.references:
        if reference.cost is not None and tab.ranking in reference.values:
            point = CostPoint(
                name=reference.name,
                seconds=reference.cost.seconds_per_frame,
                error=reference.values[tab.ranking].mean,
                kind=str(reference.kind),
            )
            points.append(point)
    return _drawable(points)


def _drawable(points: Iterable[CostPoint]) -> list[CostPoint]:
    """Return the points that have a place on logarithmic axes."""
    drawable_points = []
    for point in points:
        if point.is_drawable:
            drawable_points.append(point)
    return drawable_points


def _seconds_here(cost: EntryCost, solver_seconds_here: float | None) -> float:
    """Return the time of a frame where the solver has this time [s], if known."""
    if solver_seconds_here is None or cost.speed_up is None:
        return cost.seconds_per_frame
    return solver_seconds_here / cost.speed_up


def find_front(points: Iterable[CostPoint]) -> list[CostPoint]:
    """Return the points that are more accurate than all others that cost no more.

    They are in the order of their cost; of equal points the first one is returned.
    """
    least_error = math.inf
    front = []
    for point in sorted(points, key=lambda point: (point.seconds, point.error)):
        if point.error < least_error:
            least_error = point.error
            front.append(point)
    return front


def draw(
    points: Sequence[CostPoint], solver: float | None, ranking: str, title: str
) -> Markup:
    """Return the figure of some points, at least one.

    Args:
        points: the points.
        solver: time of a frame of the solver [s], where it is known.
        ranking: name of the ranking metric.
        title: title of the figure.
    """
    times = []
    errors = []
    for point in points:
        times.append(point.seconds)
        errors.append(point.error)
    if solver:
        times.append(solver)
    plot = Plot(
        close_logarithmic(min(times), NAME_ROOM * max(times)),
        close_logarithmic(min(errors), max(errors)),
        x_label="time of a frame [s]",
        y_label=_label_of(ranking),
        height=HEIGHT,
        key=KEY,
    )
    if solver:
        plot.upright(solver, "the simulator")
    front = find_front(points)
    front_times = [point.seconds for point in front]
    front_errors = [point.error for point in front]
    plot.line(front_times, front_errors, "front", is_free=True)
    solvers = find_front(point for point in points if point.kind == "classical")
    solver_times = [point.seconds for point in solvers]
    solver_errors = [point.error for point in solvers]
    plot.line(solver_times, solver_errors, "classical-front", is_free=True)
    spots = []
    for point in _by_need_of_label(points, front):
        spots.append(_spot_of(point, ranking, is_best=point in front))
    plot.spots(spots, joined=True)

    description = f"{len(points)} methods by processor time and {words(ranking)}"
    if solver:
        description += f"; the simulator takes {text(solver)} s per frame"
    return plot.svg(title, f"{description}.")


def _by_need_of_label(
    points: Sequence[CostPoint], front: Sequence[CostPoint]
) -> list[CostPoint]:
    """Return the best points, then the untrained predictors, then the others."""
    untrained = []
    others = []
    for point in points:
        if point in front:
            continue
        if point.kind in ("classical", "naive"):
            untrained.append(point)
        else:
            others.append(point)
    return [*front, *untrained, *others]


def _label_of(ranking: str) -> str:
    if ranking not in METRICS or METRICS[ranking].unit == "1":
        return words(ranking)
    return f"{words(ranking)} [{METRICS[ranking].unit}]"


def _spot_of(point: CostPoint, ranking: str, *, is_best: bool) -> Spot:
    description = (
        f"{point.name}{DESCRIPTIONS[point.kind]}: {text(point.seconds)} s per frame, "
        f"{words(ranking)} {text(point.error)}"
    )
    kind = point.kind
    if is_best:
        kind += " best"
    return Spot(
        x=point.seconds,
        y=point.error,
        name=point.name,
        description=description,
        kind=kind,
        href=point.href,
    )


def cost_figure(tab: Tab) -> Markup:
    """Return the figure of a tab as it stands on the page."""
    points = points_of(tab)
    caption = (
        "Further left is cheaper, further down more accurate. The dashed line joins "
        "the methods that are more accurate than every cheaper method. Their dots have "
        "a dark rim. The grey line joins the classical solvers that are more accurate "
        "than every cheaper one: an entry below it is more accurate than every solver "
        "that costs no more per frame. "
        "The upright line is the time of the simulator that made the data. If all "
        "measured entries were measured in one run, the figure has the times of this "
        "run, else those of the machine of the reference predictors. It converts "
        "other times by the simulator's time on both machines, if an entry states it. "
        "The table says which times are self-reported."
    )
    silent_count = sum(row.active and cost_of(row) is None for row in tab.rows)
    if silent_count == 1:
        caption += " 1 entry states no cost."
    elif silent_count:
        caption += f" {silent_count} entries state no cost."

    title = "Accuracy against cost"
    body = tag("p", "No costs are known.")
    if points:
        body = draw(points, tab.solver_seconds, tab.ranking, title)
    return tag(
        "figure",
        tag("div", tag("h3", title), class_="figure-head"),
        body,
        tag("figcaption", tag("p", caption)),
        class_="figure",
        data_figure="cost",
    )


def picture(board: Board, size: Size) -> str:
    """Return the figure of a data set as an SVG file of its own.

    A board without scored entries has no tab: then it shows reference predictors alone.

    Raises:
        DataError: neither entries nor reference predictors have a cost.
    """
    name = f"{size.split} {size.name}"
    tab = None
    for candidate in board.tabs:
        if candidate.id == f"{size.split}-{size.name}":
            tab = candidate
    if tab is None:
        ranking = ranking_metric(size)
        simulator = solver_seconds(size)
        points = _shipped_points(size, ranking)
    else:
        ranking = tab.ranking
        simulator = tab.solver_seconds
        points = []
        for point in points_of(tab):
            # In a file of its own the links of the page lead nowhere.
            points.append(replace(point, href=None))
    if not points:
        raise DataError(
            "nothing to draw: neither entries nor reference predictors with a cost",
            where=name,
            expected="a method that states what a frame costs",
            got="none",
            fix="state seconds_per_frame, as `lagbench predict` does",
        )

    drawing = draw(points, simulator, ranking, f"{name}: accuracy against cost")
    height = HEIGHT + key_height(KEY)
    svg = tag(
        "svg",
        tag("style", STYLE),
        drawing,
        xmlns="http://www.w3.org/2000/svg",
        viewBox=f"0 0 {WIDTH} {height}",
        width=2 * WIDTH,
        height=2 * height,
    )
    return f"{svg}\n"


def _shipped_points(size: Size, ranking: str) -> list[CostPoint]:
    points = []
    for name, reference in (shipped(size) or {}).items():
        point = CostPoint(
            name=name,
            seconds=reference.seconds_per_frame,
            error=reference.scores[ranking].mean,
            kind=str(REFERENCES[name].kind),
        )
        points.append(point)
    return _drawable(points)
