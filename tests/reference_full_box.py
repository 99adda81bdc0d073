"""The solver of full boxes a second time, in NumPy and float64, in any dimension.

Written from the equations of ``generators/nodal_stress_nd.py``, whole arrays at once.
Ghosts are filled and folded axis by axis, as slices, without tables.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.generators.full_box_parameters import FullBoxParameters
from lagbench.generators.obstacle import Obstacle
from lagbench.generators.split import InitialState

Array = NDArray[np.float64]
Index = tuple[Any, ...]
"""What picks a layer of nodes, or a node of each particle."""


class ReferenceFullBox:
    """One scenario whose walls and force do not change."""

    def __init__(
        self,
        parameters: FullBoxParameters,
        state: InitialState,
    ) -> None:
        self.p = parameters
        self.dx = 1.0 / parameters.grid
        self.box = parameters.box
        self.dimension = parameters.box.dimension
        self.shape = tuple(count + 2 for count in parameters.cells)
        self.vector_shape = (*self.shape, self.dimension)
        self.inner = (slice(1, -1),) * self.dimension
        self.sides = list(itertools.product(range(self.dimension), (0, 1)))
        self.viscosity = state.viscosity
        self.walls = state.wall_velocity
        particle_volume = state.area / parameters.particles
        self.mass = particle_volume / self.dx**self.dimension
        self.x = state.position.copy()
        self.v = state.velocity.copy()
        self.c = state.affine.copy()
        # the particles of an obstacle, which follow those of the fluid
        self.solid = slice(parameters.particles, None)
        self.solid_nodes = np.zeros(self.shape, bool)
        self.obstacle = state.obstacle
        if state.obstacle is not None:
            self.add_obstacle(state.obstacle)
        self.j = np.ones(len(self.x))
        self.force = np.zeros(self.vector_shape)
        if state.body_force is not None:
            layers = state.body_force[0]
            row_count = parameters.cells[1]
            node = np.arange(self.shape[1])
            row = np.clip(node - 1, 0, row_count - 1)
            layer_of_row = row * len(layers) // row_count
            per_row = layers[layer_of_row]
            other_axes = [axis for axis in range(self.dimension) if axis != 1]
            self.force += np.expand_dims(per_row, tuple(other_axes))
        self.rate = np.zeros(self.vector_shape)
        self.stream = np.zeros(self.dimension)
        if state.stream is not None:
            self.stream = state.stream
            rate = self.fringe(parameters)
            along_x = rate.reshape(-1, *(1,) * self.dimension)
            self.rate += along_x
        self.tangential = 1.0
        if parameters.no_slip:
            self.tangential = -1.0

    def add_obstacle(self, obstacle: Obstacle) -> None:
        """Append the particles of an obstacle, and mark the nodes that it stops."""
        solid = obstacle.position
        resting = np.zeros_like(solid)
        self.x = np.concatenate([self.x, solid])
        self.v = np.concatenate([self.v, resting])
        still = np.zeros((len(solid), self.dimension, self.dimension))
        self.c = np.concatenate([self.c, still])
        distance = np.linalg.norm(self.node_places() - obstacle.centre, axis=-1)
        self.solid_nodes = distance < obstacle.radius

    def node_places(self) -> Array:
        """Return where the nodes lie [length], ghosts included."""
        number = np.moveaxis(np.indices(self.shape), 0, -1)
        place = np.array(self.box.low) + (number - 0.5) * self.dx
        return np.asarray(place)

    def fringe(self, parameters: FullBoxParameters) -> Array:
        """Return the rate of the fringe at each column of nodes along x [1/s]."""
        column = np.arange(self.shape[0])
        place = self.box.low[0] + (column - 0.5) * self.dx
        way = place - (self.box.high[0] - parameters.fringe_length)
        share = way / parameters.fringe_length
        bump = 16.0 * (share * (1.0 - share)) ** 2
        is_in_fringe = (share > 0.0) & (share < 1.0)
        return np.where(is_in_fringe, parameters.fringe_rate * bump, 0.0)

    def step(self, count: int) -> None:
        """Advance by some substeps."""
        for _ in range(count):
            v, r, jbar = self.to_grid()
            self.fill(v, moving=True)
            self.fill_scalar(r)
            self.fill_scalar(jbar)
            acceleration = self.acceleration(v, jbar) + self.force
            acceleration += self.rate * (self.stream - v)
            gain = self.p.dt * acceleration
            v = v + gain
            v[self.solid_nodes] = 0.0
            gain[self.solid_nodes] = 0.0
            self.fill(v, moving=True)
            self.fill(gain, moving=False)
            self.to_particles(v, gain, r, jbar)

    def stencil(self) -> list[tuple[Index, Array, Array]]:
        """Return node, weight and distance from the particle, of each neighbour."""
        low_corner = np.array(self.box.low)
        scaled = (self.x - low_corner) / self.dx + 0.5
        base = np.floor(scaled - 0.5).astype(int)
        f = scaled - base
        low = 0.5 * (1.5 - f) ** 2
        middle = 0.75 - (f - 1) ** 2
        high = 0.5 * (f - 0.5) ** 2
        weight = [low, middle, high]
        result = []
        for step in np.ndindex((3,) * self.dimension):
            w = np.ones(len(f))
            for axis, i in enumerate(step):
                w = w * weight[i][:, axis]
            offset = np.array(step)
            node = tuple((base + offset).T)
            apart = (offset - f) * self.dx
            result.append((node, w, apart))
        return result

    def to_grid(self) -> tuple[Array, Array, Array]:
        """P2G, and the fold of the ghosts axis by axis; return v, r, Jbar."""
        momentum = np.zeros(self.vector_shape)
        count = np.zeros(self.shape)
        volume = np.zeros(self.shape)
        # what moving walls add; across two walls it keeps its sign
        drag = np.zeros_like(momentum)
        for node, w, apart in self.stencil():
            turning = np.einsum("pab,pb->pa", self.c, apart)
            flow = self.v + turning
            np.add.at(momentum, node, w[:, None] * flow)
            np.add.at(count, node, w)
            np.add.at(volume, node, w * self.j)
        for axis, side in self.sides:
            ghost, edge, far = self.ends(axis, side)
            if self.box.periodic[axis]:
                for q in (momentum, count, volume, drag):
                    q[far] += q[ghost]
                    q[ghost] = 0.0
                continue
            sign = self.image_sign(axis)
            speed = self.walls[2 * axis + side]
            ghost_count = count[ghost][..., None]
            wall_drag = 2.0 * speed * ghost_count
            drag[edge] += drag[ghost] + wall_drag
            momentum[edge] += sign * momentum[ghost]
            count[edge] += count[ghost]
            volume[edge] += volume[ghost]
            for q in (momentum, count, volume, drag):
                q[ghost] = 0.0
        inner = self.inner
        v = np.zeros_like(momentum)
        r = np.zeros_like(count)
        jbar = np.ones_like(count)
        total = momentum + drag
        inner_count = count[inner]
        v[inner] = total[inner] / inner_count[..., None]
        r[inner] = count[inner] * self.mass
        jbar[inner] = volume[inner] / count[inner]
        return v, r, jbar

    def image_sign(self, axis: int) -> Array:
        """Return the signs of a vector's mirror image behind a wall."""
        sign = np.full(self.dimension, self.tangential)
        sign[axis] = -1.0
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

    def fill_scalar(self, q: Array) -> None:
        """Fill the ghosts of a scalar."""
        for axis, side in self.sides:
            ghost, edge, far = self.ends(axis, side)
            source = edge
            if self.box.periodic[axis]:
                source = far
            q[ghost] = q[source]

    def fill(self, v: Array, *, moving: bool) -> None:
        """Fill the ghosts of a vector; walls move where one alone lies across."""
        drive = np.zeros_like(v)
        crossed = np.zeros((*self.shape, 1))
        for axis, side in self.sides:
            ghost, edge, far = self.ends(axis, side)
            if self.box.periodic[axis]:
                v[ghost] = v[far]
                continue
            sign = self.image_sign(axis)
            v[ghost] = sign * v[edge]
            crossed[ghost] += 1.0
            taper = np.full(drive[ghost].shape, 2.0)
            others = [other for other in range(self.dimension) if other != axis]
            for position, other in enumerate(others):
                if not self.box.periodic[other]:
                    across = taper[..., other]
                    layer = np.moveaxis(across, position, 0)
                    layer[[1, -2]] = 1.0
            wall_velocity = self.walls[2 * axis + side]
            drive[ghost] += taper * wall_velocity
        if moving:
            v += np.where(crossed == 1.0, drive, 0.0)

    def acceleration(self, v: Array, jbar: Array) -> Array:
        """Return (E/rho) grad Jbar + nu lap v at the interior nodes, 0 elsewhere."""
        a = np.zeros_like(v)
        sound_square = self.p.modulus / self.p.density
        stiffness = sound_square / (2.0 * self.dx)
        for axis in range(self.dimension):
            after = np.roll(jbar, -1, axis)
            before = np.roll(jbar, 1, axis)
            q = after - before
            for other in range(self.dimension):
                if other != axis:
                    beside = self.neighbour_sum(q, other)
                    q = 0.75 * q + 0.125 * beside
            component = v[..., axis]
            laplacian = -2.0 * self.dimension * component
            for along in range(self.dimension):
                laplacian = laplacian + self.neighbour_sum(component, along)
            diffusion = self.viscosity / self.dx**2 * laplacian
            total = stiffness * q + diffusion
            a[..., axis][self.inner] = total[self.inner]
        return a

    def neighbour_sum(self, q: Array, axis: int) -> Array:
        """Return the sum of the two neighbours of each node along an axis."""
        return np.roll(q, 1, axis) + np.roll(q, -1, axis)

    def to_particles(
        self,
        v: Array,
        gain: Array,
        r: Array,
        jbar: Array,
    ) -> None:
        """G2P with relaxation, shift, motion and the update of J."""
        p = self.p
        count = len(self.x)
        here = np.zeros((count, self.dimension))
        push = np.zeros((count, self.dimension))
        density = np.zeros(count)
        ratio = np.zeros(count)
        c = np.zeros_like(self.c)
        thicker = np.zeros((count, self.dimension))
        for node, w, apart in self.stencil():
            column = w[:, None]
            weighted_density = w * r[node]
            here += column * v[node]
            push += column * gain[node]
            density += weighted_density
            ratio += w * jbar[node]
            c += np.einsum("p,pa,pb->pab", w, v[node], apart)
            thicker += weighted_density[:, None] * apart
        scale = 4.0 / self.dx**2
        c *= scale
        density = np.maximum(density, 0.5)
        gradient = scale * thicker / density[:, None]
        shift = -p.shift * self.dx**2 * gradient
        most = 0.1 * self.dx
        shift = np.clip(shift, -most, most)
        u = self.v + push
        u += p.velocity_relaxation * (here - u)
        self.v = u + np.einsum("pab,pb->pa", c, shift)
        moved = self.x + p.dt * here + shift
        start = self.x
        inset = 1e-3 * self.dx
        low = np.array(self.box.low)
        high = np.array(self.box.high)
        wrapped = low + (moved - low) % (high - low)
        clipped = np.clip(moved, low + inset, high - inset)
        self.x = np.where(self.box.periodic, wrapped, clipped)
        if self.obstacle is not None:
            self.keep_outside(self.obstacle)
        self.x[self.solid] = start[self.solid]
        self.v[self.solid] = 0.0
        c[self.solid] = 0.0
        self.c = c
        divergence = np.einsum("paa->p", c)
        growth = p.dt * divergence * self.j
        relaxation = p.jacobian_relaxation * (ratio - self.j)
        coupling = p.density_coupling * (1.0 / density - ratio)
        self.j = self.j + growth + relaxation + coupling

    def keep_outside(self, obstacle: Obstacle) -> None:
        """Put particles that are inside an obstacle on its surface."""
        least = obstacle.radius + 1e-3 * self.dx
        way = self.x - obstacle.centre
        distance = np.linalg.norm(way, axis=1)
        is_inside = distance < least
        direction = way / distance[:, None]
        surface = obstacle.centre + least * direction
        self.x = np.where(is_inside[:, None], surface, self.x)
