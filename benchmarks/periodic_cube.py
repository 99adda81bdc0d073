# ruff: noqa: ANN001, ANN201 (Taichi infers the types of its functions)
# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""Our solver and conventional Taichi code on a periodic cube, alternately in one run.

    PYTHONPATH=. python benchmarks/periodic_cube.py --grid 16 --substeps 200 --rounds 3

The conventional side has the equations of ``generators/nodal_stress_nd.py``, written
after Taichi's own mpm88 example: one launch per substep, every phase a parallel loop,
float32 sums by atomics, Taichi's default fast math. Both sides hold four particles in a
cell and run on one core, each in a process of its own. Prints particle-substeps per
second of processor time (best of the rounds), their ratio, and the kinetic energy at
the end of both, by which the formulations are compared. Exits with 1 where the ratio is
below 3.
"""

from __future__ import annotations

import os

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")

import argparse
import json
import subprocess
import sys
import time

import numpy as np
import taichi as ti
from conventional_fluid import ConventionalFluid

from lagbench.data.box import Box
from lagbench.generators import curl_noise_3d
from lagbench.generators.draws import generator
from lagbench.generators.full_box_parameters import FullBoxParameters
from lagbench.generators.periodic_noise import scaled_to
from lagbench.generators.solver import build
from lagbench.generators.split import InitialState
from validation.flows import constants, lattice

LEAST_RATIO = 3.0


@ti.data_oriented
class ConventionalCube(ConventionalFluid):
    """Fields and kernels of a periodic cube."""

    def __init__(self, parameters: FullBoxParameters, state: InitialState) -> None:
        """Take the memory and load the particles."""
        self.n = parameters.grid
        super().__init__(
            parameters,
            state,
            nodes=(self.n, self.n, self.n),
            mass=1.0 / parameters.particles,
        )

    @ti.func
    def weights(self, x):
        """Return base node, offset in cells and quadratic B-spline weights."""
        scaled = x * self.n - 0.5
        base = ti.cast(ti.floor(scaled - 0.5), ti.i32)
        f = scaled - ti.cast(base, ti.f32)
        return (base, f, self.spline(f))

    @ti.func
    def wrapped(self, node):
        """Return the node of the cube that a node stands for."""
        return (node + self.n) % self.n

    @ti.kernel
    def substep(self):
        """Advance by dt; every loop at the top level runs in parallel."""
        for node in ti.grouped(self.m):
            self.gv[node] = ti.Vector([0.0, 0.0, 0.0])
            self.m[node] = 0.0
            self.q[node] = 0.0
        # P2G: mass, momentum and J of the particles at the nodes.
        for p in self.x:
            base, f, w = self.weights(self.x[p])
            affine = self.c[p] * self.dx
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                offset = ti.Vector([i, j, k])
                node = self.wrapped(base + offset)
                weight = self.mass * w[i][0] * w[j][1] * w[k][2]
                velocity = self.v[p] + affine @ (offset - f)
                self.gv[node] += weight * velocity
                self.m[node] += weight
                self.q[node] += weight * self.j[p]

        # Momentum becomes velocity, mass density.
        for node in ti.grouped(self.m):
            mass = self.m[node]
            if mass > 0.0:
                self.gv[node] /= mass
                self.q[node] /= mass
                self.m[node] = mass / self.dx**3
            else:
                self.q[node] = 1.0

        # Pressure and viscosity accelerate the nodes.
        for node in ti.grouped(self.m):
            gradient = ti.Vector([0.0, 0.0, 0.0])
            laplacian = -6.0 * self.gv[node]
            for i, j, k in ti.static(ti.ndrange((-1, 2), (-1, 2), (-1, 2))):
                offset = ti.Vector([i, j, k])
                neighbour = self.wrapped(node + offset)
                q = self.q[neighbour]
                near = ti.static([0.125, 0.75, 0.125])
                near_x = ti.static(near[i + 1])
                near_y = ti.static(near[j + 1])
                near_z = ti.static(near[k + 1])
                if ti.static(i != 0):
                    gradient[0] += i * near_y * near_z * q
                if ti.static(j != 0):
                    gradient[1] += j * near_x * near_z * q
                if ti.static(k != 0):
                    gradient[2] += k * near_x * near_y * q
                if ti.static(abs(i) + abs(j) + abs(k) == 1):
                    laplacian += self.gv[neighbour]
            push = self.pressure * gradient
            drag = self.diffusion * laplacian
            self.ga[node] = push + drag
        for node in ti.grouped(self.m):
            self.gv[node] += self.ga[node]
        for p in self.x:
            self.gather(p)

    @ti.func
    def gather(self, p):
        """G2P of one particle and its motion."""
        base, f, w = self.weights(self.x[p])
        v = ti.Vector([0.0, 0.0, 0.0])
        a = ti.Vector([0.0, 0.0, 0.0])
        thinner = ti.Vector([0.0, 0.0, 0.0])
        c = ti.Matrix.zero(ti.f32, 3, 3)
        density = 0.0
        smooth = 0.0
        for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
            offset = ti.Vector([i, j, k])
            apart = offset - f
            node = self.wrapped(base + offset)
            weight = w[i][0] * w[j][1] * w[k][2]
            carried = weight * self.gv[node]
            node_density = weight * self.m[node]
            v += carried
            a += weight * self.ga[node]
            c += carried.outer_product(apart)
            density += node_density
            thinner += node_density * apart
            smooth += weight * self.q[node]
        c *= 4.0 * self.n
        density = ti.max(density, 0.5)

        x = self.move(p, v, a, c, density, thinner, smooth)
        self.x[p] = x - ti.floor(x)


def start(grid: int):
    """Return constants and state: curl noise in a cube, four particles in a cell."""
    bounds = [(0.0, 1.0)] * 3
    box = Box.from_bounds(bounds, [True] * 3)
    position = lattice(box, (2 * grid, 2 * grid, grid))
    count = len(position)
    rng = generator("periodic-cube", "benchmark", 1, 0)
    flow = curl_noise_3d.draw_noise(rng, position, 2)
    flow = scaled_to(flow, 0.15)
    state = InitialState(
        position=position,
        velocity=flow.velocity,
        affine=flow.affine,
        material=np.zeros(count, np.int8),
        area=1.0,
        viscosity=5e-4,
        wall_velocity=np.zeros((6, 3)),
    )
    parameters = constants(box, grid, count)
    return parameters, state


def run_side(side: str, grid: int, substeps: int) -> dict[str, float]:
    """Return the rate of one side and its kinetic energy per mass at the end."""
    parameters, state = start(grid)
    if side == "ours":
        solver = build(parameters)
        solver.load([state])
        solver.advance(1)
        start_time = time.process_time()
        solver.advance(substeps)
        seconds = time.process_time() - start_time
        (velocity,) = solver.velocity()
    else:
        ti.init(
            arch=ti.cpu,
            cpu_max_num_threads=1,
            offline_cache=True,
            log_level=ti.ERROR,
        )
        cube = ConventionalCube(parameters, state)
        cube.substep()
        ti.sync()
        start_time = time.process_time()
        for _ in range(substeps):
            cube.substep()
        ti.sync()
        seconds = time.process_time() - start_time
        velocity = cube.v.to_numpy()
    exact_velocity = velocity.astype(np.float64)
    square_speed = np.sum(exact_velocity**2, axis=1)
    energy = 0.5 * float(np.mean(square_speed))
    rate = parameters.particles * substeps / seconds
    return {"rate": rate, "energy": energy}


def main() -> int:
    """Run both sides alternately and print their rates."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--grid", type=int, default=16)
    parser.add_argument("--substeps", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--side", choices=["ours", "conventional"])
    options = parser.parse_args()
    if options.side:
        result = run_side(options.side, options.grid, options.substeps)
        print(json.dumps(result))
        return 0

    best = {"ours": 0.0, "conventional": 0.0}
    energies = {}
    for _ in range(options.rounds):
        for side in best:
            command = [
                sys.executable,
                __file__,
                f"--side={side}",
                f"--grid={options.grid}",
                f"--substeps={options.substeps}",
            ]
            output = subprocess.run(command, check=True, capture_output=True, text=True)
            last_line = output.stdout.splitlines()[-1]
            result = json.loads(last_line)
            best[side] = max(best[side], result["rate"])
            energies[side] = result["energy"]
    ratio = best["ours"] / best["conventional"]
    for side, rate in best.items():
        millions = rate / 1e6
        print(f"{side}: {millions:.2f} M, energy {energies[side]:.6g}")
    print(f"ratio {ratio:.2f}")
    return int(ratio < LEAST_RATIO)


if __name__ == "__main__":
    raise SystemExit(main())
