"""Incompressible Navier-Stokes on a staggered grid, in two and three dimensions.

    du/dt + div(u u) = -grad p + nu lap u + f,    div u = 0

The component of the velocity along an axis stands on the faces that the axis crosses,
the pressure in the cells (Harlow and Welch, Phys. Fluids 8 (1965) 2182). Fluxes and the
Laplacian are central differences of second order. Time steps are Heun's, each stage
projected on fields without divergence (Chorin, Math. Comp. 22 (1968) 745). The
projection solves Poisson's equation exactly: cosines along walled axes and Fourier
modes along periodic ones are eigenvectors of its matrix.

Walls hold the fluid (no slip; they may move along themselves) or let it slide (free
slip). A fixed body inside the box stops the faces in it before each projection (direct
forcing; Fadlun et al., J. Comput. Phys. 161 (2000) 35). A fringe draws the velocity to
a stream. The solver takes the time step that is stable: at most half a cell per step,
and at most 0.8 of the longest time in which explicit viscosity is stable.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.data.box import Box
from lagbench.data.fringe_region import fringe_rates

Floats = NDArray[np.float64]

Velocity = list[Floats]
"""One array of face values per component [length/s]. The array of component a has one
value per cell along each axis, and along a walled axis a one more: both walls included.
"""

COURANT = 0.5
"""Cells that the fluid crosses in a time step, at most."""

BODY_PASSES = 2
"""Further projections around a fixed body in each stage of a time step."""

LEAST_WEIGHT = 1e-9
"""A face with less weight than this has no value of its own."""

VISCOUS_SHARE = 0.8
"""Time step over h^2 / (2 d nu), at most, with d axes; Heun's scheme is stable up to 1.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Forcing:
    """What draws the velocity of a fluid to given values: a fixed body, a fringe."""

    # centre and radius of the body [length], shape [axis + 1]
    obstacle: NDArray[np.floating]
    fringe_length: float  # of the fringe at the end of the box along x [length]
    fringe_rate: float  # in its middle [1/s]
    stream: Floats  # velocity to which the fringe draws [length/s], shape [axis]


