# ruff: noqa: ANN001, ANN201 (Taichi infers the types of its functions)
# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""A solver of fluids as Taichi code is usually written, to compare ours with.

This is the part that is the same in two and in three dimensions. conventional.py and
periodic_cube.py add their boxes, their grids and their substeps.
"""

from __future__ import annotations

import numpy as np
import taichi as ti

from lagbench.generators.full_box_parameters import FullBoxParameters
from lagbench.generators.split import ClosedBoxParameters, InitialState


@ti.data_oriented
class ConventionalFluid:
    """Fields of particles and nodes, and the motion of a particle.

    Args:
        parameters: constants of the solver.
        state: where the particles start, and the viscosity.
        nodes: nodes along each axis.
        mass: mass of a particle.
    """

    def __init__(
        self,
        parameters: ClosedBoxParameters | FullBoxParameters,
        state: InitialState,
        *,
        nodes: tuple[int, ...],
        mass: float,
    ) -> None:
        """Take the memory and load the particles."""
        p = parameters
        dimension = len(nodes)
        self.p = p
        self.dx = 1.0 / p.grid
        self.mass = mass
        square_sound_speed = p.modulus / p.density
        half_slope = 0.5 * p.grid  # of a difference over two cells
        self.pressure = p.dt * half_slope * square_sound_speed
        self.diffusion = state.viscosity * p.dt * p.grid**2

        # Particles: position, velocity, affine velocity and J.
        count = p.particles
        self.x = ti.Vector.field(dimension, ti.f32, count)
        self.v = ti.Vector.field(dimension, ti.f32, count)
        self.c = ti.Matrix.field(dimension, dimension, ti.f32, count)
        self.j = ti.field(ti.f32, count)
        # Nodes: mass or density, J, momentum or velocity, and acceleration.
        self.m = ti.field(ti.f32, nodes)
        self.q = ti.field(ti.f32, nodes)
        self.gv = ti.Vector.field(dimension, ti.f32, nodes)
        self.ga = ti.Vector.field(dimension, ti.f32, nodes)

        position = state.position.astype(np.float32)
        velocity = state.velocity.astype(np.float32)
        affine = state.affine.astype(np.float32)
        self.x.from_numpy(position)
        self.v.from_numpy(velocity)
        self.c.from_numpy(affine)
        self.j.fill(1.0)

    @ti.func
    def spline(self, f):
        """Return the quadratic B-spline weights of three nodes, the lowest one first.

        ``f`` is the place of a particle, counted from the lowest node in cells. It is a
        vector over the axes, and so is each weight.
        """
        first = 0.5 * (1.5 - f) ** 2
        second = 0.75 - (f - 1) ** 2
        third = 0.5 * (f - 0.5) ** 2
        return [first, second, third]

    @ti.func
    def move(self, p, v, a, c, density, thinner, smooth):
        """Renew a particle from what G2P gathered; return its place before any wall.

        Args:
            p: the particle.
            v: velocity of the nodes.
            a: acceleration of the nodes.
            c: affine velocity.
            density: density over the one at rest.
            thinner: first moment of the density.
            smooth: J of the nodes.
        """
        # Particles move a little to where the matter is thinner.
        limit = 0.1 * self.dx
        relative_gradient = 4.0 * thinner / density  # per cell
        wanted_shift = -self.p.shift * self.dx * relative_gradient
        shift = ti.math.clamp(wanted_shift, -limit, limit)
        moved = self.v[p] + a
        relaxation = self.p.velocity_relaxation * (v - moved)
        self.v[p] = moved + relaxation + c @ shift
        self.c[p] = c

        old = self.j[p]
        divergence = c.trace()
        expanded = old * (1.0 + self.p.dt * divergence)
        smoothing = self.p.jacobian_relaxation * (smooth - old)
        coupling = self.p.density_coupling * (1.0 / density - smooth)
        self.j[p] = expanded + smoothing + coupling
        return self.x[p] + self.p.dt * v + shift
