"""Three families of design tasks, sixteen instances each, drawn from a seed.

``pour``: throw a body of liquid so that it lies in a bucket's range (four numbers).
``stir``: programs of two walls that mix a marked half of a cavity (sixteen numbers).
``identify``: the viscosity of a fluid, or the friction of walls, from twenty noisy
frames (two or three numbers; the others are unknown too, but not scored).

All goals are errors: less is better. The simulator of the tasks is that of the size
mini at refinement 1, so a run takes a fraction of a second on one core.
"""

from __future__ import annotations

import functools
import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.data import WALLS
from lagbench.data.registry import Size, load
from lagbench.errors import UsageError, WorkFailedError
from lagbench.generators.constants import free_surface_walls, solver_constants
from lagbench.generators.draws import (
    fill,
    log_uniform,
    normal,
    quantise,
    uniform,
)
from lagbench.generators.shapes import Disc, Rectangle, Shape, body_at, sample_points
from lagbench.generators.solver import Solver, build
from lagbench.generators.split import (
    InitialState,
    Material,
    SolverParameters,
    liquid,
)
from lagbench.references.restarted import resolve

Floats = NDArray[np.float64]

INSTANCES = 16
"""Instances of each family."""

VERSION = 1
"""Changes when an instance does; results of another version are not comparable."""

POUR_WINDOW = 10  # last frames over which the liquid shall be in the bucket
STIR_FRAMES = 40
STIR_KNOTS = 8  # of the program of each wall
MODES = 16  # cosine modes along each axis in the mix-norm
IDENTIFY_FRAMES = 20
NOISE = 0.2  # standard deviation of observed positions, in particle spacings


@dataclass(frozen=True)
class FreeParameter:
    """A free parameter of a task."""

    name: str
    unit: str
    low: float
    high: float
    is_logarithmic: bool = False  # whether it is drawn evenly in its logarithm

    def at(self, share: float) -> float:
        """Return the value at a share of the way from low to high, from 0 to 1."""
        if self.is_logarithmic:
            value = self.low * float((self.high / self.low) ** share)
        else:
            value = self.low + (self.high - self.low) * share
        return min(max(value, self.low), self.high)


