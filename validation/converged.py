"""A converged grid solver beside the truth of full boxes.

The truth of a full box approximates the incompressible Navier-Stokes equations,

    du/dt + div(u u) = -grad p + nu lap u + f,   div u = 0,

in a box whose walls move, let the fluid slide, or are not there. The solver here shares
nothing with the simulator, nor with the reference solvers: a staggered grid (Harlow and
Welch 1965) with central differences, the pressure by a cosine or Fourier transform, and
the third-order Runge-Kutta method of Shu and Osher (1988) with a projection in each
stage. It is of second order. Its start is the drawn flow at its own faces, before the
first substep of the simulator.

At the last given frame tracers start where the truth has its particles. Their paths are
scored as a prediction: what remains is the error of the truth, and that of the grid
solver, which a second run on a finer grid shows.

usage: python -m validation.converged --split cavity [--scenarios 32,33,34]
           [--cells 96,144] [--size mini] [--root FOLDER]
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import map_coordinates

from lagbench.data.box import Box
from lagbench.data.local import resolve_root
from lagbench.data.registry import Size, load
from lagbench.data.scenario import read_scenario
from lagbench.generators import curl_noise, curl_noise_3d, poiseuille
from lagbench.generators.batch import draw_initial_state
from lagbench.generators.constants import interval
from lagbench.generators.draws import draw_offsets, draw_program, generator
from lagbench.generators.noise import gradients
from lagbench.generators.periodic_noise import draw_lattice, noise, rotated_gradient
from lagbench.generators.refinement import refined
from lagbench.generators.split import InitialState
from lagbench.metrics.table import ranking_metric

from .distance import error_between

Array = NDArray[np.float64]
Flow = Callable[[Array], Array]
"""Velocity [length/s] at points [length], both of shape [point, axis]."""

CELLS = {2: (96, 144), 3: (32, 48)}
"""Cells along an axis of the two runs, by number of axes."""


class GridSolver:
    """Incompressible flow on a staggered grid.

    Component c of the velocity stands on the faces across axis c: one more than there
    are cells along that axis, the ends included. Along a periodic axis the last face is
    the first one.

    Args:
        box: walls and periodic axes; a cube or square.
        cells: cells along each axis.
        no_slip: whether the walls hold the fluid.
        viscosity: nu [length^2/s].
    """

    def __init__(
        self, box: Box, *, cells: int, no_slip: bool, viscosity: float
    ) -> None:
        self.box = box
        self.cells = cells
        self.no_slip = no_slip
        self.viscosity = viscosity
        self.axes = range(box.dimension)
        self.spacing = float(box.lengths[0]) / cells
        # velocity of the walls [length/s], shape [2 axis, axis], and force in layers of
        # equal height along y [length/s^2], shape [layer, axis]
        self.walls = np.zeros((2 * box.dimension, box.dimension))
        self.force: Array | None = None
        self.velocity = [np.zeros(self._face_shape(axis)) for axis in self.axes]

        number = np.arange(cells)
        eigenvalues = np.zeros((cells,) * box.dimension)
        for axis in self.axes:
            angle = np.pi * number / cells
            if box.periodic[axis]:
                angle = 2.0 * angle
            along = (2.0 * np.cos(angle) - 2.0) / self.spacing**2
            shape = [1] * box.dimension
            shape[axis] = cells
            eigenvalues = eigenvalues + along.reshape(shape)
        eigenvalues.flat[0] = 1.0  # the mean of the pressure is free
        self.eigenvalues = eigenvalues

    def _face_shape(self, component: int) -> tuple[int, ...]:
        return tuple(self.cells + (axis == component) for axis in self.axes)

    def face_places(self, component: int) -> Array:
        """Return the places of a component's faces [length], shape [face, axis]."""
        coordinates = []
        for axis in self.axes:
            count = self.cells + (axis == component)
            offset = 0.0 if axis == component else 0.5
            along = self.box.low[axis] + self.spacing * (np.arange(count) + offset)
            coordinates.append(along)
        nodes = np.meshgrid(*coordinates, indexing="ij")
        return np.stack([along.ravel() for along in nodes], axis=1)

    def start(self, flow: Flow) -> None:
        """Take the flow's velocity at the faces, and remove its divergence there."""
        for component in self.axes:
            places = self.face_places(component)
            inside = self.box.wrap(places)
            values = flow(inside)[:, component]
            self.velocity[component] = values.reshape(self._face_shape(component))
        self.velocity = self._projected(self.velocity)

    def _padded(self, values: Array, component: int, axis: int) -> Array:
        """Return a component with one more layer at both ends of an axis."""
        is_own = axis == component
        first = np.take(values, [1 if is_own else 0], axis)
        last = np.take(values, [-2 if is_own else -1], axis)
        if self.box.periodic[axis]:
            return np.concatenate([last, values, first], axis)
        if is_own:
            return np.concatenate([-first, values, -last], axis)
        if self.no_slip:
            first = 2.0 * self.walls[2 * axis, component] - first
            last = 2.0 * self.walls[2 * axis + 1, component] - last
        return np.concatenate([first, values, last], axis)

    def _rates(self, velocity: Sequence[Array]) -> list[Array]:
        """Return du/dt without the pressure [length/s^2], by component."""
        rates = []
        for component in self.axes:
            own = velocity[component]
            rate = np.zeros_like(own)
            for axis in self.axes:
                padded = self._padded(own, component, axis)
                carried = _middles(padded, axis)
                carrier = carried
                if axis != component:
                    other = self._padded(velocity[axis], axis, component)
                    carrier = _middles(other, component)
                flux = carrier * carried
                rate -= np.diff(flux, axis=axis) / self.spacing
                curvature = np.diff(padded, n=2, axis=axis) / self.spacing**2
                rate += self.viscosity * curvature
            if self.force is not None:
                layers = len(self.force)
                height = self.face_places(component)[:, 1] - self.box.low[1]
                share = height / self.box.lengths[1] * layers
                layer = np.clip(share.astype(int), 0, layers - 1)
                rate += self.force[layer, component].reshape(rate.shape)
            rates.append(rate)
        return rates

    def _projected(self, velocity: Sequence[Array]) -> list[Array]:
        """Return the nearest velocity without divergence; none crosses a wall."""
        divergence = np.zeros((self.cells,) * self.box.dimension)
        for axis in self.axes:
            component = velocity[axis]
            if not self.box.periodic[axis]:
                _along(component, axis)[[0, -1]] = 0.0
            divergence += np.diff(component, axis=axis) / self.spacing

        walled = [axis for axis in self.axes if not self.box.periodic[axis]]
        periodic = [axis for axis in self.axes if self.box.periodic[axis]]
        spectrum: NDArray[np.inexact] = divergence
        if walled:
            spectrum = fft.dctn(divergence, axes=walled)
        if periodic:
            spectrum = fft.fftn(spectrum, axes=periodic)
        spectrum = spectrum / self.eigenvalues
        spectrum.flat[0] = 0.0
        if periodic:
            spectrum = fft.ifftn(spectrum, axes=periodic).real
        pressure = np.asarray(spectrum.real)
        if walled:
            pressure = fft.idctn(pressure, axes=walled)

        projected = []
        for axis in self.axes:
            first = np.take(pressure, [0], axis)
            last = np.take(pressure, [-1], axis)
            if self.box.periodic[axis]:
                first, last = last, first
            padded = np.concatenate([first, pressure, last], axis)
            slope = np.diff(padded, axis=axis) / self.spacing
            projected.append(velocity[axis] - slope)
        return projected

    def step(self, dt: float) -> None:
        """Advance by a time step [s]."""
        start = self.velocity
        state = start
        for old_share in (0.0, 0.75, 1.0 / 3.0):
            rates = self._rates(state)
            stage = []
            for old, now, rate in zip(start, state, rates, strict=True):
                advanced = now + dt * rate
                stage.append(old_share * old + (1.0 - old_share) * advanced)
            state = self._projected(stage)
        self.velocity = state

    def steps_of(self, interval: float) -> int:
        """Return how many time steps an interval [s] needs."""
        speed = sum(float(np.abs(component).max()) for component in self.velocity)
        speed = max(speed, float(np.abs(self.walls).max()), 1e-3)
        flow_step = 0.5 * self.spacing / speed
        diffusive_step = 0.5 * self.spacing**2 / (self.viscosity * len(self.axes))
        return math.ceil(interval / min(flow_step, diffusive_step))

    def at(self, places: Array) -> Array:
        """Return the velocity at places [length/s], shape [place, axis]."""
        cells_from_corner = (places - np.array(self.box.low)) / self.spacing
        columns = []
        for component in self.axes:
            padded = self.velocity[component]
            index = cells_from_corner + 0.5
            index[:, component] += 0.5
            for axis in self.axes:
                padded = self._padded(padded, component, axis)
            values = map_coordinates(padded, index.T, order=1, mode="nearest")
            columns.append(values)
        return np.stack(columns, axis=1)

    def carry(self, places: Array, interval: float) -> Array:
        """Advance by an interval [s] and return where tracers then are [length]."""
        count = self.steps_of(interval)
        dt = interval / count
        for _ in range(count):
            before = self.at(places)
            ahead = self.box.wrap(places + dt * before)
            self.step(dt)
            after = self.at(ahead)
            places = self.box.wrap(places + 0.5 * dt * (before + after))
        return places


