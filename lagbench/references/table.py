"""The table of floors: what every list of them, every row and every name comes from."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from lagbench.data.registry import Size

from . import analog, coarse_solver, extrapolation, frozen_field
from .predictor import ReferencePredictor

REFERENCES: Mapping[str, ReferencePredictor] = MappingProxyType(
    {
        floor.name: floor
        for floor in (
            extrapolation.PERSISTENCE,
            extrapolation.CONSTANT_VELOCITY,
            frozen_field.PREDICTOR,
            extrapolation.FREE_FLIGHT,
            analog.PREDICTOR,
            coarse_solver.PREDICTOR,
        )
    }
)
"""All floors by name, in the order in which they are shown."""

COUNTING = frozenset(name for name, floor in REFERENCES.items() if floor.counts)
"""Names of those that skill may be measured against."""


def references_of(size: Size) -> tuple[ReferencePredictor, ...]:
    """Return the floors of a split and size; a split of the user's own has those of its
    kind of box.
    """
    return tuple(floor for floor in REFERENCES.values() if floor.applies(size))
