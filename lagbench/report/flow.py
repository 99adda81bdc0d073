"""Arrows and streamlines over time (Figs. 5.22 to 5.24)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lagbench.grid import Fields

from .gallery import Gallery, Moment
from .maps import limit_of
from .markup import Markup, join, path_data, tag
from .page import Figure
from .panels import SIDE, grid, ramp, vector
from .streamlines import Stream, streamlines
from .subject import Subject

__all__ = ["arrow_figures", "stream_figures"]

Floats = NDArray[np.float64]

LEVELS = 6
"""Colours of speed, classes ``q0`` .. ``q5`` of the style sheet."""

ARROWS = 18
"""Most arrows across."""

LONGEST = 1.7
"""Length of an arrow of the scale's top, in distances between arrows."""

HEAD = 0.32
"""Length of its head, as a share of the arrow."""

MOST = 3
"""Entries that are drawn: lines take room."""


def arrow_figures(subject: Subject, gallery: Gallery) -> Iterator[Figure]:
    """Yield arrows of truth, prediction and difference, one figure per entry (Fig. 5.22)."""
    yield from _figures(subject, gallery, _arrows, "arrows", "Velocity arrows", "Fig. 5.22", difference=True)


def stream_figures(subject: Subject, gallery: Gallery) -> Iterator[Figure]:
    """Yield streamlines of truth and prediction, one figure per entry (Figs. 5.23, 5.24)."""
    yield from _figures(
        subject, gallery, _streams, "streamlines", "Streamlines", "Figs. 5.23, 5.24", difference=False
    )


def _figures(
    subject: Subject,
    gallery: Gallery,
    draw: Callable[[Subject, Fields, Floats, float], Markup],
    name: str,
    title: str,
    thesis: str,
    *,
    difference: bool,
) -> Iterator[Figure]:
    scenario = subject.scenarios[0]
    moments = gallery.at(scenario, subject.times)
    limit = limit_of([_speed(m.truth.fields.velocity) for m in moments])
    for entry in subject.entries[:MOST]:
        rows = list(_rows(subject, gallery, moments, entry.number, limit, draw, difference=difference))
        rows[1] = (entry.name, rows[1][1])
        yield Figure(
            name=f"{name}-{entry.number}",
            title=f"{title} over time: {entry.name}",
            thesis=thesis,
            body=join(
                [
                    ramp("flow", limit, "speed [length/frame]"),
                    grid([f"frame {m.frame}" for m in moments], rows, width=7.4),
                ]
            ),
            caption=join([_caption(subject, scenario, difference=difference)]),
            wide=True,
        )


def _caption(subject: Subject, scenario: int, *, difference: bool) -> str:
    said = f"Scenario {scenario}; colour is speed on the score grid, on one scale for all panels"
    said += ", and so is the length of arrows. Difference: predicted − true." if difference else "."
    left = [entry.name for entry in subject.entries[MOST:]]
    return said + (f" Not drawn for want of room: {', '.join(left)}." if left else "")


def _rows(
    subject: Subject,
    gallery: Gallery,
    moments: Sequence[Moment],
    number: int,
    limit: float,
    draw: Callable[[Subject, Fields, Floats, float], Markup],
    *,
    difference: bool,
) -> Iterator[tuple[str, list[Markup]]]:
    """Yield the rows: truth, prediction, and their difference where it is asked for."""
    sides: dict[str, Callable[[Moment], Floats]] = {
        "truth": lambda m: m.truth.fields.velocity,
        "prediction": lambda m: m.pairs[number].predicted_fields.velocity,
    }
    if difference:
        sides["difference"] = lambda m: m.pairs[number].predicted_fields.velocity - m.truth.fields.velocity
    for name, velocity in sides.items():
        panels = []
        for moment in moments:
            drawn = draw(subject, moment.truth.fields, velocity(moment), limit)
            alt = f"{name}, frame {moment.frame}"
            panels.append(vector(drawn, gallery.walls[moment.scenario], alt))
        yield name, panels


