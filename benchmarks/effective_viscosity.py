"""Print the viscosity that the decay of curl noise amounts to, per size and frequency.

    python benchmarks/effective_viscosity.py --root FOLDER [--size mini full] [--subset
    test]

In a free-slip box -dE/dt = nu Z with E = mean(u^2) / 2 and Z = mean(omega^2). nu is the
slope of E(0) - E(f) on the integral of Z over the frames given and predicted, by least
squares through the origin; Z is that of the score grid. Beside it stands the energy
that is left after those frames.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np
from scipy.integrate import cumulative_trapezoid

from lagbench.data.grid import Grid, fields
from lagbench.data.registry import Size, load
from lagbench.data.scenario import read_scenario


def main() -> int:
    """Print one line per size and frequency, and one over all of a size."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--size", nargs="+", default=["mini", "full"])
    parser.add_argument("--subset", default="test")
    given = parser.parse_args()
    for name in given.size:
        size = load().size("curl-noise", name)
        found = defaultdict(list)
        for scenario in size.subsets[given.subset]:
            frequency, *fit = _fit(size, given.root, scenario)
            found[frequency].append(fit)
        for frequency, fits in sorted(found.items()):
            viscosity, left = np.mean(fits, axis=0)
            print(
                f"{name}, frequency {frequency}: nu = {viscosity:.2e} length^2/s, "
                f"{left:.0%} of E left"
            )
        every = np.array([fit for fits in found.values() for fit in fits])
        print(
            f"{name}: median nu = {np.median(every[:, 0]):.2e} length^2/s, "
            f"{np.median(every[:, 1]):.0%} left"
        )
    return 0


def _fit(size: Size, root: Path, scenario: int) -> tuple[int, float, float]:
    """Return frequency, viscosity [length^2/s] and the share of energy left."""
    grid = Grid(size.task.score_grid.cells, size.task.score_grid.placement)
    (low, high), _ = size.bounds
    full = grid.full_weight(size.particles, (high - low) ** 2)
    energy = []
    enstrophy = []
    with read_scenario(size.path(root, scenario)) as file:
        for frame in range(size.task.input_frames + size.task.horizon):
            position = file.read("position", frame).astype(np.float64)
            velocity = file.read("velocity", frame).astype(np.float64)
            energy.append(0.5 * np.mean(np.sum(velocity**2, axis=-1)))
            enstrophy.append(
                np.nanmean(fields(position, velocity, grid, full=full).vorticity ** 2)
            )
        frequency = int(file.header.parameters["frequency"])
    spent = cumulative_trapezoid(enstrophy, dx=size.frame_interval, initial=0.0)
    lost = energy[0] - np.array(energy)
    return frequency, float(spent @ lost / (spent @ spent)), energy[-1] / energy[0]


if __name__ == "__main__":
    raise SystemExit(main())