class StaggeredGrid:
    """A staggered grid that fills a box, and the operators of the equations on it.

    Args:
        box: the box; all its walls are of one kind.
        cells: cells along each axis, shape [axis].
        no_slip: whether walls hold the fluid; else it slides along them.
        forcing: what draws the velocity at the faces to given values; None for nothing.
        upwinding: factor on the upwind part of third-order advection [1]: 1 of Leonard,
            3 of Kawamura and Kuwahara; None for central differences of second order.
    """

    def __init__(
        self,
        box: Box,
        *,
        cells: Sequence[int],
        no_slip: bool,
        forcing: Forcing | None = None,
        upwinding: float | None = None,
    ) -> None:
        self.box = box
        self.forcing = forcing
        self.upwinding = upwinding
        self.cells = tuple(cells)
        self.no_slip = no_slip
        self.spacing = box.lengths / np.asarray(self.cells)
        self._modes = []
        eigenvalues = np.zeros(self.cells)
        for axis, count in enumerate(self.cells):
            modes, rates = poisson_modes(count, periodic=box.periodic[axis])
            shape = [1] * box.dimension
            shape[axis] = count
            rates_along_axis = rates.reshape(shape)
            eigenvalues += rates_along_axis / self.spacing[axis] ** 2
            self._modes.append(modes)
        # The pressure is known up to a constant: its mean mode is left out.
        eigenvalues.flat[0] = np.inf
        self._inverse_eigenvalues = 1.0 / eigenvalues

    @property
    def dimension(self) -> int:
        """Number of axes: 2 or 3."""
        return self.box.dimension

    def face_shape(self, component: int) -> tuple[int, ...]:
        """Return the shape of the array of a velocity component."""
        shape = list(self.cells)
        if not self.box.periodic[component]:
            shape[component] += 1
        return tuple(shape)

    def face_origin(self, component: int) -> Floats:
        """Return where the first face of a component lies [length], shape [axis]."""
        offset = np.full(self.dimension, 0.5)
        offset[component] = 0.0
        low = np.asarray(self.box.low)
        return np.asarray(low + offset * self.spacing)

    def rest(self) -> Velocity:
        """Return the velocity of a fluid at rest [length/s]."""
        velocity = []
        for component in range(self.dimension):
            shape = self.face_shape(component)
            velocity.append(np.zeros(shape))
        return velocity

    # --- the equations ---------------------------------------------------------------

    def divergence(self, velocity: Velocity) -> Floats:
        """Return div u in the cells [1/s], shape [*cells]."""
        total = np.zeros(self.cells)
        for axis, values in enumerate(velocity):
            if self.box.periodic[axis]:
                upper = np.roll(values, -1, axis)
                change = upper - values
            else:
                change = np.diff(values, axis=axis)
            total += change / self.spacing[axis]
        return total

    def project(self, velocity: Velocity) -> Velocity:
        """Return the nearest velocity without divergence [length/s].

        ``u - grad p`` with ``lap p = div u``; walls stay impermeable.
        """
        source = self.divergence(velocity)
        pressure = self._solve_poisson(source)
        projected = []
        for axis, values in enumerate(velocity):
            h = self.spacing[axis]
            if self.box.periodic[axis]:
                lower = np.roll(pressure, 1, axis)
                gradient = (pressure - lower) / h
                corrected = values - gradient
            else:
                gradient = np.diff(pressure, axis=axis) / h
                inner = _slice(self.dimension, axis, 1, -1)
                corrected = values.copy()
                corrected[inner] -= gradient
            projected.append(corrected)
        return projected

    def _solve_poisson(self, source: Floats) -> Floats:
        """Return the p of mean 0 with ``lap p = source``, shape [*cells]."""
        coefficients = source
        for axis, modes in enumerate(self._modes):
            coefficients = _multiply_along(modes, coefficients, axis)
        coefficients = -coefficients * self._inverse_eigenvalues
        for axis, modes in enumerate(self._modes):
            coefficients = _multiply_along(modes.T, coefficients, axis)
        return coefficients

    def acceleration(
        self,
        velocity: Velocity,
        *,
        viscosity: float,
        wall_velocity: Floats,
        force: ArrayLike | None = None,
    ) -> Velocity:
        """Return ``-div(u u) + nu lap u + f`` at the faces [length/s^2].

        Args:
            velocity: face velocities [length/s].
            viscosity: kinematic viscosity nu [length^2/s].
            wall_velocity: velocity of each wall, two walls per axis, shape [2 axis,
                axis] [length/s]; rows of periodic axes are not read.
            force: acceleration f [length/s^2] of the whole fluid, shape [axis], or of
                layers of equal height along y, lowest first, shape [layer, axis].
        """
        padded = []
        for component, values in enumerate(velocity):
            ghosted = self._with_ghosts(values, component, wall_velocity)
            padded.append(ghosted)
        rates = []
        for component, ghosted in enumerate(padded):
            rate = viscosity * self._laplacian(ghosted)
            for axis in range(self.dimension):
                flux = self._flux(padded, component, axis, wall_velocity)
                rate -= np.diff(flux, axis=axis) / self.spacing[axis]
            if force is not None:
                rate += self._force_at_faces(np.asarray(force), component)
            self._stop_at_walls(rate, component)
            rates.append(rate)
        return rates

    def _stop_at_walls(self, values: Floats, component: int) -> None:
        """Set a component to 0 at the walls that it would cross."""
        if self.box.periodic[component]:
            return
        low_wall = _slice(self.dimension, component, None, 1)
        high_wall = _slice(self.dimension, component, -1, None)
        values[low_wall] = 0.0
        values[high_wall] = 0.0

    def _force_at_faces(self, force: Floats, component: int) -> Floats:
        """Return the acceleration at the faces of a component [length/s^2].

        It has one value along all axes but y, the faces' rows of cells along y.
        """
        layers = np.atleast_2d(force)[:, component]
        row_count = self.face_shape(component)[1]
        cell_count = self.cells[1]
        rows = np.arange(row_count)
        cell = np.minimum(rows, cell_count - 1)
        layer = cell * len(layers) // cell_count
        shape = [1] * self.dimension
        shape[1] = row_count
        at_rows = layers[layer]
        return np.asarray(at_rows.reshape(shape))

    def _with_ghosts(
        self, values: Floats, component: int, wall_velocity: Floats
    ) -> Floats:
        """Return a component with one more layer on each side of every axis."""
        padded = values
        for axis in range(self.dimension):
            padded = self._extend(padded, component, axis, wall_velocity, layers=1)
        return padded

    def _extend(
        self,
        values: Floats,
        component: int,
        axis: int,
        wall_velocity: Floats,
        *,
        layers: int,
    ) -> Floats:
        """Return a component with ghost layers at both ends of an axis.

        Across a wall stands the mirror image: ``2 u_wall - u`` where it holds the
        fluid, u where it slides, -u for the component that the wall stops.
        """
        dimension = self.dimension
        if self.box.periodic[axis]:
            low = values[_slice(dimension, axis, -layers, None)]
            high = values[_slice(dimension, axis, None, layers)]
            return np.concatenate((low, values, high), axis)
        # the component that the wall stops has its own face in the mirror
        mirror = 1 if axis == component else 0
        low = values[_slice(dimension, axis, mirror, mirror + layers)]
        end = values.shape[axis] - mirror
        high = values[_slice(dimension, axis, end - layers, end)]
        low = np.flip(low, axis)
        high = np.flip(high, axis)
        if axis == component:
            low = -low
            high = -high
        elif self.no_slip:
            low = 2.0 * wall_velocity[2 * axis, component] - low
            high = 2.0 * wall_velocity[2 * axis + 1, component] - high
        return np.concatenate((low, values, high), axis)

    def _laplacian(self, padded: Floats) -> Floats:
        """Return the Laplacian of a component that is padded with ghosts.

        The result has no ghosts [1/(length s)].
        """
        core = (slice(1, -1),) * self.dimension
        here = padded[core]
        total = np.zeros(here.shape)
        for axis in range(self.dimension):
            below = padded[_neighbour(self.dimension, axis, -1)]
            above = padded[_neighbour(self.dimension, axis, +1)]
            change = below - 2.0 * here + above
            total += change / self.spacing[axis] ** 2
        return total

    def _flux(
        self, padded: Velocity, component: int, axis: int, wall_velocity: Floats
    ) -> Floats:
        """Return ``u_component u_axis`` half a cell before and after each face.

        There the two velocities meet: in cells where the axis is the component's own,
        else on edges. The carrier is a mean of two values. The carried value is one
        too; or, with upwinding a, that of fourth order less an upwind part,

            (-u_0 + 7 u_1 + 7 u_2 - u_3) / 12
                + a sign(carrier) (u_3 - 3 u_2 + 3 u_1 - u_0) / 12.

        Its row i along the axis lies on the lower side of the component's row i.
        """
        dimension = self.dimension
        narrow = list((slice(1, -1),) * dimension)
        narrow[axis] = slice(None)
        carried = padded[component][tuple(narrow)]
        below = carried[_slice(dimension, axis, None, -1)]
        above = carried[_slice(dimension, axis, 1, None)]
        total = below + above
        if axis == component:
            carrier = 0.5 * total
        else:
            carrier = self._at_edges(padded[axis], axis=axis, component=component)
            count = total.shape[axis]
            carrier = carrier[_slice(dimension, axis, None, count)]
        if self.upwinding is None:
            return carrier * (0.5 * total)
        core = carried[_slice(dimension, axis, 1, -1)]
        wide = self._extend(core, component, axis, wall_velocity, layers=2)
        farther_below = wide[_slice(dimension, axis, None, -3)]
        farther_above = wide[_slice(dimension, axis, 3, None)]
        mean = 7.0 * total - farther_below - farther_above
        upwind = farther_above - farther_below - 3.0 * (above - below)
        return (carrier * mean + self.upwinding * np.abs(carrier) * upwind) / 12.0

    def _at_edges(self, padded: Floats, *, axis: int, component: int) -> Floats:
        """Return u_axis half a cell before the faces of another component.

        Row i along ``axis`` lies on the lower edge of the component's row i. Along the
        component's axis the rows are the component's faces.
        """
        dimension = self.dimension
        # Drop the ghosts of all other axes and the lower ghost of the own axis: a face
        # of number i is the lower end of cell i.
        keep = [slice(1, -1)] * dimension
        keep[axis] = slice(1, None)
        keep[component] = slice(None)
        values = padded[tuple(keep)]
        pairs = values.shape[component] - 1
        left = values[_slice(dimension, component, None, pairs)]
        right = values[_slice(dimension, component, 1, None)]
        mean = 0.5 * (left + right)
        if self.box.periodic[component]:
            # Periodic faces have no upper end: the last pair repeats the first.
            return mean[_slice(dimension, component, None, -1)]
        return mean

    # --- time ------------------------------------------------------------------------

    def project_forced(self, velocity: Velocity, dt: float) -> Velocity:
        """Return the projected velocity after a step of the forcing [length/s].

        In the fringe ``v = (u + dt sigma U) / (1 + dt sigma)``. In the body v is 0; the
        projection gives it some velocity, which is taken off and projected again
        :data:`BODY_PASSES` times.

        Args:
            velocity: face velocities u [length/s].
            dt: time step [s].
        """
        if self.forcing is None:
            return self.project(velocity)
        drawn = []
        for component, values in enumerate(velocity):
            rate, _ = self._forcing_at_faces[component]
            gain = dt * rate * self.forcing.stream[component]
            drawn.append((values + gain) / (1.0 + dt * rate))
        projected = self.project(self._stop_in_body(drawn))
        for _ in range(BODY_PASSES):
            projected = self.project(self._stop_in_body(projected))
        return projected

    def _stop_in_body(self, velocity: Velocity) -> Velocity:
        """Return the velocity with 0 at the faces in the body [length/s]."""
        stopped = []
        for component, values in enumerate(velocity):
            _, is_solid = self._forcing_at_faces[component]
            stopped.append(np.where(is_solid, 0.0, values))
        return stopped

    @functools.cached_property
    def _forcing_at_faces(self) -> list[tuple[Floats, NDArray[np.bool_]]]:
        """The fringe's rate [1/s] and the body's faces, for each component."""
        forcing = self.forcing
        if forcing is None:
            return []
        tables = []
        for component in range(self.dimension):
            number = np.indices(self.face_shape(component))
            number = np.moveaxis(number, 0, -1)
            place = self.face_origin(component) + number * self.spacing
            rate = fringe_rates(
                place[..., 0],
                end=self.box.high[0],
                length=forcing.fringe_length,
                rate=forcing.fringe_rate,
            )
            way = place - forcing.obstacle[:-1]
            square = (way * way).sum(axis=-1)
            tables.append((rate, square < forcing.obstacle[-1] ** 2))
        return tables

    def advance(
        self,
        velocity: Velocity,
        *,
        duration: float,
        viscosity: float,
        wall_velocity: Floats,
        force: ArrayLike | None = None,
    ) -> Velocity:
        """Return the velocity after some time, walls and force held [length/s].

        Args:
            velocity: face velocities at the start [length/s].
            duration: time to advance [s].
            viscosity: kinematic viscosity [length^2/s].
            wall_velocity: as in :meth:`acceleration`.
            force: as in :meth:`acceleration`.
        """
        steps = self.step_count(
            velocity,
            duration=duration,
            viscosity=viscosity,
            wall_velocity=wall_velocity,
        )
        dt = duration / steps
        rate_of = functools.partial(
            self.acceleration,
            viscosity=viscosity,
            wall_velocity=wall_velocity,
            force=force,
        )
        for _ in range(steps):
            rate = rate_of(velocity)
            guess = _add(velocity, rate, dt)
            predictor = self.project_forced(guess, dt)
            later_rate = rate_of(predictor)
            half_way = _add(velocity, rate, 0.5 * dt)
            end = _add(half_way, later_rate, 0.5 * dt)
            velocity = self.project_forced(end, dt)
        return velocity

    def step_count(
        self,
        velocity: Velocity,
        *,
        duration: float,
        viscosity: float,
        wall_velocity: Floats,
    ) -> int:
        """Return how many time steps a duration takes at the least [1]."""
        speeds = []
        for values in velocity:
            speed = np.abs(values)
            speeds.append(float(speed.max()))
        wall_speed = np.abs(wall_velocity)
        speeds.append(float(wall_speed.max(initial=0.0)))
        fastest = max(speeds)
        h = float(self.spacing.min())
        courant_steps = duration * fastest / (COURANT * h)
        viscous_share = VISCOUS_SHARE / (2 * self.dimension)
        viscous_steps = duration * viscosity / (viscous_share * h**2)
        stable_steps = np.ceil(max(courant_steps, viscous_steps))
        return max(1, int(stable_steps))

    # --- particles -------------------------------------------------------------------

    def from_particles(
        self,
        position: Floats,
        velocity: Floats,
        *,
        wall_velocity: Floats,
        corrections: int = 2,
    ) -> Velocity:
        """Return the field without divergence that comes near particles' velocities.

        First a face takes the mean of the particles less than a cell away, weighted
        linearly along each axis; faces without any take the mean of their neighbours.
        That mean smooths the field. Each correction spreads what the field then lacks
        at the particles in the same way and adds it.

        Args:
            position: particle positions [length], shape [particle, axis].
            velocity: particle velocities [length/s], shape [particle, axis].
            wall_velocity: as in :meth:`acceleration`.
            corrections: how often the field is corrected.
        """
        mean = self._spread(position, velocity)
        field = self.project(mean)
        for _ in range(corrections):
            reached = self.at_particles(field, position, wall_velocity=wall_velocity)
            lacking = self._spread(position, velocity - reached)
            corrected = _add(field, lacking, 1.0)
            field = self.project(corrected)
        return field

    def _spread(self, position: Floats, velocity: Floats) -> Velocity:
        """Return at each face the weighted mean of the particles around it."""
        field = []
        for component in range(self.dimension):
            particle_values = velocity[:, component]
            shape = self.face_shape(component)
            face_count = int(np.prod(shape))
            sums = np.zeros(face_count)
            weight = np.zeros(face_count)
            faces, shares = self._corners(position, component)
            for face, share in zip(faces, shares, strict=True):
                weight += np.bincount(face, share, face_count)
                sums += np.bincount(face, share * particle_values, face_count)
            values = fill_gaps(sums.reshape(shape), weight.reshape(shape))
            self._stop_at_walls(values, component)
            field.append(values)
        return field

    def _corners(
        self, position: Floats, component: int
    ) -> tuple[list[NDArray[np.intp]], list[Floats]]:
        """Return the faces around particles, as flat indices, and their linear weights.

        Weights of faces beyond a wall go to the nearest face.
        """
        shape = self.face_shape(component)
        place = (position - self.face_origin(component)) / self.spacing
        lower = np.floor(place).astype(np.intp)
        fraction = place - lower
        per_axis = []
        for axis, count in enumerate(shape):
            lower_row = lower[:, axis]
            upper_row = lower_row + 1
            if self.box.periodic[axis]:
                lower_row = np.mod(lower_row, count)
                upper_row = np.mod(upper_row, count)
            else:
                lower_row = np.clip(lower_row, 0, count - 1)
                upper_row = np.clip(upper_row, 0, count - 1)
            upper_weight = fraction[:, axis]
            lower_weight = 1.0 - upper_weight
            ends = ((lower_row, lower_weight), (upper_row, upper_weight))
            per_axis.append(ends)
        indices = []
        shares = []
        for corner in itertools.product(*per_axis):
            flat = np.zeros(len(position), np.intp)
            share = np.ones(len(position))
            for count, (row, weight) in zip(shape, corner, strict=True):
                flat = flat * count + row
                share = share * weight
            indices.append(flat)
            shares.append(share)
        return indices, shares

    def at_particles(
        self, velocity: Velocity, position: Floats, *, wall_velocity: Floats
    ) -> Floats:
        """Return the velocity at points, linear along each axis between the faces.

        Args:
            velocity: face velocities [length/s].
            position: points in the box [length], shape [point, axis].
            wall_velocity: as in :meth:`acceleration`; at a wall that holds the fluid
                the velocity is the wall's.

        Returns:
            Velocities [length/s], shape [point, axis].
        """
        result = np.empty(position.shape)
        for component, values in enumerate(velocity):
            padded = self._with_ghosts(values, component, wall_velocity)
            distance = position - self.face_origin(component)
            # The lower ghost layer stands one cell before the first face.
            place = distance / self.spacing + 1.0
            result[:, component] = interpolate(padded, place)
        return result

    def carry(
        self,
        position: Floats,
        *,
        before: Velocity,
        after: Velocity,
        duration: float,
        wall_velocity: Floats,
    ) -> Floats:
        """Return where the fluid takes particles while its velocity changes (Heun).

        Args:
            position: positions at the start [length], shape [particle, axis].
            before: face velocities at the start [length/s].
            after: face velocities at the end [length/s].
            duration: time between them [s].
            wall_velocity: as in :meth:`acceleration`.
        """
        start = self.at_particles(before, position, wall_velocity=wall_velocity)
        moved = position + duration * start
        guess = self.box.inside(moved)
        end = self.at_particles(after, guess, wall_velocity=wall_velocity)
        moved = position + 0.5 * duration * (start + end)
        return self.box.inside(moved)


