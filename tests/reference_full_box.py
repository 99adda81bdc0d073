"""The solver of full boxes a second time, in NumPy and float64, in any dimension.

Written from the equations of ``generators/nodal_stress_nd.py``, whole arrays at once.
Ghosts are filled and folded axis by axis, as slices, without tables.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from lagbench.generators.full_box_parameters import FullBoxParameters
from lagbench.generators.split import InitialState

Array = NDArray[np.float64]


class ReferenceFullBox:
    """One scenario whose walls and force do not change."""

    def __init__(self, parameters: FullBoxParameters, state: InitialState) -> None:
        self.p = parameters
        self.dx = 1.0 / parameters.grid
        self.box = parameters.box
        self.dimension = parameters.box.dimension
        self.shape = tuple(count + 2 for count in parameters.cells)
        self.viscosity = state.viscosity
        self.walls = state.wall_velocity
        particle_volume = state.area / parameters.particles
        self.mass = particle_volume / self.dx**self.dimension
        self.x = state.position.copy()
        self.v = state.velocity.copy()
        self.c = state.affine.copy()
        self.j = np.ones(parameters.particles)
        self.force = np.zeros((*self.shape, self.dimension))
        if state.body_force is not None:
            layers = state.body_force[0]
            row_count = parameters.cells[1]
            row = np.clip(np.arange(self.shape[1]) - 1, 0, row_count - 1)
            per_row = layers[row * len(layers) // row_count]
            other_axes = tuple(a for a in range(self.dimension) if a != 1)
            self.force += np.expand_dims(per_row, other_axes)
        self.tangential = 1.0
        if parameters.no_slip:
            self.tangential = -1.0

    def step(self, count: int) -> None:
        """Advance by some substeps."""
        for _ in range(count):
            v, r, jbar = self.to_grid()
            self.fill(v, moving=True)
            self.fill_scalar(r)
            self.fill_scalar(jbar)
            acceleration = self.acceleration(v, jbar) + self.force
            gain = self.p.dt * acceleration
            v = v + gain
            self.fill(v, moving=True)
            self.fill(gain, moving=False)
            self.to_particles(v, gain, r, jbar)

    def stencil(self) -> list[tuple[tuple[Array, ...], Array, Array]]:
        """Return node, weight and distance from the particle, of each neighbour."""
        scaled = (self.x - np.array(self.box.low)) / self.dx + 0.5
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
            result.append((node, w, (offset - f) * self.dx))
        return result

    def to_grid(self) -> tuple[Array, Array, Array]:
        """P2G, and the fold of the ghosts axis by axis; return v, r, Jbar."""
        momentum = np.zeros((*self.shape, self.dimension))
        count = np.zeros(self.shape)
        volume = np.zeros(self.shape)
        # what moving walls add; across two walls it keeps its sign
        drag = np.zeros_like(momentum)
        for node, w, apart in self.stencil():
            flow = self.v + np.einsum("pab,pb->pa", self.c, apart)
            np.add.at(momentum, node, w[:, None] * flow)
            np.add.at(count, node, w)
            np.add.at(volume, node, w * self.j)
        for axis in range(self.dimension):
            for side in (0, 1):
                ghost, edge, far = self.ends(axis, side)
                if self.box.periodic[axis]:
                    for q in (momentum, count, volume, drag):
                        q[far] += q[ghost]
                        q[ghost] = 0.0
                    continue
                sign = np.full(self.dimension, self.tangential)
                sign[axis] = -1.0
                speed = self.walls[2 * axis + side]
                ghost_count = count[ghost][..., None]
                drag[edge] += drag[ghost] + 2.0 * speed * ghost_count
                momentum[edge] += sign * momentum[ghost]
                count[edge] += count[ghost]
                volume[edge] += volume[ghost]
                for q in (momentum, count, volume, drag):
                    q[ghost] = 0.0
        inner = (slice(1, -1),) * self.dimension
        v = np.zeros_like(momentum)
        r = np.zeros_like(count)
        jbar = np.ones_like(count)
        total = momentum + drag
        v[inner] = total[inner] / count[inner][..., None]
        r[inner] = count[inner] * self.mass
        jbar[inner] = volume[inner] / count[inner]
        return v, r, jbar

    def ends(self, axis: int, side: int) -> tuple[tuple, tuple, tuple]:
        """Return the slices of a ghost layer, the layer beside it, and the one at the
        other end.
        """
        whole = [slice(None)] * self.dimension
        layers = []
        for index in ((0, 1, -2), (-1, -2, 1))[side]:
            chosen = list(whole)
            chosen[axis] = index
            layers.append(tuple(chosen))
        return layers[0], layers[1], layers[2]

    def fill_scalar(self, q: Array) -> None:
        """Fill the ghosts of a scalar."""
        for axis, side in itertools.product(range(self.dimension), (0, 1)):
            ghost, edge, far = self.ends(axis, side)
            q[ghost] = q[far] if self.box.periodic[axis] else q[edge]

    def fill(self, v: Array, *, moving: bool) -> None:
        """Fill the ghosts of a vector; walls move where one alone lies across."""
        drive = np.zeros_like(v)
        crossed = np.zeros((*self.shape, 1))
        for axis, side in itertools.product(range(self.dimension), (0, 1)):
            ghost, edge, far = self.ends(axis, side)
            if self.box.periodic[axis]:
                v[ghost] = v[far]
                continue
            sign = np.full(self.dimension, self.tangential)
            sign[axis] = -1.0
            v[ghost] = sign * v[edge]
            crossed[ghost] += 1.0
            taper = np.full(drive[ghost].shape, 2.0)
            others = [a for a in range(self.dimension) if a != axis]
            for position, other in enumerate(others):
                if not self.box.periodic[other]:
                    layer = np.moveaxis(taper[..., other], position, 0)
                    layer[[1, -2]] = 1.0
            drive[ghost] += taper * self.walls[2 * axis + side]
        if moving:
            v += np.where(crossed == 1.0, drive, 0.0)

    def acceleration(self, v: Array, jbar: Array) -> Array:
        """Return (E/rho) grad Jbar + nu lap v at the interior nodes, 0 elsewhere."""
        inner = (slice(1, -1),) * self.dimension
        a = np.zeros_like(v)
        stiffness = self.p.modulus / self.p.density / (2.0 * self.dx)
        for axis in range(self.dimension):
            q = np.roll(jbar, -1, axis) - np.roll(jbar, 1, axis)
            for other in range(self.dimension):
                if other != axis:
                    beside = np.roll(q, 1, other) + np.roll(q, -1, other)
                    q = 0.75 * q + 0.125 * beside
            laplacian = -2.0 * self.dimension * v[..., axis]
            for along in range(self.dimension):
                laplacian = laplacian + np.roll(v[..., axis], 1, along)
                laplacian = laplacian + np.roll(v[..., axis], -1, along)
            diffusion = self.viscosity / self.dx**2 * laplacian
            total = stiffness * q + diffusion
            a[..., axis][inner] = total[inner]
        return a

    def to_particles(self, v: Array, gain: Array, r: Array, jbar: Array) -> None:
        """G2P with relaxation, shift, motion and the update of J."""
        p = self.p
        count = len(self.x)
        here = np.zeros((count, self.dimension))
        push = np.zeros((count, self.dimension))
        density = np.zeros(count)
        ratio = np.zeros(count)
        c = np.zeros((count, self.dimension, self.dimension))
        thicker = np.zeros((count, self.dimension))
        for node, w, apart in self.stencil():
            here += w[:, None] * v[node]
            push += w[:, None] * gain[node]
            density += w * r[node]
            ratio += w * jbar[node]
            c += np.einsum("p,pa,pb->pab", w, v[node], apart)
            thicker += (w * r[node])[:, None] * apart
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
        inset = 1e-3 * self.dx
        low = np.array(self.box.low)
        high = np.array(self.box.high)
        wrapped = low + (moved - low) % (high - low)
        clipped = np.clip(moved, low + inset, high - inset)
        self.x = np.where(self.box.periodic, wrapped, clipped)
        self.c = c
        growth = p.dt * np.einsum("paa->p", c) * self.j
        relaxed = self.j + growth + p.jacobian_relaxation * (ratio - self.j)
        self.j = relaxed + p.density_coupling * (1.0 / density - ratio)