@dataclass(frozen=True, kw_only=True, eq=False)
class DesignTask:
    """One instance of a family."""

    name: str  # family and number, as in pour-03
    split: str  # whose simulator runs, at size mini and refinement 1
    goal: str  # what is to be reached, in words
    unit: str  # of the error
    parameters: tuple[FreeParameter, ...]
    frames: int  # frames that are simulated after frame 0
    # from the size (ours or a coarser one) and the parameters to the start of the run
    start: Callable[[Size, Floats], InitialState]
    # from positions [length], shape [frame, particle, axis], and the parameters to the
    # error
    measure: Callable[[Floats, Floats], float]
    # noisy positions of `identify` in the frames behind frame 0 [length], shape [frame,
    # particle, axis]
    observe: Callable[[], Floats] | None = None
    # parameters of the run that `identify` shows
    truth: tuple[float, ...] | None = None
    # low and high corner of the bucket of `pour` [length], shape [2, axis]
    bucket: Floats | None = None
    # axis along which `stir` divides the marked half from the other
    marked_axis: int | None = None

    @property
    def size(self) -> Size:
        """The size whose solver runs."""
        return load().size(self.split, "mini")

    def at(self, shares: ArrayLike) -> list[float]:
        """Return the parameters at shares of the way from low to high, from 0 to 1."""
        values = []
        for parameter, share in zip(
            self.parameters, np.asarray(shares, np.float64).tolist(), strict=True
        ):
            values.append(parameter.at(min(max(share, 0.0), 1.0)))
        return values

    def check(self, values: Sequence[float]) -> Floats:
        """Return parameters as an array.

        Raises:
            UsageError: too few or too many, or one out of bounds.
        """
        array = np.asarray(values, np.float64)
        if array.shape != (len(self.parameters),):
            raise UsageError(
                f"{self.name} has {len(self.parameters)} parameters, not {array.size}"
            )
        for value, parameter in zip(array.tolist(), self.parameters, strict=True):
            if not parameter.low <= value <= parameter.high:
                raise UsageError(
                    f"{self.name}: {parameter.name} is {value:g}; give "
                    f"{parameter.low:g} to {parameter.high:g} {parameter.unit}"
                )
        return array

    def simulate(
        self, values: Sequence[float], *, refinement: float = 1.0
    ) -> NDArray[np.float32]:
        """Return the positions of a run [length], shape [frame, particle, axis].

        Args:
            values: the parameters.
            refinement: cells along each axis over those of the judge. The coarser
                solver is that of the restarted simulator.

        Raises:
            UsageError: parameters out of bounds.
            WorkFailedError: the run left the bounds within which the solver is valid.
        """
        size = self.size
        array = self.check(values)
        if refinement == 1.0:
            return self._run(solver_constants(size), self.start(size, array))
        particles = size.parameters["particles"].model_copy(
            update={"value": int(size.particles * refinement**2)}
        )
        coarse_size = size.model_copy(
            update={"parameters": {**size.parameters, "particles": particles}}
        )
        resolution = resolve(size, refinement)
        constants = replace(resolution.constants, particles=coarse_size.particles)
        state = self.start(coarse_size, array)
        scale = resolution.scale
        state = replace(
            state,
            position=resolution.into_solver(state.position),
            velocity=scale * state.velocity,
            area=scale**2 * state.area,
            viscosity=scale**2 * state.viscosity,
            wall_velocity=scale * state.wall_velocity,
        )
        positions = self._run(constants, state).astype(np.float64)
        return resolution.from_solver(positions).astype(np.float32)

    def _run(
        self, constants: SolverParameters, state: InitialState
    ) -> NDArray[np.float32]:
        solver = _solver(constants)
        solver.load([state])
        substeps = round(self.size.frame_interval / constants.dt)
        positions = [solver.position()[0].copy()]
        for _ in range(self.frames):
            solver.advance(substeps)
            positions.append(solver.position()[0].copy())
        return np.stack(positions)

    def error(self, values: Sequence[float]) -> float:
        """Return the error that parameters reach; infinite where the run fails."""
        try:
            positions = self.simulate(values).astype(np.float64)
        except WorkFailedError:
            return math.inf
        return self.measure(positions, self.check(values))

    def objective(self, values: Sequence[float], *, refinement: float = 1.0) -> float:
        """Return what a search minimises, from one run; infinite where it fails."""
        try:
            positions = self.simulate(values, refinement=refinement)
        except WorkFailedError:
            return math.inf
        return self.objective_of(positions.astype(np.float64), values)

    def objective_of(self, positions: Floats, values: Sequence[float]) -> float:
        """Return what a search minimises, for the positions of any simulator.

        It is the error itself, or for ``identify``, whose error is hidden, the root
        mean square distance from the noisy positions. A coarser run has other
        particles: each stands for the observed one that starts nearest.

        Args:
            positions: of all frames [length], shape [frame, particle, axis].
            values: the parameters.
        """
        array = self.check(values)
        if self.observe is None:
            return self.measure(positions, array)
        # listing the tasks loads no SciPy
        from scipy.spatial import cKDTree

        observed = self.observe()
        displacement = positions[1:] - positions[0]
        start = self.start(self.size, array).position
        _, nearest = cKDTree(start).query(positions[0])
        expected = observed[:, nearest] - start[nearest]
        return float(np.sqrt(((displacement - expected) ** 2).sum(axis=-1).mean()))


@functools.lru_cache(maxsize=8)
def _solver(parameters: SolverParameters) -> Solver:
    """Return the solver of some constants, compiled once per process."""
    return build(parameters)


