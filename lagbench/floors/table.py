"""The table of floors: what every list of them, every row and every name comes from."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from lagbench.data.registry import Size

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

COUNTING = frozenset(name for name, floor in FLOORS.items() if floor.counts)
"""Names of those that skill may be measured against."""


def floors_of(size: Size) -> tuple[Floor, ...]:
    """Return the floors of a split and size; a split of the user's own has those of its
    kind of box.
    """
    return tuple(floor for floor in FLOORS.values() if floor.applies(size))
