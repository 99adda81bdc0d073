"""What every solver does around its kernels: load, advance, check, read out.

A solver is the kernels of one formulation (fields of a batch of scenarios, and one
substep) inside a :class:`Driver`, which knows the bounds within which they are valid.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Generic, Protocol, TypeVar

import numpy as np

from lagbench.errors import UsageError, WorkFailedError

from . import backend
from .full_box_parameters import FullBoxParameters
from .language import ti
from .solver import Health, Singles
from .split import (
    Device,
    FreeSurfaceParameters,
    InitialState,
    Material,
)
from .transfer import Nothing, Template

Parameters = TypeVar("Parameters", FreeSurfaceParameters, FullBoxParameters)


class Field(Protocol):
    """The part of a Taichi field that a driver uses."""

    def from_numpy(self, array: Singles) -> None:
        """Set all values."""

    def to_numpy(self) -> Singles:
        """Return all values."""


class Kernels(Protocol):
    """What a driver asks of the kernels of a formulation."""

    # particle positions [length]; in full boxes the last component is the largest -J
    x: Field
    particle_state: Field  # what particles spread, the velocity first
    particle_volume: Field  # m / (rho dx^d), shape [scenario]
    speed_bound: float  # the CFL bound dx/dt [length/s]

    @property
    def at_rest(self) -> Sequence[float]:
        """What a particle at rest spreads at first, shape [4]."""

    @property
    def slopes(self) -> Sequence[Field]:
        """Derivative of the velocity, first, at the particles, along each axis."""

    @property
    def position_min(self) -> float | Sequence[float]:
        """Smallest coordinate of a particle, along all axes or along each [length]."""

    @property
    def position_max(self) -> float | Sequence[float]:
        """Largest coordinate of a particle, along all axes or along each [length]."""

    def run_serially(self, substeps: int) -> None:
        """Advance scenario 0 by many substeps in one thread."""

    def run_in_parallel(self) -> None:
        """Advance every scenario by one substep."""

    def restart_extremes(self) -> None:
        """Start an advance: the extremes are those of the present state."""


class Driver(ABC, Generic[Parameters]):
    """A solver around kernels.

    :func:`.build` explains the arguments, :class:`.Solver` the methods.
    """

    def __init__(
        self,
        parameters: Parameters,
        *,
        device: Device = Device.CPU,
        scenarios: int = 1,
        threads: int | None = None,
    ) -> None:
        """Start Taichi and take the memory; kernels compile when they first run."""
        self.parameters: Parameters = parameters
        self.device = device
        self.scenarios = scenarios
        # of each scenario, for messages
        self.names: Sequence[str] = [f"scenario {i}" for i in range(scenarios)]
        threads = backend.start(device, scenarios=scenarios, threads=threads)
        self._kernels = self._compile(device is not Device.CPU, threads)
        self._substeps = 0

    @property
    @abstractmethod
    def dimension(self) -> int:
        """Number of axes: 2 or 3."""

    @abstractmethod
    def _compile(self, atomic: bool, threads: int) -> Kernels:
        """Make the kernels and their fields."""

    @abstractmethod
    def _start(self, states: Sequence[InitialState]) -> None:
        """Fill the fields that only this formulation has."""

    @abstractmethod
    def health(self) -> list[Health]:
        """Return what each scenario went through during the last advance.

        Before the first one these are the extremes of the loaded state.
        """

    @abstractmethod
    def _broken_bounds(self, index: int, health: Health) -> dict[str, str]:
        """Return the bounds of this formulation that a scenario has left, each with the
        value that it reached.
        """

    def load(self, states: Sequence[InitialState]) -> None:
        """Start one scenario per state.

        Raises:
            UsageError: the number of states is wrong, or one is no initial state.
            WorkFailedError: a state is outside the solver's bounds.
        """
        if len(states) != self.scenarios:
            raise UsageError(
                f"wrong number of scenarios: got {len(states)}, expected "
                f"{self.scenarios}",
            )
        for index, state in enumerate(states):
            self._check_state(index, state)

        p = self.parameters
        kernels = self._kernels
        self._fixed = self._fixed_positions(states)
        self._place(stack(states, "position"))
        shape = (self.scenarios, p.particles, 4)
        particle_state = np.empty(shape, np.float32)
        # what stands behind the velocity keeps its value at rest; its slopes are 0
        particle_state[...] = kernels.at_rest
        particle_state[..., : self.dimension] = stack(states, "velocity")
        self._write(kernels.particle_state, particle_state, at_rest=kernels.at_rest)
        affine = stack(states, "affine")
        for axis, field in enumerate(kernels.slopes):
            slope = np.zeros(shape, np.float32)
            slope[..., : self.dimension] = affine[..., axis]
            self._write(field, slope)

        # volume of a particle [length^d], shape [scenario]
        self._volume = np.array([state.area / p.particles for state in states])
        # volume of a particle in cells
        cell_volumes = self._volume * p.grid**self.dimension
        kernels.particle_volume.from_numpy(cell_volumes.astype(np.float32))
        self._start(states)
        self._substeps = 0
        kernels.restart_extremes()

    def advance(self, substeps: int) -> None:
        """Advance every scenario; one that leaves the solver's bounds is a
        WorkFailedError.
        """
        if substeps == 0:
            return
        self._kernels.restart_extremes()
        end = self._substeps + substeps
        while self._substeps < end:
            until = self._drive(end)
            self._run(until - self._substeps)
            self._substeps = until
        self._check_health(substeps)

    def _run(self, substeps: int) -> None:
        if self.device is Device.CPU:
            self._kernels.run_serially(substeps)
            return
        for _ in range(substeps):
            self._kernels.run_in_parallel()

    def _check_health(self, substeps: int) -> None:
        """Refuse to go on where a scenario left a bound during the last substeps."""
        speed_bound = self._kernels.speed_bound
        for index, health in enumerate(self.health()):
            broken: dict[str, str] = {}
            if not health.finite:
                broken["every number is finite"] = "NaN or an infinite number"
            # NaN breaks no bound here: "finite" above tells of it, and as a value it
            # would say nothing.
            if health.max_speed > speed_bound:
                bound = f"CFL: abs(v) <= dx/dt = {speed_bound:.6g}"
                broken[bound] = f"abs(v) = {health.max_speed:.6g}"
            broken |= self._broken_bounds(index, health)
            if broken:
                raise self._blow_up(index, substeps, broken)

    def _blow_up(
        self, index: int, substeps: int, broken: dict[str, str]
    ) -> WorkFailedError:
        end = self._substeps
        span = f"substeps {end - substeps} to {end}"
        if substeps == 1:
            span = f"substep {end}"
        return WorkFailedError(
            f"the simulation blew up: got {'; '.join(broken.values())}, expected "
            f"{'; '.join(broken)}; a smaller dt (a larger substeps_per_frame), a "
            "softer material, a smaller viscosity or smaller velocities",
            where=f"{self.names[index]}, {span}",
        )

    def _drive(self, end: int) -> int:
        """Set what acts from outside now; return the substep up to which it acts.

        The result is ``end`` at most.
        """
        return end

    def position(self) -> Singles:
        """Particle positions [length], shape [scenario, particle, axis]."""
        return self._read(self._kernels.x)[..., : self.dimension]

    def velocity(self) -> Singles:
        """Particle velocities v_p [length/s], shape [scenario, particle, axis]."""
        state = self._kernels.particle_state.to_numpy()
        return state[:, : self.parameters.particles, : self.dimension]

    def _read(self, field: Field) -> Singles:
        """Return a field of the particles that move, shape [scenario, particle, 4].

        The rows behind them, of the particles that never move, are left out.
        """
        particles = self.parameters.particles
        if self.device is not Device.CPU:
            return field.to_numpy()[:, :particles]
        # the CPU simulates one scenario at a time
        values = np.empty((1, particles, 4), np.float32)
        _copy(field, values)
        return values

    def displace(self, offset: Singles) -> None:
        """Add an offset to the positions [length], shape [scenario, particle, axis];
        kept in the box.
        """
        self._place(self.position() + offset.astype(np.float32))

    def _fixed_positions(self, states: Sequence[InitialState]) -> Singles:
        """Return where the particles that never move are, behind those of the states.

        The fields have so many rows more. Shape [scenario, particle, 4], zeros beside
        the positions [length]; this driver has none.
        """
        return np.zeros((len(states), 0, 4), np.float32)

    def _place(self, position: Singles) -> None:
        """Set the positions, kept in the box; the fields hold zeros beside."""
        dimension = position.shape[-1]
        padded = np.zeros((*position.shape[:2], 4), np.float32)
        padded[..., :dimension] = self._inside(position)
        self._kernels.x.from_numpy(np.concatenate([padded, self._fixed], axis=1))

    def _write(
        self,
        field: Field,
        values: Singles,
        at_rest: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
    ) -> None:
        """Fill a field of the particles.

        Args:
            field: field of a formulation.
            values: shape [scenario, particle, 4].
            at_rest: value of the particles that never move.
        """
        fixed = np.empty_like(self._fixed)
        fixed[...] = at_rest
        field.from_numpy(np.concatenate([values, fixed], axis=1))

    def _inside(self, position: Singles) -> Singles:
        """Return positions clipped to the box [length], shape [..., axis]."""
        least = np.asarray(self._kernels.position_min, np.float32)
        most = np.asarray(self._kernels.position_max, np.float32)
        return np.clip(position, least, most)

    def _check_state(self, index: int, state: InitialState) -> None:
        """Refuse a state that the kernels cannot start from."""
        where = self.names[index]
        count = self.parameters.particles
        dimension = self.dimension
        shapes = {
            "position": (count, dimension),
            "velocity": (count, dimension),
            "affine": (count, dimension, dimension),
            "material": (count,),
        }
        for name, shape in shapes.items():
            array = np.asarray(getattr(state, name))
            kinds = "iu" if name == "material" else "f"
            if array.shape != shape or array.dtype.kind not in kinds:
                raise UsageError(
                    f"{name} of an initial state has shape {array.shape}, "
                    f"{array.dtype}; give {shape}, see docs/extending.md",
                    where=where,
                )
        position = np.asarray(state.position)
        is_outside = (position < 0.0) | (position > 1.0)
        is_known = np.isin(state.material, [material.value for material in Material])
        if is_outside.any() or not is_known.all() or not 0.0 < state.area <= 1.0:
            raise UsageError(
                "an initial state needs positions in the unit box, known materials, "
                "and an area up to 1; mend the split's initial_state",
                where=where,
            )

        speed_bound = self._kernels.speed_bound
        speed = np.abs(state.velocity).max()
        stretch = np.abs(state.affine).max() * self.parameters.dt
        is_finite = np.isfinite(position).all()
        if not is_finite or not (speed <= speed_bound and stretch <= 2.0):
            raise WorkFailedError(
                "the initial state is outside the solver's bounds: got abs(v) = "
                f"{speed:.6g}, abs(C) dt = {stretch:.6g}, expected finite positions, "
                f"abs(v) <= dx/dt = {speed_bound:.6g}, abs(C) dt <= 2; draw slower "
                "motion, or lower dt in the file of the split",
                where=where,
            )


def check_program(
    program: object,
    row: tuple[int, ...],
    *,
    where: str,
    has_one_row: bool = False,
) -> None:
    """Refuse motions of walls, or forces, that a solver cannot take row by row.

    Args:
        program: velocities or accelerations, shape [frame, *row].
        row: shape of a row.
        where: place of the program, for messages.
        has_one_row: whether a single row, without an axis of frames, is one too.

    Raises:
        UsageError: it is no array of finite numbers, of another shape, or without rows.
    """
    array = program if isinstance(program, np.ndarray) else np.empty((), object)
    is_numeric = array.dtype.kind in "fiu" and bool(np.isfinite(array).all())
    is_row = has_one_row and array.shape == row
    is_program = array.ndim > 0 and len(array) > 0 and array.shape[1:] == row
    if not is_numeric or not (is_row or is_program):
        raise UsageError(
            "a program of an initial state is no array of finite numbers, shape "
            f"[frame, {', '.join(map(str, row))}]; correct the initial state",
            where=where,
        )


@ti.kernel
def _copy(field: Template, values: ti.types.ndarray()) -> Nothing:  # type: ignore[valid-type]
    # In this thread: to wake others, as `to_numpy` does, takes longer than the copy.
    ti.loop_config(serialize=True)
    for p in range(values.shape[1]):
        for c in ti.static(range(4)):
            values[0, p, c] = field[0, p][c]


def stack(states: Sequence[InitialState], name: str) -> Singles:
    """Return an array of every state as float32, shape [scenario, ...]."""
    arrays = [getattr(state, name) for state in states]
    return np.stack(arrays).astype(np.float32)
