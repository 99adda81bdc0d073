"""The table of floors: what every list of them, every row and every name comes from."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from lagbench.data.registry import Size

from . import analog, coarse_solver, constant_velocity, free_flight, frozen_field, persistence
from .floor import Floor

FLOORS: Mapping[str, Floor] = MappingProxyType(
    {
        module.FLOOR.name: module.FLOOR
        for module in (persistence, constant_velocity, frozen_field, free_flight, analog, coarse_solver)
    }
)
"""All floors by name, in the order in which they are shown."""


def floors_of(size: Size) -> tuple[Floor, ...]:
    """Return the floors of a split and size; a split of the user's own has those of its kind of box."""
    return tuple(floor for floor in FLOORS.values() if floor.applies(size))
