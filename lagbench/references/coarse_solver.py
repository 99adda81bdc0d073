"""Coarse solver: the same equations on a coarser grid, with its longer time step.

What a surrogate must be compared with: accuracy against cost. It learns nothing, but it
knows the equations, the viscosity, the materials and the motion of the walls to the
end. Its grid has half as many cells along each axis, or a quarter, and its time step is
two or four times as long. Where the walls do not lie on nodes of the half grid, it has
two thirds of the cells and a time step that is 1.5 times as long. A seeded subset of
the particles, as many to a cell as before and as evenly spread, carries the mass. In a
full box the others move as those around them do (see :mod:`.predictor`); on a free
surface each keeps its offset to the nearest particle of its material that carries mass.

The solver starts from displacements alone: in full boxes the velocity of the last given
frame is extrapolated from two of them, ``(3 u(f) - u(f-1)) / 2``; in free fall it is
``u(f) + g / 2``.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from lagbench.data.registry import Size
from lagbench.generators.constants import solver_constants
from lagbench.generators.split import InitialState
from lagbench.work.engine import find_engine

from .predictor import (
    Floats,
    Given,
    Kind,
    Prediction,
    ReferencePredictor,
    velocity_field,
    with_wall_images,
)
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


def predict(given: Given, times: int | Fraction) -> Prediction:
    """Yield positions that the solver on a coarser grid finds.

    Raises:
        ValueError: the split and size has no such grid.
    """
    coarse = coarser(given.size, times)
    if coarse is None:
        raise ValueError(f"{given.size.split} {given.size.name} has no coarser size")
    return predict_with(given, coarse)


def predict_with(given: Given, coarse: Size) -> Prediction:
    """Yield positions that the solver finds with the constants of a size."""
    rollout = CoarseRollout(given, coarse)
    for _ in given.predicted_frames:
        position = rollout.advance()
        yield position.astype("float32")


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
        self.frame = given.predicted_frames[0]  # the next one, an absolute number
        self.position = given.last.copy()
        count = min(coarse.particles, len(given.last))
        self.carriers = spread_subset(self.position, given.material, count)
        self.before = self.position[self.carriers]  # where they were a frame ago
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

        The last wall velocities that are known stay.

        Raises:
            WorkFailedError: the solver left the bounds within which it is valid.
        """
        given = self.given
        self.solver.advance(self.substeps)
        after = self.solver.position()[0].astype(np.float64)
        position = self.position.copy()
        if given.size.is_full_box and self.others.size:
            last_known = len(given.walls) - 1
            points, velocities = with_wall_images(
                given,
                self.before,
                given.box.displacement(self.before, after),
                given.walls[min(self.frame, last_known)],
            )
            field = velocity_field(points, velocities)
            position[self.others] += field(position[self.others])
        else:
            position[self.others] = after[self.leader] + self.offset
        position[self.carriers] = after
        self.before = after
        self.position = given.inside(position)
        self.frame += 1
        return self.position


def _state(given: Given, carriers: NDArray[np.intp]) -> InitialState:
    """Return the start of the solver: the particles that carry mass."""
    size = given.size
    interval = size.frame_interval
    if size.is_full_box:
        step_before = given.box.displacement(given.position[-3], given.position[-2])
        velocity = (1.5 * given.step - 0.5 * step_before) / interval
    else:
        gravity = float(size.value("gravity"))
        velocity = given.step / interval
        velocity[:, UP] -= 0.5 * gravity * interval
    # row 0 of a program never acts: row 1 is on the way to the first predicted frame
    last_given = given.predicted_frames[0] - 1
    wall_velocity = given.walls[last_given:] / interval
    if not given.driven:
        wall_velocity = wall_velocity[0]
    count = len(carriers)
    dimension = given.box.dimension
    viscosity = given.parameters.get("viscosity", 0.0)
    friction = given.parameters.get("friction", 0.0)
    return InitialState(
        position=given.last[carriers],
        velocity=velocity[carriers],
        affine=np.zeros((count, dimension, dimension)),
        material=given.material[carriers],
        area=given.area,
        viscosity=float(str(viscosity)),
        friction=float(str(friction)),
        wall_velocity=wall_velocity,
    )


TWO_THIRDS = Fraction(3, 2)
"""How many times fewer cells where the walls do not lie on nodes of half the grid."""


def _has_half(size: Size) -> bool:
    """Tell whether the solver runs on half of the cells."""
    return coarser(size, 2) is not None


def _has_quarter(size: Size) -> bool:
    """Tell whether the solver runs on a quarter of the cells."""
    return coarser(size, 4) is not None


def _has_two_thirds_only(size: Size) -> bool:
    """Tell whether the solver runs on two thirds of the cells, but not on half."""
    return not _has_half(size) and coarser(size, TWO_THIRDS) is not None


def _make_predictor(
    name: str, times: int | Fraction, share: str, applies: Callable[[Size], bool]
) -> ReferencePredictor:
    """Return the solver with ``times`` fewer cells along each axis, as a predictor."""

    def predict_scenario(given: Given) -> Prediction:
        return predict(given, times)

    return ReferencePredictor(
        name=name,
        title=f"Coarse solver, {share} of the cells",
        kind=Kind.CLASSICAL,
        definition=f"The solver itself on a grid with {share} of the cells along each"
        " axis, with the longer time step of that grid: it knows the equations, the"
        " materials and what drives the flow.",
        applies=applies,
        predict=predict_scenario,
    )


PREDICTORS = (
    _make_predictor("coarse-solver", 2, "half", _has_half),
    _make_predictor("coarse-solver-4x", 4, "a quarter", _has_quarter),
    _make_predictor(
        "coarse-solver-two-thirds", TWO_THIRDS, "two thirds", _has_two_thirds_only
    ),
)
