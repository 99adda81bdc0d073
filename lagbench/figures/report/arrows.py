"""Velocity arrows over time: truth, prediction and difference (Figs. 5.22 to 5.24)."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lagbench.data.grid import Fields
from lagbench.figures.html import (
    SIDE,
    Markup,
    ReportFigure,
    draw_line_panel,
    draw_panel_grid,
    draw_ramp,
    join,
    path_data,
    tag,
)

from .subject import Gallery, Moment, ReportEntry, Subject, limit_of

Floats = NDArray[np.float64]

LEVELS = 6
"""Colours of speed, classes ``q0`` to ``q5`` of the style sheet."""

MOST_ARROWS = 18  # across a panel
MOST_ENTRIES = 3  # entries that are drawn: arrows take room
LONGEST = 1.7  # arrow of the scale's top, in distances between arrows
MOST_TIMES_LIMIT = 1.5  # arrows of runaways are cut off at so many times the top
SHORTEST = 1.0  # shorter arrows are dots [panel coordinate]
HEAD = 0.32  # length of an arrow's head, as a share of the arrow
HEAD_SPREAD = 0.55  # half its width, as a share of its length

DISC_NUMBERS = 3  # x, y and radius

TINY = 1e-300  # keeps quotients finite


def arrow_figures(subject: Subject, gallery: Gallery) -> Iterator[ReportFigure]:
    """Yield a figure of velocity arrows over time for each of the first entries."""
    scenario = subject.scenarios[0]
    moments = gallery.at(scenario, subject.times)
    speeds = [_speed(moment.truth.fields.section.velocity) for moment in moments]
    limit = limit_of(speeds)
    caption = (
        f"Scenario {scenario}; colour is speed on the score grid, on one scale for all "
        "panels, and so is the length of arrows. Difference: predicted − true."
    )
    omitted = subject.names[MOST_ENTRIES:]
    if omitted:
        caption += f" Not drawn for want of room: {', '.join(omitted)}."
    ramp = draw_ramp("flow", limit, "speed [length/frame]")

    for entry in subject.entries[:MOST_ENTRIES]:
        # a method may have the name of another row
        rows: list[tuple[str, list[Markup]]] = [
            ("truth", []),
            (entry.name, []),
            ("difference", []),
        ]
        for moment in moments:
            panels = _draw_panels(subject, gallery, moment, entry, limit=limit)
            for (_, row), panel in zip(rows, panels, strict=True):
                row.append(panel)
        columns = [moment.title for moment in moments]
        panel_grid = draw_panel_grid(columns, rows, width=7.4)
        yield ReportFigure(
            name=f"arrows-{entry.number}",
            title=f"Velocity over time: {entry.name}",
            thesis="Figs. 5.22–5.24",
            body=join([ramp, panel_grid]),
            caption=caption,
            wide=True,
        )


def _draw_panels(
    subject: Subject,
    gallery: Gallery,
    moment: Moment,
    entry: ReportEntry,
    *,
    limit: float,
) -> list[Markup]:
    """Return the panels of truth, prediction and difference at one frame."""
    fields = moment.truth.fields.section
    true = fields.velocity
    predicted = moment.pairs[entry.number].predicted_fields.section.velocity
    velocities = {
        "truth": true,
        "prediction": predicted,
        "difference": predicted - true,
    }
    label = gallery.labels[moment.scenario]
    width, height = fields.grid.box.lengths.tolist()
    obstacle = draw_obstacle(fields, label.obstacle)
    panels = []
    for name, velocity in velocities.items():
        arrows = _draw_arrows(fields, velocity, limit=limit)
        drawn = join([obstacle, arrows])
        alt = f"{name}, frame {moment.frame}"
        panel = draw_line_panel(drawn, label.classes, alt, aspect=width / height)
        panels.append(panel)
    return panels


def draw_obstacle(fields: Fields, obstacle: NDArray[np.float32] | None) -> Markup:
    """Return a fixed disc in the coordinates of a panel; nothing without one.

    A ball is left out: it need not lie in the slice that is drawn.
    """
    if obstacle is None or len(obstacle) != DISC_NUMBERS:
        return Markup("")
    (left, right), (_, top) = fields.grid.box.bounds
    scale = SIDE / (right - left)
    x, y, radius = obstacle.tolist()
    return tag(
        "circle",
        cx=f"{scale * (x - left):.2f}",
        cy=f"{scale * (top - y):.2f}",
        r=f"{scale * radius:.2f}",
        class_="obstacle",
    )


def _draw_arrows(fields: Fields, velocity: Floats, *, limit: float) -> Markup:
    """Return arrows at every k-th node that counts, coloured by speed.

    A panel shows the inside of the box in coordinates from 0 to :data:`SIDE`, from the
    top left.
    """
    grid = fields.grid
    every = math.ceil(max(grid.shape) / MOST_ARROWS)
    counted = np.argwhere(fields.counted)  # shape [node, 2]
    is_axis_shown = (counted - every // 2) % every == 0
    is_shown = is_axis_shown.all(axis=1)
    column, row = counted[is_shown].T

    (left, right), (_, top) = grid.box.bounds
    scale = SIDE / (right - left)
    start_x, start_y = grid.start
    node_x = start_x + (column + grid.origin) * grid.spacing
    node_y = start_y + (row + grid.origin) * grid.spacing
    x = (node_x - left) * scale
    y = (top - node_y) * scale

    u, v = velocity[column, row].T
    speed = np.hypot(u, v)
    longest = scale * every * grid.spacing * LONGEST
    share = speed / limit
    length = longest * np.minimum(share, MOST_TIMES_LIMIT)
    divisor = np.maximum(speed, TINY)
    along_x = length * u / divisor
    along_y = -length * v / divisor

    levels = np.clip(share * LEVELS, 0, LEVELS - 1)
    levels = levels.astype(int)
    data = [""] * LEVELS
    arrows = zip(x, y, along_x, along_y, levels, strict=True)
    for middle_x, middle_y, a, b, level in arrows:
        data[level] += arrow_data(middle_x, middle_y, a, b)
    paths = []
    for level, level_data in enumerate(data):
        if level_data:
            path = tag("path", d=level_data, class_=f"q{level}")
            paths.append(path)
    return join(paths)


def arrow_data(x: float, y: float, a: float, b: float) -> str:
    """Return path data of an arrow (a, b) around its middle; a short one is a dot."""
    if np.hypot(a, b) < SHORTEST:
        return path_data([(x, y)])
    middle = np.array([x, y])
    along = np.array([a, b])
    across = HEAD_SPREAD * np.array([b, -a])
    tail = middle - along / 2
    tip = middle + along / 2
    left = tip - HEAD * (along + across)
    right = tip - HEAD * (along - across)
    shaft = path_data([tail, tip])
    return shaft + path_data([left, tip, right])


def _speed(velocity: Floats) -> Floats:
    speed: Floats = np.sqrt((velocity**2).sum(axis=-1))
    return speed
