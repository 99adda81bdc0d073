# ruff: noqa: ANN001, ANN201 (Taichi infers the types of its functions)
# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""The closed box in conventional Taichi code: the yardstick of our solver.

The equations are those of ``lagbench.generators.closed_box``. The code is written after
Taichi's own mpm128 example: one kernel launch per substep, every phase a parallel loop,
float32 sums by atomics, Taichi's default fast math. Its sums depend on
the order of threads, so no two runs agree to the bit.

    python benchmarks/conventional.py --grid 40 --threads 1 --substeps 2000

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

from lagbench.data import WALLS
from lagbench.generators.split import ClosedBoxParameters, InitialState
from validation.experiment import (
    Case,
    initial_state,
    plan,
    solver_parameters,
)


@ti.data_oriented
class Conventional:
    """Fields and kernels of one cavity whose top wall moves along x.

    Args:
        parameters: constants of the solver.
        state: where the particles start, viscosity and wall speed.
    """

    def __init__(self, parameters: ClosedBoxParameters, state: InitialState) -> None:
        """Take the memory and load the particles."""
        self.p = parameters
        self.low = parameters.wall
        self.high = parameters.grid - parameters.wall
        self.dx = 1.0 / parameters.grid
        self.lid = float(state.wall_velocity[WALLS.index("top"), 0])
        self.mass = parameters.density * state.area / parameters.particles
        self.pressure = (
            0.5
            * parameters.grid
            * parameters.dt
            * parameters.modulus
            / parameters.density
        )
        self.diffusion = state.viscosity * parameters.dt * parameters.grid**2
        self.inset = (self.low + 0.5 + 1e-3) * self.dx
        n = parameters.particles
        nodes = (parameters.grid + 1, parameters.grid + 1)
        self.x = ti.Vector.field(2, ti.f32, n)
        self.v = ti.Vector.field(2, ti.f32, n)
        self.c = ti.Matrix.field(2, 2, ti.f32, n)
        self.j = ti.field(ti.f32, n)
        self.m = ti.field(ti.f32, nodes)
        self.q = ti.field(ti.f32, nodes)
        self.gv = ti.Vector.field(2, ti.f32, nodes)
        self.ga = ti.Vector.field(2, ti.f32, nodes)
        for target, values in (
            (self.x, state.position),
            (self.v, state.velocity),
            (self.c, state.affine),
        ):
            target.from_numpy(values.astype(np.float32))
        self.j.fill(1.0)

    @ti.func
    def weights(self, x):
        """Return base node, offset in cells and quadratic B-spline weights."""
        base = ti.cast(x * self.p.grid - 0.5, ti.i32)
        f = x * self.p.grid - ti.cast(base, ti.f32)
        return (
            base,
            f,
            [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2],
        )

    @ti.func
    def fold(self, inner, ghost, flip, moved):
        """Add the mirror image of a ghost node to its interior node."""
        self.m[inner] += self.m[ghost]
        self.q[inner] += self.q[ghost]
        self.gv[inner] += flip * self.gv[ghost] + ti.Vector(
            [2.0 * moved * self.m[ghost], 0.0]
        )

    @ti.kernel
    def substep(self):
        """Advance by dt; every loop at the top level runs in parallel."""
        for i, k in self.m:
            self.gv[i, k] = ti.Vector([0.0, 0.0])
            self.m[i, k] = 0.0
            self.q[i, k] = 0.0
        for p in self.x:
            base, f, w = self.weights(self.x[p])
            affine = self.c[p] * self.dx
            for i, k in ti.static(ti.ndrange(3, 3)):
                offset = ti.Vector([i, k])
                weight = self.mass * w[i][0] * w[k][1]
                self.gv[base + offset] += weight * (self.v[p] + affine @ (offset - f))
                self.m[base + offset] += weight
                self.q[base + offset] += weight * self.j[p]
        flip = ti.Vector([-1.0, -1.0])
        for k in range(self.low, self.high + 1):
            self.fold(ti.Vector([self.low + 1, k]), ti.Vector([self.low, k]), flip, 0.0)
            self.fold(
                ti.Vector([self.high - 1, k]), ti.Vector([self.high, k]), flip, 0.0
            )
        for i in range(self.low + 1, self.high):
            self.fold(ti.Vector([i, self.low + 1]), ti.Vector([i, self.low]), flip, 0.0)
            self.fold(
                ti.Vector([i, self.high - 1]), ti.Vector([i, self.high]), flip, self.lid
            )
        for i, k in ti.ndrange((self.low + 1, self.high), (self.low + 1, self.high)):
            mass = self.m[i, k]
            if mass > 0.0:
                self.gv[i, k] /= mass
                self.q[i, k] /= mass
                self.m[i, k] = mass / (self.p.density * self.dx * self.dx)
            else:
                self.q[i, k] = 1.0
        for k in range(self.low + 1, self.high):
            self.mirror(ti.Vector([self.low, k]), ti.Vector([self.low + 1, k]), 0.0)
            self.mirror(ti.Vector([self.high, k]), ti.Vector([self.high - 1, k]), 0.0)
        for i in range(self.low, self.high + 1):
            self.mirror(ti.Vector([i, self.low]), ti.Vector([i, self.low + 1]), 0.0)
            self.mirror(
                ti.Vector([i, self.high]), ti.Vector([i, self.high - 1]), self.lid_at(i)
            )
        for i, k in ti.ndrange((self.low + 1, self.high), (self.low + 1, self.high)):
            q = ti.static(self.q)
            across = q[i + 1, k] - q[i - 1, k]
            along = q[i, k + 1] - q[i, k - 1]
            rising = q[i + 1, k + 1] - q[i - 1, k - 1]
            falling = q[i + 1, k - 1] - q[i - 1, k + 1]
            gradient = ti.Vector(
                [
                    0.75 * across + 0.125 * (rising + falling),
                    0.75 * along + 0.125 * (rising - falling),
                ]
            )
            v = ti.static(self.gv)
            laplacian = (
                v[i + 1, k] + v[i - 1, k] + v[i, k + 1] + v[i, k - 1] - 4.0 * v[i, k]
            )
            self.ga[i, k] = self.pressure * gradient + self.diffusion * laplacian
        for i, k in ti.ndrange((self.low + 1, self.high), (self.low + 1, self.high)):
            self.gv[i, k] += self.ga[i, k]
        for k in range(self.low + 1, self.high):
            self.mirror_velocity(
                ti.Vector([self.low, k]), ti.Vector([self.low + 1, k]), 0.0
            )
            self.mirror_velocity(
                ti.Vector([self.high, k]), ti.Vector([self.high - 1, k]), 0.0
            )
        for i in range(self.low, self.high + 1):
            self.mirror_velocity(
                ti.Vector([i, self.low]), ti.Vector([i, self.low + 1]), 0.0
            )
            self.mirror_velocity(
                ti.Vector([i, self.high]), ti.Vector([i, self.high - 1]), self.lid_at(i)
            )
        for p in self.x:
            self.gather(p)

    @ti.func
    def lid_at(self, i):
        """Return the lid speed that the ghost fill sees: halved in the last cells, 0 in
        the corners.
        """
        speed = self.lid
        if i == self.low + 1 or i == self.high - 1:
            speed = 0.5 * self.lid
        if i == self.low or i == self.high:
            speed = 0.0
        return speed

    @ti.func
    def mirror(self, ghost, inner, moved):
        """Fill a ghost node's density, J and velocity."""
        self.m[ghost] = self.m[inner]
        self.q[ghost] = self.q[inner]
        self.gv[ghost] = ti.Vector([2.0 * moved, 0.0]) - self.gv[inner]

    @ti.func
    def mirror_velocity(self, ghost, inner, moved):
        """Fill a ghost node's velocity and acceleration."""
        self.gv[ghost] = ti.Vector([2.0 * moved, 0.0]) - self.gv[inner]
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
            apart = offset - f
            weight = w[i][0] * w[k][1]
            carried = weight * self.gv[base + offset]
            v += carried
            a += weight * self.ga[base + offset]
            c += carried.outer_product(apart)
            density += weight * self.m[base + offset]
            thinner += weight * self.m[base + offset] * apart
            smooth += weight * self.q[base + offset]
        c *= 4.0 * self.p.grid
        density = ti.max(density, 0.5)
        limit = 0.1 * self.dx
        shift = ti.math.clamp(
            -4.0 * self.p.shift * self.dx * thinner / density, -limit, limit
        )
        moved = self.v[p] + a
        self.v[p] = moved + self.p.velocity_relaxation * (v - moved) + c @ shift
        self.x[p] = ti.math.clamp(
            self.x[p] + self.p.dt * v + shift, self.inset, 1.0 - self.inset
        )
        self.c[p] = c
        old = self.j[p]
        self.j[p] = (
            old * (1.0 + self.p.dt * c.trace())
            + self.p.jacobian_relaxation * (smooth - old)
            + self.p.density_coupling * (1.0 / density - smooth)
        )


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
        Case.CAVITY, reynolds=100.0, grid=options.grid, substeps=options.substeps
    )
    box = Conventional(solver_parameters(experiment), initial_state(experiment))
    box.substep()
    ti.sync()
    wall = []
    processor = []
    for _ in range(options.repeats):
        start = time.perf_counter(), time.process_time()
        for _ in range(options.substeps):
            box.substep()
        ti.sync()
        wall.append(time.perf_counter() - start[0])
        processor.append(time.process_time() - start[1])
    work = experiment.particles * options.substeps
    speed = {
        "per_core": work / min(wall) / options.threads,
        "per_processor_second": work / min(processor),
        "energy": float(0.5 * np.mean(np.sum(box.v.to_numpy() ** 2, axis=-1))),
    }
    print(json.dumps(speed))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
