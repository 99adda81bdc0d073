"""Statistics of positions, per-frame velocities and accelerations, streamed.

With x(f) the positions of frame f and the frame as time unit (Tables 5.1 and 5.3)::

    u(f) = x(f) - x(f-1)             a(f) = u(f) - u(f-1)
    mean = sum(q) / n                std  = sqrt(sum(q^2) / n - mean^2)

per component, over all particles, frames and scenarios of a subset (population std, no
n - 1).

The nine digits of a statistic depend on the data alone. Positions are float32 in the
unit box, so their float64 sums over one frame and those of their differences are exact
up to 2^13 particles away from 0; squares add in a fixed order within a frame; and
frames and scenarios are joined by ``math.fsum``, which is correctly rounded whatever
the order or the chunks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import DataError

from . import WALL
from .box import UNIT_SQUARE, Box
from .checksums import round_digits
from .scenario import ScenarioFile, read_scenario

QUANTITIES = ("position", "velocity", "acceleration")
"""Order of the quantities: differences of order 0, 1 and 2 over frames."""


@dataclass(frozen=True)
class Moments:
    """Count, sum and sum of squares of one quantity."""

    count: int  # values per component
    total: tuple[float, ...]  # sum of the values of each component
    squares: tuple[float, ...]  # sum of their squares


def scenario_moments(
    frames: Iterable[NDArray[np.float32]], box: Box = UNIT_SQUARE
) -> dict[str, Moments]:
    """Return the moments of one scenario.

    Args:
        frames: positions of every frame in order, each of shape [particle, space].
        box: box that holds the particles: a velocity is the way that a particle went.
    """
    recent: list[NDArray[np.float64]] = []
    counts = dict.fromkeys(QUANTITIES, 0)
    totals: dict[str, list[NDArray[np.float64]]] = {}
    squares: dict[str, list[NDArray[np.float64]]] = {}
    for name in QUANTITIES:
        totals[name] = []
        squares[name] = []
    highest_order = len(QUANTITIES) - 1
    for position in frames:
        by_axis = np.ascontiguousarray(position.T, dtype=np.float64)
        differences = [by_axis]
        for order, earlier in enumerate(recent):
            later = differences[-1]
            if order == 0:
                change = box.displacement(earlier.T, later.T).T
            else:
                change = later - earlier
            differences.append(change)
        recent = differences[:highest_order]
        for name, values in zip(QUANTITIES, differences, strict=False):
            square = values * values
            counts[name] += values.shape[1]
            totals[name].append(values.sum(axis=1))
            squares[name].append(square.sum(axis=1))
    moments = {}
    for name in QUANTITIES:
        moments[name] = Moments(
            count=counts[name],
            total=_sum_columns(totals[name]),
            squares=_sum_columns(squares[name]),
        )
    return moments


def combine(scenarios: Iterable[dict[str, Moments]]) -> dict[str, Moments]:
    """Return the moments over several scenarios, in any order."""
    scenario_list = list(scenarios)
    combined = {}
    for name in QUANTITIES:
        filled = []
        for scenario in scenario_list:
            if scenario[name].count:
                filled.append(scenario[name])
        combined[name] = Moments(
            count=sum(moments.count for moments in filled),
            total=_sum_columns([moments.total for moments in filled]),
            squares=_sum_columns([moments.squares for moments in filled]),
        )
    return combined


def statistics(scenarios: Iterable[dict[str, Moments]]) -> dict[str, tuple[float, ...]]:
    """Return mean and std per component, to nine significant digits."""
    result: dict[str, tuple[float, ...]] = {}
    for name, moments in combine(scenarios).items():
        if not moments.count:
            continue
        means = []
        deviations = []
        for total, square in zip(moments.total, moments.squares, strict=True):
            mean = total / moments.count
            variance = square / moments.count - mean * mean
            means.append(round_digits(mean))
            deviations.append(round_digits(math.sqrt(max(0.0, variance))))
        result[f"{name}_mean"] = tuple(means)
        result[f"{name}_std"] = tuple(deviations)
    return result


def file_statistics(
    paths: Sequence[Path], box: Box = UNIT_SQUARE
) -> dict[str, tuple[float, ...]]:
    """Return the statistics of scenario files, read one frame at a time."""
    if not paths:
        raise DataError("no scenario files: expected at least one file for statistics")
    return statistics([file_moments(path, box=box) for path in paths])


def file_moments(
    path: Path,
    report: Callable[[int], None] = lambda _: None,
    *,
    box: Box = UNIT_SQUARE,
) -> dict[str, Moments]:
    """Return the moments of one scenario file, read one frame at a time."""
    with read_scenario(path) as file:
        moments = scenario_moments(_read_frames(file), box)
    report(1)
    return moments


def _read_frames(file: ScenarioFile) -> Iterator[NDArray[np.float32]]:
    """Yield the positions of every frame without walls, shape [particle, space]."""
    is_scored = file.read("material") != WALL
    for block in file.blocks("position"):
        yield from block if is_scored.all() else block[:, is_scored]


def _sum_columns(
    rows: Sequence[Sequence[float] | NDArray[np.float64]],
) -> tuple[float, ...]:
    """Return the column sums, correctly rounded."""
    return tuple(math.fsum(column) for column in zip(*rows, strict=True))
