"""A closed-box experiment of any size: checked settings, its run, and its results.

The splits in datasets.yaml come in three sizes; an experiment scales size ``full`` to
any grid. The box stays where it is as nearly as nodes allow, dt shrinks with dx, the
particles per cell and the constants per substep stay.
"""

from __future__ import annotations

import dataclasses
import decimal
import enum
import itertools
import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from lagbench.data import WALLS, registry
from lagbench.data.box import Box
from lagbench.errors import UsageError
from lagbench.generators import cavity, curl_noise
from lagbench.generators.draws import fill, quantise
from lagbench.generators.full_box_parameters import FullBoxParameters
from lagbench.generators.noise import gradients
from lagbench.generators.periodic_noise import rotated_gradient
from lagbench.generators.solver import build
from lagbench.generators.split import (
    Device,
    InitialState,
    Material,
)

from . import diagnostics

if TYPE_CHECKING:
    from lagbench.generators.full_box import FullBox


_LEAST_GRID = 16
_VISCOUS_LIMIT = 0.2  # largest nu dt / dx^2 [1]
_ACOUSTIC_LIMIT = 0.5  # largest c dt / dx [1]
_MACH_LIMIT = 1.0 / 3.0  # largest lid speed over the speed of sound [1]
_LID_SPEED = 0.15  # lid speed unless told otherwise [length/s]
_FREQUENCY = 4  # Perlin frequency unless told otherwise
# beyond it velocity gradients outgrow the range of :func:`.draws.quantise`
_LARGEST_FREQUENCY = 14


class Case(enum.StrEnum):
    """Which closed box: driven by its lid, or stirred once."""

    CAVITY = "cavity"
    CURL_NOISE = "curl-noise"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Experiment:
    """Settings of one run, checked and complete; :func:`plan` makes them."""

    case: Case  # which box
    # U L / nu with the lid speed U, or the initial RMS speed in curl noise [1]; None
    # for an inviscid fluid
    reynolds: float | None
    grid: int  # cells across the unit box
    particles: int
    substeps: int  # solver steps
    dt: float  # substep [s]
    lid_speed: float  # speed of the top wall [length/s]; 0 in curl noise
    # substep after which the lid stands still, None for never
    lid_off_after: int | None
    frequency: int  # Perlin lattice cells across the box; 0 in the cavity
    seed: int  # seed of the particle lattice and of the stirring

    @property
    def frame_substeps(self) -> int:
        """Substeps between two records, nearest to the split's frame interval."""
        return max(1, round(_full_size(self.case).frame_interval / self.dt))


def _full_size(case: Case) -> registry.Size:
    return registry.load().size(case.value, "full")


def plan(
    case: Case,
    *,
    substeps: int,
    reynolds: float | None = None,
    grid: int = 40,
    particles: int | None = None,
    dt: float | None = None,
    lid_speed: float | None = None,
    lid_off_after: int | None = None,
    frequency: int | None = None,
    seed: int = 0,
) -> Experiment:
    """Complete and check the settings of a run.

    Arguments are the attributes of :class:`Experiment`; those that are None take the
    value of size ``full``, scaled to the grid.

    Raises:
        UsageError: a setting does not belong to the case, or the solver cannot resolve
            it or is unstable at it.
    """
    is_cavity = case is Case.CAVITY
    if is_cavity:
        _check_cavity_options(reynolds, frequency)
    else:
        _check_curl_noise_options(lid_speed, lid_off_after)
    _require(
        grid >= _LEAST_GRID,
        "the grid is too small",
        where="--grid",
        expected=f"at least {_LEAST_GRID}",
        got=grid,
    )
    _require(
        substeps >= 1,
        "there is nothing to simulate",
        where="--substeps",
        expected="at least 1",
        got=substeps,
    )
    _require(
        seed >= 0,
        "a seed is not negative",
        where="--seed",
        expected="at least 0",
        got=seed,
    )

    full = _full_size(case)
    if particles is None:
        particles = round(full.particles * (grid / full.grid) ** 2)
    if dt is None:
        dt = full.dt * full.grid / grid
    if lid_speed is None:
        lid_speed = _LID_SPEED if is_cavity else 0.0
    if frequency is None:
        frequency = 0 if is_cavity else _FREQUENCY
    experiment = Experiment(
        case=case,
        reynolds=reynolds,
        grid=grid,
        particles=particles,
        substeps=substeps,
        dt=dt,
        lid_speed=lid_speed,
        lid_off_after=lid_off_after,
        frequency=frequency,
        seed=seed,
    )
    _check_ranges(experiment)
    return experiment


def _require(
    holds: bool, what: str, *, where: str, expected: object, got: object
) -> None:
    """Raise a UsageError unless something holds."""
    if not holds:
        raise UsageError(f"{what}: got {got}, expected {expected}", where=where)


