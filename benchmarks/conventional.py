# ruff: noqa: ANN001, ANN201 (Taichi infers the types of its functions)
# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""The closed box in conventional Taichi code: the yardstick of our solver.

The equations are those of ``lagbench.generators.closed_box``. The code is written after
Taichi's own mpm128 example: one kernel launch per substep, every phase a parallel loop,
float32 sums by atomics, Taichi's default fast math. Its sums depend on
the order of threads, so no two runs agree to the bit.

    PYTHONPATH=. python benchmarks/conventional.py --grid 40 --threads 1 --substeps 2000

prints one JSON object: particle-substeps per second of wall time and core, and per
second of processor time (best of the repeats), and the mean kinetic energy per particle
at the end, by which the two formulations are compared.
"""

from __future__ import annotations

import os

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")

import argparse
import json
import time

import numpy as np
import taichi as ti
from conventional_fluid import ConventionalFluid

from lagbench.data import WALLS
from lagbench.generators.split import ClosedBoxParameters, InitialState
from validation.experiment import (
    Case,
    initial_state,
    plan,
    solver_parameters,
)


@ti.data_oriented
class ConventionalSquare(ConventionalFluid):
    """Fields and kernels of one cavity whose top wall moves along x.

    Args:
        parameters: constants of the solver.
        state: where the particles start, viscosity and wall speed.
    """

    def __init__(self, parameters: ClosedBoxParameters, state: InitialState) -> None:
        """Number the nodes at the walls, take the memory and load the particles."""
        # The walls lie half-way between two nodes. The ghost nodes lie half a cell
        # outside the walls, the first and the last node half a cell inside.
        self.low_ghost = parameters.wall
        self.high_ghost = parameters.grid - parameters.wall
        self.first = self.low_ghost + 1
        self.last = self.high_ghost - 1
        self.inside = (self.first, self.last + 1)

        top = WALLS.index("top")
        self.lid_speed = float(state.wall_velocity[top, 0])

        node_count = parameters.grid + 1  # along each axis
        fluid_mass = parameters.density * state.area
        super().__init__(
            parameters,
            state,
            nodes=(node_count, node_count),
            mass=fluid_mass / parameters.particles,
        )

        # Particles stay a thousandth of a cell inside the walls.
        wall_cells = self.low_ghost + 0.5  # place of the low walls [cell]
        inset_cells = wall_cells + 1e-3
        self.inset = inset_cells * self.dx

    @ti.func
    def weights(self, x):
        """Return base node, offset in cells and quadratic B-spline weights."""
        cells = x * self.p.grid
        base = ti.cast(cells - 0.5, ti.i32)
        f = cells - ti.cast(base, ti.f32)
        return (base, f, self.spline(f))

    @ti.func
    def ends_of_row(self, k):
        """Return the left ghost node, the node beside it, and both on the right."""
        left = ti.Vector([self.low_ghost, k])
        inside_left = ti.Vector([self.first, k])
        right = ti.Vector([self.high_ghost, k])
        inside_right = ti.Vector([self.last, k])
        return (left, inside_left, right, inside_right)

    @ti.func
    def ends_of_column(self, i):
        """Return the lowest ghost node, the node beside it, and both at the top."""
        bottom = ti.Vector([i, self.low_ghost])
        inside_bottom = ti.Vector([i, self.first])
        top = ti.Vector([i, self.high_ghost])
        inside_top = ti.Vector([i, self.last])
        return (bottom, inside_bottom, top, inside_top)

    @ti.func
    def fold(self, inner, ghost, flip, moved):
        """Add the mirror image of a ghost node to its interior node."""
        ghost_mass = self.m[ghost]
        wall_momentum = ti.Vector([2.0 * moved * ghost_mass, 0.0])
        mirrored_momentum = flip * self.gv[ghost]
        self.m[inner] += ghost_mass
        self.q[inner] += self.q[ghost]
        self.gv[inner] += mirrored_momentum + wall_momentum

    @ti.kernel
    def substep(self):
        """Advance by dt; every loop at the top level runs in parallel."""
        for i, k in self.m:
            self.gv[i, k] = ti.Vector([0.0, 0.0])
            self.m[i, k] = 0.0
            self.q[i, k] = 0.0
        # P2G: mass, momentum and J of the particles at the nodes.
        for p in self.x:
            base, f, w = self.weights(self.x[p])
            affine = self.c[p] * self.dx
            for i, k in ti.static(ti.ndrange(3, 3)):
                offset = ti.Vector([i, k])
                node = base + offset
                weight = self.mass * w[i][0] * w[k][1]
                velocity = self.v[p] + affine @ (offset - f)
                self.gv[node] += weight * velocity
                self.m[node] += weight
                self.q[node] += weight * self.j[p]

        # The ghost nodes give their sums to the nodes inside the walls.
        flip = ti.Vector([-1.0, -1.0])
        for k in range(self.low_ghost, self.high_ghost + 1):
            left, inside_left, right, inside_right = self.ends_of_row(k)
            self.fold(inside_left, left, flip, 0.0)
            self.fold(inside_right, right, flip, 0.0)
        for i in range(self.first, self.high_ghost):
            bottom, inside_bottom, top, inside_top = self.ends_of_column(i)
            self.fold(inside_bottom, bottom, flip, 0.0)
            self.fold(inside_top, top, flip, self.lid_speed)

        # Momentum becomes velocity, mass density.
        for i, k in ti.ndrange(self.inside, self.inside):
            mass = self.m[i, k]
            if mass > 0.0:
                self.gv[i, k] /= mass
                self.q[i, k] /= mass
                rest_mass = self.p.density * self.dx * self.dx
                self.m[i, k] = mass / rest_mass
            else:
                self.q[i, k] = 1.0
        for k in range(self.first, self.high_ghost):
            left, inside_left, right, inside_right = self.ends_of_row(k)
            self.mirror(left, inside_left, 0.0)
            self.mirror(right, inside_right, 0.0)
        for i in range(self.low_ghost, self.high_ghost + 1):
            bottom, inside_bottom, top, inside_top = self.ends_of_column(i)
            self.mirror(bottom, inside_bottom, 0.0)
            self.mirror(top, inside_top, self.lid_at(i))

        # Pressure and viscosity accelerate the nodes.
        for i, k in ti.ndrange(self.inside, self.inside):
            q = ti.static(self.q)
            across = q[i + 1, k] - q[i - 1, k]
            along = q[i, k + 1] - q[i, k - 1]
            rising = q[i + 1, k + 1] - q[i - 1, k - 1]
            falling = q[i + 1, k - 1] - q[i - 1, k + 1]
            gradient_x = 0.75 * across + 0.125 * (rising + falling)
            gradient_y = 0.75 * along + 0.125 * (rising - falling)
            gradient = ti.Vector([gradient_x, gradient_y])

            v = ti.static(self.gv)
            beside = v[i + 1, k] + v[i - 1, k]
            above_and_below = v[i, k + 1] + v[i, k - 1]
            laplacian = beside + above_and_below - 4.0 * v[i, k]
            push = self.pressure * gradient
            drag = self.diffusion * laplacian
            self.ga[i, k] = push + drag
        for i, k in ti.ndrange(self.inside, self.inside):
            self.gv[i, k] += self.ga[i, k]
        for k in range(self.first, self.high_ghost):
            left, inside_left, right, inside_right = self.ends_of_row(k)
            self.mirror_velocity(left, inside_left, 0.0)
            self.mirror_velocity(right, inside_right, 0.0)
        for i in range(self.low_ghost, self.high_ghost + 1):
            bottom, inside_bottom, top, inside_top = self.ends_of_column(i)
            self.mirror_velocity(bottom, inside_bottom, 0.0)
            self.mirror_velocity(top, inside_top, self.lid_at(i))

        for p in self.x:
            self.gather(p)

    @ti.func
    def lid_at(self, i):
        """Return the lid speed that the ghost fill sees: halved in the last cells, 0 in
        the corners.
        """
        speed = self.lid_speed
        if i == self.first or i == self.last:
            speed = 0.5 * self.lid_speed
        if i == self.low_ghost or i == self.high_ghost:
            speed = 0.0
        return speed

    @ti.func
    def mirror(self, ghost, inner, moved):
        """Fill a ghost node's density, J and velocity."""
        twice_wall_velocity = ti.Vector([2.0 * moved, 0.0])
        self.m[ghost] = self.m[inner]
        self.q[ghost] = self.q[inner]
        self.gv[ghost] = twice_wall_velocity - self.gv[inner]

    @ti.func
    def mirror_velocity(self, ghost, inner, moved):
        """Fill a ghost node's velocity and acceleration."""
        twice_wall_velocity = ti.Vector([2.0 * moved, 0.0])
        self.gv[ghost] = twice_wall_velocity - self.gv[inner]
        self.ga[ghost] = -self.ga[inner]

    @ti.func
    def gather(self, p):
        """G2P of one particle and its motion."""
        base, f, w = self.weights(self.x[p])
        v = ti.Vector([0.0, 0.0])
        a = ti.Vector([0.0, 0.0])
        thinner = ti.Vector([0.0, 0.0])
        c = ti.Matrix.zero(ti.f32, 2, 2)
        density = 0.0
        smooth = 0.0
        for i, k in ti.static(ti.ndrange(3, 3)):
            offset = ti.Vector([i, k])
            node = base + offset
            apart = offset - f
            weight = w[i][0] * w[k][1]
            carried = weight * self.gv[node]
            node_density = weight * self.m[node]
            v += carried
            a += weight * self.ga[node]
            c += carried.outer_product(apart)
            density += node_density
            thinner += node_density * apart
            smooth += weight * self.q[node]
        c *= 4.0 * self.p.grid
        density = ti.max(density, 0.5)

        position = self.move(p, v, a, c, density, thinner, smooth)
        self.x[p] = ti.math.clamp(position, self.inset, 1.0 - self.inset)


