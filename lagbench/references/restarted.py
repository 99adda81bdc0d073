"""Restarted simulator: the solver that made the data, started from the given frames.

What a surrogate must be compared with first: it knows the equations, the materials,
the viscosity and what drives the flow, and lacks only what the frames do not show. It
runs at a *refinement*: its cells along each axis over those of the recorded spacing,
with as many time steps a frame in the same measure, and with as many particles a cell.
The cells are whole: where the box has 21 of them, a half is 10.

It starts at the first given frame and runs to the last one, so that the pressure is
there when the prediction begins. On a free surface the matter of the first frame is
undeformed, J = 1, F = 1 and C = 0, and falls freely; so says the description of the
splits. In a full box the velocities are those of a polynomial in time through all given
frames, and C is the slope of a linear function of the nearest particles. The solver's
particles are the given ones: all of them, a spread subset below a refinement of 1, or
each split into parts above it. At each given frame they are put where it has them; what
they lacked on the way corrects the velocities of the start, once. A particle that the
solver does not have keeps its offset to the nearest of its material.

In a full box at other refinements than 1 that leaves holes. There the solver's
particles are a fresh lattice with velocities of the same fit, and the given particles
are carried by the solver's field on a staggered grid.
"""

from __future__ import annotations

import math
import weakref
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import Box
from lagbench.data.registry import Size
from lagbench.generators.constants import solver_constants
from lagbench.generators.draws import quantise
from lagbench.generators.obstacle import Obstacle
from lagbench.generators.refinement import PER_SUBSTEP
from lagbench.generators.solver import Solver, build
from lagbench.generators.split import (
    FreeSurfaceParameters,
    InitialState,
    SolverParameters,
)
from lagbench.work.engine import find_engine

from .predictor import (
    Floats,
    Given,
    Kind,
    Prediction,
    ReferencePredictor,
    fit_linear,
    fitted_velocity,
)
from .staggered import StaggeredGrid

REFINEMENTS = {
    "restarted": (1.0, "the recorded resolution"),
    "restarted-2x": (2.0, "twice the recorded resolution"),
    "restarted-two-thirds": (2.0 / 3.0, "two thirds of the recorded resolution"),
    "restarted-half": (0.5, "half of the recorded resolution"),
    "restarted-quarter": (0.25, "a quarter of the recorded resolution"),
}
"""Refinement of each row, and its name for readers."""

LEAST_CELLS = 4
"""Cells of the box along its shortest axis, at least."""

LEAST_PARTICLES = 30
"""Particles of the solver, at least."""

NEAREST = 13
"""Particles to which a linear function is fitted, the particle itself included."""

JITTER = 0.25
"""Width of the offsets from a fresh lattice, in its spacings."""


# --- the solver at a refinement -------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Resolution:
    """The solver of a size at a refinement, and where the box lies in it.

    The walls must lie where the solver wants them: on nodes, or half-way between. So
    its lengths are s times those of the data, with s = 1 where nothing has to give;
    velocities and accelerations too, and moduli and viscosities s^2 times.
    """

    constants: SolverParameters  # all but the number of particles
    cells: tuple[int, ...]  # of the box, shape [axis]
    refinement: float  # that of whole cells [1]
    scale: float  # s [1]
    low: Floats  # lower corner of the box in the data [length], shape [axis]
    solver_low: Floats  # the same in the solver

    def into_solver(self, position: Floats) -> Floats:
        """Return positions in the solver [length of the solver]."""
        return np.asarray(self.solver_low + self.scale * (position - self.low))

    def from_solver(self, position: Floats) -> Floats:
        """Return positions in the data [length]."""
        return np.asarray(self.low + (position - self.solver_low) / self.scale)


def resolve(size: Size, refinement: float) -> Resolution:
    """Return the solver of a size at a refinement of its recorded spacing."""
    lengths = size.box.lengths
    low = np.asarray(size.box.low)
    recorded = np.rint(lengths * size.grid).astype(int)
    unit = math.gcd(*recorded.tolist())
    parts = max(1, round(refinement * unit))
    cells = recorded // unit * parts
    actual = parts / unit
    substeps = math.ceil(size.substeps_per_frame * actual)

    constants = solver_constants(size)
    values: dict[str, Any] = {"dt": size.frame_interval / substeps}
    if isinstance(constants, FreeSurfaceParameters):
        wall = max(1, round(actual * constants.wall))
        grid = int(cells[0]) + 2 * wall
        scale = float(cells[0] / (grid * lengths[0]))
        solver_low = np.full(len(low), wall / grid)
        values["wall"] = wall
        values["gravity"] = constants.gravity * scale
    else:
        grid = math.ceil(actual * size.grid - 1e-9)
        scale = float(cells[0] / (grid * lengths[0]))
        solver_low = scale * low
        values["substeps_per_frame"] = substeps
        for name in PER_SUBSTEP:
            values[name] = min(1.0, getattr(constants, name) / actual)
        values["fringe_length"] = constants.fringe_length * scale
        values["box"] = Box(
            low=tuple(solver_low.tolist()),
            high=tuple((solver_low + scale * lengths).tolist()),
            periodic=size.box.periodic,
        )
    values["grid"] = grid
    for field in fields(constants):
        if field.name.endswith(("modulus", "viscosity", "damping")):
            values[field.name] = getattr(constants, field.name) * scale**2
    return Resolution(
        constants=replace(constants, **values),
        cells=tuple(cells.tolist()),
        refinement=actual,
        scale=scale,
        low=low,
        solver_low=solver_low,
    )