def _middles(values: Array, axis: int) -> Array:
    """Return the means of neighbours along an axis."""
    along = np.moveaxis(values, axis, 0)
    return np.moveaxis(0.5 * (along[1:] + along[:-1]), 0, axis)


def _along(values: Array, axis: int) -> Array:
    """Return a view with an axis in front."""
    return np.moveaxis(values, axis, 0)


def initial_flow(size: Size, scenario: int, state: InitialState) -> Flow:
    """Return the drawn flow of a scenario as a function of the place.

    Args:
        size: the split and size.
        scenario: id.
        state: the scenario before its first substep, at the refinement of the truth;
            its velocities scale the flow.
    """

    def unscaled(points: Array) -> Array:
        rng = generator(size.split, size.name, size.major, scenario, size.draw_seed)
        if size.split == "poiseuille":
            start = poiseuille.start_frame(size, scenario, rng)
            frames = start + size.frame_count(scenario)
            amplitude = size.value("force_max")
            gap = interval(size, "knot_gap")
            draw_program(rng, frames, amplitude=amplitude, knot_gap=gap)
        draw_offsets(rng, (size.particles, size.dimension), subdivision=1)
        frequency = int(state.parameters["frequency"])
        if size.split == "curl-noise":
            low, high = size.bounds[0]
            psi = curl_noise.stream_function(
                points,
                gradients(rng, frequency),
                low=low,
                high=high,
                scale=float(state.parameters["scale"]),
            )
            return rotated_gradient(psi).velocity
        if size.split == "curl-noise-3d":
            if curl_noise_3d.has_rings(scenario):
                return curl_noise_3d.draw_rings(size, rng, points).velocity
            return curl_noise_3d.draw_noise(rng, points, frequency).velocity
        return rotated_gradient(noise(points, draw_lattice(rng, frequency, 2))).velocity

    at_particles = unscaled(state.position)
    factor = np.vdot(at_particles, state.velocity) / np.vdot(at_particles, at_particles)
    return lambda points: factor * unscaled(points)


