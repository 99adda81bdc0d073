"""Accuracy against cost: what a frame costs, and how wrong it is, of entries, floors
and the solver.

Both axes are logarithmic. Costs of floors and solver are processor time on one core of
the machine that measured the floors; an entry's own time is brought there by its
speed-up over the solver, where it says one. Drawn without a script; dots are links or
can be focused, and say in words what they show.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from lagbench.data.registry import Size
from lagbench.errors import DataError
from lagbench.figures.chart import WIDTH, Plot, Spot, close_logarithmic
from lagbench.figures.html import Markup, tag, text, words
from lagbench.metrics.table import METRICS, ranking_metric
from lagbench.references.shipped import shipped, solver_seconds

from .model import Board, Tab

HEIGHT = 330

COARSE = "coarse-solver"

# the axis of time reaches so many times the dearest, so that its name has a place
# beside it
NAME_ROOM = 8.0

STYLE = """
.chart{background:#fff;font-family:system-ui,sans-serif}.chart text{font-size:12px;fill:#1c2330}
.chart .tick,.chart .note{fill:#667085;font-size:11.5px}.grid{stroke:#e4e7ec}.axis,.mark{stroke:#98a2b3}
.level{stroke:#98a2b3;stroke-dasharray:5 4}.front{fill:none;stroke:#2458d3;stroke-dasharray:4 4}
.end{text-anchor:end}.middle{text-anchor:middle}.dot circle{fill:#fff;stroke:#2458d3;stroke-width:1.8}
.dot.best circle{fill:#2458d3}.dot.floor circle{stroke:#667085}.dot.coarse circle{fill:#667085;stroke:#667085}
.dot .reach,.dot.best .reach,.dot.coarse .reach,.dot.floor .reach{fill:none;stroke:none}
.name{paint-order:stroke;stroke:#fff;stroke-width:4px}
"""
"""Colours of a picture on its own; on the page the style sheets have them."""


@dataclass(frozen=True, kw_only=True)
class Mark:
    """What stands in the figure."""

    name: str
    seconds: float  # processor time of a frame [s]
    error: float  # ranking metric
    kind: str  # "entry", "floor" or "coarse", the coarse solver
    href: str | None = None


def marks_of(tab: Tab) -> list[Mark]:
    """Return active entries that say what they cost, then floors; what has no place is
    left out.
    """
    solver = tab.solver_seconds
    marks = []
    for row in tab.rows:
        cost = row.entry.cost
        if row.active and cost is not None and tab.ranking in row.values:
            # on the machine that timed the solver, where that can be said
            own = cost.seconds_per_frame
            speed_up = cost.speed_up
            if solver is None or speed_up is None:
                seconds = own
            else:
                seconds = solver / speed_up
            href = f"#tab={tab.id}&entry={row.id}"
            error = row.values[tab.ranking].mean
            marks.append(
                Mark(
                    name=row.entry.name,
                    seconds=seconds,
                    error=error,
                    kind="entry",
                    href=href,
                )
            )
    marks += [
        _floor(floor.name, floor.cost.seconds_per_frame, floor.values[tab.ranking].mean)
        for floor in tab.floors
        if floor.cost is not None and tab.ranking in floor.values
    ]
    return [
        mark
        for mark in marks
        if 0.0 < mark.seconds < math.inf and 0.0 < mark.error < math.inf
    ]


def _floor(name: str, seconds: float, error: float) -> Mark:
    return Mark(
        name=name,
        seconds=seconds,
        error=error,
        kind="coarse" if name == COARSE else "floor",
    )


def front(marks: Iterable[Mark]) -> list[Mark]:
    """Return the marks that no other beats in both, from cheap to dear."""
    best = math.inf
    kept = []
    for mark in sorted(marks, key=lambda mark: (mark.seconds, mark.error)):
        if mark.error < best:
            best = mark.error
            kept.append(mark)
    return kept


def draw(
    marks: Sequence[Mark], solver: float | None, ranking: str, title: str
) -> Markup:
    """Return the figure of some marks, at least one."""
    reach = [mark.seconds for mark in marks] + ([solver] if solver else [])
    errors = [mark.error for mark in marks]
    if ranking in METRICS:
        unit = METRICS[ranking].unit
    else:
        unit = "1"
    plot = Plot(
        close_logarithmic(min(reach), NAME_ROOM * max(reach)),
        close_logarithmic(min(errors), max(errors)),
        x_label="time of a frame [s]",
        y_label=words(ranking) + ("" if unit == "1" else f" [{unit}]"),
        height=HEIGHT,
    )
    if solver:
        plot.upright(solver, "the solver itself")
    best = front(marks)
    plot.line(
        [mark.seconds for mark in best], [mark.error for mark in best], "front"
    )
    told = {
        "entry": "",
        "floor": ", a floor",
        "coarse": ", the solver on a coarser grid",
    }
    plot.spots(
        [
            Spot(
                x=mark.seconds,
                y=mark.error,
                name=mark.name,
                description=f"{mark.name}{told[mark.kind]}: {text(mark.seconds)} s per frame,"
                f" {words(ranking)} {text(mark.error)}",
                kind=f"{mark.kind} best"
                if mark in best and mark.kind == "entry"
                else mark.kind,
                href=mark.href,
            )
            for mark in marks
        ]
    )
    if solver:
        beside = f"; the solver itself takes {text(solver)} s per frame"
    else:
        beside = ""
    return plot.svg(
        title, f"{len(marks)} methods by processor time and {words(ranking)}{beside}."
    )


def cost_figure(tab: Tab) -> Markup:
    """Return the figure of a tab as it stands on the page."""
    marks = marks_of(tab)
    without = sum(row.active and row.entry.cost is None for row in tab.rows)
    said = (
        "Further left is cheaper, further down more accurate; the line joins those "
        "that no other beats in"
        " both. The upright line is what the solver itself takes."
        " Costs of entries are self-reported, brought to the machine of the solver by "
        "their speed-up."
    )
    if any(mark.kind == "coarse" for mark in marks):
        said += " Filled grey is the solver on a coarser grid."
    if without:
        said += f" {without} {'entry says' if without == 1 else 'entries say'} nothing about cost."
    title = "Accuracy against cost"
    if marks:
        body = draw(marks, tab.solver_seconds, tab.ranking, title)
    else:
        body = tag("p", "No costs are known.")
    head = tag("div", tag("h3", title), class_="figure-head")
    foot = tag("figcaption", tag("p", said))
    return tag("figure", head, body, foot, class_="figure", data_figure="cost")


def picture(board: Board, size: Size) -> str:
    """Return the figure of a data set as an SVG file of its own; without entries, that
    of the floors.
    """
    tab = next(
        (tab for tab in board.tabs if tab.id == f"{size.split}-{size.name}"), None
    )
    ranking = ranking_metric(size)
    solver = solver_seconds(size)
    if tab is not None:
        marks = [replace(mark, href=None) for mark in marks_of(tab)]
        ranking = tab.ranking
    else:
        known = shipped(size) or {}
        marks = [
            _floor(n, held.seconds_per_frame, held.scores[ranking].mean)
            for n, held in known.items()
        ]
    if not marks:
        what = "nothing to draw: neither entries nor floors with a cost"
        where = f"{size.split} {size.name}"
        raise DataError(
            what, where=where, fix="`lagbench predict` labels what a frame takes"
        )
    drawn = draw(
        marks, solver, ranking, f"{size.split} {size.name}: accuracy against cost"
    )
    box = {"viewBox": f"0 0 {WIDTH} {HEIGHT}", "width": 2 * WIDTH, "height": 2 * HEIGHT}
    return f"{tag('svg', tag('style', STYLE), drawn, xmlns='http://www.w3.org/2000/svg', **box)}\n"
