"""Validate the solvers on flows with a known answer, from one command.

    python -m validation.flows                    all cases, about half an hour
    python -m validation.flows --case poiseuille --case taylor-green

Prints one line per case: what was measured, the truth, the deviation, the largest that
counts as valid, and the processor time. Exit code 0: all valid; 1: one is not.

taylor-green
    Decay of u = sin kx cos ky, v = -cos kx sin ky in a periodic square at Re = U/(k nu)
    = 100; energy after 10 / (k U) against exp(-4 nu k^2 t).
poiseuille
    Steady reverse Poiseuille flow at Re = U H / nu = 10 against the parabola.
taylor-green-3d
    The Taylor-Green vortex in a cube at Re 100 (Brachet et al., J. Fluid Mech. 130
    (1983) 411); peak of the dissipation against a pseudo-spectral solver.
thin-cavity
    Lid-driven cavity at Re 100, periodic along z, against Ghia, Ghia & Shin (1982).
cube
    Lid-driven cube at Re 100 against the staggered grid of the reference predictors.
cube-1000
    Lid-driven cube at Re 1000 on a grid of 32 cells beside Albensoeder and Kuhlmann
    (2005). The data have Reynolds numbers up to 100, so the bound is wide.
strouhal
    Frequency of the vortices behind a disc at Re 100, f D / U, against Williamson
    (1989). The disc has 8 cells across and blocks 1/12 of a channel, which raises the
    frequency; Williamson's stream has no walls.
cylinder-drag
    Mean drag coefficient of the same disc against Park, Kwon and Choi (1998). It is
    taken from the momentum that the fringe gives to the stream.
dam-break, dam-break-3d
    Front of a breaking column of liquid, with the constants of fluid full and fluid-3d
    mini, against Martin and Moyce (1952); `dam_break.py` prints the whole curve.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from lagbench.data.box import Box
from lagbench.generators.cylinder import eddy, moved_out
from lagbench.generators.full_box_parameters import FullBoxParameters
from lagbench.generators.obstacle import Obstacle, is_inside
from lagbench.generators.periodic_noise import fill_box
from lagbench.generators.solver import Solver, build
from lagbench.generators.split import InitialState, Material
from lagbench.references.staggered import StaggeredGrid

from . import dam_break
from .diagnostics import Y, centre_lines

Array = NDArray[np.float64]

SOUND_SPEED = 5.0**0.5  # [length/s]
COURANT = 0.3  # cells that sound crosses in a substep


ALBENSOEDER = np.array(
    [
        (0.0000, 0.00000),
        (0.0547, -0.20623),
        (0.0625, -0.22283),
        (0.0703, -0.23696),
        (0.1016, -0.27293),
        (0.1719, -0.25160),
        (0.2813, -0.10999),
        (0.4531, -0.00612),
        (0.5000, 0.00802),
        (0.6172, 0.03905),
        (0.7344, 0.07334),
        (0.8516, 0.12183),
        (0.9531, 0.33171),
        (0.9609, 0.39821),
        (0.9688, 0.48443),
        (0.9766, 0.58964),
        (1.0000, 1.00000),
    ]
)
"""Height over the side, and u over the speed of the lid, on the centre line of the cube
at Re 1000: S. Albensoeder, H. C. Kuhlmann, J. Comput. Phys. 206 (2005) 536-558, Table
5, whose x is 1/2 minus the height.
"""


@dataclass(frozen=True, kw_only=True)
class CaseResult:
    """What a case measured."""

    measured: float
    truth: float
    deviation: float  # relative, or in units of the driving speed
    tolerance: float  # the largest valid deviation


def constants(
    box: Box, grid: int, particles: int, *, no_slip: bool = True, force_layers: int = 0
) -> FullBoxParameters:
    """Return the constants of the splits at an acoustic Courant number of 0.3."""
    return FullBoxParameters(
        particles=particles,
        grid=grid,
        dt=COURANT / grid / SOUND_SPEED,
        box=box,
        no_slip=no_slip,
        density=1e-4,
        modulus=5e-4,
        velocity_relaxation=0.01,
        jacobian_relaxation=0.1,
        density_coupling=0.01,
        shift=0.01,
        force_layers=force_layers,
        substeps_per_frame=1_000_000,  # what drives the flow does not change
    )


def lattice(box: Box, counts: Sequence[int]) -> Array:
    """Return particles on a jittered lattice in a box, shape [particle, axis]."""
    rng = np.random.default_rng(1)
    return fill_box(rng, counts, low=box.low, high=box.high, jitter=0.25)


def started(
    parameters: FullBoxParameters,
    position: Array,
    *,
    viscosity: float,
    velocity: Array | None = None,
    affine: Array | None = None,
    walls: Array | None = None,
    force: Array | None = None,
) -> Solver:
    """Return a solver that holds one scenario."""
    dimension = parameters.box.dimension
    count = len(position)
    if velocity is None:
        velocity = np.zeros((count, dimension))
    if affine is None:
        affine = np.zeros((count, dimension, dimension))
    if walls is None:
        walls = np.zeros((2 * dimension, dimension))
    state = InitialState(
        position=position,
        velocity=velocity,
        affine=affine,
        material=np.full(count, Material.LIQUID, dtype=np.int8),
        area=parameters.box.volume,
        viscosity=viscosity,
        wall_velocity=walls,
        body_force=force,
    )
    solver = build(parameters)
    solver.load([state])
    return solver


def nodal_velocity(solver: Solver) -> Array:
    """Return the nodal velocity [length/s], shape [*cells, axis]."""
    velocity = solver.grid_velocity()[0]  # type: ignore[attr-defined]
    return np.asarray(velocity, np.float64)


def energy(solver: Solver) -> float:
    """Return the mean of abs(v)^2 / 2 over the nodes [length^2/s^2]."""
    return float(0.5 * (nodal_velocity(solver) ** 2).sum(axis=-1).mean())


def vortex(position: Array, speed: float) -> tuple[Array, Array]:
    """Return velocity and gradient of the Taylor-Green vortex with k = 2 pi."""
    dimension = position.shape[1]
    k = 2.0 * np.pi
    sine = np.sin(k * position)
    cosine = np.cos(k * position)
    velocity = np.zeros_like(position)
    affine = np.zeros((*position.shape, dimension))
    for component, sign in ((0, 1.0), (1, -1.0)):
        # the component is the sine along its own axis, times cosines along the others
        factors = [cosine[:, axis] for axis in range(dimension)]
        slopes = [-k * sine[:, axis] for axis in range(dimension)]
        factors[component] = sine[:, component]
        slopes[component] = k * cosine[:, component]
        velocity[:, component] = sign * speed * np.prod(factors, axis=0)
        for axis in range(dimension):
            changed = [*factors]
            changed[axis] = slopes[axis]
            affine[:, component, axis] = sign * speed * np.prod(changed, axis=0)
    return velocity, affine


def taylor_green(grid: int = 32) -> CaseResult:
    """Energy of the decaying vortex in a square after ten turnovers."""
    speed = 0.2
    k = 2.0 * np.pi
    viscosity = speed / k / 100.0
    box = Box.from_bounds([(0.0, 1.0)] * 2, [True, True])
    position = lattice(box, (2 * grid, 2 * grid))
    parameters = constants(box, grid, len(position))
    velocity, affine = vortex(position, speed)
    solver = started(
        parameters, position, viscosity=viscosity, velocity=velocity, affine=affine
    )
    solver.advance(1)
    before = energy(solver)
    steps = round(10.0 / (k * speed) / parameters.dt)
    solver.advance(steps)
    ratio = energy(solver) / before
    truth = float(np.exp(-4.0 * viscosity * k**2 * steps * parameters.dt))
    return CaseResult(
        measured=ratio, truth=truth, deviation=abs(ratio / truth - 1.0), tolerance=0.01
    )


def poiseuille(grid: int = 32) -> CaseResult:
    """Profile of steady reverse Poiseuille flow, in units of its largest speed."""
    speed = 0.2
    viscosity = speed * 0.5 / 10.0
    acceleration = 8.0 * viscosity * speed / 0.25
    box = Box.from_bounds([(0.0, 1.0)] * 2, [True, True])
    position = lattice(box, (2 * grid, 2 * grid))
    parameters = constants(box, grid, len(position), force_layers=2)

    def profile(y: Array) -> Array:
        """Return u / U at some heights."""
        within = np.where(y < 0.5, y, y - 0.5)
        return np.asarray(np.where(y < 0.5, 1.0, -1.0) * 16.0 * within * (0.5 - within))

    velocity = np.zeros_like(position)
    velocity[:, 0] = 0.7 * speed * profile(position[:, 1])
    force = np.zeros((1, 2, 2))
    force[0, 0, 0] = acceleration
    force[0, 1, 0] = -acceleration
    solver = started(
        parameters, position, viscosity=viscosity, velocity=velocity, force=force
    )
    steps = round(0.25 / viscosity / parameters.dt)
    solver.advance(round(0.7 * steps))
    mean = np.zeros(grid)
    for _ in range(20):
        solver.advance(round(0.3 * steps / 20))
        mean += nodal_velocity(solver)[..., 0].mean(axis=0) / 20.0
    height = (np.arange(grid) + 0.5) / grid
    error = float(np.sqrt(np.mean((mean / speed - profile(height)) ** 2)))
    return CaseResult(
        measured=float(np.abs(mean).max() / speed),
        truth=1.0,
        deviation=error,
        tolerance=0.01,
    )


def spectral_dissipation(
    cells: int, reynolds: float, *, duration: float, dt: float
) -> Array:
    """Return dissipation over time of the Taylor-Green vortex, U = k = 1.

    Pseudo-spectral, in rotation form, with the two-thirds rule and RK4 (Canuto et al.,
    Spectral Methods, 2007); one value every quarter of a time unit.
    """
    points = 2.0 * np.pi * np.arange(cells) / cells
    x, y, z = np.meshgrid(points, points, points, indexing="ij")
    u = np.sin(x) * np.cos(y) * np.cos(z)
    v = -np.cos(x) * np.sin(y) * np.cos(z)
    whole = np.fft.fftfreq(cells, 1.0 / cells)
    half = np.fft.rfftfreq(cells, 1.0 / cells)
    wave = np.stack(np.meshgrid(whole, whole, half, indexing="ij"))
    square = (wave**2).sum(axis=0)
    divisor = np.where(square == 0.0, 1.0, square)
    is_kept = (np.abs(wave) < cells / 3.0).all(axis=0)

    def forward(field: Array) -> NDArray[np.complex128]:
        return np.asarray(np.fft.rfftn(field, axes=(1, 2, 3)))

    def backward(modes: NDArray[np.complex128]) -> Array:
        return np.asarray(np.fft.irfftn(modes, s=(cells,) * 3, axes=(1, 2, 3)))

    def rate(modes: NDArray[np.complex128]) -> NDArray[np.complex128]:
        vorticity = backward(1j * np.cross(wave, modes, axis=0))
        product = forward(np.cross(backward(modes), vorticity, axis=0)) * is_kept
        product -= wave * (wave * product).sum(axis=0) / divisor
        return np.asarray(product - square / reynolds * modes)

    modes = forward(np.stack([u, v, 0.0 * u]))
    every = round(0.25 / dt)
    dissipation = []
    for step in range(round(duration / dt) + 1):
        if step % every == 0:
            vorticity = backward(1j * np.cross(wave, modes, axis=0))
            dissipation.append((vorticity**2).sum(axis=0).mean() / reynolds)
        first = rate(modes)
        second = rate(modes + 0.5 * dt * first)
        third = rate(modes + 0.5 * dt * second)
        fourth = rate(modes + dt * third)
        modes = modes + dt / 6.0 * (first + 2.0 * (second + third) + fourth)
    return np.array(dissipation)


def taylor_green_3d(grid: int = 24) -> CaseResult:
    """Peak of the dissipation of the vortex in a cube, in units of k U^3."""
    speed = 0.2
    k = 2.0 * np.pi
    unit = 1.0 / (k * speed)  # of time [s]
    box = Box.from_bounds([(0.0, 1.0)] * 3, [True] * 3)
    position = lattice(box, (2 * grid,) * 3)
    parameters = constants(box, grid, len(position))
    velocity, affine = vortex(position, speed)
    solver = started(
        parameters,
        position,
        viscosity=speed / k / 100.0,
        velocity=velocity,
        affine=affine,
    )
    steps = round(0.25 * unit / parameters.dt)
    times = 0.25 + np.arange(32) * steps * parameters.dt / unit
    energies = []
    for _ in times:
        solver.advance(steps)
        energies.append(energy(solver) / speed**2)
    dissipation = -np.gradient(np.array(energies), times)
    truth = float(spectral_dissipation(32, 100.0, duration=8.0, dt=0.05).max())
    peak = float(dissipation[2:-1].max())
    return CaseResult(
        measured=peak, truth=truth, deviation=abs(peak / truth - 1.0), tolerance=0.08
    )


def _centre_line(
    grid: int, depth: int, *, is_thin: bool, lid_travel: float, reynolds: float = 100.0
) -> Array:
    """Return u / U at the nodes of the vertical centre line of a driven cavity.

    Args:
        grid: cells along x and y.
        depth: cells along z.
        is_thin: whether the box is periodic along z.
        lid_travel: distance by which the lid moves [sides of the box].
        reynolds: speed of the lid times the side over the viscosity.
    """
    speed = 0.26
    box = Box.from_bounds(
        [(0.0, 1.0), (0.0, 1.0), (0.0, depth / grid)], [False, False, is_thin]
    )
    per_cell_side = 2 if is_thin else 1.5
    counts = [round(per_cell_side * cells) for cells in (grid, grid, depth)]
    position = lattice(box, counts)
    parameters = constants(box, grid, len(position))
    walls = np.zeros((6, 3))
    walls[3, 0] = speed
    viscosity = speed / reynolds
    solver = started(parameters, position, viscosity=viscosity, walls=walls)
    steps = round(lid_travel / speed / parameters.dt)
    solver.advance(round(0.9 * steps))
    mean = np.zeros(grid)
    middle = slice(grid // 2 - 1, grid // 2 + 1)
    across = slice(None) if is_thin else slice(depth // 2 - 1, depth // 2 + 1)
    for _ in range(20):
        solver.advance(steps // 200)
        u = nodal_velocity(solver)[middle, :, across, 0]
        mean += u.mean(axis=(0, 2)) / speed / 20.0
    return mean


def thin_cavity(grid: int = 24) -> CaseResult:
    """The cavity in a thin box, periodic along z, against Ghia's u at Re 100."""
    u = _centre_line(grid, 4, is_thin=True, lid_travel=25.0)
    height = np.r_[0.0, (np.arange(grid) + 0.5) / grid, 1.0]
    ghia = centre_lines(100.0)
    assert ghia is not None  # Reynolds number 100 is tabulated
    measured = CubicSpline(height, np.r_[0.0, u, 1.0])(Y)
    error = float(np.sqrt(np.nanmean((measured - np.array(ghia.u)) ** 2)))
    return CaseResult(
        measured=float(u.min()),
        truth=float(np.nanmin(ghia.u)),
        deviation=error,
        tolerance=0.01,
    )


