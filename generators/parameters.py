"""From a size in datasets.yaml to the constants and walls of its solver."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, TypeVar

from .base import ClosedBoxParameters, FreeSurfaceParameters

if TYPE_CHECKING:
    from lagbench.registry import Size

__all__ = ["closed_box_walls", "constants", "free_surface_walls"]

Kind = TypeVar("Kind", ClosedBoxParameters, FreeSurfaceParameters)


def constants(kind: type[Kind], size: Size, **fixed: object) -> Kind:
    """Return the solver constants that a size names; others keep their defaults.

    Args:
        kind: which solver's constants.
        size: source of every constant of the same name, and of dt.
        **fixed: what the split settles itself, such as ``no_slip``.
    """
    given = {f.name: size.value(f.name) for f in fields(kind) if f.name in size.parameters}
    return kind(**{"dt": size.dt, **given, **fixed})


def closed_box_walls(size: Size) -> tuple[float, float]:
    """Return the low and high wall, half-way between two nodes [length]."""
    low = (float(size.value("wall")) + 0.5) / size.grid
    return low, 1.0 - low


def free_surface_walls(size: Size) -> tuple[float, float]:
    """Return the low and high wall, each on a node [length]."""
    low = float(size.value("wall")) / size.grid
    return low, 1.0 - low
