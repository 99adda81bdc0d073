"""Quantities that tell whether a closed box simulates well: J, occupancy, energy, divergence.

NumPy only; every function takes arrays, none a solver.

Centre-line profiles of a lid-driven cavity: from nodal velocities to Ghia's points.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from lagbench.generators.split import ClosedBoxParameters

from . import ghia

__all__ = [
    "Box",
    "Rates",
    "box_of",
    "displacement_energy",
    "grid_rates",
    "kinetic_energy",
    "lid_corners",
    "occupancy",
    "Profiles",
    "draw",
    "extract",
]


CORNER_CELLS = 5
"""Extent of the regions under the two ends of the lid, where J is far from 1 [cells]."""

Reals = NDArray[np.floating]


@dataclass(frozen=True, kw_only=True)
class Box:
    """A square box whose walls lie half-way between nodes."""

    low: float  # coordinate of the left and bottom walls [length]
    high: float  # coordinate of the right and top walls [length]
    cells: int  # whole cells between two walls; each is centred at a node

    @property
    def width(self) -> float:
        """Distance L between opposite walls [length]."""
        return self.high - self.low

    @property
    def spacing(self) -> float:
        """Width dx of a cell [length]."""
        return self.width / self.cells

    @property
    def nodes(self) -> NDArray[np.float64]:
        """Coordinates of the nodes between two walls [length], shape [cells]."""
        return np.asarray(self.low + self.spacing * (np.arange(self.cells) + 0.5), dtype=np.float64)


def box_of(parameters: ClosedBoxParameters) -> Box:
    """Return the box that the parameters describe."""
    low = (parameters.wall + 0.5) / parameters.grid
    return Box(low=low, high=1.0 - low, cells=parameters.grid - 2 * parameters.wall - 1)


def occupancy(position: Reals, box: Box) -> NDArray[np.int64]:
    """Count the particles in each cell.

    Args:
        position: particle positions [length], shape [particle, 2].
        box: where they are; one outside its walls counts for the nearest cell.

    Returns:
        Counts, shape [cells, cells]; their sum is the number of particles.
    """
    cell = np.floor((position - box.low) / box.spacing).astype(np.int64)
    column, row = np.clip(cell, 0, box.cells - 1).T
    counts = np.bincount(column * box.cells + row, minlength=box.cells**2)
    return counts.reshape(box.cells, box.cells)


def lid_corners(position: Reals, box: Box) -> NDArray[np.bool_]:
    """Tell which particles lie in the 5 x 5 cells at either end of the top wall."""
    extent = CORNER_CELLS * box.spacing
    x, y = position[:, 0], position[:, 1]
    return (y > box.high - extent) & ((x < box.low + extent) | (x > box.high - extent))


def kinetic_energy(velocity: Reals, mass: float) -> float:
    """Return E = sum m abs(v)^2 / 2 [mass length^2/s^2] (thesis Eq. 5.11)."""
    return 0.5 * mass * float(np.sum(np.square(velocity, dtype=np.float64)))


def displacement_energy(after: Reals, before: Reals, mass: float) -> float:
    """Return the kinetic energy of x(f) - x(f-1), taking the frame as the unit of time."""
    return kinetic_energy(after.astype(np.float64) - before.astype(np.float64), mass)


@dataclass(frozen=True)
class Rates:
    """Velocity gradients of a flow."""

    divergence: float  # RMS of u_x + v_y [1/s]
    vorticity: float  # RMS of v_x - u_y [1/s]

    @property
    def ratio(self) -> float:
        """Divergence over vorticity [1]; 0 for incompressible flow, NaN for a fluid at rest."""
        return self.divergence / self.vorticity if self.vorticity > 0.0 else float("nan")


def grid_rates(velocity: Reals, spacing: float) -> Rates:
    """Return RMS divergence and vorticity by central differences.

    Args:
        velocity: nodal velocity [length/s], shape [column, row, 2].
        spacing: distance of nodes [length].
    """
    field = velocity.astype(np.float64)
    along_x = (field[2:, 1:-1] - field[:-2, 1:-1]) / (2.0 * spacing)
    along_y = (field[1:-1, 2:] - field[1:-1, :-2]) / (2.0 * spacing)
    divergence = along_x[..., 0] + along_y[..., 1]
    vorticity = along_x[..., 1] - along_y[..., 0]
    return Rates(
        divergence=float(np.sqrt(np.mean(divergence**2))), vorticity=float(np.sqrt(np.mean(vorticity**2)))
    )


Array = NDArray[np.float64]

_DRAWN_POINTS = 201


@dataclass(frozen=True)
class Profiles:
    """Velocity on the two centre lines, as splines in units of box width and lid speed."""

    u: CubicSpline  # u/U against height on x = 1/2
    v: CubicSpline  # v/U against abscissa on y = 1/2

    def at_reference_points(self) -> ghia.CentreLines:
        """Return both profiles where Ghia, Ghia & Shin tabulate theirs."""
        return ghia.CentreLines(u=np.asarray(self.u(ghia.Y)), v=np.asarray(self.v(ghia.X)))


def extract(velocity: NDArray[np.floating], box: Box, lid_speed: float) -> Profiles:
    """Return the profiles of a nodal velocity field.

    Cubic splines through the nodes and the walls, where the fluid moves with the wall.

    Args:
        velocity: nodal velocity between the walls [length/s], shape [column, row, 2].
        box: where the nodes are.
        lid_speed: speed U of the top wall [length/s].
    """
    field = velocity.astype(np.float64) / lid_speed
    nodes = (box.nodes - box.low) / box.width
    middle_u = _spline(nodes, field[:, :, 0], 0.0, 0.0)(0.5)
    middle_v = _spline(nodes, field[:, :, 1].T, 0.0, 0.0)(0.5)
    return Profiles(u=_spline(nodes, middle_u, 0.0, 1.0), v=_spline(nodes, middle_v, 0.0, 0.0))


def _spline(nodes: Array, values: Array, at_low: float, at_high: float) -> CubicSpline:
    """Interpolate along the first axis between a wall value at 0 and one at 1."""
    low, high = (np.full((1, *values.shape[1:]), value) for value in (at_low, at_high))
    return CubicSpline(np.concatenate([[0.0], nodes, [1.0]]), np.concatenate([low, values, high]))


def draw(profiles: Profiles, reference: ghia.CentreLines | None, title: str, path: Path) -> None:
    """Draw u against height and v against abscissa, Ghia's points over them."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    line = np.linspace(0.0, 1.0, _DRAWN_POINTS)
    left.plot(profiles.u(line), line, label="lagbench")
    right.plot(line, profiles.v(line), label="lagbench")
    if reference is not None:
        left.plot(reference.u, ghia.Y, "o", mfc="none", label="Ghia, Ghia & Shin 1982")
        right.plot(ghia.X, reference.v, "o", mfc="none", label="Ghia, Ghia & Shin 1982")
    left.set(xlabel="u / U on x = 1/2", ylabel="y / L")
    right.set(xlabel="x / L", ylabel="v / U on y = 1/2")
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend()
    figure.suptitle(title)
    figure.savefig(path, dpi=150)
