"""Statistics of positions, per-frame velocities and accelerations, streamed.

With x(f) the positions of frame f and the frame as time unit (Tables 5.1 and 5.3)::

    u(f) = x(f) - x(f-1)             a(f) = u(f) - u(f-1)
    mean = sum(q) / n                std  = sqrt(sum(q^2) / n - mean^2)

per component, over all particles, frames and scenarios of a subset (population std, no
n - 1).

The nine digits that come out depend on the data alone. Positions are float32 in the
unit box, so their float64 sums over one frame and those of their differences are exact
up to 2^13 particles away from 0; squares add in a fixed order within a frame; and
frames and scenarios are joined by ``math.fsum``, which is correctly rounded whatever
the order or the chunks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import DataError

from .checksums import round_digits
from .scenario import read_scenario

QUANTITIES = ("position", "velocity", "acceleration")
"""Order of the quantities: differences of order 0, 1 and 2 over frames."""


@dataclass(frozen=True)
class Moments:
    """Count, sum and sum of squares of one quantity."""

    count: int  # values per component
    total: tuple[float, ...]  # sum of the values of each component
    squares: tuple[float, ...]  # sum of their squares


def scenario_moments(frames: Iterable[NDArray[np.float32]]) -> dict[str, Moments]:
    """Return the moments of one scenario.

    Args:
        frames: positions of every frame in order, each of shape [particle, space].
    """
    recent: list[NDArray[np.float64]] = []
    counts = dict.fromkeys(QUANTITIES, 0)
    totals: dict[str, list[NDArray[np.float64]]] = {name: [] for name in QUANTITIES}
    squares: dict[str, list[NDArray[np.float64]]] = {name: [] for name in QUANTITIES}
    for position in frames:
        differences = [np.ascontiguousarray(position.T, dtype=np.float64)]
        for earlier in recent:
            differences.append(differences[-1] - earlier)
        recent = differences[: len(QUANTITIES) - 1]
        for name, values in zip(QUANTITIES, differences, strict=False):
            counts[name] += values.shape[1]
            totals[name].append(values.sum(axis=1))
            squares[name].append((values * values).sum(axis=1))
    return {
        name: Moments(counts[name], _fsum(totals[name]), _fsum(squares[name]))
        for name in QUANTITIES
    }


def combine(scenarios: Iterable[dict[str, Moments]]) -> dict[str, Moments]:
    """Return the moments over several scenarios, in any order."""
    held = list(scenarios)
    return {
        name: Moments(
            sum(moments[name].count for moments in held),
            _fsum([moments[name].total for moments in held if moments[name].count]),
            _fsum([moments[name].squares for moments in held if moments[name].count]),
        )
        for name in QUANTITIES
    }


def statistics(scenarios: Iterable[dict[str, Moments]]) -> dict[str, tuple[float, ...]]:
    """Return mean and std per component, to nine significant digits."""
    result: dict[str, tuple[float, ...]] = {}
    for name, moments in combine(scenarios).items():
        if moments.count:
            mean = [total / moments.count for total in moments.total]
            pairs = zip(moments.squares, mean, strict=True)
            std = [
                math.sqrt(max(0.0, square / moments.count - m * m))
                for square, m in pairs
            ]
            result[f"{name}_mean"] = tuple(map(round_digits, mean))
            result[f"{name}_std"] = tuple(map(round_digits, std))
    return result


def file_statistics(paths: Sequence[Path]) -> dict[str, tuple[float, ...]]:
    """Return the statistics of scenario files, read one frame at a time."""
    if not paths:
        raise DataError(
            "no scenario files", expected="at least one file for statistics"
        )
    return statistics([file_moments(path) for path in paths])


def file_moments(
    path: Path, report: Callable[[int], None] = lambda _: None
) -> dict[str, Moments]:
    """Return the moments of one scenario file, read one frame at a time."""
    with read_scenario(path) as file:
        moments = scenario_moments(
            frame for block in file.blocks("position") for frame in block
        )
    report(1)
    return moments


def _fsum(rows: Sequence[Sequence[float] | NDArray[np.float64]]) -> tuple[float, ...]:
    """Return the column sums, correctly rounded."""
    return tuple(math.fsum(column) for column in zip(*rows, strict=True))