# --- a scenario on its way ------------------------------------------------------------


class Restart(ABC):
    """A scenario on its way in the solver.

    Args:
        given: what is given of the scenario.
        resolution: the solver.
    """

    def __init__(self, given: Given, resolution: Resolution) -> None:
        # Not imported here: the solver keeps its engine quiet.
        find_engine()

        self.given = given
        self.resolution = resolution
        self.frame = given.predicted_frames[0]  # the next one, an absolute number
        self.position = given.last.copy()
        counts: dict[str, Any] = {"particles": self._choose_particles()}
        self._obstacle = _obstacle_of(given, resolution)
        if self._obstacle is not None:
            counts["obstacle_particles"] = len(self._obstacle.position)
        constants = replace(resolution.constants, **counts)
        self._substeps = round(given.size.frame_interval / constants.dt)
        self._solver = borrow_solver(constants)
        weakref.finalize(self, give_back, constants, self._solver)
        self._run_through_given_frames()
        self._before = self._solver_position()  # of the solver's particles

    @abstractmethod
    def _choose_particles(self) -> int:
        """Choose the solver's particles; return their number."""

    @abstractmethod
    def _run_through_given_frames(self) -> None:
        """Bring the solver to the last given frame."""

    @abstractmethod
    def _follow(self, before: Floats, after: Floats) -> Floats:
        """Return where the given particles go with those of the solver [length]."""

    def advance(self) -> Floats:
        """Return the positions in the next frame [length], shape [particle, axis].

        Raises:
            WorkFailedError: the solver left the bounds within which it is valid.
        """
        self._solver.advance(self._substeps)
        after = self._solver_position()
        position = self._follow(self._before, after)
        self.position = self.given.inside(position)
        self._before = after
        self.frame += 1
        return self.position

    def _solver_position(self) -> Floats:
        """Return where the solver's particles are [length], shape [particle, axis]."""
        position = self._solver.position()[0].astype(np.float64)
        return self.resolution.from_solver(position)

    def _load(
        self,
        *,
        position: Floats,
        velocity: Floats,
        affine: Floats,
        material: NDArray[np.int8],
    ) -> None:
        """Start the solver at the first given frame; arguments as of InitialState."""
        given = self.given
        size = given.size
        scale = self.resolution.scale
        interval = size.frame_interval
        dimension = given.box.dimension

        # row 0 of a program never acts: row 1 is on the way to the second frame
        wall_velocity = np.zeros((2 * dimension, dimension))
        if given.driven:
            wall_velocity = given.walls * (scale / interval)
        body_force = None
        if given.body_force is not None:
            body_force = given.body_force * (scale / interval**2)
        stream = None
        if size.has_fringe:
            stream = np.zeros(dimension)
            stream[0] = float(size.value("speed")) * scale
        # the viscosity of a free surface is a constant of its solver
        viscosity = 0.0
        if size.is_full_box:
            viscosity = float(str(given.parameters.get("viscosity", 0.0)))
        friction = float(str(given.parameters.get("friction", 0.0)))

        in_solver = self.resolution.into_solver(given.inside(position))
        state = InitialState(
            position=quantise(np.clip(in_solver, 0.0, 1.0)),
            velocity=quantise(velocity * scale),
            affine=quantise(affine),
            material=material,
            area=given.area * scale**dimension,
            viscosity=viscosity * scale**2,
            friction=friction,
            wall_velocity=wall_velocity,
            body_force=body_force,
            obstacle=self._obstacle,
            stream=stream,
        )
        self._solver.load([state])


