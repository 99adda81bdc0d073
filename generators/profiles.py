"""Centre-line profiles of a lid-driven cavity: from nodal velocities to Ghia's points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from . import ghia
from .diagnostics import Box

__all__ = ["Profiles", "draw", "extract"]

Array = NDArray[np.float64]

_DRAWN_POINTS = 201


@dataclass(frozen=True)
class Profiles:
    """Velocity on the two centre lines, as splines in units of box width and lid speed.

    Attributes:
        u: u/U against height on x = 1/2.
        v: v/U against abscissa on y = 1/2.
    """

    u: CubicSpline
    v: CubicSpline

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
    """Draw u against height and v against abscissa, Ghia's points over them.

    Args:
        profiles: what was computed.
        reference: what is tabulated at this Reynolds number, if anything is.
        title: what the figure shows.
        path: picture to write; its ending chooses the format.
    """
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
