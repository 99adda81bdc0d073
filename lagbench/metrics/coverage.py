"""Number of nodes of a score grid that particles cover, and grids with enough of them.

A grid that is too fine has nodes without particles, one that is too coarse too few
nodes inside.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import UNIT_SQUARE, Box
from lagbench.data.grid import Grid, Placement, fields

from .metric import MINIMUM_NODES

CELLS = range(4, 129)
"""Cells across of the grids that are tried."""


@dataclass(frozen=True)
class Cloud:
    """Particles of one frame."""

    position: NDArray[np.floating[Any]]  # [length], shape [particle, 2]
    area: float  # that they cover at first [length^2]


def covered_nodes(cloud: Cloud, grid: Grid) -> int:
    """Return the number of nodes at which vorticity is defined.

    Metrics of vorticity need :data:`.metric.MINIMUM_NODES` of them.
    """
    position = np.asarray(cloud.position, np.float64)
    at_rest = np.zeros_like(position)
    full = grid.full_weight(len(position), cloud.area)
    grid_fields = fields(position, at_rest, grid, full=full)
    return int(np.count_nonzero(grid_fields.differentiable))


def fitting_cells(
    clouds: Callable[[], Iterable[Cloud]],
    placement: Placement,
    *,
    near: int,
    box: Box = UNIT_SQUARE,
) -> int | None:
    """Return the number of cells nearest to ``near`` at which each cloud fits.

    A cloud fits a grid of which it covers enough nodes. Of two numbers as near the
    smaller is taken; None where no grid fits. ``clouds`` is called for each grid that
    is tried, so that one cloud is in memory at a time.
    """
    candidates: list[int] = sorted(
        {near, *CELLS}, key=lambda cells: (abs(cells - near), cells)
    )
    for cells in candidates:
        if not box.has_whole_cells(cells):
            continue
        grid = Grid(cells, placement, box)
        if all(covered_nodes(cloud, grid) >= MINIMUM_NODES for cloud in clouds()):
            return cells
    return None
