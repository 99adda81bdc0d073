"""How many nodes of a score grid particles cover, and which grid they cover enough of.

A grid that is too fine has nodes without particles, one that is too coarse too few nodes inside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lagbench.data.grid import Grid, Placement, fields

from .metric import MINIMUM_NODES

__all__ = ["Cloud", "covered_nodes", "fitting_cells"]

TRIED = range(4, 129)
"""Cells across of the grids that are tried."""


@dataclass(frozen=True)
class Cloud:
    """Particles of one frame."""

    position: ArrayLike  # [length], shape [particle, 2]
    area: float  # that they cover at first [length^2]


def covered_nodes(cloud: Cloud, grid: Grid) -> int:
    """Return at how many nodes vorticity stands; metrics of it want :data:`.metric.MINIMUM_NODES`."""
    position = np.asarray(cloud.position, np.float64)
    full = grid.full_weight(len(position), cloud.area)
    found = fields(position, np.zeros_like(position), grid, full=full)
    return int(np.count_nonzero(found.differentiable))


def fitting_cells(clouds: Sequence[Cloud], placement: Placement, *, near: int) -> int | None:
    """Return the cells across, nearest to a number, of a grid of which each cloud covers enough nodes.

    None where there is none; of two as near the coarser one.
    """
    nearest: list[int] = sorted({near, *TRIED}, key=lambda cells: abs(cells - near))
    for cells in nearest:
        grid = Grid(cells, placement)
        if all(covered_nodes(cloud, grid) >= MINIMUM_NODES for cloud in clouds):
            return cells
    return None