def task_names() -> list[str]:
    """Return the names of all instances, family by family.

    >>> names = task_names()
    >>> len(names), names[0], names[-1]
    (48, 'pour-00', 'identify-15')
    """
    names = []
    for family in FAMILIES:
        for number in range(INSTANCES):
            names.append(f"{family}-{number:02d}")
    return names


@functools.cache
def load_task(name: str) -> DesignTask:
    """Return an instance by its name, as in ``pour-03``.

    Raises:
        UsageError: there is no such task.
    """
    if name not in task_names():
        raise UsageError(
            f"no design task {name!r}; `lagbench design list` names all of them"
        )
    family, _, number = name.partition("-")
    digest = hashlib.sha256(f"design/{family}/{VERSION}".encode()).digest()
    word = int.from_bytes(digest[:8], "big")
    seed = np.random.SeedSequence((word, int(number)))
    rng = np.random.Generator(np.random.PCG64(seed))
    return FAMILIES[family](name, int(number), rng)


# --- pour -----------------------------------------------------------------------------


def _draw_pour(name: str, number: int, rng: np.random.Generator) -> DesignTask:
    """Draw a body of liquid, a bucket and the frame at which the liquid lies in it."""
    del number
    area = uniform(rng, 0.04, 0.06)
    shape: Shape = Disc.of_area(area)
    if rng.random() < 0.5:
        shape = Rectangle.of_area(area, uniform(rng, 0.6, 1.7))
    left = uniform(rng, 0.45, 0.75)
    bucket = np.array([(left, 0.0), (left + 0.2, 0.35)])
    frames = 36 + int(24 * rng.random())
    shift_seed = int(rng.random() * 2**32)
    goal = (
        f"the liquid lies between x = {left:.3f} and {left + 0.2:.3f}, below y = 0.35, "
        f"in the last {POUR_WINDOW} of {frames} frames"
    )

    def start(size: Size, values: Floats) -> InitialState:
        x, y, speed, angle = values.tolist()
        low, high = free_surface_walls(size)
        body = body_at(shape, x, y)
        points = np.random.Generator(np.random.PCG64(shift_seed))
        position = sample_points(points, body, size.particles)
        direction = math.radians(angle)
        velocity = quantise((speed * math.cos(direction), speed * math.sin(direction)))
        return InitialState(
            position=np.clip(position, low, high),
            velocity=np.tile(velocity, (size.particles, 1)),
            affine=np.zeros((size.particles, 2, 2)),
            material=liquid(size.particles),
            area=area,
        )

    def measure(positions: Floats, values: Floats) -> float:
        del values
        last = positions[-POUR_WINDOW:]
        beyond = np.maximum(bucket[0] - last, last - bucket[1])
        distance = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
        return float(distance.mean())

    reach_x, reach_y = shape.reach
    return DesignTask(
        name=name,
        split="fluid",
        goal=goal,
        unit="length",
        parameters=(
            FreeParameter("x", "length", 0.08 + reach_x, 0.42),
            FreeParameter("y", "length", 0.08 + reach_y, 0.6),
            FreeParameter("speed", "length/s", 0.0, 2.5),
            FreeParameter("angle", "degree", -30.0, 80.0),
        ),
        frames=frames,
        start=start,
        measure=measure,
        bucket=bucket,
    )


# --- stir -----------------------------------------------------------------------------