def poisson_modes(count: int, *, periodic: bool) -> tuple[Floats, Floats]:
    """Return the orthonormal eigenvectors of the second difference, and its -values.

    Along a periodic axis these are the real Fourier modes, between walls the cosines of
    the discrete cosine transform DCT-II.

    Args:
        count: cells n along the axis.
        periodic: whether the axis repeats itself.

    Returns:
        Eigenvectors as rows, shape [mode, cell], the constant one first; and minus the
        eigenvalues for a spacing of 1, ``2 - 2 cos(theta)``, shape [mode].
    """
    cell = np.arange(count)
    mode = np.arange(count)
    if periodic:
        wave = (mode + 1) // 2
        theta = 2.0 * np.pi * wave / count
        phase = theta[:, None] * cell
        is_sine = (mode % 2 == 0) & (mode > 0)
        sines = np.sin(phase)
        cosines = np.cos(phase)
        modes = np.where(is_sine[:, None], sines, cosines)
    else:
        theta = np.pi * mode / count
        phase = theta[:, None] * (cell + 0.5)
        modes = np.cos(phase)
    square = np.sum(modes**2, axis=1, keepdims=True)
    modes /= np.sqrt(square)
    rates = 2.0 - 2.0 * np.cos(theta)
    return modes, rates


def interpolate(values: Floats, place: Floats) -> Floats:
    """Return values at points between nodes, linear along each axis.

    Args:
        values: values at nodes, at least two along each axis.
        place: points in units of nodes, the first node at 0, shape [point, axis];
            points beyond the nodes are extrapolated from the nearest two.

    Returns:
        Values, shape [point].
    """
    shape = values.shape
    last_axis_first = np.cumprod((1, *shape[:0:-1]))
    strides = last_axis_first[::-1]
    flat = values.ravel()
    base = np.zeros(len(place), np.intp)
    fractions = []
    for axis, count in enumerate(shape):
        along = place[:, axis]
        row = along.astype(np.intp)
        lower = np.clip(row, 0, count - 2)
        base += lower * strides[axis]
        fractions.append(along - lower)
    return _blend(flat, base, strides, fractions)


