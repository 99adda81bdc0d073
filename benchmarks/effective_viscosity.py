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
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid

from lagbench.data.grid import fields
from lagbench.data.registry import Size, load
from lagbench.data.scenario import read_scenario


class ViscosityFit(NamedTuple):
    """The viscosity of one scenario, fitted to its loss of energy."""

    frequency: int
    viscosity: float  # [length^2/s]
    energy_share: float  # of the initial energy that is left at the end


def main() -> int:
    """Print one line per size and frequency, and one over all of a size."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--size", nargs="+", default=["mini", "full"])
    parser.add_argument("--subset", default="test")
    options = parser.parse_args()
    for name in options.size:
        size = load().size("curl-noise", name)
        fits = []
        for scenario in size.subsets[options.subset]:
            fit = _fit(size, options.root, scenario)
            fits.append(fit)
        _print_fits(name, fits)
    return 0


def _print_fits(name: str, fits: Sequence[ViscosityFit]) -> None:
    # viscosities and shares of energy by frequency
    viscosities: dict[int, list[float]] = defaultdict(list)
    energy_shares: dict[int, list[float]] = defaultdict(list)
    for fit in fits:
        viscosities[fit.frequency].append(fit.viscosity)
        energy_shares[fit.frequency].append(fit.energy_share)
    for frequency in sorted(viscosities):
        viscosity = np.mean(viscosities[frequency])
        energy_share = np.mean(energy_shares[frequency])
        print(
            f"{name}, frequency {frequency}: nu = {viscosity:.2e} length^2/s, "
            f"{energy_share:.0%} of E left"
        )
    all_viscosities = [fit.viscosity for fit in fits]
    all_shares = [fit.energy_share for fit in fits]
    viscosity = np.median(all_viscosities)
    energy_share = np.median(all_shares)
    print(f"{name}: median nu = {viscosity:.2e} length^2/s, {energy_share:.0%} left")


def _fit(size: Size, root: Path, scenario: int) -> ViscosityFit:
    """Fit dE/dt = - nu * enstrophy to the energy E of a scenario."""
    task = size.task
    grid = size.field_grid
    (low, high), _ = size.bounds
    area = (high - low) ** 2
    full_weight = grid.full_weight(size.particles, area)
    frame_count = task.input_frames + task.horizon
    energies = []
    enstrophies = []
    path = size.path(root, scenario)
    with read_scenario(path) as file:
        for frame in range(frame_count):
            stored_position = file.read("position", frame)
            stored_velocity = file.read("velocity", frame)
            position = stored_position.astype(np.float64)
            velocity = stored_velocity.astype(np.float64)
            squared_speed = np.sum(velocity**2, axis=-1)
            energy = 0.5 * float(np.mean(squared_speed))
            energies.append(energy)
            node_fields = fields(position, velocity, grid, full=full_weight)
            enstrophy = float(np.nanmean(node_fields.vorticity**2))
            enstrophies.append(enstrophy)
        parameters = file.header.parameters

    # integral of the enstrophy up to each frame, and the energy lost up to it
    interval = size.frame_interval
    dissipation = cumulative_trapezoid(enstrophies, dx=interval, initial=0)
    initial_energy = energies[0]
    energy_loss = initial_energy - np.array(energies)
    product = dissipation @ energy_loss
    square = dissipation @ dissipation
    viscosity = float(product / square)
    energy_share = energies[-1] / initial_energy
    frequency = int(str(parameters["frequency"]))
    return ViscosityFit(frequency, viscosity, energy_share)


if __name__ == "__main__":
    raise SystemExit(main())