def _draw_stir(name: str, number: int, rng: np.random.Generator) -> DesignTask:
    """Draw a viscosity and the walls that stir; one half of the fluid is marked."""
    axis = number % 2  # along which the moving walls slide and the marked half ends
    walls = ("bottom", "top") if axis == 0 else ("left", "right")
    viscosity = log_uniform(rng, 5e-4, 5e-3)
    jitter_seed = int(rng.random() * 2**32)
    limit = float(load().size("cavity", "mini").value("speed_max"))
    parameters = []
    for wall in walls:
        for knot in range(STIR_KNOTS):
            parameters.append(
                FreeParameter(f"{wall}_{knot}", "length/s", -limit, limit)
            )

    def start(size: Size, values: Floats) -> InitialState:
        low, high = size.bounds[0]
        frames = np.arange(STIR_FRAMES + 1)
        knots = np.linspace(0, STIR_FRAMES, STIR_KNOTS)
        motion = np.zeros((len(frames), len(WALLS), 2))
        for wall, program in zip(walls, values.reshape(2, STIR_KNOTS), strict=True):
            speed = quantise(np.interp(frames, knots, program))
            motion[:, WALLS.index(wall), axis] = speed
        jitter = np.random.Generator(np.random.PCG64(jitter_seed))
        position = fill(
            jitter, size.particles, low=low, high=high, jitter=size.value("jitter")
        )
        return InitialState(
            position=position,
            velocity=np.zeros((size.particles, 2)),
            affine=np.zeros((size.particles, 2, 2)),
            material=liquid(size.particles),
            area=(high - low) ** 2,
            viscosity=viscosity,
            wall_velocity=motion,
        )

    def measure(positions: Floats, values: Floats) -> float:
        del values
        low, high = load().size("cavity", "mini").bounds[0]
        places = (positions - low) / (high - low)
        mark = np.where(places[0, :, axis] < 0.5, 1.0, -1.0)
        return mix_norm(places[-1], mark) / mix_norm(places[0], mark)

    return DesignTask(
        name=name,
        split="cavity",
        goal=f"the mix-norm of the marked half is small after {STIR_FRAMES} frames",
        unit="1",
        parameters=tuple(parameters),
        frames=STIR_FRAMES,
        start=start,
        measure=measure,
        marked_axis=axis,
    )


def mix_norm(places: Floats, mark: Floats) -> float:
    """Return the mix-norm of a marked fluid in a unit square with walls.

    ``sqrt(sum_k |c_k|^2 / sqrt(1 + |pi k|^2))`` over the cosine modes k != 0, where
    ``c_k`` is the mean over particles of mark times mode (Mathew, Mezic, Petzold 2005,
    Physica D 211, Eq. 7, for walls in place of a torus). It is small where the mark is
    uniform at all but fine scales.

    Args:
        places: positions in the square, from 0 to 1, shape [particle, 2].
        mark: 1 or -1 of each particle, shape [particle].
    """
    centred = mark - mark.mean()
    wave = np.arange(MODES)
    scale = np.where(wave > 0, math.sqrt(2.0), 1.0)
    modes_x = scale * np.cos(np.pi * wave * places[:, :1])  # [particle, mode]
    modes_y = scale * np.cos(np.pi * wave * places[:, 1:])
    coefficients = np.einsum("p,pi,pj->ij", centred, modes_x, modes_y) / len(mark)
    square = wave[:, None] ** 2 + wave[None, :] ** 2
    weight = 1.0 / np.sqrt(1.0 + np.pi**2 * square)
    return float(np.sqrt((weight * coefficients**2).sum()))


# --- identify -------------------------------------------------------------------------


def _draw_identify(name: str, number: int, rng: np.random.Generator) -> DesignTask:
    """Draw the unknown numbers of a run, and the noise of what is seen of it."""
    if number % 2 == 0:
        return _draw_viscosity(name, rng)
    return _draw_friction(name, rng)