def predict(size: Size, scenario: int, *, cells: int, given: Array) -> Array:
    """Return where tracers are in the predicted frames [length].

    Args:
        size: the split and size.
        scenario: id.
        cells: cells of the grid along each axis.
        given: the truth in the last given frame [length], shape [particle, axis].

    Returns:
        Shape [frame, particle, axis].
    """
    state = draw_initial_state(refined(size), scenario)
    solver = GridSolver(
        size.box,
        cells=cells,
        no_slip=size.split.startswith("cavity"),
        viscosity=state.viscosity,
    )
    if np.any(state.velocity):
        solver.start(initial_flow(size, scenario, state))
    first = state.start_frame + size.task.input_frames
    places = np.zeros((1, size.dimension)) + size.box.centre
    frames = []
    for frame in range(1, first + size.task.horizon):
        solver.walls = state.walls_towards(frame)
        if state.body_force is not None:
            solver.force = state.force_towards(frame)
        if frame == first:
            places = given
        places = solver.carry(places, size.frame_interval)
        if frame >= first:
            frames.append(places)
    return np.stack(frames)


def compare(
    size: Size, root: Path, scenario: int, cells: Sequence[int]
) -> tuple[float, float]:
    """Return the error of the truth, and that of the coarser of two grids, both
    measured against the finer grid.
    """
    task = size.task
    with read_scenario(size.path(root, scenario)) as file:
        position = file.read("position", slice(0, task.input_frames + task.horizon))
        material = file.read("material")
    given = position[: task.input_frames].astype(np.float64)
    truth = position[task.input_frames :]
    coarse, fine = [
        predict(size, scenario, cells=count, given=given[-1]) for count in cells
    ]

    def error(prediction: NDArray[np.floating]) -> float:
        return error_between(
            size,
            prediction,
            fine,
            given=given,
            material=material,
            area=size.box.volume,
        )

    return error(truth), error(coarse)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line of this module; return its exit code."""
    options = _parse(arguments)
    size = load().size(options.split, options.size)
    root = resolve_root(options.root)
    scenarios = options.scenarios or size.subsets["test"][:3]
    cells = options.cells or CELLS[size.dimension]
    metric = ranking_metric(size)
    _say(
        f"{size.split} {size.name} {size.version}, refinement {size.refinement}: "
        f"{metric} against a grid of {cells[1]} cells"
    )
    _say(f"scenario  truth   {cells[0]} cells")
    errors = []
    for scenario in scenarios:
        errors.append(compare(size, root, scenario, cells))
        of_truth, of_grid = errors[-1]
        _say(f"{scenario:8d}  {of_truth:.4f}  {of_grid:.4f}")
    of_truth, of_grid = np.mean(errors, axis=0)
    _say(f"    mean  {of_truth:.4f}  {of_grid:.4f}")
    return 0


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    def numbers(text: str) -> list[int]:
        return [int(word) for word in text.split(",")]

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--split", required=True)
    parser.add_argument("--size", default="mini")
    parser.add_argument("--root", type=Path)
    parser.add_argument("--scenarios", type=numbers)
    parser.add_argument("--cells", type=numbers)
    return parser.parse_args(arguments)


if __name__ == "__main__":
    raise SystemExit(main())