def _round_bound(bound: float, *, is_least: bool) -> str:
    """Return a bound in three digits, rounded to the side that it allows."""
    rounding = decimal.ROUND_CEILING if is_least else decimal.ROUND_FLOOR
    context = decimal.Context(prec=3, rounding=rounding)
    rounded = context.create_decimal_from_float(bound)
    return f"{float(rounded):.3g}"


def _check_cavity_options(reynolds: float | None, frequency: int | None) -> None:
    _require(
        reynolds is not None,
        "a cavity needs a Reynolds number",
        where="--re",
        expected="a positive number",
        got=None,
    )
    _require(
        frequency is None,
        "a cavity has no stirring",
        where="--frequency",
        expected="not given",
        got=frequency,
    )


def _check_curl_noise_options(
    lid_speed: float | None, lid_off_after: int | None
) -> None:
    _require(
        lid_speed is None and lid_off_after is None,
        "curl noise has no lid",
        where="--lid-speed, --lid-off-after",
        expected="not given",
        got=(lid_speed, lid_off_after),
    )


def _check_ranges(experiment: Experiment) -> None:
    """Refuse what the solver cannot resolve or is unstable at."""
    parameters = solver_parameters(experiment)
    box = diagnostics.box_of(parameters)
    sound_speed = math.sqrt(parameters.modulus / parameters.density)

    cell_count = box.cells**2
    _require(
        experiment.particles >= cell_count,
        "fewer particles than cells",
        where="--particles",
        expected=f"at least {cell_count} in {box.cells} x {box.cells} cells",
        got=experiment.particles,
    )
    dt_max = _ACOUSTIC_LIMIT / (sound_speed * parameters.grid)
    _require(
        0.0 < experiment.dt <= dt_max,
        "sound outruns the grid",
        where="--dt",
        expected=f"above 0, at most {_round_bound(dt_max, is_least=False)}",
        got=experiment.dt,
    )
    if experiment.case is Case.CAVITY:
        _check_lid(experiment, sound_speed)
    else:
        _check_frequency(experiment, box)
    if experiment.reynolds is not None:
        _check_reynolds(experiment, box, experiment.reynolds)


def _check_lid(experiment: Experiment, sound_speed: float) -> None:
    speed_max = _MACH_LIMIT * sound_speed
    _require(
        0.0 < experiment.lid_speed <= speed_max,
        "not a subsonic lid",
        where="--lid-speed",
        expected=f"above 0, at most {_round_bound(speed_max, is_least=False)}",
        got=experiment.lid_speed,
    )
    stop = experiment.lid_off_after
    _require(
        stop is None or 0 < stop < experiment.substeps,
        "the lid stops outside the run",
        where="--lid-off-after",
        expected=f"from 1 to {experiment.substeps - 1}",
        got=stop,
    )


def _check_frequency(experiment: Experiment, box: diagnostics.SquareBox) -> None:
    frequency_max = min(box.cells // 2, _LARGEST_FREQUENCY)
    _require(
        1 <= experiment.frequency <= frequency_max,
        "the grid cannot hold this frequency",
        where="--frequency",
        expected=f"from 1 to {frequency_max}",
        got=experiment.frequency,
    )


def _check_reynolds(
    experiment: Experiment, box: diagnostics.SquareBox, reynolds: float
) -> None:
    _require(
        math.isfinite(reynolds) and reynolds > 0.0,
        "not a Reynolds number",
        where="--re",
        expected="a positive number",
        got=reynolds,
    )
    speed = experiment.lid_speed
    if experiment.case is Case.CURL_NOISE:
        inviscid = dataclasses.replace(experiment, reynolds=None)
        speed = _root_mean_square(initial_state(inviscid).velocity)
    # Explicit diffusion is unstable beyond this viscosity.
    diffusion_limit = _VISCOUS_LIMIT * box.spacing**2
    reynolds_min = speed * box.width * experiment.dt / diffusion_limit
    _require(
        reynolds >= reynolds_min,
        "too viscous for the substep",
        where="--re",
        expected=f"at least {_round_bound(reynolds_min, is_least=True)} "
        f"at dt = {experiment.dt:.3g}",
        got=reynolds,
    )


def solver_parameters(experiment: Experiment) -> FullBoxParameters:
    """Return the constants of size ``full``, with the experiment's particles, grid, dt.

    The walls stay where they are, as nearly as the nodes of the grid allow.
    """
    full = _full_size(experiment.case)
    if experiment.case is Case.CAVITY:
        parameters = cavity.solver_parameters(full)
    else:
        parameters = curl_noise.solver_parameters(full)
    # a wall lies half a cell from its layer of ghost nodes
    full_low, _ = parameters.box.bounds[0]
    # Python rounds halves to even, NumPy alike: 4.5 gives 4.
    ghost_layer = round(full_low * experiment.grid - 0.5)
    low = (ghost_layer + 0.5) / experiment.grid
    return dataclasses.replace(
        parameters,
        particles=experiment.particles,
        grid=experiment.grid,
        dt=experiment.dt,
        box=Box.from_bounds([(low, 1.0 - low)] * 2),
    )


def initial_state(experiment: Experiment) -> InitialState:
    """Fill the box: at rest under a moving lid, or stirred by curl noise."""
    box = diagnostics.box_of(solver_parameters(experiment))
    full = _full_size(experiment.case)
    rng = np.random.Generator(np.random.PCG64(experiment.seed))
    position = fill(
        rng,
        experiment.particles,
        low=box.low,
        high=box.high,
        jitter=full.value("jitter"),
    )
    velocity = np.zeros_like(position)
    affine = np.zeros((*position.shape, 2))
    if experiment.case is Case.CURL_NOISE:
        lattice = gradients(rng, experiment.frequency)
        psi = curl_noise.stream_function(
            position,
            lattice,
            low=box.low,
            high=box.high,
            scale=full.value("velocity_scale"),
        )
        flow = rotated_gradient(psi)
        velocity = quantise(flow.velocity)
        affine = quantise(flow.affine)

    wall_velocity = np.zeros((len(WALLS), 2))
    wall_velocity[WALLS.index("top"), 0] = experiment.lid_speed
    speed = experiment.lid_speed or _root_mean_square(velocity)
    # nu = U L / Re [length^2/s]
    viscosity = 0.0
    if experiment.reynolds is not None:
        viscosity = speed * box.width / experiment.reynolds
    return InitialState(
        position=position,
        velocity=velocity,
        affine=affine,
        material=np.full(len(position), Material.LIQUID, dtype=np.int8),
        area=box.width**2,
        viscosity=viscosity,
        wall_velocity=quantise(wall_velocity),
    )


def _root_mean_square(velocity: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.sum(velocity**2, axis=-1))))