def _draw_viscosity(name: str, rng: np.random.Generator) -> DesignTask:
    """Draw a cavity whose viscosity and speed of the lid are unknown."""
    parameters = (
        FreeParameter("viscosity", "length^2/s", 2e-4, 2e-2, is_logarithmic=True),
        FreeParameter("lid_speed", "length/s", 0.05, 0.26),
    )
    truth = np.array([log_uniform(rng, 4e-4, 1e-2), uniform(rng, 0.1, 0.25)])
    jitter_seed = int(rng.random() * 2**32)

    def start(size: Size, values: Floats) -> InitialState:
        viscosity, lid_speed = values.tolist()
        low, high = size.bounds[0]
        wall_velocity = np.zeros((len(WALLS), 2))
        wall_velocity[WALLS.index("top"), 0] = quantise(lid_speed)
        jitter = np.random.Generator(np.random.PCG64(jitter_seed))
        position = fill(
            jitter, size.particles, low=low, high=high, jitter=size.value("jitter")
        )
        return InitialState(
            position=position,
            velocity=np.zeros((size.particles, 2)),
            affine=np.zeros((size.particles, 2, 2)),
            material=liquid(size.particles),
            area=(high - low) ** 2,
            viscosity=viscosity,
            wall_velocity=wall_velocity,
        )

    return _identify(name, "cavity", parameters, truth, start, rng)


def _draw_friction(name: str, rng: np.random.Generator) -> DesignTask:
    """Draw a jelly body that slides; friction and velocity are unknown."""
    parameters = (
        FreeParameter("friction", "1", 0.01, 1.0, is_logarithmic=True),
        FreeParameter("velocity_x", "length/s", -2.0, 2.0),
        FreeParameter("velocity_y", "length/s", -1.0, 1.0),
    )
    truth = np.array(
        [
            log_uniform(rng, 0.03, 0.5),
            math.copysign(uniform(rng, 0.8, 1.8), rng.random() - 0.5),
            uniform(rng, -0.8, 0.2),
        ]
    )
    shape = Rectangle.of_area(uniform(rng, 0.03, 0.05), uniform(rng, 0.6, 1.7))
    shift_seed = int(rng.random() * 2**32)

    def start(size: Size, values: Floats) -> InitialState:
        friction, velocity_x, velocity_y = values.tolist()
        low, high = free_surface_walls(size)
        body = body_at(shape, 0.5, low + shape.reach[1] + 0.01)
        points = np.random.Generator(np.random.PCG64(shift_seed))
        position = sample_points(points, body, size.particles)
        velocity = quantise((velocity_x, velocity_y))
        return InitialState(
            position=np.clip(position, low, high),
            velocity=np.tile(velocity, (size.particles, 1)),
            affine=np.zeros((size.particles, 2, 2)),
            material=np.full(size.particles, Material.JELLY, np.int8),
            area=shape.measure,
            friction=friction,
        )

    return _identify(name, "multimaterial", parameters, truth, start, rng)


def _identify(
    name: str,
    split: str,
    parameters: tuple[FreeParameter, ...],
    truth: Floats,
    start: Callable[[Size, Floats], InitialState],
    rng: np.random.Generator,
) -> DesignTask:
    """Return a task whose error is the distance of the first parameter's logarithm."""
    noise_seed = int(rng.random() * 2**32)

    def measure(positions: Floats, values: Floats) -> float:
        del positions
        return abs(math.log(values[0] / truth[0]))

    @functools.cache
    def observe() -> Floats:
        positions = task.simulate(truth.tolist()).astype(np.float64)[1:]
        state = start(task.size, truth)
        spacing = math.sqrt(state.area / len(state.position))
        source = np.random.Generator(np.random.PCG64(noise_seed))
        return positions + normal(source, NOISE * spacing, positions.shape)

    task = DesignTask(
        name=name,
        split=split,
        goal=f"the {parameters[0].name} of a run, from {IDENTIFY_FRAMES} noisy frames",
        unit="1 (difference of logarithms)",
        parameters=parameters,
        frames=IDENTIFY_FRAMES,
        start=start,
        measure=measure,
        observe=observe,
        truth=tuple(truth.tolist()),
    )
    return task


FAMILIES: Mapping[str, Callable[[str, int, np.random.Generator], DesignTask]] = {
    "pour": _draw_pour,
    "stir": _draw_stir,
    "identify": _draw_identify,
}
"""What draws an instance of each family."""
