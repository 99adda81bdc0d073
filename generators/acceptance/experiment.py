"""A closed-box experiment of any size: checked settings, its run, and what shows
whether the solver is right.

The splits in datasets.yaml come in three sizes; an experiment scales size ``full`` to
any grid. The box stays where it is as nearly as nodes allow, dt shrinks with dx, the
particles per cell and the constants per substep stay.
"""

from __future__ import annotations

import dataclasses
import enum
import itertools
import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from lagbench.data import WALLS, registry
from lagbench.errors import UsageError
from lagbench.generators import cavity, curl_noise
from lagbench.generators.draws import fill, quantise
from lagbench.generators.noise import gradients
from lagbench.generators.solver import Device, build
from lagbench.generators.split import ClosedBoxParameters, InitialState, Material

from . import diagnostics

if TYPE_CHECKING:
    from lagbench.generators.closed_box import ClosedBox


_LEAST_GRID = 16
_VISCOUS_LIMIT = 0.2
_ACOUSTIC_LIMIT = 0.5
_MACH_LIMIT = 1.0 / 3.0
# beyond it velocity gradients outgrow what :func:`.draws.quantise` holds
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
        """Substeps between two records, as near to the split's frame interval as they
        allow.
        """
        return max(1, round(_full(self.case).frame_interval / self.dt))


def _full(case: Case) -> registry.Size:
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
    """Complete and check the settings of a run; attributes as in
    :class:`Experiment`.
    """
    full = _full(case)
    if case is Case.CAVITY:
        _check(
            reynolds is not None,
            "a cavity needs a Reynolds number",
            "--re",
            "a positive number",
            None,
        )
        _check(
            frequency is None,
            "a cavity has no stirring",
            "--frequency",
            "not given",
            frequency,
        )
    else:
        lid = lid_speed, lid_off_after
        _check(
            lid == (None, None),
            "curl noise has no lid",
            "--lid-speed, --lid-off-after",
            "not given",
            lid,
        )
    _check(
        grid >= _LEAST_GRID,
        "the grid is too small",
        "--grid",
        f"at least {_LEAST_GRID}",
        grid,
    )
    _check(
        substeps >= 1,
        "there is nothing to simulate",
        "--substeps",
        "at least 1",
        substeps,
    )
    _check(seed >= 0, "a seed is not negative", "--seed", "at least 0", seed)
    driven = case is Case.CAVITY
    experiment = Experiment(
        case=case,
        reynolds=reynolds,
        grid=grid,
        particles=round(full.particles * (grid / full.grid) ** 2)
        if particles is None
        else particles,
        substeps=substeps,
        dt=full.dt * full.grid / grid if dt is None else dt,
        lid_speed=(0.15 if lid_speed is None else lid_speed) if driven else 0.0,
        lid_off_after=lid_off_after,
        frequency=0 if driven else (4 if frequency is None else frequency),
        seed=seed,
    )
    _check_ranges(experiment)
    return experiment


def _check(holds: bool, what: str, where: str, expected: object, got: object) -> None:
    if not holds:
        raise UsageError(what, where=where, expected=expected, got=got)