def _arrows(subject: Subject, fields: Fields, velocity: Floats, limit: float) -> Markup:
    """Return arrows at evenly many nodes that count."""
    counted = np.argwhere(fields.counted)
    every = max(1, -(-fields.grid.nodes // ARROWS))
    chosen = counted[((counted - every // 2) % every == 0).all(axis=1)]
    x, y = _places(subject, fields, chosen[:, 0].astype(float), chosen[:, 1].astype(float))
    unit = SIDE * every * fields.grid.spacing / _width(subject) * LONGEST / limit
    u, v = velocity[chosen[:, 0], chosen[:, 1]].T
    capped = np.minimum(1.0, 1.5 * limit / np.maximum(np.hypot(u, v), 1e-300))  # runaways stay in sight
    lines: list[list[str]] = [[] for _ in range(LEVELS)]
    for level, data in zip(
        _levels(np.hypot(u, v), limit), map(_arrow, x, y, u * unit * capped, -v * unit * capped), strict=True
    ):
        lines[level].append(data)
    return _by_level(lines)


def _arrow(x: float, y: float, a: float, b: float) -> str:
    """Return an arrow through a point as path data; a short one is a dot."""
    if not np.hypot(a, b) >= 1.0:
        return path_data([(x, y)])
    tip_x, tip_y = x + a / 2, y + b / 2
    left = (tip_x - HEAD * (a + 0.55 * b), tip_y - HEAD * (b - 0.55 * a))
    right = (tip_x - HEAD * (a - 0.55 * b), tip_y - HEAD * (b + 0.55 * a))
    return path_data([(x - a / 2, y - b / 2), (tip_x, tip_y)]) + path_data([left, (tip_x, tip_y), right])


def _streams(subject: Subject, fields: Fields, velocity: Floats, limit: float) -> Markup:
    """Return streamlines, each piece in the colour of its speed."""
    lines: list[list[str]] = [[] for _ in range(LEVELS)]
    for stream in streamlines(velocity, fields.counted):
        x, y = _places(subject, fields, stream.x, stream.y)
        for level, piece in _pieces(stream, limit):
            lines[level].append(path_data(zip(x[piece], y[piece], strict=True)))
        lines[_levels(stream.speed, limit)[len(x) // 2]].append(_head(x, y))
    return _by_level(lines)


def _pieces(stream: Stream, limit: float) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Yield stretches of one colour and their points, thinned out, joined to the next stretch."""
    levels = _levels(stream.speed, limit)
    cuts = [0, *(np.flatnonzero(np.diff(levels)) + 1).tolist(), len(levels)]
    for low, high in pairwise(cuts):
        last = min(high, len(levels) - 1)
        points = [*range(low, last, 2), last]
        yield int(levels[low]), np.array(points)


def _head(x: Floats, y: Floats) -> str:
    """Return an arrowhead in the middle of a line."""
    k = len(x) // 2
    a, b = x[k] - x[k - 1], y[k] - y[k - 1]
    size = 5.0 / max(float(np.hypot(a, b)), 1e-9)
    a, b = a * size, b * size
    wings = [(x[k] - a - 0.6 * b, y[k] - b + 0.6 * a), (x[k], y[k]), (x[k] - a + 0.6 * b, y[k] - b - 0.6 * a)]
    return path_data(wings)


def _places(subject: Subject, fields: Fields, i: Floats, k: Floats) -> tuple[Floats, Floats]:
    """Return node numbers as coordinates of a panel, which shows the inside of the box."""
    (left, _), (_, top) = subject.exam.size.bounds
    scale = SIDE / _width(subject)
    x, y = ((n + fields.grid.origin) * fields.grid.spacing for n in (i, k))
    return (x - left) * scale, (top - y) * scale


def _width(subject: Subject) -> float:
    (left, right), _ = subject.exam.size.bounds
    return right - left


def _speed(velocity: Floats) -> Floats:
    return np.asarray(np.sqrt((velocity**2).sum(axis=-1)), np.float64)


def _levels(speed: Floats, limit: float) -> NDArray[np.intp]:
    return np.clip(speed / limit * LEVELS, 0, LEVELS - 1).astype(np.intp)


def _by_level(lines: Sequence[Sequence[str]]) -> Markup:
    return join(tag("path", d="".join(data), class_=f"q{level}") for level, data in enumerate(lines) if data)