def cube(grid: int = 24, reference_cells: int = 32) -> CaseResult:
    """The driven cube at Re 100 against the staggered grid, along its centre line."""
    u = _centre_line(grid, grid, is_thin=False, lid_travel=20.0)
    box = Box.from_bounds([(0.0, 1.0)] * 3)
    staggered = StaggeredGrid(box, cells=(reference_cells,) * 3, no_slip=True)
    walls = np.zeros((6, 3))
    walls[3, 0] = 1.0
    field = staggered.advance(
        staggered.rest(), duration=20.0, viscosity=0.01, wall_velocity=walls
    )
    middle = reference_cells // 2
    faces = field[0][middle, :, middle - 1 : middle + 1].mean(axis=-1)
    cell = (np.arange(reference_cells) + 0.5) / reference_cells
    height = (np.arange(grid) + 0.5) / grid
    truth = np.interp(height, np.r_[0.0, cell, 1.0], np.r_[0.0, faces, 1.0])
    error = float(np.sqrt(np.mean((u - truth) ** 2)))
    return CaseResult(
        measured=float(u.min()),
        truth=float(faces.min()),
        deviation=error,
        tolerance=0.02,
    )


def cube_at_1000(grid: int = 32) -> CaseResult:
    """The driven cube at Re 1000 beside Albensoeder and Kuhlmann (2005)."""
    u = _centre_line(grid, grid, is_thin=False, lid_travel=40.0, reynolds=1000.0)
    height = np.r_[0.0, (np.arange(grid) + 0.5) / grid, 1.0]
    profile = CubicSpline(height, np.r_[0.0, u, 1.0])
    published = ALBENSOEDER[:, 1]
    error = float(np.sqrt(np.mean((profile(ALBENSOEDER[:, 0]) - published) ** 2)))
    return CaseResult(
        measured=float(u.min()),
        truth=float(published.min()),
        deviation=error,
        tolerance=0.05,
    )