def _blend(
    flat: Floats, base: NDArray[np.intp], strides: NDArray[np.intp], fractions: Velocity
) -> Floats:
    """Return the linear blend over the axes that are left, first axis outermost."""
    if not fractions:
        return np.take(flat, base)
    fraction, *other_fractions = fractions
    other_strides = strides[1:]
    next_base = base + strides[0]
    lower = _blend(flat, base, other_strides, other_fractions)
    upper = _blend(flat, next_base, other_strides, other_fractions)
    upper -= lower
    upper *= fraction
    upper += lower
    return upper


def fill_gaps(sums: Floats, weight: Floats) -> Floats:
    """Return ``sums / weight`` at the faces of a grid, with gaps filled.

    A face without weight gets the mean of its neighbours that have a value.
    Gaps close from their edges, layer by layer, but not across the ends of a periodic
    axis. Without any weight all values are 0.
    """
    has_value = weight > LEAST_WEIGHT
    divisor = np.where(has_value, weight, 1.0)
    values = np.where(has_value, sums / divisor, 0.0)
    if not has_value.any():
        return values
    while not has_value.all():
        total = np.zeros(values.shape)
        count = np.zeros(values.shape)
        padded_values = np.pad(values * has_value, 1)
        padded_has_value = np.pad(has_value.astype(np.float64), 1)
        for axis in range(values.ndim):
            for step in (-1, +1):
                beside = _neighbour(values.ndim, axis, step)
                total += padded_values[beside]
                count += padded_has_value[beside]
        closing = ~has_value & (count > 0)
        values[closing] = total[closing] / count[closing]
        has_value |= closing
    return values


def _add(velocity: Velocity, rate: Velocity, dt: float) -> Velocity:
    """Return ``velocity + dt rate``."""
    later = []
    for values, change in zip(velocity, rate, strict=True):
        later.append(values + dt * change)
    return later


def _multiply_along(matrix: Floats, values: Floats, axis: int) -> Floats:
    """Return the product of a matrix and the columns of an array along an axis."""
    if values.ndim == 2:
        if axis == 0:
            return matrix @ values
        return values @ matrix.T
    product = np.tensordot(matrix, values, (1, axis))
    return np.moveaxis(product, 0, axis)


def _slice(
    dimension: int, axis: int, start: int | None, stop: int | None
) -> tuple[slice, ...]:
    """Return the index that takes ``start:stop`` along one axis and all of the rest."""
    index = [slice(None)] * dimension
    index[axis] = slice(start, stop)
    return tuple(index)


def _neighbour(dimension: int, axis: int, step: int) -> tuple[slice, ...]:
    """Return the index of the core of a padded array, moved by one along an axis."""
    index = [slice(1, -1)] * dimension
    if step < 0:
        index[axis] = slice(None, -2)
    else:
        index[axis] = slice(2, None)
    return tuple(index)
