"""Constants of the solver of full boxes in two and three dimensions.

NumPy only: a split can be drawn, inspected and tested without Taichi.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import Box
from lagbench.data.fringe_region import fringe_rates

__all__ = ["FullBoxParameters"]


@dataclass(frozen=True, kw_only=True)
class FullBoxParameters:
    """Constants of the weakly compressible solver of a full box.

    The equations stand in :mod:`.nodal_stress`. Nodes are the middles of cells; the
    box is a whole number of cells long along each axis.
    """

    particles: int  # particles in one scenario
    grid: int  # cells across a length of 1
    dt: float  # substep [s]
    box: Box  # walls and periodic axes
    # whether the walls hold the fluid or let it slide
    no_slip: bool
    density: float  # rest density rho [mass/length^d]
    modulus: float  # bulk modulus E [mass length^(2-d)/s^2]; c^2 = E/rho
    # lambda, share of the grid velocity mixed into v_p per substep [1]
    velocity_relaxation: float
    # kappa, share of the nodal J mixed into J_p per substep [1]
    jacobian_relaxation: float
    # theta, pull of J_p towards the grid density per substep [1]
    density_coupling: float
    shift: float  # beta, strength of the particle shift [1]
    # layers of equal height along y on which a body force acts; 0 for no force
    force_layers: int = 0
    # substeps for which one row of a program of walls or forces acts
    substeps_per_frame: int = 1
    obstacle_particles: int = 0  # particles of a fixed obstacle; 0 for no obstacle
    # the last part of the box along x, in which the velocity is drawn to the stream
    fringe_length: float = 0.0  # [length]
    fringe_rate: float = 0.0  # rate in the middle of the fringe [1/s]; 0 for no fringe

    @property
    def cells(self) -> tuple[int, ...]:
        """Cells along each axis, shape [axis]."""
        lengths = self.box.lengths.tolist()
        return tuple(round(length * self.grid) for length in lengths)

    @property
    def origin(self) -> tuple[float, ...]:
        """Coordinate of the ghost nodes below each axis [cells], shape [axis]."""
        # twelve digits: a sum of halves and whole cells is exact
        return tuple(round(low * self.grid - 0.5, 12) for low in self.box.low)

    def fringe_rates(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the rate at which the fringe draws to the stream [1/s].

        Args:
            place: coordinates along x [length].
        """
        return fringe_rates(
            place,
            end=self.box.high[0],
            length=self.fringe_length,
            rate=self.fringe_rate,
        )