@dataclass(frozen=True, kw_only=True)
class Shedding:
    """What a disc in a stream does once its wake is periodic."""

    strouhal: float  # frequency times the diameter over the speed of the stream
    drag: float  # mean drag over rho U^2 D / 2
    amplitude: float  # of the velocity across the stream behind the disc, over U


@functools.cache
def shedding(
    grid: int = 128,
    *,
    diameter: float = 1.0 / 16.0,
    height: float = 0.75,
    reynolds: float = 100.0,
    duration: float = 60.0,
) -> Shedding:
    """Return what a disc in a channel of length 1 sheds.

    Speeds and Reynolds number are those of the stream that reaches the disc.

    Args:
        grid: cells across a length of 1.
        diameter: D of the disc [length].
        height: of the channel [length].
        reynolds: U D / nu.
        duration: simulated time in D / U; its second half is measured.
    """
    speed = 0.25
    low = 0.5 - 0.5 * height
    box = Box.from_bounds([(0.0, 1.0), (low, low + height)], [True, False])
    centre = np.array([0.3125, 0.5])
    counts = (2 * grid, round(2 * grid * height))
    position = lattice(box, counts)
    cell = np.indices(counts).reshape(2, -1).T
    places = np.array(box.low) + (cell + 0.5) / (2 * grid)
    is_solid = is_inside(places, (0.3125, 0.5), 0.5 * diameter)
    fluid = moved_out(position[~is_solid], centre, 0.5 * diameter)
    parameters = dataclasses.replace(
        constants(box, grid, len(fluid), no_slip=False),
        obstacle_particles=int(is_solid.sum()),
        fringe_length=0.15,
        fringe_rate=20.0,
    )
    behind = centre + np.array([1.5 * diameter, 0.0])
    velocity, affine = eddy(fluid, behind, radius=1.5 * diameter, speed=speed)
    velocity[:, 0] += speed
    stream = np.array([speed, 0.0])
    state = InitialState(
        position=fluid,
        velocity=velocity,
        affine=affine,
        material=np.full(len(fluid), Material.LIQUID, dtype=np.int8),
        area=box.volume * len(fluid) / len(places),
        viscosity=speed * diameter / reynolds,
        obstacle=Obstacle(
            centre=(0.3125, 0.5), radius=0.5 * diameter, position=places[is_solid]
        ),
        stream=stream,
    )
    solver = build(parameters)
    solver.load([state])

    unit = diameter / speed  # of time [s]
    steps = round(0.1 * unit / parameters.dt)
    interval = steps * parameters.dt
    solver.advance(round(0.5 * duration * unit / parameters.dt))
    node = (np.arange(grid) + 0.5) / grid
    rates = parameters.fringe_rates(node)
    column = int(behind[0] * grid)
    row = round(0.5 * height * grid)
    across = []
    drags = []
    bulks = []
    for _ in range(round(0.5 * duration * unit / interval)):
        solver.advance(steps)
        field = nodal_velocity(solver)
        across.append(field[column, row, 1])
        gain = rates[:, None] * (speed - field[..., 0])  # [length/s^2]
        drags.append(gain.sum() / grid**2)
        bulks.append(field[: grid // 8, :, 0].mean())
    bulk = float(np.mean(bulks))  # the stream that reaches the disc [length/s]
    signal = np.array(across)
    frequency = crossing_rate(signal) / interval
    drag = float(np.mean(drags)) / (0.5 * bulk**2 * diameter)
    return Shedding(
        strouhal=frequency * diameter / bulk,
        drag=drag,
        amplitude=float(np.sqrt(2.0) * signal.std() / bulk),
    )


def crossing_rate(signal: Array) -> float:
    """Return how often per sample a signal rises through zero.

    Crossings lie between samples, where the line through them is zero.
    """
    before = signal[:-1]
    after = signal[1:]
    number = np.flatnonzero((before < 0.0) & (after >= 0.0))
    if len(number) < 3:
        return 0.0
    share = before[number] / (before[number] - after[number])
    place = number + share
    return float((len(place) - 1) / (place[-1] - place[0]))


def strouhal() -> CaseResult:
    """Strouhal number of a disc at Re 100; C. H. K. Williamson, J. Fluid Mech. 206
    (1989) 579-627, has 0.164 to 0.166.
    """
    measured = shedding().strouhal
    truth = 0.165
    return CaseResult(
        measured=measured,
        truth=truth,
        deviation=abs(measured / truth - 1.0),
        tolerance=0.12,
    )


def cylinder_drag() -> CaseResult:
    """Drag coefficient of a disc at Re 100; J. Park, K. Kwon, H. Choi, KSME Int. J. 12
    (1998) 1200-1205, have 1.33.
    """
    measured = shedding().drag
    truth = 1.33
    return CaseResult(
        measured=measured,
        truth=truth,
        deviation=abs(measured / truth - 1.0),
        tolerance=0.12,
    )


def dam_front(split: str, size: str, tolerance: float) -> CaseResult:
    """Last place of the front of a breaking column, in widths of the column; J. C.
    Martin and W. J. Moyce, Phil. Trans. R. Soc. A 244 (1952) 312-324. The deviation is
    the mean over the front's way.
    """
    result = dam_break.run(size, split)
    return CaseResult(
        measured=result.front[-1],
        truth=result.experiment[-1],
        deviation=result.deviation,
        tolerance=tolerance,
    )


CASES: dict[str, Callable[[], CaseResult]] = {
    "taylor-green": taylor_green,
    "poiseuille": poiseuille,
    "taylor-green-3d": taylor_green_3d,
    "thin-cavity": thin_cavity,
    "cube": cube,
    "cube-1000": cube_at_1000,
    "strouhal": strouhal,
    "cylinder-drag": cylinder_drag,
    "dam-break": functools.partial(dam_front, "fluid", "full", 0.10),
    "dam-break-3d": functools.partial(dam_front, "fluid-3d", "mini", 0.05),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the cases that are named, or all, and return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--case", action="append", choices=list(CASES))
    options = parser.parse_args(arguments)
    failures = 0
    for name in options.case or CASES:
        start = time.process_time()
        result = CASES[name]()
        seconds = time.process_time() - start
        is_valid = result.deviation <= result.tolerance
        failures += not is_valid
        sys.stdout.write(
            f"{name:16s} {result.measured:9.5f}  truth {result.truth:9.5f}"
            f"  deviation {result.deviation:.4f}  tolerance {result.tolerance:g}"
            f"  {'valid' if is_valid else 'NOT VALID'}  {seconds:.0f} s\n"
        )
        sys.stdout.flush()
    return int(failures > 0)


if __name__ == "__main__":
    raise SystemExit(main())