def _check_ranges(experiment: Experiment) -> None:
    """Refuse what the solver cannot resolve or is unstable at."""
    parameters = solver_parameters(experiment)
    e = experiment
    speed = experiment.lid_speed
    box = diagnostics.box_of(parameters)
    sound = math.sqrt(parameters.modulus / parameters.density)
    fastest = _ACOUSTIC_LIMIT / (sound * parameters.grid)
    fewest = f"at least {box.cells**2} in {box.cells} x {box.cells} cells"
    enough = e.particles >= box.cells**2
    _check(enough, "fewer particles than cells", "--particles", fewest, e.particles)
    _check(
        0.0 < e.dt <= fastest,
        "sound outruns the grid",
        "--dt",
        f"above 0, at most {fastest:.3g}",
        e.dt,
    )
    if e.case is Case.CAVITY:
        top = _MACH_LIMIT * sound
        off = e.lid_off_after
        subsonic = 0.0 < speed <= top
        span = f"above 0, at most {top:.3g}"
        _check(subsonic, "not a subsonic lid", "--lid-speed", span, speed)
        within = off is None or 0 < off < e.substeps
        span = f"from 1 to {e.substeps - 1}"
        _check(within, "the lid stops outside the run", "--lid-off-after", span, off)
    else:
        most = min(box.cells // 2, _LARGEST_FREQUENCY)
        held = 1 <= e.frequency <= most
        span = f"from 1 to {most}"
        _check(
            held,
            "the grid cannot hold this frequency",
            "--frequency",
            span,
            e.frequency,
        )
    if e.reynolds is None:
        return
    positive = math.isfinite(e.reynolds) and e.reynolds > 0.0
    _check(positive, "not a Reynolds number", "--re", "a positive number", e.reynolds)
    if e.case is Case.CURL_NOISE:
        speed = _root_mean_square(
            initial_state(dataclasses.replace(e, reynolds=None)).velocity
        )
    # Explicit diffusion is unstable beyond this viscosity.
    least = speed * box.width * e.dt / (_VISCOUS_LIMIT * box.spacing**2)
    stable = e.reynolds >= least
    span = f"at least {least:.3g} at dt = {e.dt:.3g}"
    _check(stable, "too viscous for the substep", "--re", span, e.reynolds)


def solver_parameters(experiment: Experiment) -> ClosedBoxParameters:
    """Return the constants of size ``full``, scaled to the experiment's grid."""
    full = _full(experiment.case)
    driven = experiment.case is Case.CAVITY
    parameters = (
        cavity.solver_parameters(full) if driven else curl_noise.solver_parameters(full)
    )
    wall = (parameters.wall + 0.5) * experiment.grid / parameters.grid - 0.5
    return dataclasses.replace(
        parameters,
        particles=experiment.particles,
        grid=experiment.grid,
        dt=experiment.dt,
        # Python rounds halves to even, NumPy alike: 4.5 gives 4.
        wall=round(wall),
    )


def initial_state(experiment: Experiment) -> InitialState:
    """Fill the box with particles: at rest under a moving lid, or stirred by curl
    noise.
    """
    box = diagnostics.box_of(solver_parameters(experiment))
    full = _full(experiment.case)
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
        psi = curl_noise.stream_function(
            position,
            gradients(rng, experiment.frequency),
            low=box.low,
            high=box.high,
            scale=full.value("velocity_scale"),
        )
        velocity, affine = curl_noise.flow(psi)
    wall_velocity = np.zeros((len(WALLS), 2))
    wall_velocity[WALLS.index("top"), 0] = experiment.lid_speed
    speed = experiment.lid_speed or _root_mean_square(velocity)
    return InitialState(
        position=position,
        velocity=velocity,
        affine=affine,
        material=np.full(len(position), Material.LIQUID, dtype=np.int8),
        area=box.width**2,
        # nu = U L / Re [length^2/s]
        viscosity=0.0
        if experiment.reynolds is None
        else speed * box.width / experiment.reynolds,
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
class Check:
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
class Result:
    """What a run has shown so far."""

    experiment: Experiment  # the settings
    # one per check, in time order
    checks: list[Check] = dataclasses.field(default_factory=list)
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
        if (
            self.experiment.case is not Case.CURL_NOISE
            or not energy
            or energy[0] == 0.0
        ):
            return None
        return energy[-1] / energy[0]

    @property
    def largest_rise_after_lid_off(self) -> float | None:
        """Largest relative gain of kinetic energy by a frame since the lid stopped;
        None while it moves.
        """
        off = self.experiment.lid_off_after
        if off is None:
            return None
        after = [
            e
            for at, e in zip(self.frame_substeps, self.kinetic_energy, strict=True)
            if at >= off
        ]
        return max((b / a - 1.0 for a, b in itertools.pairwise(after)), default=None)

    def deviations(self) -> tuple[diagnostics.Deviation, diagnostics.Deviation] | None:
        """Return the deviation of u and of v from Ghia, Ghia & Shin, where they
        tabulate.
        """
        reference = diagnostics.centre_lines(self.experiment.reynolds or 0.0)
        if (
            self.profiles is None
            or reference is None
            or self.experiment.lid_off_after is not None
        ):
            return None
        found = self.profiles.at_reference_points()
        return diagnostics.deviation(found.u, reference.u), diagnostics.deviation(
            found.v, reference.v
        )


def run(
    experiment: Experiment,
    *,
    device: Device = Device.CPU,
    report: Report = lambda _: None,
) -> Result:
    """Simulate an experiment and measure it."""
    driven = experiment.case is Case.CAVITY
    end = experiment.substeps
    frame = experiment.frame_substeps
    result = Result(
        experiment=experiment, averaged_from=end - max(1, min(AVERAGED, end // 4))
    )
    parameters = solver_parameters(experiment)
    state = initial_state(experiment)
    box = diagnostics.box_of(parameters)
    mass = parameters.density * state.area / experiment.particles
    # nodes between the walls
    inside = slice(parameters.wall + 1, parameters.grid - parameters.wall)
    threads = 1 if device is Device.CPU else None
    solver = cast("ClosedBox", build(parameters, device=device, threads=threads))
    # The first substep compiles; loading again starts afresh, and no compilation is
    # timed.
    solver.load([state])
    solver.advance(1)
    solver.load([state])
    done = 0
    before = solver.position()[0]
    stops = {0, end, result.averaged_from, experiment.lid_off_after or 0}
    stops |= {*range(CHECK_EVERY, end, CHECK_EVERY), *range(frame, end, frame)}
    for stop in sorted(stops):
        start = time.perf_counter()
        solver.advance(stop - done, average=done >= result.averaged_from)
        result.seconds += time.perf_counter() - start
        done = stop
        if done == experiment.lid_off_after:
            solver.move_walls(np.zeros((1, *state.wall_velocity.shape), np.float32))
        position = solver.position()[0]
        if done % frame == 0:
            result.frame_substeps.append(done)
            result.kinetic_energy.append(
                diagnostics.kinetic_energy(solver.velocity()[0], mass)
            )
            if done > 0:
                result.displacement_energy.append(
                    diagnostics.displacement_energy(position, before, mass)
                )
            before = position
        if done == end or (done > 0 and done % CHECK_EVERY == 0):
            jacobian = solver.jacobian()[0]
            outside = (
                jacobian[~diagnostics.lid_corners(position, box)]
                if driven
                else jacobian
            )
            counts = diagnostics.occupancy(position, box)
            rates = diagnostics.grid_rates(
                solver.grid_velocity()[0][inside, inside], box.spacing
            )
            result.checks.append(
                Check(
                    substep=done,
                    jacobian_min=float(jacobian.min()),
                    jacobian_max=float(jacobian.max()),
                    jacobian_min_outside_lid_corners=float(outside.min()),
                    jacobian_max_outside_lid_corners=float(outside.max()),
                    empty_cells=int(np.sum(counts == 0)),
                    particles_per_cell_min=int(counts.min()),
                    particles_per_cell_max=int(counts.max()),
                    divergence_rms=rates.divergence,
                    vorticity_rms=rates.vorticity,
                    divergence_over_vorticity=rates.ratio,
                )
            )
        report(done)
    if driven:
        mean = solver.mean_grid_velocity()[0][inside, inside]
        result.profiles = diagnostics.extract(mean, box, experiment.lid_speed)
    return result
