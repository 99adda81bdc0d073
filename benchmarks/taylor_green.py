"""Print how the grid vorticity of Taylor-Green converges with the particle count.

Particles lie at random, on a jittered lattice or on a lattice; the grid is that of
cavity full. The flow u = (sin kx cos ky, -cos kx sin ky) with k = 2 pi has vorticity 2
k sin kx sin ky. The error stops falling where that of the spline and the central
difference, of second order in the grid spacing, takes over: the last line shows it
alone, with very many particles.

    python benchmarks/taylor_green.py [--cells 40]
"""

from __future__ import annotations

import argparse
import math

import numpy as np
from numpy.typing import NDArray

from lagbench.data.grid import Grid, fields

Floats = NDArray[np.float64]

SIDES = (20, 32, 45, 64, 91, 128, 181, 256)
"""Particles along a side. From the second on, each square has nearly twice as many
particles as the one before.
"""

WAVE = 2.0 * math.pi


JITTERS = {"random": math.nan, "jitter 0.25": 0.25, "lattice": 0.0}
"""Width of the jitter of each kind of positions, in spacings; NaN for random ones."""

FINE_SIDE = 2000  # particles along a side where only the error of the grid is left


def velocity(position: Floats) -> Floats:
    """Return the velocity of the Taylor-Green flow at positions, [particle, 2]."""
    phase_x = WAVE * position[:, 0]
    phase_y = WAVE * position[:, 1]
    velocity_x = np.sin(phase_x) * np.cos(phase_y)
    velocity_y = -np.cos(phase_x) * np.sin(phase_y)
    return np.stack([velocity_x, velocity_y], axis=1)


def sample_positions(side: int, jitter: float) -> Floats:
    """Return particles in the unit square, shape [particle, 2].

    They are the points of a lattice, each moved at random by up to half of ``jitter``
    spacings along each axis. Where ``jitter`` is NaN they are uniform random points.
    """
    rng = np.random.Generator(np.random.PCG64(0))
    if math.isnan(jitter):
        return rng.random((side * side, 2))
    axis = (np.arange(side) + 0.5) / side
    coordinates = np.meshgrid(axis, axis, indexing="ij")
    lattice = np.stack(coordinates, axis=-1)
    lattice = lattice.reshape(-1, 2)
    draws = rng.random(lattice.shape)
    offset = (draws - 0.5) * jitter / side
    return lattice + offset


def relative_error(position: Floats, grid: Grid) -> float:
    """Return the RMS error of the vorticity over the RMS of the exact one [1]."""
    full_weight = grid.full_weight(len(position), 1.0)
    flow = velocity(position)
    node_fields = fields(position, flow, grid, full=full_weight)
    phase = WAVE * grid.axis
    phase_x, phase_y = np.meshgrid(phase, phase, indexing="ij")
    amplitude = 2.0 * WAVE
    all_exact = amplitude * np.sin(phase_x) * np.sin(phase_y)

    nodes = node_fields.differentiable
    exact = all_exact[nodes]
    error = node_fields.vorticity[nodes] - exact
    squared_error = np.mean(error**2)
    exact_square = np.mean(exact**2)
    return float(np.sqrt(squared_error / exact_square))


def main() -> int:
    """Print one line per particle count."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--cells", type=int, default=40)
    options = parser.parse_args()
    grid = Grid(options.cells)
    print(
        f"relative RMS error of the vorticity, {grid.cells}x{grid.cells} nodes at "
        "cell centres"
    )
    heads = ""
    for kind in JITTERS:
        heads += f"{kind:>14s}"
    print(f"{'particles':>10s}{'per cell':>10s}{heads}")
    cell_count = grid.cells**2
    for side in SIDES:
        particle_count = side * side
        particles_per_cell = particle_count / cell_count
        line = f"{particle_count:10d}{particles_per_cell:10.2f}"
        for jitter in JITTERS.values():
            position = sample_positions(side, jitter)
            error = relative_error(position, grid)
            line += f"{error:14.4f}"
        print(line)
    fine_lattice = sample_positions(FINE_SIDE, 0.0)
    error = relative_error(fine_lattice, grid)
    print(f"grid alone ({len(fine_lattice):,} particles on a lattice): {error:.4f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
