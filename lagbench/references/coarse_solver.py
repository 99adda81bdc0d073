"""Coarse solver: the same equations of a free surface on a coarser grid.

The solver inside the hybrid of :mod:`lagbench.baselines.hybrid_coarse`. It knows the
equations and the materials. Its grid has fewer cells along each axis, and its time step
is longer by the same factor. A seeded subset of the particles, as many to a cell as
before and as evenly spread, carries the mass. Each other particle keeps its offset to
the nearest particle of its material that carries mass.

The solver starts from displacements alone: in free fall the velocity of the last given
frame is ``u(f) + g / 2``.
"""

from __future__ import annotations

import math
import weakref
from dataclasses import replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from lagbench.data.registry import Size
from lagbench.generators.constants import solver_constants
from lagbench.generators.split import InitialState
from lagbench.work.engine import find_engine

from .predictor import Floats, Given
from .restarted import borrow_solver, give_back, leaders, spread_subset
from .train_library import UP

MIN_CELLS = 16
"""Least cells of a coarser grid across the unit box."""

MIN_PARTICLES = 100
"""Least particles that carry the mass on a coarser grid."""

SOLVED = ("fluid", "multimaterial", "fluid-3d", "multimaterial-3d")
"""Splits that are solved; in full boxes the projection solver is cheaper and better."""


def coarser(size: Size, times: int | Fraction) -> Size | None:
    """Return a size with fewer cells along each axis, by a factor.

    Its time step is longer by the same factor, and a cell has as many particles.

    Args:
        size: the split and size that is predicted.
        times: the factor: 3/2, 2 or 4.

    Returns:
        None where the solver does not solve the split, where a wall would lie between
        two nodes, or where too few cells or particles would be left.
    """
    if size.split not in SOLVED:
        return None
    wall = int(size.value("wall"))
    if size.grid % times or wall % times:
        return None
    values = {
        "grid": int(size.grid / times),
        "wall": int(wall / times),
        "substeps_per_frame": math.ceil(size.substeps_per_frame / times),
        "particles": int(size.particles // times**size.dimension),
    }
    if values["grid"] < MIN_CELLS or values["particles"] < MIN_PARTICLES:
        return None
    parameters = dict(size.parameters)
    for name, value in values.items():
        parameters[name] = parameters[name].model_copy(update={"value": value})
    return size.model_copy(update={"parameters": parameters})


class CoarseRollout:
    """A scenario on its way, on the grid and with the constants of a coarser size.

    Args:
        given: what is given of the scenario.
        coarse: grid, constants and number of particles that carry mass.
    """

    def __init__(self, given: Given, coarse: Size) -> None:
        # Not imported here: the solver keeps its engine quiet.
        find_engine()

        self.given = given
        self.substeps = coarse.substeps_per_frame
        self.position = given.last.copy()
        count = min(coarse.particles, len(given.last))
        self.carriers = spread_subset(self.position, given.material, count)
        all_particles = np.arange(len(self.position))
        self.others = np.setdiff1d(all_particles, self.carriers)
        self.leader = leaders(given, self.carriers, self.others)
        self.offset = given.box.displacement(
            self.position[self.carriers][self.leader], self.position[self.others]
        )
        constants = replace(solver_constants(coarse), particles=count)
        self.solver = borrow_solver(constants)
        weakref.finalize(self, give_back, constants, self.solver)
        self.solver.load([_state(given, self.carriers)])

    def advance(self) -> Floats:
        """Return the positions in the next frame [length], shape [particle, axis].

        Raises:
            WorkFailedError: the solver left the bounds within which it is valid.
        """
        given = self.given
        self.solver.advance(self.substeps)
        after = self.solver.position()[0].astype(np.float64)
        position = self.position.copy()
        position[self.others] = after[self.leader] + self.offset
        position[self.carriers] = after
        self.position = given.inside(position)
        return self.position


def _state(given: Given, carriers: NDArray[np.intp]) -> InitialState:
    """Return the start of the solver: the particles that carry mass."""
    size = given.size
    interval = size.frame_interval
    velocity = given.step / interval
    velocity[:, UP] -= 0.5 * float(size.value("gravity")) * interval
    count = len(carriers)
    dimension = given.box.dimension
    friction = given.parameters.get("friction", 0.0)
    return InitialState(
        position=given.last[carriers],
        velocity=velocity[carriers],
        affine=np.zeros((count, dimension, dimension)),
        material=given.material[carriers],
        area=given.area,
        friction=float(str(friction)),
        wall_velocity=np.zeros((2 * dimension, dimension)),
    )
