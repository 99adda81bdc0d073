"""Streamlines of a velocity on a grid, evenly spaced, traced by the midpoint rule.

Each line keeps a cell of a coarse mask for itself, as in Jobard & Lefer (1997): a new line
starts where no other has passed and ends where it would run into one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Stream", "streamlines"]

Floats = NDArray[np.float64]

STEP = 0.4
"""Length of a step in node distances."""

SLOW = 1e-3
"""Lines end where the speed falls below this share of the greatest."""

SHORTEST = 3.0
"""Lines shorter than this many node distances are left out."""

MOST_STEPS = 400
"""Steps of one line in either direction."""


@dataclass(frozen=True)
class Stream:
    """One streamline.

    Attributes:
        x: places in node numbers, shape [point].
        y: places in node numbers, shape [point].
        speed: speed there, shape [point].
    """

    x: Floats
    y: Floats
    speed: Floats


class _Flow:
    """Velocity between nodes, bilinear; none where a corner of the cell does not count."""

    def __init__(self, velocity: Floats, counted: NDArray[np.bool_]) -> None:
        self._u = velocity[..., 0].tolist()
        self._v = velocity[..., 1].tolist()
        whole = counted[:-1, :-1] & counted[1:, :-1] & counted[:-1, 1:] & counted[1:, 1:]
        self._whole = whole.tolist()
        self.shape = whole.shape
        speed = np.sqrt((velocity**2).sum(axis=-1))
        self._slow = SLOW * float(speed[counted].max(initial=0.0))

    def at(self, x: float, y: float) -> tuple[float, float, float] | None:
        """Return direction and speed, None outside or where the flow rests."""
        i, k = math.floor(x), math.floor(y)
        if not (0 <= i < self.shape[0] and 0 <= k < self.shape[1] and self._whole[i][k]):
            return None
        a, b = x - i, y - k
        u, v = (_mixed(field, i, k, a, b) for field in (self._u, self._v))
        speed = math.hypot(u, v)
        return None if speed <= self._slow else (u / speed, v / speed, speed)


def _mixed(field: list[list[float]], i: int, k: int, a: float, b: float) -> float:
    low = field[i][k] * (1 - a) + field[i + 1][k] * a
    high = field[i][k + 1] * (1 - a) + field[i + 1][k + 1] * a
    return low * (1 - b) + high * b


def streamlines(velocity: Floats, counted: NDArray[np.bool_], *, cells: int = 18) -> list[Stream]:
    """Return streamlines that cover a flow evenly.

    Args:
        velocity: velocity at the nodes, shape [x node, y node, 2].
        counted: nodes that count, shape [x node, y node].
        cells: cells across of the mask that keeps lines apart.
    """
    flow = _Flow(velocity, counted)
    scale = cells / max(flow.shape)
    taken: set[tuple[int, int]] = set()
    found = []
    for column, row in _seeds(cells):
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


def _seeds(cells: int) -> list[tuple[int, int]]:
    """Return all cells, from the rim inwards: lines along walls come first."""
    every = [(i, k) for i in range(cells) for k in range(cells)]
    return sorted(every, key=lambda c: min(c[0], c[1], cells - 1 - c[0], cells - 1 - c[1]))


def _trace(
    flow: _Flow,
    start: tuple[float, float],
    sign: float,
    scale: float,
    taken: set[tuple[int, int]],
    passed: set[tuple[int, int]],
) -> list[tuple[float, float, float]]:
    """Follow the flow, or go against it, until it ends, meets a line, or comes back to its start."""
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
        x, y = x + sign * STEP * half[0], y + sign * STEP * half[1]
    return line


def _cell(x: float, y: float, scale: float) -> tuple[int, int]:
    return int(x * scale), int(y * scale)
