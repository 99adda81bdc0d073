"""How many nodes of a score grid particles cover, and which grid they cover enough of.

A grid that is too fine has nodes without particles, one that is too coarse too few
nodes inside.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.data.grid import Grid, Placement, fields

from .metric import MINIMUM_NODES


@dataclass(frozen=True)
class Cloud:
    """Particles of one frame."""

    position: NDArray[np.floating[Any]]  # [length], shape [particle, 2]
    area: float  # that they cover at first [length^2]


def covered_nodes(cloud: Cloud, grid: Grid) -> int:
    """Return at how many nodes vorticity stands; metrics of it want
    :data:`.metric.MINIMUM_NODES`.
    """
    position = np.asarray(cloud.position, np.float64)
    full = grid.full_weight(len(position), cloud.area)
    found = fields(position, np.zeros_like(position), grid, full=full)
    return int(np.count_nonzero(found.differentiable))


def fitting_cells(
    clouds: Callable[[], Iterable[Cloud]], placement: Placement, *, near: int
) -> int | None:
    """Return the cells across, nearest to a number, of a grid of which each cloud
    covers enough nodes.

    None where there is none; of two as near the coarser one. Clouds are asked for anew
    for each grid that is tried, so that one is in memory at a time.
    """
    tried: list[int] = sorted(
        {near, *range(4, 129)}, key=lambda cells: (abs(cells - near), cells)
    )
    for cells in tried:
        grid = Grid(cells, placement)
        if all(covered_nodes(cloud, grid) >= MINIMUM_NODES for cloud in clouds()):
            return cells
    return None
