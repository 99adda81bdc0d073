"""The table of floors: what every list of them, every row and every name comes from."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from lagbench.data.registry import Size
from lagbench.metrics.aggregate import Score

from . import analog, coarse_solver, extrapolation, frozen_field
from .floor import Floor

FLOORS: Mapping[str, Floor] = MappingProxyType(
    {
        floor.name: floor
        for floor in (
            extrapolation.PERSISTENCE,
            extrapolation.CONSTANT_VELOCITY,
            frozen_field.FLOOR,
            extrapolation.FREE_FLIGHT,
            analog.FLOOR,
            coarse_solver.FLOOR,
        )
    }
)
"""All floors by name, in the order in which they are shown."""


def counting(scores: Mapping[str, Score]) -> dict[str, Score]:
    """Return the scores of the floors that count: those that skill may be measured against."""
    return {name: score for name, score in scores.items() if name in FLOORS and FLOORS[name].counts}


def floors_of(size: Size) -> tuple[Floor, ...]:
    """Return the floors of a split and size; a split of the user's own has those of its kind of box."""
    return tuple(floor for floor in FLOORS.values() if floor.applies(size))
