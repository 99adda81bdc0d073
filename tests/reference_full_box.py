"""The solver of full boxes a second time, in NumPy, in two and three dimensions.

Written from the equations of ``generators/nodal_stress.py``, whole arrays at once.
Every operation rounds to float32 in the order in which the equation is written; sums
over particles are 64-bit integers. Ghosts are filled and folded as slices, without
tables.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from reference_arithmetic import (
    HALF,
    ONE,
    TWO,
    ZERO,
    Float,
    Floats,
    Mask,
    Sums,
    fixed,
)

from lagbench.generators.full_box_parameters import FullBoxParameters
from lagbench.generators.obstacle import Obstacle
from lagbench.generators.split import InitialState

Index = tuple[Any, ...]
"""What picks a layer of nodes, or a node of each particle."""

Place = tuple[int, ...]
"""Steps from a node to a neighbour along each axis."""

INSET = 1e-3  # distance that particles keep from a wall [cells]
LARGEST_JACOBIAN = 8.0
SPEED_REACH = {2: 16.0, 3: 32.0}
"""Largest velocity in a stencil over dx/dt [1], by dimension: a power of two."""

NEIGHBOURS: dict[int, tuple[tuple[Place, ...], ...]] = {
    2: (
        ((1, 0), (0, 1)),
        ((1, 1), (1, -1)),
    ),
    3: (
        ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((1, 1, 0), (1, 0, 1), (1, 0, -1), (1, -1, 0), (0, 1, 1), (0, 1, -1)),
        ((1, 1, 1), (1, 1, -1), (1, -1, 1), (1, -1, -1)),
    ),
}
"""One of each two opposite neighbours of a node, by dimension: those beside it along
one axis, along two, along three.
"""

GRADIENT_WEIGHTS = {
    2: (Float(0.75), Float(0.125)),
    3: (Float(0.5625), Float(0.09375), Float(0.015625)),
}
"""Weights of the differences over these neighbours: products of 3/4 and 1/8."""


@dataclass
class Stencil:
    """Where the particles touch the grid.

    These are the lowest node, the offset from the middle node [cells], shape [particle,
    axis], and the weights, shape [place, particle, axis].
    """

    base: NDArray[np.int32]
    offset: Floats
    weights: Floats

    @classmethod
    def at(cls, scaled: Floats, cells: Sequence[int]) -> Stencil:
        """Quadratic B-splines around positions in cells from the lowest ghosts."""
        base = (scaled - HALF).astype(np.int32)
        # A periodic coordinate may round up to the end of the last cell.
        last = np.array(cells, np.int32) - 1
        base = np.minimum(base, last)
        distance = scaled - base.astype(Float)
        outer = Float(1.5) - distance
        middle = distance - ONE
        inner = distance - HALF
        low = HALF * (outer * outer)
        mid = Float(0.75) - middle * middle
        high = HALF * (inner * inner)
        weights = np.stack([low, mid, high])
        return cls(base, middle, weights)

    def nodes(self) -> Iterator[tuple[Place, Index, Floats]]:
        """Yield steps from the middle node, nodes and weights, shape [particle, 1]."""
        dimension = self.base.shape[1]
        for place in itertools.product(range(3), repeat=dimension):
            weight = self.weights[place[0]][:, 0]
            for axis in range(1, dimension):
                weight = weight * self.weights[place[axis]][:, axis]
            node = self.base + np.array(place, np.int32)
            step = tuple(i - 1 for i in place)
            yield step, tuple(node.T), weight[:, None]


class ReferenceFullBox:
    """One scenario; constants are computed in float64, then rounded once."""

    def __init__(
        self,
        parameters: FullBoxParameters,
        state: InitialState,
    ) -> None:
        p = parameters
        self.p = parameters
        self.state = state
        self.box = p.box
        self.dimension = p.box.dimension
        self.dx = 1.0 / p.grid
        self.dt = Float(p.dt)
        self.shape = tuple(count + 2 for count in p.cells)
        self.inner = (slice(1, -1),) * self.dimension
        self.sides = list(itertools.product(range(self.dimension), (0, 1)))
        low = np.array(p.box.low)
        high = np.array(p.box.high)
        # where the lowest ghosts lie [cells]
        self.origin = (low * p.grid - 0.5).astype(Float)
        self.low = low.astype(Float)
        self.high = high.astype(Float)
        self.period = (high - low).astype(Float)
        self.least = (low + INSET * self.dx).astype(Float)
        self.most = (high - INSET * self.dx).astype(Float)
        self.tangential = ONE
        if p.no_slip:
            self.tangential = -ONE

        particle_count = p.particles + p.obstacle_particles
        count_bits = np.ceil(np.log2(particle_count))
        room = min(50, 62 - int(count_bits))
        greatest_speed = SPEED_REACH[self.dimension] * self.dx / p.dt
        speed_bits = np.ceil(np.log2(greatest_speed))
        self.velocity_scale = 2.0 ** (room - int(speed_bits))
        self.count_scale = 2.0**room / LARGEST_JACOBIAN

        nodes_per_volume = p.grid**self.dimension
        particle_volume = state.area / p.particles * nodes_per_volume
        stiffness = p.dt * p.modulus / (2.0 * p.density * self.dx)
        diffusion = state.viscosity * p.dt * p.grid**2
        self.particle_volume = Float(particle_volume)
        self.stiffness = Float(stiffness)
        self.diffusion = Float(diffusion)
        self.shift = Float(-p.shift * self.dx**2)
        self.shift_bound = Float(0.1 * self.dx)

        position = state.position.astype(Float)
        self.x = self.kept_inside(position)
        self.v = state.velocity.astype(Float)
        # C, shape [particle, component, axis]
        self.c = state.affine.astype(Float)
        # the particles of an obstacle, which follow those of the fluid
        self.solid = slice(p.particles, None)
        self.solid_nodes = np.zeros(p.cells, bool)
        if state.obstacle is not None:
            self.add_obstacle(state.obstacle)
        self.j = np.ones(particle_count, Float)

        self.damping = np.zeros(p.cells, Float)
        self.stream = np.zeros(self.dimension, Float)
        if state.stream is not None:
            damping = p.dt * self.fringe()
            along_x = damping.reshape(-1, *(1,) * (self.dimension - 1))
            self.damping += along_x.astype(Float)
            self.stream = state.stream.astype(Float)
        self.done = 0
        self.drive()

    def add_obstacle(self, obstacle: Obstacle) -> None:
        """Append the particles of an obstacle, and mark the nodes that it stops."""
        solid = obstacle.position.astype(Float)
        resting = np.zeros_like(solid)
        self.x = np.concatenate([self.x, solid])
        self.v = np.concatenate([self.v, resting])
        still = np.zeros((len(solid), self.dimension, self.dimension), Float)
        self.c = np.concatenate([self.c, still])
        distance = np.linalg.norm(self.node_places() - obstacle.centre, axis=-1)
        self.solid_nodes = distance < obstacle.radius

    def node_places(self) -> NDArray[np.float64]:
        """Return where the interior nodes lie [length], shape [*cells, axis]."""
        number = np.moveaxis(np.indices(self.p.cells), 0, -1)
        place = np.array(self.box.low) + (number + 0.5) * self.dx
        return np.asarray(place)

    def fringe(self) -> NDArray[np.float64]:
        """Return the rate of the fringe at each column of nodes along x [1/s]."""
        p = self.p
        column = np.arange(p.cells[0])
        place = self.box.low[0] + (column + 0.5) * self.dx
        way = place - (self.box.high[0] - p.fringe_length)
        share = way / p.fringe_length
        bump = 16.0 * (share * (1.0 - share)) ** 2
        is_in_fringe = (share > 0.0) & (share < 1.0)
        return np.where(is_in_fringe, p.fringe_rate * bump, 0.0)

    def drive(self) -> None:
        """Set the velocity of the walls and the force that act in this substep."""
        frame = self.done // self.p.substeps_per_frame + 1
        walls = self.state.wall_velocity
        if walls.ndim == 3:
            walls = walls[min(frame, len(walls) - 1)]
        self.walls = walls.astype(Float)
        # dt f at each interior node
        self.force = np.zeros((*self.p.cells, self.dimension), Float)
        program = self.state.body_force
        if program is not None:
            layers = program[min(frame, len(program) - 1)]
            row_count = self.p.cells[1]
            layer_of_row = np.arange(row_count) * len(layers) // row_count
            per_row = self.dt * layers[layer_of_row].astype(Float)
            other_axes = [axis for axis in range(self.dimension) if axis != 1]
            self.force += np.expand_dims(per_row, tuple(other_axes))

    def step(self, count: int) -> None:
        """Advance by some substeps."""
        for _ in range(count):
            self.drive()
            self.done += 1
            scaled = self.x * Float(self.p.grid) - self.origin
            stencil = Stencil.at(scaled, self.p.cells)
            sums = self.to_grid(stencil)
            v, r, jbar = self.fold(sums)
            self.fill(v, moving=True)
            self.fill_scalar(r)
            self.fill_scalar(jbar)
            gain = self.gain(v, jbar)
            v = v + gain
            v[self.inner][self.solid_nodes] = ZERO
            self.fill(v, moving=True)
            self.fill(gain, moving=False)
            self.to_particles(stencil, v, gain, r, jbar)

    def to_grid(self, stencil: Stencil) -> Sums:
        """P2G of (n v, n J, n) in fixed point, shape [*nodes, axis + 2]."""
        sums = np.zeros((*self.shape, self.dimension + 2), np.int64)
        slope = Float(self.dx) * self.c
        middle = self.v
        for axis in range(self.dimension):
            offset = stencil.offset[:, axis, None]
            middle = middle - offset * slope[:, :, axis]
        ratio = self.j[:, None]
        for step, node, weight in stencil.nodes():
            flow = middle
            for axis in range(self.dimension):
                flow = flow + Float(step[axis]) * slope[:, :, axis]
            momentum = fixed(weight * flow, self.velocity_scale)
            volume = fixed(weight * ratio, self.count_scale)
            count = fixed(weight, self.count_scale)
            parts = np.concatenate([momentum, volume, count], axis=1)
            np.add.at(sums, node, parts)
        return sums

    def fold(self, sums: Sums) -> tuple[Floats, Floats, Floats]:
        """Give what ghosts received to the nodes that they stand for; return v, r,
        Jbar.
        """
        total = sums.copy()
        # what moving walls add to n v
        drag = np.zeros((*self.shape, self.dimension), Float)
        unit = Float(1.0 / self.count_scale)
        # the ends of the axes that a ghost lies beyond, as seen from its node
        for ends in itertools.product((None, 0, 1), repeat=self.dimension):
            if not any(end is not None for end in ends):
                continue
            node, ghost = self.image(ends)
            sign = np.ones(self.dimension + 2, np.int64)
            speed = np.zeros(self.dimension, Float)
            for axis, end in enumerate(ends):
                if end is None or self.box.periodic[axis]:
                    continue
                vector_sign = self.image_sign(axis)
                sign[: self.dimension] *= vector_sign.astype(np.int64)
                speed = speed + TWO * self.walls[2 * axis + end]
            received = sums[ghost]
            total[node] += sign * received
            ghost_count = received[..., -1:].astype(Float) * unit
            drag[node] += speed * ghost_count

        is_filled = total[..., -1] > 0
        count = total[..., -1].astype(Float) * unit
        count = np.where(is_filled, count, ONE)
        volume = total[..., -2].astype(Float) * unit
        velocity_unit = Float(1.0 / self.velocity_scale)
        momentum = total[..., :-2].astype(Float) * velocity_unit + drag
        v = np.where(is_filled[..., None], momentum / count[..., None], ZERO)
        r = np.where(is_filled, count * self.particle_volume, ZERO)
        jbar = np.where(is_filled, volume / count, ONE)
        return v, r, jbar

    def image(self, ends: Sequence[int | None]) -> tuple[Index, Index]:
        """Return the interior nodes at some ends of the box, and the ghosts that stand
        for them there: the next ones at walls, those beyond the other end of periodic
        axes.
        """
        node: list[Any] = [slice(1, -1)] * self.dimension
        ghost: list[Any] = [slice(1, -1)] * self.dimension
        for axis, end in enumerate(ends):
            if end is None:
                continue
            low_ghost = 0
            high_ghost = -1
            near_ghost = low_ghost
            far_ghost = high_ghost
            node[axis] = 1
            if end == 1:
                near_ghost = high_ghost
                far_ghost = low_ghost
                node[axis] = -2
            ghost[axis] = near_ghost
            if self.box.periodic[axis]:
                ghost[axis] = far_ghost
        return tuple(node), tuple(ghost)

    def image_sign(self, axis: int) -> Floats:
        """Return the signs of a vector's mirror image behind a wall."""
        sign = np.full(self.dimension, self.tangential)
        sign[axis] = -ONE
        return sign

    def ends(self, axis: int, side: int) -> tuple[Index, Index, Index]:
        """Return the slices of a ghost layer, the layer beside it, and the one at the
        other end.
        """
        indices = (0, 1, -2)
        if side == 1:
            indices = (-1, -2, 1)
        ghost, edge, far = (self.layer(axis, index) for index in indices)
        return ghost, edge, far

    def layer(self, axis: int, index: int) -> Index:
        """Return the slices of one layer of nodes."""
        chosen: list[Any] = [slice(None)] * self.dimension
        chosen[axis] = index
        return tuple(chosen)

    def fill_scalar(self, q: Floats) -> None:
        """Fill the ghosts of a scalar."""
        for axis, side in self.sides:
            ghost, edge, far = self.ends(axis, side)
            source = edge
            if self.box.periodic[axis]:
                source = far
            q[ghost] = q[source]

    def fill(self, v: Floats, *, moving: bool) -> None:
        """Fill the ghosts of a vector; walls move where one alone lies across."""
        drive = np.zeros_like(v)
        crossed = np.zeros((*self.shape, 1))
        for axis, side in self.sides:
            ghost, edge, far = self.ends(axis, side)
            if self.box.periodic[axis]:
                v[ghost] = v[far]
                continue
            v[ghost] = self.image_sign(axis) * v[edge]
            crossed[ghost] += 1.0
            taper = np.full(drive[ghost].shape, TWO)
            others = [other for other in range(self.dimension) if other != axis]
            for position, other in enumerate(others):
                if not self.box.periodic[other]:
                    across = taper[..., other]
                    layer = np.moveaxis(across, position, 0)
                    layer[[1, -2]] = ONE
            wall_velocity = self.walls[2 * axis + side]
            drive[ghost] += taper * wall_velocity
        if moving:
            v += np.where(crossed == 1.0, drive, ZERO)

    def gain(self, v: Floats, jbar: Floats) -> Floats:
        """Return dt a = dt ((E/rho) grad Jbar + nu lap v + f + sigma (U - v)) at the
        interior nodes, 0 elsewhere and in an obstacle.
        """
        middle = v[self.inner]
        pressure_force = self.stiffness * self.pressure_gradient(jbar)
        inner_gain = pressure_force + self.diffusion * self.laplacian(v)
        inner_gain = inner_gain + self.force
        inner_gain = inner_gain + self.damping[..., None] * (self.stream - middle)
        inner_gain[self.solid_nodes] = ZERO
        gain = np.zeros_like(v)
        gain[self.inner] = inner_gain
        return gain

    def pressure_gradient(self, jbar: Floats) -> Floats:
        """Return 2 dx grad Jbar at the interior nodes, shape [*cells, axis]."""
        shape = (*self.p.cells, self.dimension)
        gradient = np.zeros(shape, Float)
        weights = GRADIENT_WEIGHTS[self.dimension]
        neighbours = NEIGHBOURS[self.dimension]
        for weight, steps in zip(weights, neighbours, strict=True):
            total = np.zeros(shape, Float)
            for step in steps:
                ahead, behind = self.opposite(jbar, step)
                rise = ahead - behind
                total = total + rise[..., None] * np.array(step, Float)
            gradient = gradient + weight * total
        return gradient

    def laplacian(self, v: Floats) -> Floats:
        """Return dx^2 lap v at the interior nodes, shape [*cells, axis]."""
        middle = v[self.inner]
        total = np.zeros_like(middle)
        for step in NEIGHBOURS[self.dimension][0]:
            ahead, behind = self.opposite(v, step)
            total = total + (ahead + behind)
        return np.asarray(total - Float(2.0 * self.dimension) * middle)

    def opposite(self, q: Floats, step: Place) -> tuple[Floats, Floats]:
        """Return the values at a neighbour of each interior node, and opposite it."""
        ahead = []
        behind = []
        for steps, count in zip(step, self.p.cells, strict=True):
            ahead.append(slice(1 + steps, 1 + steps + count))
            behind.append(slice(1 - steps, 1 - steps + count))
        return q[tuple(ahead)], q[tuple(behind)]

    def to_particles(
        self,
        stencil: Stencil,
        v: Floats,
        gain: Floats,
        r: Floats,
        jbar: Floats,
    ) -> None:
        """G2P with relaxation, shift, motion and the update of J."""
        p = self.p
        nodal = np.concatenate([v, r[..., None], gain, jbar[..., None]], axis=-1)
        here, slopes = self.gather(stencil, nodal)
        mean_velocity = here[:, : self.dimension]
        density = here[:, self.dimension]
        particle_gain = here[:, self.dimension + 1 : -1]
        mean_ratio = here[:, -1]
        c = slopes[:, : self.dimension]
        density_slope = slopes[:, self.dimension]

        volume = ONE / np.maximum(density, HALF)
        factor = self.shift * volume
        wanted = factor[:, None] * density_slope
        shift: Floats = np.clip(wanted, -self.shift_bound, self.shift_bound)
        u: Floats = self.v + particle_gain
        u = u + Float(p.velocity_relaxation) * (mean_velocity - u)
        change = np.zeros_like(u)
        for axis in range(self.dimension):
            change = change + shift[:, axis, None] * c[:, :, axis]
        start = self.x
        step = self.dt * mean_velocity + shift
        self.x = self.kept_inside(start + step)
        if self.state.obstacle is not None:
            self.x = self.kept_outside(self.state.obstacle, self.x)
        self.v = u + change
        self.x[self.solid] = start[self.solid]
        self.v[self.solid] = ZERO
        c[self.solid] = ZERO
        self.c = c

        divergence = np.zeros_like(self.j)
        for axis in range(self.dimension):
            divergence = divergence + c[:, axis, axis]
        growth = self.dt * divergence * self.j
        relaxation = Float(p.jacobian_relaxation) * (mean_ratio - self.j)
        coupling = Float(p.density_coupling) * (volume - mean_ratio)
        self.j = self.j + growth + relaxation + coupling

    def gather(self, stencil: Stencil, nodal: Floats) -> tuple[Floats, Floats]:
        """Return values at the particles, shape [particle, value], and their slopes
        along each axis, shape [particle, value, axis].
        """
        here = np.zeros((len(self.x), nodal.shape[-1]), Float)
        slopes = np.zeros((*here.shape, self.dimension), Float)
        shares: dict[Place, Floats] = {}
        for step, node, weight in stencil.nodes():
            shares[step] = weight * nodal[node]
        if self.dimension == 2:
            add_nodes(here, slopes, shares)
        else:
            add_rows(here, slopes, shares)
        for axis in range(self.dimension):
            slopes[..., axis] -= stencil.offset[:, axis, None] * here
        return here, Float(4.0 * self.p.grid) * slopes

    def kept_inside(self, x: Floats) -> Floats:
        """Return positions between the walls, wrapped along periodic axes."""
        clipped = np.clip(x, self.least, self.most)
        wrapped = np.where(x >= self.high, x - self.period, x)
        wrapped = np.where(wrapped < self.low, wrapped + self.period, wrapped)
        wrapped = np.where(wrapped < self.high, wrapped, self.low)
        return np.where(self.box.periodic, wrapped, clipped)

    def kept_outside(self, obstacle: Obstacle, x: Floats) -> Floats:
        """Return positions outside an obstacle, those inside put on its surface."""
        least = Float(obstacle.radius + INSET * self.dx)
        way = x - np.array(obstacle.centre, Float)
        square = np.zeros(len(x), Float)
        for component in way.T:
            square = square + component * component
        is_inside: Mask = square < least * least
        stretch = least / np.sqrt(np.where(is_inside, square, ONE))
        factor = stretch - ONE
        on_surface = x + factor[:, None] * way
        return np.where(is_inside[:, None], on_surface, x)


def add_nodes(here: Floats, slopes: Floats, shares: dict[Place, Floats]) -> None:
    """Sum the shares of the nodes and their differences, node by node."""
    for step, share in shares.items():
        here += share
        for axis, steps in enumerate(step):
            slopes[..., axis] += Float(steps) * share


def add_rows(here: Floats, slopes: Floats, shares: dict[Place, Floats]) -> None:
    """Sum the same in space: first the three nodes of each row along z."""
    for i, j in itertools.product((-1, 0, 1), repeat=2):
        low = shares[i, j, -1]
        high = shares[i, j, 1]
        row = low + shares[i, j, 0] + high
        here += row
        slopes[..., 0] += Float(i) * row
        slopes[..., 1] += Float(j) * row
        slopes[..., 2] += high - low