class ParticleRestart(Restart):
    """The solver's particles are the given ones, some of them, or their parts."""

    def _choose_particles(self) -> int:
        given = self.given
        refinement = self.resolution.refinement
        count, dimension = given.last.shape
        if refinement > 1.0:
            spacing = (given.area / count) ** (1.0 / dimension)
            parts = round(refinement)
            steps = spacing * ((np.arange(parts) + 0.5) / parts - 0.5)
            offsets = _lattice([steps] * dimension)
            self._parent = np.repeat(np.arange(count), len(offsets))
            self._offset = np.tile(offsets, (count, 1))
            # each particle keeps its offset to a part of its own that is drawn
            source = np.random.Generator(np.random.PCG64(0))
            draws = source.random((count,))
            chosen = (draws * len(offsets)).astype(np.intp)
            self._leader = np.arange(count) * len(offsets) + chosen
            self._carriers = np.zeros(0, np.intp)
            self._others = np.arange(count)
            return len(self._parent)
        carried: int = min(count, round(count * float(refinement**dimension)))
        self._carriers = spread_subset(given.last, given.material, carried)
        self._parent = self._carriers
        self._offset = np.zeros((carried, dimension))
        self._others = np.setdiff1d(np.arange(count), self._carriers)
        self._leader = leaders(given, self._carriers, self._others)
        return carried

    def _run_through_given_frames(self) -> None:
        given = self.given
        frames = given.position
        count, dimension = given.last.shape
        velocity = fitted_velocity(given, 0)
        for _ in range(2):
            affine = np.zeros((count, dimension, dimension))
            if given.size.is_full_box:
                _, affine = local_fit(given, frames[0], velocity, at=frames[0])
            turned = np.einsum("pij,pj->pi", affine[self._parent], self._offset)
            self._load(
                position=frames[0][self._parent] + self._offset,
                velocity=velocity[self._parent] + turned,
                affine=affine[self._parent],
                material=given.material[self._parent],
            )
            lacking = np.zeros_like(velocity)
            for position in frames[1:]:
                self._solver.advance(self._substeps)
                target = given.inside(position[self._parent] + self._offset)
                now = self._solver_position()
                missing = _mean_of_parent(
                    given.box.displacement(now, target), self._parent, count
                )
                lacking += missing
                move = missing[self._parent] * self.resolution.scale
                self._solver.displace(move.astype(np.float32)[None])
            duration = (len(frames) - 1) * given.size.frame_interval
            velocity = velocity + lacking / duration

    def _follow(self, before: Floats, after: Floats) -> Floats:
        step = self.given.box.displacement(before[self._leader], after[self._leader])
        position = self.position.copy()
        position[self._others] += step
        position[self._carriers] = after[: len(self._carriers)]
        return position


def _mean_of_parent(values: Floats, parent: NDArray[np.intp], count: int) -> Floats:
    """Return the mean of the parts of each particle, 0 where it has none."""
    parts = np.maximum(1, np.bincount(parent, minlength=count))
    total = np.zeros((count, values.shape[1]))
    for axis, column in enumerate(values.T):
        total[:, axis] = np.bincount(parent, column, count)
    return total / parts[:, None]


class LatticeRestart(Restart):
    """The solver's particles are a lattice; the given ones are carried by its field."""

    def _choose_particles(self) -> int:
        given = self.given
        box = given.box
        spacing = (given.area / len(given.last)) ** (1.0 / box.dimension)
        counts = np.rint(box.lengths * self.resolution.refinement / spacing)
        axes = [np.arange(count) + 0.5 for count in counts]
        cell = box.lengths / counts
        middle = np.asarray(box.low) + cell * _lattice(axes)
        draws = np.random.Generator(np.random.PCG64(0)).random(middle.shape)
        places = middle + JITTER * cell * (draws - 0.5)
        if given.obstacle is not None:
            way = middle - given.obstacle[:-1]
            is_outside = (way**2).sum(axis=1) >= given.obstacle[-1] ** 2
            places = places[is_outside]
        self._places = given.inside(places)
        self._grid = StaggeredGrid(
            box, cells=self.resolution.cells, no_slip=given.driven
        )
        return len(places)

    def _run_through_given_frames(self) -> None:
        given = self.given
        velocity, affine = local_fit(
            given, given.position[0], fitted_velocity(given, 0), at=self._places
        )
        self._load(
            position=self._places,
            velocity=velocity,
            affine=affine,
            material=np.full(len(velocity), given.material[0]),
        )
        for _ in given.position[1:]:
            self._solver.advance(self._substeps)

    def _follow(self, before: Floats, after: Floats) -> Floats:
        given = self.given
        grid = self._grid
        walls = given.walls[min(self.frame, len(given.walls) - 1)]
        step = given.box.displacement(before, after)
        middle = given.inside(before + 0.5 * step)
        field = grid.from_particles(middle, step, wall_velocity=walls)
        start = grid.at_particles(field, self.position, wall_velocity=walls)
        half_way = given.inside(self.position + 0.5 * start)
        change = grid.at_particles(field, half_way, wall_velocity=walls)
        return np.asarray(self.position + change)


