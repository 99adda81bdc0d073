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
from lagbench.errors import check_installed
from lagbench.generators.constants import solver_constants
from lagbench.generators.solver import Solver, build
from lagbench.generators.split import InitialState, SolverParameters

from .predictor import (
    Floats,
    Given,
    Kind,
    Prediction,
    ReferencePredictor,
    velocity_field,
    with_wall_images,
)
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
        # Not imported here: the solver keeps Taichi quiet.
        check_installed("taichi", extra="generate")

        self.given = given
        self.substeps = coarse.substeps_per_frame
        self.frame = given.predicted_frames[0]  # the next one, an absolute number
        self.position = given.last.copy()
        count = min(coarse.particles, len(given.last))
        self.carriers = spread_subset(self.position, given.material, count)
        self.before = self.position[self.carriers]  # where they were a frame ago
        all_particles = np.arange(len(self.position))
        self.others = np.setdiff1d(all_particles, self.carriers)
        self.leader = _leaders(given, self.carriers, self.others)
        self.offset = given.box.displacement(
            self.position[self.carriers][self.leader], self.position[self.others]
        )
        constants = replace(solver_constants(coarse), particles=count)
        self.solver = _borrow_solver(constants)
        weakref.finalize(self, _give_back, constants, self.solver)
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


MOST_KEPT = 4
"""Sets of constants of which free solvers are kept, at most."""

_idle_solvers: dict[SolverParameters, list[Solver]] = {}
"""Free solvers by their constants, last used ones last: to build one compiles it."""


def _borrow_solver(constants: SolverParameters) -> Solver:
    """Return a solver that no other rollout uses."""
    idle = _idle_solvers.get(constants)
    if idle:
        return idle.pop()
    return build(constants, threads=1)


def _give_back(constants: SolverParameters, solver: Solver) -> None:
    """Keep a solver for the next rollout; where there are many, the oldest go."""
    idle = _idle_solvers.pop(constants, [])
    idle.append(solver)
    _idle_solvers[constants] = idle
    while len(_idle_solvers) > MOST_KEPT:
        oldest = next(iter(_idle_solvers))
        del _idle_solvers[oldest]


def spread_subset(
    position: Floats, material: NDArray[np.integer], count: int
) -> NDArray[np.intp]:
    """Return which particles carry the mass: one, drawn, of each group of neighbours.

    Groups follow material, column and height. A material with fewer particles than a
    group may get none.
    """
    order = _order_of_columns(position, material, count)
    draws = np.random.Generator(np.random.PCG64(0)).random(count)
    groups = np.array_split(order, count)
    carriers = []
    for draw, group in zip(draws, groups, strict=True):
        place = int(draw * len(group))
        carriers.append(group[place])
    return np.sort(carriers)


def _order_of_columns(
    position: Floats, material: NDArray[np.integer], count: int
) -> NDArray[np.intp]:
    """Return the particles of each material column by column, along the last axis.

    In three dimensions a slab across x holds columns across y.
    """
    particles, dimension = position.shape
    x = position[:, 0]
    y = position[:, 1]
    column = np.zeros(particles, np.intp)
    for kind in np.unique(material):
        members = np.flatnonzero(material == kind)
        chosen_count = math.ceil(count * len(members) / particles)
        if dimension == 2:
            columns = math.isqrt(chosen_count)
            column[members] = _rank(x[members], columns)
            continue
        root = float(np.cbrt(chosen_count))
        side = max(1, round(root))
        slab = _rank(x[members], side)
        for number in range(side):
            inside = members[slab == number]
            column_of_slab = _rank(y[inside], side)
            column[inside] = number * side + column_of_slab
    last_axis = position[:, -1]
    return np.lexsort((last_axis, column, material))


def _rank(coordinate: Floats, groups: int) -> NDArray[np.intp]:
    """Return in which of so many groups of nearly equal counts each one lies."""
    order = np.argsort(coordinate, kind="stable")
    place = np.argsort(order, kind="stable")
    count = max(1, len(coordinate))
    return np.asarray(place * groups // count, np.intp)


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


def _leaders(
    given: Given, carriers: NDArray[np.intp], others: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Return for each other particle the index of the nearest of its material that
    carries mass; of any material where none of its own does.
    """
    carrier_position = given.last[carriers]
    carrier_material = given.material[carriers]
    other_position = given.last[others]
    other_material = given.material[others]
    leader = np.zeros(len(others), np.intp)
    for kind in np.unique(other_material):
        pool = np.flatnonzero(carrier_material == kind)
        if not pool.size:
            pool = np.arange(len(carriers))
        led = np.flatnonzero(other_material == kind)
        tree = given.box.tree(carrier_position[pool])
        points = given.box.tree_points(other_position[led])
        _, nearest = tree.query(points)
        leader[led] = pool[nearest]
    return leader


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
