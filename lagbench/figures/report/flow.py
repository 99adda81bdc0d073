"""Arrows and streamlines over time (Figs. 5.22 to 5.24).

Streamlines are evenly spaced and traced by the midpoint rule. Each keeps a cell of a
coarse mask for itself, as in Jobard & Lefer (1997): it starts where no other has
passed, and ends where it would meet one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lagbench.data.grid import Fields
from lagbench.figures.html import (
    SIDE,
    Figure,
    Markup,
    grid,
    join,
    path_data,
    ramp,
    tag,
    vector,
)

from .subject import Gallery, Subject, limit_of

Floats = NDArray[np.float64]

STEP = 0.4  # length of a step in node distances
SLOW = 1e-3  # lines end where the speed falls below this share of the greatest
SHORTEST = 3.0  # lines shorter than this many node distances are left out
MOST_STEPS = 400  # steps of one line in either direction


@dataclass(frozen=True)
class Stream:
    """One streamline."""

    x: Floats  # places in node numbers, shape [point]
    y: Floats  # places in node numbers, shape [point]
    speed: Floats  # speed there, shape [point]


class _Flow:
    """Velocity between nodes, bilinear; none where a corner of the cell does not
    count.
    """

    def __init__(self, velocity: Floats, counted: NDArray[np.bool_]) -> None:
        self._u = velocity[..., 0].tolist()
        self._v = velocity[..., 1].tolist()
        whole = (
            counted[:-1, :-1] & counted[1:, :-1] & counted[:-1, 1:] & counted[1:, 1:]
        )
        self._whole = whole.tolist()
        self.shape = whole.shape
        speed = np.sqrt((velocity**2).sum(axis=-1))
        self._slow = SLOW * float(speed[counted].max(initial=0.0))

    def at(self, x: float, y: float) -> tuple[float, float, float] | None:
        """Return direction and speed, None outside or where the flow rests."""
        i = math.floor(x)
        k = math.floor(y)
        if not (
            0 <= i < self.shape[0] and 0 <= k < self.shape[1] and self._whole[i][k]
        ):
            return None
        a = x - i
        b = y - k
        u, v = (
            (field[i][k] * (1 - a) + field[i + 1][k] * a) * (1 - b)
            + (field[i][k + 1] * (1 - a) + field[i + 1][k + 1] * a) * b
            for field in (self._u, self._v)
        )
        speed = math.hypot(u, v)
        if speed <= self._slow:
            return None
        return (u / speed, v / speed, speed)


def streamlines(
    velocity: Floats, counted: NDArray[np.bool_], *, cells: int = 18
) -> list[Stream]:
    """Return streamlines that cover a flow evenly; so many cells across keep them
    apart.
    """
    flow = _Flow(velocity, counted)
    scale = cells / max(flow.shape)
    taken: set[tuple[int, int]] = set()
    found = []
    # from the rim inwards: lines along walls come first
    every = [(i, k) for i in range(cells) for k in range(cells)]
    for column, row in sorted(
        every, key=lambda c: min(c[0], c[1], cells - 1 - c[0], cells - 1 - c[1])
    ):
        if (column, row) in taken:
            continue
        passed: set[tuple[int, int]] = set()
        start = ((column + 0.5) / scale, (row + 0.5) / scale)
        back = _trace(flow, start, -1.0, scale, taken, passed)
        line = [*back[::-1], *_trace(flow, start, 1.0, scale, taken, passed)[1:]]
        if len(line) * STEP >= SHORTEST:
            taken |= passed
            found.append(Stream(*np.array(line).T))
    return found


def _trace(
    flow: _Flow,
    start: tuple[float, float],
    sign: float,
    scale: float,
    taken: set[tuple[int, int]],
    passed: set[tuple[int, int]],
) -> list[tuple[float, float, float]]:
    """Follow the flow, or go against it, until it ends, meets a line, or comes back to
    its start.
    """
    x, y = start
    line: list[tuple[float, float, float]] = []
    cell = _cell(x, y, scale)
    for _ in range(MOST_STEPS):
        here = flow.at(x, y)
        if here is None:
            break
        now = _cell(x, y, scale)
        if now in taken or (now != cell and now in passed):
            break
        cell = now
        passed.add(now)
        line.append((x, y, here[2]))
        half = flow.at(x + 0.5 * sign * STEP * here[0], y + 0.5 * sign * STEP * here[1])
        if half is None:
            break
        x = x + sign * STEP * half[0]
        y = y + sign * STEP * half[1]
    return line


def _cell(x: float, y: float, scale: float) -> tuple[int, int]:
    return int(x * scale), int(y * scale)


LEVELS = 6
"""Colours of speed, classes ``q0`` .. ``q5`` of the style sheet."""

ARROWS = 18  # most arrows across
LONGEST = 1.7  # length of an arrow of the scale's top, in distances between arrows
HEAD = 0.32  # length of its head, as a share of the arrow
MOST = 3  # entries that are drawn: lines take room


def flow_figures(subject: Subject, gallery: Gallery) -> Iterator[Figure]:
    """Yield arrows of truth, prediction and difference (5.22), then streamlines (5.23,
    5.24), by entry.
    """
    scenario = subject.scenarios[0]
    moments = gallery.at(scenario, subject.times)
    limit = limit_of(
        [np.sqrt((m.truth.fields.velocity**2).sum(axis=-1)) for m in moments]
    )
    colour = f"Scenario {scenario}; colour is speed on the score grid, on one scale for all panels"
    length = ", and so is the length of arrows. Difference: predicted − true."
    left = [entry.name for entry in subject.entries[MOST:]]
    if left:
        more = f" Not drawn for want of room: {', '.join(left)}."
    else:
        more = ""
    for draw, name, title, thesis, said, shown in (
        (_arrows, "arrows", "Velocity arrows", "Fig. 5.22", length, 3),
        (_streams, "streamlines", "Streamlines", "Figs. 5.23, 5.24", ".", 2),
    ):
        for entry in subject.entries[:MOST]:
            panels: dict[str, list[Markup]] = {}
            for moment in moments:
                true = moment.truth.fields.velocity
                predicted = moment.pairs[entry.number].predicted_fields.velocity
                fields = {
                    "truth": true,
                    "prediction": predicted,
                    "difference": predicted - true,
                }
                for what, velocity in list(fields.items())[:shown]:
                    drawn = draw(subject, moment.truth.fields, velocity, limit)
                    panel = vector(
                        drawn,
                        gallery.walls[scenario].classes,
                        f"{what}, frame {moment.frame}",
                    )
                    panels.setdefault(what, []).append(panel)
            rows = list(
                zip(("truth", entry.name, "difference"), panels.values(), strict=False)
            )
            drawn = grid(
                [f"frame {moment.frame}" for moment in moments], rows, width=7.4
            )
            yield Figure(
                name=f"{name}-{entry.number}",
                title=f"{title} over time: {entry.name}",
                thesis=thesis,
                body=join([ramp("flow", limit, "speed [length/frame]"), drawn]),
                caption=f"{colour}{said}{more}",
                wide=True,
            )


def _arrows(subject: Subject, fields: Fields, velocity: Floats, limit: float) -> Markup:
    """Return arrows at evenly many nodes that count."""
    counted = np.argwhere(fields.counted)
    every = max(1, -(-fields.grid.nodes // ARROWS))
    chosen = counted[((counted - every // 2) % every == 0).all(axis=1)]
    x, y = _places(
        subject, fields, chosen[:, 0].astype(float), chosen[:, 1].astype(float)
    )
    (left_wall, right_wall), _ = subject.task.size.bounds
    unit = (
        SIDE * every * fields.grid.spacing / (right_wall - left_wall) * LONGEST / limit
    )
    u, v = velocity[chosen[:, 0], chosen[:, 1]].T
    # runaways stay in sight
    capped = np.minimum(1.0, 1.5 * limit / np.maximum(np.hypot(u, v), 1e-300))
    lines: list[list[str]] = [[] for _ in range(LEVELS)]
    levels = _levels(np.hypot(u, v), limit)
    for x0, y0, a, b, level in zip(
        x, y, u * unit * capped, -v * unit * capped, levels, strict=True
    ):
        data = path_data([(x0, y0)])  # a short arrow is a dot
        if np.hypot(a, b) >= 1.0:
            tip = tip_x, tip_y = x0 + a / 2, y0 + b / 2
            left = (tip_x - HEAD * (a + 0.55 * b), tip_y - HEAD * (b - 0.55 * a))
            right = (tip_x - HEAD * (a - 0.55 * b), tip_y - HEAD * (b + 0.55 * a))
            data = path_data([(x0 - a / 2, y0 - b / 2), tip]) + path_data(
                [left, tip, right]
            )
        lines[level].append(data)
    return _by_level(lines)


def _streams(
    subject: Subject, fields: Fields, velocity: Floats, limit: float
) -> Markup:
    """Return streamlines, each piece in the colour of its speed."""
    lines: list[list[str]] = [[] for _ in range(LEVELS)]
    for stream in streamlines(velocity, fields.counted):
        x, y = _places(subject, fields, stream.x, stream.y)
        levels = _levels(stream.speed, limit)
        cuts = [0, *(np.flatnonzero(np.diff(levels)) + 1).tolist(), len(levels)]
        for low, high in pairwise(cuts):  # thinned out, joined to the next stretch
            last = min(high, len(levels) - 1)
            points = np.array([*range(low, last, 2), last])
            lines[levels[low]].append(path_data(zip(x[points], y[points], strict=True)))
        k = len(x) // 2  # an arrowhead in the middle
        a = x[k] - x[k - 1]
        b = y[k] - y[k - 1]
        size = 5.0 / max(float(np.hypot(a, b)), 1e-9)
        a = a * size
        b = b * size
        left = (x[k] - a - 0.6 * b, y[k] - b + 0.6 * a)
        right = (x[k] - a + 0.6 * b, y[k] - b - 0.6 * a)
        lines[levels[k]].append(path_data([left, (x[k], y[k]), right]))
    return _by_level(lines)


def _places(
    subject: Subject, fields: Fields, i: Floats, k: Floats
) -> tuple[Floats, Floats]:
    """Return node numbers as coordinates of a panel, which shows the inside of the
    box.
    """
    (left, right), (_, top) = subject.task.size.bounds
    scale = SIDE / (right - left)
    x, y = ((n + fields.grid.origin) * fields.grid.spacing for n in (i, k))
    return (x - left) * scale, (top - y) * scale


def _levels(speed: Floats, limit: float) -> NDArray[np.intp]:
    return np.clip(speed / limit * LEVELS, 0, LEVELS - 1).astype(np.intp)


def _by_level(lines: Sequence[Sequence[str]]) -> Markup:
    return join(
        tag("path", d="".join(data), class_=f"q{level}")
        for level, data in enumerate(lines)
        if data
    )
