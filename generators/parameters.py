"""From a size in datasets.yaml to constants, walls and the ranges of what is drawn."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, TypeVar

from .base import ClosedBoxParameters, FreeSurfaceParameters
from .preflight import check_constants
from .shapes import Region

if TYPE_CHECKING:
    from lagbench.registry import Size

__all__ = ["closed_box_walls", "constants", "free_surface_walls", "interval", "ranges"]

Kind = TypeVar("Kind", ClosedBoxParameters, FreeSurfaceParameters)


def constants(kind: type[Kind], size: Size, **fixed: object) -> Kind:
    """Return the solver constants that a size names; others keep their defaults.

    Args:
        kind: which solver's constants.
        size: source of every constant of the same name, and of dt.
        **fixed: what the split settles itself, such as ``no_slip``.

    Raises:
        UnreadableFileError: the size lacks a constant, or its value is none that a solver can use.
    """
    given = {f.name: size.value(f.name) for f in fields(kind) if f.name in size.parameters}
    settled = {"dt": size.dt, **given, **fixed}
    check_constants(kind, settled, size)
    return kind(**settled)


def closed_box_walls(size: Size) -> tuple[float, float]:
    """Return the low and high wall, half-way between two nodes [length]."""
    low = (float(size.value("wall")) + 0.5) / size.grid
    return low, 1.0 - low


def free_surface_walls(size: Size) -> tuple[float, float]:
    """Return the low and high wall, each on a node [length]."""
    low = float(size.value("wall")) / size.grid
    return low, 1.0 - low


def interval(size: Size, name: str) -> tuple[float, float]:
    """Return the parameters ``<name>_min`` and ``<name>_max``."""
    return float(size.value(f"{name}_min")), float(size.value(f"{name}_max"))


def ranges(size: Size, name: str) -> Region:
    """Return the intervals of ``<name>_x`` and ``<name>_y``."""
    return interval(size, f"{name}_x"), interval(size, f"{name}_y")