def main() -> int:
    """Run the cavity at Reynolds number 100 and print its speed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--grid", type=int, default=40)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--substeps", type=int, default=2000)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    ti.init(
        arch=ti.cpu,
        cpu_max_num_threads=options.threads,
        offline_cache=True,
        log_level=ti.ERROR,
    )
    experiment = plan(
        Case.CAVITY,
        reynolds=100.0,
        grid=options.grid,
        substeps=options.substeps,
    )
    parameters = solver_parameters(experiment)
    state = initial_state(experiment)
    box = ConventionalSquare(parameters, state)
    box.substep()
    ti.sync()
    wall_times = []  # [s]
    processor_times = []  # [s]
    for _ in range(options.repeats):
        wall_start = time.perf_counter()
        processor_start = time.process_time()
        for _ in range(options.substeps):
            box.substep()
        ti.sync()
        wall_times.append(time.perf_counter() - wall_start)
        processor_times.append(time.process_time() - processor_start)
    particle_substeps = experiment.particles * options.substeps
    velocity = box.v.to_numpy()
    square_speed = np.sum(velocity**2, axis=-1)
    speed = {
        "per_core": particle_substeps / min(wall_times) / options.threads,
        "per_processor_second": particle_substeps / min(processor_times),
        "energy": float(0.5 * np.mean(square_speed)),
    }
    print(json.dumps(speed))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