# --- the start ------------------------------------------------------------------------


def local_fit(
    given: Given, position: Floats, velocity: Floats, *, at: Floats
) -> tuple[Floats, Floats]:
    """Return velocity [length/s] and velocity gradient [1/s] at some places.

    They are those of a linear function of the nearest particles.

    Args:
        given: what is given of the scenario: its box.
        position: of the particles [length], shape [particle, axis].
        velocity: of the particles [length/s], shape [particle, axis].
        at: the places [length], shape [place, axis].

    Returns:
        Arrays of shapes [place, axis] and [place, axis, axis].
    """
    box = given.box
    tree = box.tree(position)
    neighbour_count = min(NEAREST, len(position))
    found = tree.query(box.tree_points(at), k=neighbour_count)
    distance, nearest = map(np.asarray, found)
    way = box.displacement(at[:, None], position[nearest])
    solution = fit_linear(distance, way, velocity[nearest])
    return solution[:, 0], np.swapaxes(solution[:, 1:], 1, 2)


def _lattice(axes: list[Floats]) -> Floats:
    """Return all points with such coordinates along each axis, shape [point, axis]."""
    grids = np.meshgrid(*axes, indexing="ij")
    return np.stack([grid.ravel() for grid in grids], axis=1)


def _obstacle_of(given: Given, resolution: Resolution) -> Obstacle | None:
    """Return the fixed body in the solver, filled with a lattice around its centre."""
    if given.obstacle is None:
        return None
    centre = given.obstacle[:-1].astype(np.float64)
    radius = float(given.obstacle[-1])
    spacing = 1.0 / (float(given.size.value("lattice")) * resolution.refinement)
    most = math.ceil(radius / spacing)
    steps: Floats = spacing * (np.arange(-most, most, dtype=np.float64) + 0.5)
    ways = _lattice([steps] * given.box.dimension)
    is_inside = (ways**2).sum(axis=1) < radius**2
    return Obstacle(
        centre=tuple(resolution.into_solver(centre).tolist()),
        radius=radius * resolution.scale,
        position=resolution.into_solver(centre + ways[is_inside]),
    )


def leaders(
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


MOST_KEPT = 4
"""Sets of constants of which free solvers are kept, at most."""

_idle_solvers: dict[SolverParameters, list[Solver]] = {}
"""Free solvers by their constants, last used ones last: to build one compiles it."""


def borrow_solver(constants: SolverParameters) -> Solver:
    """Return a solver that no other rollout uses."""
    idle = _idle_solvers.get(constants)
    if idle:
        return idle.pop()
    return build(constants, threads=1)


def give_back(constants: SolverParameters, solver: Solver) -> None:
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


# --- the rows -------------------------------------------------------------------------


def predict(given: Given, refinement: float) -> Prediction:
    """Yield positions that the restarted simulator finds at a refinement."""
    resolution = resolve(given.size, refinement)
    return follow(start(given, resolution))


def start(given: Given, resolution: Resolution) -> Restart:
    """Return a scenario that stands at its last given frame."""
    if given.size.is_full_box and resolution.refinement != 1.0:
        return LatticeRestart(given, resolution)
    return ParticleRestart(given, resolution)


def follow(restart: Restart) -> Prediction:
    """Yield the positions of the frames to predict."""
    for _ in restart.given.predicted_frames:
        yield restart.advance().astype("float32")


def runs_at(size: Size, refinement: float) -> bool:
    """Tell whether the simulator of a split and size runs at a refinement.

    Above 1 it runs where the truth is finer than its files.
    """
    if not size.simulated:
        return False
    if refinement > 1.0:
        return size.refinement > 1
    cells = np.rint(size.box.lengths * size.grid * refinement)
    particles = size.particles * refinement**size.dimension
    return bool(cells.min() >= LEAST_CELLS and particles >= LEAST_PARTICLES)


def _describe(name: str, refinement: float, words: str) -> ReferencePredictor:
    return ReferencePredictor(
        name=name,
        title=f"Restarted simulator, {words}",
        kind=Kind.CLASSICAL,
        definition="The simulator of the data, started from the given frames, at"
        f" {words}: it knows the equations, the materials and what drives the flow.",
        applies=lambda size: runs_at(size, refinement),
        predict=lambda given: predict(given, refinement),
    )


PREDICTORS = tuple(
    _describe(name, refinement, words)
    for name, (refinement, words) in REFINEMENTS.items()
)
