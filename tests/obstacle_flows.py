"""Full boxes with an obstacle: the lattice of their particles, the solver's
constants.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import Box
from lagbench.generators.full_box_parameters import FullBoxParameters
from lagbench.generators.split import InitialState


def regular_places(box: Box, counts: Sequence[int]) -> NDArray[np.float64]:
    """Return a regular lattice that fills a box [length], shape [particle, axis].

    Args:
        box: the box.
        counts: particles along each axis.
    """
    cell = np.indices(counts).reshape(len(counts), -1).T
    share = (cell + 0.5) / np.asarray(counts)
    return np.array(box.low) + box.lengths * share


def constants_around(state: InitialState, box: Box, grid: int) -> FullBoxParameters:
    """Return the constants of a solver for a state with an obstacle and a fringe."""
    assert state.obstacle is not None
    return FullBoxParameters(
        particles=len(state.position),
        grid=grid,
        dt=4e-3,
        box=box,
        no_slip=False,
        density=1e-4,
        modulus=5e-4,
        velocity_relaxation=0.01,
        jacobian_relaxation=0.1,
        density_coupling=0.01,
        shift=0.01,
        obstacle_particles=len(state.obstacle.position),
        fringe_length=0.25,
        fringe_rate=60.0,
    )
