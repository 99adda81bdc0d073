"""The closed-box solver a second time, in NumPy: written from the equations, whole
arrays at once.

Strict float32 throughout; sums are int64. Walls are mirrored by slices rather than
index by index.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lagbench.generators.split import ClosedBoxParameters, InitialState

Single = NDArray[np.float32]
Nodes = NDArray[np.int32]
Sums = NDArray[np.int64]
f = np.float32

HALF = f(0.5)
ONE = f(1.0)
TWO = f(2.0)


class Side(NamedTuple):
    """One of two opposite walls: its ghost layer, the layer inside, its number."""

    ghost: int
    edge: int
    wall: int


class ReferenceClosedBox:
    """One scenario; the equations stand in ``generators/nodal_stress.py``."""

    def __init__(
        self,
        parameters: ClosedBoxParameters,
        state: InitialState,
    ) -> None:
        p = parameters
        self.p = parameters
        dx = 1.0 / p.grid
        self.inv_dx = f(p.grid)
        self.dt = f(p.dt)
        self.low = p.wall
        self.high = p.grid - p.wall
        self.sides = (
            Side(ghost=self.low, edge=self.low + 1, wall=0),
            Side(ghost=self.high, edge=self.high - 1, wall=1),
        )
        least = (self.low + 0.5 + 1e-3) * dx
        most = (self.high - 0.5 - 1e-3) * dx
        self.bounds = (f(least), f(most))
        count_bits = np.ceil(np.log2(p.particles))
        room = 62 - int(count_bits)
        greatest_speed = 16.0 * dx / p.dt
        speed_bits = np.ceil(np.log2(greatest_speed))
        fastest = int(speed_bits)
        self.mv_bits = min(room, 50) - fastest
        self.m_bits = min(room, 50) - 3
        self.cell_scale = f(2.0**self.mv_bits * dx)
        doubled_density = p.density * 2.0
        nodes_per_area = p.grid**2
        stiffness = p.dt * p.modulus / (doubled_density * dx)
        diffusion = state.viscosity * p.dt * nodes_per_area
        fill = state.area / p.particles * nodes_per_area
        self.stiffness = f(stiffness)
        self.diffusion = f(diffusion)
        self.fill = f(fill)
        self.gradient = f(4.0 * p.grid)
        self.shift = f(-p.shift * dx * dx)
        self.shift_bound = f(0.1 * dx)
        self.sign = -1 if p.no_slip else 1
        program = state.wall_velocity.reshape(-1, 4, 2)
        self.program = program.astype(f)
        self.wall = self.program[0]
        self.done = 0
        position = state.position.astype(f)
        self.x = np.clip(position, *self.bounds)
        self.v = state.velocity.astype(f)
        self.c = state.affine.astype(f)
        self.j = np.ones(p.particles, f)

    def step(self, count: int) -> None:
        """Advance by some substeps."""
        for _ in range(count):
            frame = self.done // self.p.substeps_per_frame + 1
            last_frame = len(self.program) - 1
            self.wall = self.program[min(frame, last_frame)]
            self.done += 1
            sums = self.to_grid()
            v, r, jbar = self.fold(sums)
            self.mirror_scalar(r)
            self.mirror_scalar(jbar)
            self.mirror(v, moving=True)
            a = self.acceleration(v, jbar)
            v = v + a
            self.mirror(v, moving=True)
            self.mirror(a, moving=False)
            self.to_particles(v, a, r, jbar)

    def weights(self) -> tuple[Nodes, Single, list[Single]]:
        """Return base nodes, offsets f and the three B-spline weights per axis."""
        scaled = self.x * self.inv_dx
        base = (scaled - HALF).astype(np.int32)
        offset = scaled - base.astype(f)
        outer = f(1.5) - offset
        middle = offset - ONE
        inner = offset - HALF
        low = HALF * (outer * outer)
        mid = f(0.75) - middle * middle
        high = HALF * (inner * inner)
        return base, offset, [low, mid, high]

    def node(self, base: Nodes, i: int, k: int) -> tuple[Nodes, Nodes]:
        """Return the numbers of one of the nine nodes around each particle."""
        column = base[:, 0] + i
        row = base[:, 1] + k
        return column, row

    def node_weight(self, weight: list[Single], i: int, k: int) -> Single:
        """Return the weight of that node for each particle, shape [particle, 1]."""
        along_x = weight[i][:, 0]
        along_y = weight[k][:, 1]
        w = along_x * along_y
        return w[:, None]

    def to_grid(self) -> Sums:
        """P2G of (m v_x, m v_y, m, m J), in units of the particle mass and fixed
        point.
        """
        base, offset, weight = self.weights()
        width = self.p.grid + 1
        sums = np.zeros((width, width, 4), dtype=np.int64)
        mv = f(2.0**self.mv_bits)
        m = f(2.0**self.m_bits)
        east = self.cell_scale * self.c[:, :, 0]
        north = self.cell_scale * self.c[:, :, 1]
        centred = offset - ONE
        middle = mv * self.v
        middle = middle - centred[:, :1] * east
        middle = middle - centred[:, 1:] * north
        volume = m * self.j[:, None]
        for i, k in np.ndindex(3, 3):
            w = self.node_weight(weight, i, k)
            momentum = middle + f(i - 1) * east
            momentum = momentum + f(k - 1) * north
            parts = [w * momentum, w * m, w * volume]
            exact = np.concatenate(parts, axis=1).astype(np.float64)
            rounded = np.rint(exact).astype(np.int64)
            np.add.at(sums, self.node(base, i, k), rounded)
        return sums

    def fold(self, sums: Sums) -> tuple[Single, Single, Single]:
        """Give what ghosts received to their mirror images; return v, r, Jbar."""
        sign = self.sign
        total = sums.copy()
        drag = np.zeros((*sums.shape[:2], 2), f)
        unit = f(2.0**-self.m_bits)
        # what a wall's motion adds per unit of mass along it
        double_wall = TWO * self.wall
        side = np.array([-1, sign, 1, 1])
        level = np.array([sign, -1, 1, 1])
        inner = slice(self.low + 1, self.high)
        for ghost, edge, wall in self.sides:
            received = sums[ghost, inner]
            mass = received[:, 2].astype(f) * unit
            total[edge, inner] += side * received
            drag[edge, inner, 1] += double_wall[wall, 1] * mass
            received = sums[inner, ghost]
            mass = received[:, 2].astype(f) * unit
            total[inner, edge] += level * received
            drag[inner, edge, 0] += double_wall[wall + 2, 0] * mass
        for ghost_x, x, side_wall in self.sides:
            for ghost_y, y, level_wall in self.sides:
                received = sums[ghost_x, ghost_y]
                total[x, y] += side * level * received
                mass = received[2].astype(f) * unit
                drag[x, y, 0] += double_wall[level_wall + 2, 0] * mass
                drag[x, y, 1] += double_wall[side_wall, 1] * mass
        count = total[:, :, 2]
        filled = count > 0
        counted_mass = count.astype(f) * unit
        mass = np.where(filled, counted_mass, ONE)
        momentum_unit = f(2.0**-self.mv_bits)
        momentum = total[:, :, :2].astype(f) * momentum_unit
        velocity = (momentum + drag) / mass[:, :, None]
        volume = total[:, :, 3].astype(f) * unit

        v = np.where(filled[:, :, None], velocity, f(0.0))
        r = np.where(filled, mass * self.fill, f(0.0))
        jbar = np.where(filled, volume / mass, ONE)
        return v, r, jbar

    def mirror_scalar(self, q: Single) -> None:
        """Mirror an even scalar: columns first, then whole rows with the corners."""
        for ghost, edge, _ in self.sides:
            q[ghost] = q[edge]
        for ghost, edge, _ in self.sides:
            q[:, ghost] = q[:, edge]

    def mirror(self, v: Single, *, moving: bool) -> None:
        """Mirror a vector: the normal component is odd about a wall.

        The tangential one is odd about the wall's velocity, even where fluid slides.
        """
        sign = f(self.sign)
        inner = slice(self.low + 1, self.high)
        inner_count = self.high - self.low - 1
        taper = np.ones(inner_count, f)
        taper[[0, -1]] = HALF
        speed = np.zeros_like(self.wall)
        if moving:
            speed = self.wall
        for ghost, edge, wall in self.sides:
            side_speed = TWO * speed[wall, 1]
            level_speed = TWO * speed[wall + 2, 0]
            side_image = sign * v[edge, inner, 1]
            level_image = sign * v[inner, edge, 0]
            v[ghost, inner, 0] = -v[edge, inner, 0]
            v[ghost, inner, 1] = side_image + taper * side_speed
            v[inner, ghost, 0] = level_image + taper * level_speed
            v[inner, ghost, 1] = -v[inner, edge, 1]
        for ghost_x, x, _ in self.sides:
            for ghost_y, y, _ in self.sides:
                v[ghost_x, ghost_y] = -sign * v[x, y]

    def acceleration(self, v: Single, jbar: Single) -> Single:
        """Return dt ((E/rho) grad Jbar + nu lap v) at interior nodes, 0 elsewhere."""

        def at(q: Any, di: int, dj: int) -> Any:
            columns = slice(self.low + 1 + di, self.high + di)
            rows = slice(self.low + 1 + dj, self.high + dj)
            return q[columns, rows]

        rising = at(jbar, 1, 1) - at(jbar, -1, -1)
        falling = at(jbar, 1, -1) - at(jbar, -1, 1)
        eastward = at(jbar, 1, 0) - at(jbar, -1, 0)
        northward = at(jbar, 0, 1) - at(jbar, 0, -1)
        x = f(0.75) * eastward + f(0.125) * (rising + falling)
        y = f(0.75) * northward + f(0.125) * (rising - falling)
        gradient = np.stack([x, y], axis=-1)

        beside = at(v, 1, 0) + at(v, -1, 0)
        above_below = at(v, 0, 1) + at(v, 0, -1)
        centre = f(4.0) * at(v, 0, 0)
        laplacian = beside + above_below - centre
        a = np.zeros_like(v)
        inner = at(a, 0, 0)
        pressure_force = self.stiffness * gradient
        inner[...] = pressure_force + self.diffusion * laplacian
        return a

    def to_particles(
        self,
        v: Single,
        a: Single,
        r: Single,
        jbar: Single,
    ) -> None:
        """G2P with relaxation, shift and the update of J."""
        p = self.p
        base, offset, weight = self.weights()
        scalars = np.stack([r, jbar], axis=2)
        nodal = np.concatenate([v, scalars], axis=2)
        here = np.zeros((p.particles, 4), f)
        slope_x = np.zeros((p.particles, 4), f)
        slope_y = np.zeros((p.particles, 4), f)
        gain = np.zeros((p.particles, 2), f)
        for i, k in np.ndindex(3, 3):
            node = self.node(base, i, k)
            w = self.node_weight(weight, i, k)
            share = w * nodal[node]
            gain += w * a[node]
            here += share
            slope_x += f(i - 1) * share
            slope_y += f(k - 1) * share
        centred = offset - ONE
        slope_x = slope_x - centred[:, :1] * here
        slope_y = slope_y - centred[:, 1:] * here
        slope_x = self.gradient * slope_x
        slope_y = self.gradient * slope_y
        mean_velocity = here[:, :2]
        density = here[:, 2]
        mean_ratio = here[:, 3]

        volume = ONE / np.maximum(density, HALF)
        density_slope = np.stack([slope_x[:, 2], slope_y[:, 2]], axis=1)
        factor = self.shift * volume
        push = factor[:, None] * density_slope
        push = np.clip(push, -self.shift_bound, self.shift_bound)
        u = self.v + gain
        u = u + f(p.velocity_relaxation) * (mean_velocity - u)
        along_x = push[:, :1] * slope_x[:, :2]
        along_y = push[:, 1:] * slope_y[:, :2]
        self.v = u + (along_x + along_y)
        step = self.dt * mean_velocity + push
        self.x = np.clip(self.x + step, *self.bounds)
        velocity_slopes = [slope_x[:, :2], slope_y[:, :2]]
        self.c = np.stack(velocity_slopes, axis=2)
        divergence = slope_x[:, 0] + slope_y[:, 1]
        growth = self.dt * divergence * self.j
        relaxation = f(p.jacobian_relaxation) * (mean_ratio - self.j)
        relaxed = self.j + growth + relaxation
        coupling = f(p.density_coupling) * (volume - mean_ratio)
        self.j = relaxed + coupling