CHECK_EVERY = 10_000  # substeps between two checks
# substeps at the end over which the nodal velocity is averaged, at most a quarter of
# the run
AVERAGED = 3000

Report = Callable[[int], None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class AcceptanceCheck:
    """State of the box at one substep."""

    substep: int  # when
    jacobian_min: float  # smallest J of any particle [1]
    jacobian_max: float  # largest J of any particle [1]
    # the same without the 5 x 5 cells at either end of a lid [1]
    jacobian_min_outside_lid_corners: float
    jacobian_max_outside_lid_corners: float  # likewise [1]
    empty_cells: int  # cells without a particle
    particles_per_cell_min: int  # particles in the emptiest cell
    particles_per_cell_max: int  # particles in the fullest cell
    divergence_rms: float  # of the nodal velocity [1/s]
    vorticity_rms: float  # of the nodal velocity [1/s]
    divergence_over_vorticity: float  # their ratio [1]; NaN for a fluid at rest


@dataclasses.dataclass(kw_only=True)
class ExperimentResult:
    """What a run has shown so far."""

    experiment: Experiment  # the settings
    # one per check, in time order
    checks: list[AcceptanceCheck] = dataclasses.field(default_factory=list)
    # substep of each record of the energy, 0 first
    frame_substeps: list[int] = dataclasses.field(default_factory=list)
    # E = sum m v_p^2 / 2 at each of them [mass length^2/s^2]
    kinetic_energy: list[float] = dataclasses.field(default_factory=list)
    # sum m (x(f) - x(f-1))^2 / 2 of each whole frame from the first [mass length^2]
    displacement_energy: list[float] = dataclasses.field(default_factory=list)
    averaged_from: int  # first substep of the velocity average
    profiles: diagnostics.Profiles | None = None  # centre lines; None in curl noise
    seconds: float = 0.0  # wall time spent in the solver [s]

    @property
    def retention(self) -> float | None:
        """Curl noise: displacement energy of the last frame over the first's [1]."""
        energy = self.displacement_energy
        is_curl_noise = self.experiment.case is Case.CURL_NOISE
        if not is_curl_noise or not energy or energy[0] == 0.0:
            return None
        return energy[-1] / energy[0]

    @property
    def largest_rise_after_lid_off(self) -> float | None:
        """Largest relative gain of kinetic energy in a frame since the lid stopped.

        None while the lid moves.
        """
        stop = self.experiment.lid_off_after
        if stop is None:
            return None
        energies = []
        for substep, energy in zip(
            self.frame_substeps, self.kinetic_energy, strict=True
        ):
            if substep >= stop:
                energies.append(energy)
        rises = [after / before - 1.0 for before, after in itertools.pairwise(energies)]
        return max(rises, default=None)

    def deviations(self) -> tuple[diagnostics.Deviation, diagnostics.Deviation] | None:
        """Return the deviation of u and of v from Ghia, Ghia & Shin.

        None where they tabulate nothing.
        """
        reference = diagnostics.centre_lines(self.experiment.reynolds or 0.0)
        if self.profiles is None or reference is None:
            return None
        if self.experiment.lid_off_after is not None:
            return None
        measured = self.profiles.at_reference_points()
        u_deviation = diagnostics.deviation(measured.u, reference.u)
        v_deviation = diagnostics.deviation(measured.v, reference.v)
        return u_deviation, v_deviation


def run(
    experiment: Experiment,
    *,
    device: Device = Device.CPU,
    report: Report = lambda _: None,
) -> ExperimentResult:
    """Simulate an experiment and measure it."""
    end = experiment.substeps
    averaged_count = max(1, min(AVERAGED, end // 4))
    result = ExperimentResult(experiment=experiment, averaged_from=end - averaged_count)
    parameters = solver_parameters(experiment)
    state = initial_state(experiment)
    box = diagnostics.box_of(parameters)
    mass = parameters.density * state.area / experiment.particles
    solver = _build_solver(parameters, state, device)

    done = 0
    velocity_sums = []
    last_position = solver.position()[0]
    for stop in _stops(experiment, result.averaged_from):
        start = time.perf_counter()
        if done >= result.averaged_from:
            velocity_sums.append(_sum_of_velocities(solver, stop - done))
        else:
            solver.advance(stop - done)
        result.seconds += time.perf_counter() - start
        done = stop
        if done == experiment.lid_off_after:
            at_rest = np.zeros((1, *state.wall_velocity.shape), np.float32)
            solver.move_walls(at_rest)

        position = solver.position()[0]
        if done % experiment.frame_substeps == 0:
            result.frame_substeps.append(done)
            energy = diagnostics.kinetic_energy(solver.velocity()[0], mass)
            result.kinetic_energy.append(energy)
            if done > 0:
                energy = diagnostics.displacement_energy(position, last_position, mass)
                result.displacement_energy.append(energy)
            last_position = position
        if done == end or (done > 0 and done % CHECK_EVERY == 0):
            result.checks.append(_measure_state(solver, experiment, box, done))
        report(done)

    if experiment.case is Case.CAVITY:
        mean_velocity = np.sum(velocity_sums, axis=0) / averaged_count
        result.profiles = diagnostics.extract(mean_velocity, box, experiment.lid_speed)
    return result


def _build_solver(
    parameters: FullBoxParameters, state: InitialState, device: Device
) -> FullBox:
    """Return a solver that stands at a state, with compiled kernels."""
    threads = 1 if device is Device.CPU else None
    solver = cast("FullBox", build(parameters, device=device, threads=threads))
    # The first substep compiles; loading again starts afresh, and no compilation is
    # timed.
    solver.load([state])
    solver.advance(1)
    solver.load([state])
    return solver


def _stops(experiment: Experiment, averaged_from: int) -> list[int]:
    """Return the substeps at which something is measured or changed, ascending."""
    end = experiment.substeps
    interval = experiment.frame_substeps
    stops = {0, end, averaged_from, experiment.lid_off_after or 0}
    stops.update(range(CHECK_EVERY, end, CHECK_EVERY))
    stops.update(range(interval, end, interval))
    return sorted(stops)


def _sum_of_velocities(solver: FullBox, substeps: int) -> NDArray[np.float64]:
    """Advance, and return the sum of the nodal velocities of all substeps."""
    total = np.zeros((*solver.parameters.cells, 2))
    for _ in range(substeps):
        solver.advance(1)
        total += solver.grid_velocity()[0]
    return total


def _measure_state(
    solver: FullBox, experiment: Experiment, box: diagnostics.SquareBox, substep: int
) -> AcceptanceCheck:
    """Measure J, the particles per cell and the velocity gradients of the box."""
    position = solver.position()[0]
    jacobian = solver.jacobian()[0]
    outside_corners = jacobian
    if experiment.case is Case.CAVITY:
        outside_corners = jacobian[~diagnostics.lid_corners(position, box)]

    counts = diagnostics.occupancy(position, box)
    velocity = solver.grid_velocity()[0]
    gradients_of_flow = diagnostics.grid_rates(velocity, box.spacing)
    return AcceptanceCheck(
        substep=substep,
        jacobian_min=float(jacobian.min()),
        jacobian_max=float(jacobian.max()),
        jacobian_min_outside_lid_corners=float(outside_corners.min()),
        jacobian_max_outside_lid_corners=float(outside_corners.max()),
        empty_cells=int(np.sum(counts == 0)),
        particles_per_cell_min=int(counts.min()),
        particles_per_cell_max=int(counts.max()),
        divergence_rms=gradients_of_flow.divergence,
        vorticity_rms=gradients_of_flow.vorticity,
        divergence_over_vorticity=gradients_of_flow.ratio,
    )
