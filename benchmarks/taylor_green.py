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
"""Particles along a side; each has twice the particles of the one before."""

WAVE = 2.0 * math.pi


def velocity(x: Floats) -> Floats:
    """Return the flow at positions, shape [particle, 2]."""
    s = WAVE * x
    return np.stack(
        [np.sin(s[:, 0]) * np.cos(s[:, 1]), -np.cos(s[:, 0]) * np.sin(s[:, 1])], axis=1
    )


def particles(side: int, jitter: float, rng: np.random.Generator) -> Floats:
    """Return a lattice moved by ``jitter`` spacings at the most, or random points for
    NaN.
    """
    if math.isnan(jitter):
        return rng.random((side * side, 2))
    axis = (np.arange(side) + 0.5) / side
    lattice = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    return lattice + (rng.random(lattice.shape) - 0.5) * jitter / side


def error(x: Floats, grid: Grid) -> float:
    """Return the RMS error of the vorticity over that of the exact one [1]."""
    found = fields(x, velocity(x), grid, full=grid.full_weight(len(x), 1.0))
    nodes = found.differentiable
    a, b = np.meshgrid(WAVE * grid.axis, WAVE * grid.axis, indexing="ij")
    exact = 2.0 * WAVE * np.sin(a) * np.sin(b)
    return float(
        np.sqrt(
            np.mean((found.vorticity - exact)[nodes] ** 2) / np.mean(exact[nodes] ** 2)
        )
    )


def main() -> int:
    """Print one line per particle count."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--cells", type=int, default=40)
    grid = Grid(parser.parse_args().cells)
    kinds = {"random": math.nan, "jitter 0.25": 0.25, "lattice": 0.0}
    print(
        f"relative RMS error of the vorticity, {grid.cells}x{grid.cells} nodes at "
        f"cell centres"
    )
    print(
        f"{'particles':>10s}{'per cell':>10s}"
        + "".join(f"{kind:>14s}" for kind in kinds)
    )
    for side in SIDES:
        rng = np.random.Generator(np.random.PCG64(0))
        cells = "".join(
            f"{error(particles(side, jitter, rng), grid):14.4f}"
            for jitter in kinds.values()
        )
        print(f"{side * side:10d}{side * side / grid.cells**2:10.2f}{cells}")
    rng = np.random.Generator(np.random.PCG64(0))
    print(
        f"grid alone (4 million particles on a lattice): "
        f"{error(particles(2000, 0.0, rng), grid):.4f}"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
