"""The closed-box solver a second time, in NumPy: written from the equations, whole
arrays at once.

Strict float32 throughout; sums are int64. Walls are mirrored by slices rather than
index by index.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.generators.split import ClosedBoxParameters, InitialState

Single = NDArray[np.float32]
f = np.float32


class ReferenceClosedBox:
    """One scenario; the equations stand in ``generators/nodal_stress.py``."""

    def __init__(self, parameters: ClosedBoxParameters, state: InitialState) -> None:
        p = parameters
        self.p = parameters
        dx = 1.0 / p.grid
        self.inv_dx = f(p.grid)
        self.dt = f(p.dt)
        self.low = p.wall
        self.high = p.grid - p.wall
        least = f((p.wall + 0.5 + 1e-3) * dx)
        most = f((p.grid - p.wall - 0.5 - 1e-3) * dx)
        self.bounds = (least, most)
        room = 62 - int(np.ceil(np.log2(p.particles)))
        fastest = int(np.ceil(np.log2(16.0 * dx / p.dt)))
        self.mv_bits = min(room, 50) - fastest
        self.m_bits = min(room, 50) - 3
        self.cell_scale = f(2.0**self.mv_bits * dx)
        self.stiffness = f(p.dt * p.modulus / (p.density * 2.0 * dx))
        self.diffusion = f(state.viscosity * p.dt * p.grid**2)
        self.fill = f(state.area / p.particles * p.grid**2)
        self.gradient = f(4.0 * p.grid)
        self.shift = f(-p.shift * dx * dx)
        self.shift_bound = f(0.1 * dx)
        self.sign = -1 if p.no_slip else 1
        self.program = state.wall_velocity.reshape(-1, 4, 2).astype(f)
        self.wall = self.program[0]
        self.done = 0
        self.x = np.clip(state.position.astype(f), *self.bounds)
        self.v = state.velocity.astype(f)
        self.c = state.affine.astype(f)
        self.j = np.ones(p.particles, f)

    def step(self, count: int) -> None:
        """Advance by some substeps."""
        for _ in range(count):
            frame = self.done // self.p.substeps_per_frame + 1
            self.wall = self.program[min(frame, len(self.program) - 1)]
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

    def weights(self) -> tuple[NDArray[np.int32], Single, list[Single]]:
        """Return base nodes, offsets f and the three B-spline weights per axis."""
        scaled = self.x * self.inv_dx
        base = (scaled - f(0.5)).astype(np.int32)
        offset = scaled - base.astype(f)
        outer = f(1.5) - offset
        middle = offset - f(1.0)
        inner = offset - f(0.5)
        low = f(0.5) * (outer * outer)
        mid = f(0.75) - middle * middle
        high = f(0.5) * (inner * inner)
        return base, offset, [low, mid, high]

    def to_grid(self) -> NDArray[np.int64]:
        """P2G of (m v_x, m v_y, m, m J), in units of the particle mass and fixed
        point.
        """
        base, offset, weight = self.weights()
        width = self.p.grid + 1
        sums = np.zeros((width, width, 4), np.int64)
        mv = f(2.0**self.mv_bits)
        m = f(2.0**self.m_bits)
        east = self.cell_scale * self.c[:, :, 0]
        north = self.cell_scale * self.c[:, :, 1]
        centred = offset - f(1.0)
        middle = mv * self.v - centred[:, :1] * east - centred[:, 1:] * north
        for i, k in np.ndindex(3, 3):
            w = weight[i][:, 0] * weight[k][:, 1]
            w = w[:, None]
            momentum = (middle + f(i - 1) * east) + f(k - 1) * north
            volume = m * self.j[:, None]
            parts = np.concatenate([w * momentum, w * m, w * volume], axis=1)
            rounded = np.rint(parts.astype(np.float64))
            node = (base[:, 0] + i, base[:, 1] + k)
            np.add.at(sums, node, rounded.astype(np.int64))
        return sums

    def fold(self, sums: NDArray[np.int64]) -> tuple[Single, Single, Single]:
        """Give what ghosts received to their mirror images; return v, r, Jbar."""
        low = self.low
        high = self.high
        sign = self.sign
        total = sums.copy()
        drag = np.zeros((*sums.shape[:2], 2), f)
        unit = f(2.0**-self.m_bits)
        side = np.array([-1, sign, 1, 1])
        level = np.array([sign, -1, 1, 1])
        inner = slice(low + 1, high)
        for ghost, edge, wall in ((low, low + 1, 0), (high, high - 1, 1)):
            received = sums[ghost, inner]
            mass = received[:, 2].astype(f) * unit
            total[edge, inner] += side * received
            drag[edge, inner, 1] += f(2.0) * self.wall[wall, 1] * mass
            received = sums[inner, ghost]
            mass = received[:, 2].astype(f) * unit
            total[inner, edge] += level * received
            drag[inner, edge, 0] += f(2.0) * self.wall[wall + 2, 0] * mass
        for ghost_x, x, side_wall in ((low, low + 1, 0), (high, high - 1, 1)):
            for ghost_y, y, level_wall in ((low, low + 1, 2), (high, high - 1, 3)):
                received = sums[ghost_x, ghost_y]
                total[x, y] += side * level * received
                mass = received[2].astype(f) * unit
                drag[x, y, 0] += f(2.0) * self.wall[level_wall, 0] * mass
                drag[x, y, 1] += f(2.0) * self.wall[side_wall, 1] * mass
        count = total[:, :, 2]
        filled = count > 0
        mass = np.where(filled, count.astype(f) * unit, f(1.0))
        momentum_unit = f(2.0**-self.mv_bits)
        momentum = total[:, :, :2].astype(f) * momentum_unit + drag
        velocity = momentum / mass[:, :, None]
        v = np.where(filled[:, :, None], velocity, f(0.0))
        r = np.where(filled, mass * self.fill, f(0.0))
        volume = total[:, :, 3].astype(f) * unit
        return v, r, np.where(filled, volume / mass, f(1.0))

    def mirror_scalar(self, q: Single) -> None:
        """Mirror an even scalar: columns first, then whole rows with the corners."""
        low = self.low
        high = self.high
        q[low] = q[low + 1]
        q[high] = q[high - 1]
        q[:, low] = q[:, low + 1]
        q[:, high] = q[:, high - 1]

    def mirror(self, v: Single, *, moving: bool) -> None:
        """Mirror a vector: the normal component is odd about a wall.

        The tangential one is odd about the wall's velocity, even where fluid slides.
        """
        low = self.low
        high = self.high
        sign = f(self.sign)
        inner = slice(low + 1, high)
        taper = np.ones(high - low - 1, f)
        taper[[0, -1]] = f(0.5)
        speed = np.zeros_like(self.wall)
        if moving:
            speed = self.wall
        for ghost, edge, wall in ((low, low + 1, 0), (high, high - 1, 1)):
            side_drive = taper * (f(2.0) * speed[wall, 1])
            level_drive = taper * (f(2.0) * speed[wall + 2, 0])
            v[ghost, inner, 0] = -v[edge, inner, 0]
            v[ghost, inner, 1] = sign * v[edge, inner, 1] + side_drive
            v[inner, ghost, 0] = sign * v[inner, edge, 0] + level_drive
            v[inner, ghost, 1] = -v[inner, edge, 1]
        for ghost_x, x in ((low, low + 1), (high, high - 1)):
            for ghost_y, y in ((low, low + 1), (high, high - 1)):
                v[ghost_x, ghost_y] = -sign * v[x, y]

    def acceleration(self, v: Single, jbar: Single) -> Single:
        """Return dt ((E/rho) grad Jbar + nu lap v) at interior nodes, 0 elsewhere."""

        def at(q: Any, di: int, dj: int) -> Any:
            low = self.low + 1
            high = self.high
            return q[low + di : high + di, low + dj : high + dj]

        rising = at(jbar, 1, 1) - at(jbar, -1, -1)
        falling = at(jbar, 1, -1) - at(jbar, -1, 1)
        eastward = at(jbar, 1, 0) - at(jbar, -1, 0)
        northward = at(jbar, 0, 1) - at(jbar, 0, -1)
        x = f(0.75) * eastward + f(0.125) * (rising + falling)
        y = f(0.75) * northward + f(0.125) * (rising - falling)
        gradient = np.stack([x, y], axis=-1)

        beside = at(v, 1, 0) + at(v, -1, 0)
        above_below = at(v, 0, 1) + at(v, 0, -1)
        laplacian = beside + above_below - f(4.0) * at(v, 0, 0)
        a = np.zeros_like(v)
        inner = at(a, 0, 0)
        inner[...] = self.stiffness * gradient + self.diffusion * laplacian
        return a

    def to_particles(self, v: Single, a: Single, r: Single, jbar: Single) -> None:
        """G2P with relaxation, shift and the update of J."""
        p = self.p
        base, offset, weight = self.weights()
        nodal = np.concatenate([v, r[:, :, None], jbar[:, :, None]], axis=2)
        here = np.zeros((p.particles, 4), f)
        slope_x = np.zeros((p.particles, 4), f)
        slope_y = np.zeros((p.particles, 4), f)
        gain = np.zeros((p.particles, 2), f)
        for i, k in np.ndindex(3, 3):
            node = (base[:, 0] + i, base[:, 1] + k)
            w = weight[i][:, 0] * weight[k][:, 1]
            w = w[:, None]
            share = w * nodal[node]
            gain += w * a[node]
            here += share
            slope_x += f(i - 1) * share
            slope_y += f(k - 1) * share
        centred = offset - f(1.0)
        slope_x = self.gradient * (slope_x - centred[:, :1] * here)
        slope_y = self.gradient * (slope_y - centred[:, 1:] * here)

        volume = f(1.0) / np.maximum(here[:, 2], f(0.5))
        density_slope = np.stack([slope_x[:, 2], slope_y[:, 2]], axis=1)
        factor = self.shift * volume
        push = factor[:, None] * density_slope
        push = np.clip(push, -self.shift_bound, self.shift_bound)
        u = self.v + gain
        u = u + f(p.velocity_relaxation) * (here[:, :2] - u)
        along_x = push[:, :1] * slope_x[:, :2]
        along_y = push[:, 1:] * slope_y[:, :2]
        self.v = u + (along_x + along_y)
        step = self.dt * here[:, :2] + push
        self.x = np.clip(self.x + step, *self.bounds)
        self.c = np.stack([slope_x[:, :2], slope_y[:, :2]], axis=2)
        growth = self.dt * (slope_x[:, 0] + slope_y[:, 1]) * self.j
        relaxed = self.j + growth + f(p.jacobian_relaxation) * (here[:, 3] - self.j)
        self.j = relaxed + f(p.density_coupling) * (volume - here[:, 3])
