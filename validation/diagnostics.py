"""Quantities that tell whether a closed box simulates well.

These are J, occupancy, energy, divergence and profiles. NumPy only; every function
takes arrays, none a solver. Centre-line profiles of a
lid-driven cavity are compared with those of Ghia, Ghia & Shin:

U. Ghia, K. N. Ghia, C. T. Shin, J. Comput. Phys. 48 (1982) 387-411, Tables I and II:
u/U on x = 1/2 and v/U on y = 1/2 of the unit cavity, the lid at y = 1 moving to +x with
speed U. The values at the walls (0, and 1 on the lid) are left out: they are boundary
conditions.

Misprints of the paper, NaN here: at Re 400, v(0.9063) = -0.23827 does not lie on a
smooth curve through its neighbours (about -0.38 does); at Re 3200, u(0.4531) = -0.86636
has its decimal point one place too far right.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from lagbench.generators.full_box_parameters import FullBoxParameters

# extent of the regions under the two ends of the lid, where J is far from 1 [cells]
CORNER_CELLS = 5

Reals = NDArray[np.floating]


@dataclass(frozen=True, kw_only=True)
class SquareBox:
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
        middles = np.arange(self.cells) + 0.5
        return np.asarray(self.low + self.spacing * middles, dtype=np.float64)


def box_of(parameters: FullBoxParameters) -> SquareBox:
    """Return the box that the parameters describe."""
    low, high = parameters.box.bounds[0]
    return SquareBox(low=low, high=high, cells=parameters.cells[0])


def occupancy(position: Reals, box: SquareBox) -> NDArray[np.int64]:
    """Return the particles in each cell, shape [cells, cells].

    A particle outside the box counts for the nearest cell.
    """
    cell = np.floor((position - box.low) / box.spacing).astype(np.int64)
    column, row = np.clip(cell, 0, box.cells - 1).T
    counts = np.bincount(column * box.cells + row, minlength=box.cells**2)
    return counts.reshape(box.cells, box.cells)


def lid_corners(position: Reals, box: SquareBox) -> NDArray[np.bool_]:
    """Tell which particles lie in the 5 x 5 cells at either end of the top wall."""
    extent = CORNER_CELLS * box.spacing
    x = position[:, 0]
    y = position[:, 1]
    is_at_top = y > box.high - extent
    is_at_left = x < box.low + extent
    is_at_right = x > box.high - extent
    return is_at_top & (is_at_left | is_at_right)


def kinetic_energy(velocity: Reals, mass: float) -> float:
    """Return E = sum m abs(v)^2 / 2 [mass length^2/s^2] (thesis Eq. 5.11)."""
    return 0.5 * mass * float(np.sum(np.square(velocity, dtype=np.float64)))


def displacement_energy(after: Reals, before: Reals, mass: float) -> float:
    """Return the kinetic energy of x(f) - x(f-1), with the frame as unit of time."""
    displacement = after.astype(np.float64) - before.astype(np.float64)
    return kinetic_energy(displacement, mass)


@dataclass(frozen=True)
class VelocityGradients:
    """How much a flow diverges and turns."""

    divergence: float  # RMS of u_x + v_y [1/s]
    vorticity: float  # RMS of v_x - u_y [1/s]

    @property
    def ratio(self) -> float:
        """Divergence over vorticity [1].

        It is 0 for incompressible flow, NaN for a fluid at rest.
        """
        if self.vorticity > 0.0:
            return self.divergence / self.vorticity
        return float("nan")


def grid_rates(velocity: Reals, spacing: float) -> VelocityGradients:
    """Return RMS divergence and vorticity of a nodal velocity by central differences.

    The velocity has the shape [column, row, 2].
    """
    field = velocity.astype(np.float64)
    along_x = (field[2:, 1:-1] - field[:-2, 1:-1]) / (2.0 * spacing)
    along_y = (field[1:-1, 2:] - field[1:-1, :-2]) / (2.0 * spacing)
    divergence = along_x[..., 0] + along_y[..., 1]
    vorticity = along_x[..., 1] - along_y[..., 0]
    return VelocityGradients(
        divergence=_root_mean_square(divergence),
        vorticity=_root_mean_square(vorticity),
    )


def _root_mean_square(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))


Array = NDArray[np.float64]

_MISPRINT = float("nan")

Y = (
    0.9766, 0.9688, 0.9609, 0.9531, 0.8516, 0.7344, 0.6172, 0.5000,
    0.4531, 0.2813, 0.1719, 0.1016, 0.0703, 0.0625, 0.0547,
)  # fmt: skip
"""Heights of the values of u on x = 1/2 [cavity width]."""

X = (
    0.9688, 0.9609, 0.9531, 0.9453, 0.9063, 0.8594, 0.8047, 0.5000,
    0.2344, 0.2266, 0.1563, 0.0938, 0.0781, 0.0703, 0.0625,
)  # fmt: skip
"""Abscissae of the values of v on y = 1/2 [cavity width]."""

_U = {
    100: (
        0.84123, 0.78871, 0.73722, 0.68717, 0.23151, 0.00332, -0.13641, -0.20581,
        -0.21090, -0.15662, -0.10150, -0.06434, -0.04775, -0.04192, -0.03717,
    ),
    400: (
        0.75837, 0.68439, 0.61756, 0.55892, 0.29093, 0.16256, 0.02135, -0.11477,
        -0.17119, -0.32726, -0.24299, -0.14612, -0.10338, -0.09266, -0.08186,
    ),
    1000: (
        0.65928, 0.57492, 0.51117, 0.46604, 0.33304, 0.18719, 0.05702, -0.06080,
        -0.10648, -0.27805, -0.38289, -0.29730, -0.22220, -0.20196, -0.18109,
    ),
    3200: (
        0.53236, 0.48296, 0.46547, 0.46101, 0.34682, 0.19791, 0.07156, -0.04272,
        _MISPRINT, -0.24427, -0.34323, -0.41933, -0.37827, -0.35344, -0.32407,
    ),
    5000: (
        0.48223, 0.46120, 0.45992, 0.46036, 0.33556, 0.20087, 0.08183, -0.03039,
        -0.07404, -0.22855, -0.33050, -0.40435, -0.43643, -0.42901, -0.41165,
    ),
}  # fmt: skip

_V = {
    100: (
        -0.05906, -0.07391, -0.08864, -0.10313, -0.16914, -0.22445, -0.24533, 0.05454,
        0.17527, 0.17507, 0.16077, 0.12317, 0.10890, 0.10091, 0.09233,
    ),
    400: (
        -0.12146, -0.15663, -0.19254, -0.22847, _MISPRINT, -0.44993, -0.38598, 0.05186,
        0.30174, 0.30203, 0.28124, 0.22965, 0.20920, 0.19713, 0.18360,
    ),
    1000: (
        -0.21388, -0.27669, -0.33714, -0.39188, -0.51550, -0.42665, -0.31966, 0.02526,
        0.32235, 0.33075, 0.37095, 0.32627, 0.30353, 0.29012, 0.27485,
    ),
    3200: (
        -0.39017, -0.47425, -0.52357, -0.54053, -0.44307, -0.37401, -0.31184, 0.00999,
        0.28188, 0.29030, 0.37119, 0.42768, 0.41906, 0.40917, 0.39560,
    ),
    5000: (
        -0.49774, -0.55069, -0.55408, -0.52876, -0.41442, -0.36214, -0.30018, 0.00945,
        0.27280, 0.28066, 0.35368, 0.42951, 0.43648, 0.43329, 0.42447,
    ),
}  # fmt: skip

REYNOLDS = tuple(_U)  # Reynolds numbers U L / nu that are tabulated here


@dataclass(frozen=True)
class CentreLines:
    """Velocities on the two centre lines."""

    # u/U at (1/2, Y) [1], shape [15]; NaN where there is no value
    u: NDArray[np.float64]
    # v/U at (X, 1/2) [1], shape [15]; NaN where there is no value
    v: NDArray[np.float64]


@dataclass(frozen=True)
class Deviation:
    """How far one profile lies from another."""

    rmse: float  # root of the mean squared difference [1]; 0 is perfect
    maximum: float  # largest absolute difference [1]; 0 is perfect


def centre_lines(reynolds: float) -> CentreLines | None:
    """Return the tabulated profiles at a Reynolds number, None where there are none."""
    if reynolds not in _U:
        return None
    return CentreLines(u=np.array(_U[int(reynolds)]), v=np.array(_V[int(reynolds)]))


def deviation(
    measured: NDArray[np.float64], reference: NDArray[np.float64]
) -> Deviation:
    """Compare two profiles at the points where the reference has a value."""
    is_tabulated = ~np.isnan(reference)
    difference = measured[is_tabulated] - reference[is_tabulated]
    return Deviation(
        rmse=float(np.sqrt(np.mean(difference**2))),
        maximum=float(np.max(np.abs(difference))),
    )


@dataclass(frozen=True)
class Profiles:
    """Velocity on the two centre lines, in units of box width and lid speed."""

    u: CubicSpline  # u/U against height on x = 1/2
    v: CubicSpline  # v/U against abscissa on y = 1/2

    def at_reference_points(self) -> CentreLines:
        """Return both profiles where Ghia, Ghia & Shin tabulate theirs."""
        return CentreLines(u=np.asarray(self.u(Y)), v=np.asarray(self.v(X)))


def extract(
    velocity: NDArray[np.floating], box: SquareBox, lid_speed: float
) -> Profiles:
    """Return the profiles of a nodal velocity between the walls.

    The velocity [length/s] has the shape [column, row, 2]. The profiles are cubic
    splines through the nodes and the walls, where the fluid moves with the wall.
    """
    field = velocity.astype(np.float64) / lid_speed
    nodes = (box.nodes - box.low) / box.width
    u = field[:, :, 0]
    v = field[:, :, 1]
    # u of every row on x = 1/2, v of every column on y = 1/2
    u_on_line = _spline(nodes, u, 0.0, 0.0)(0.5)
    v_on_line = _spline(nodes, v.T, 0.0, 0.0)(0.5)
    u_profile = _spline(nodes, u_on_line, 0.0, 1.0)
    v_profile = _spline(nodes, v_on_line, 0.0, 0.0)
    return Profiles(u=u_profile, v=v_profile)


def _spline(nodes: Array, values: Array, at_low: float, at_high: float) -> CubicSpline:
    """Interpolate along the first axis between a wall value at 0 and one at 1."""
    wall_shape = (1, *values.shape[1:])
    low = np.full(wall_shape, at_low)
    high = np.full(wall_shape, at_high)
    abscissae = np.concatenate([[0.0], nodes, [1.0]])
    return CubicSpline(abscissae, np.concatenate([low, values, high]))


def draw_profiles(
    profiles: Profiles, reference: CentreLines | None, title: str, path: Path
) -> None:
    """Draw u against height and v against abscissa, Ghia's points over them."""
    # heavy: loaded only where a picture is asked for
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    line = np.linspace(0.0, 1.0, 201)
    left.plot(profiles.u(line), line, label="lagbench")
    right.plot(line, profiles.v(line), label="lagbench")
    if reference is not None:
        left.plot(reference.u, Y, "o", mfc="none", label="Ghia, Ghia & Shin 1982")
        right.plot(X, reference.v, "o", mfc="none", label="Ghia, Ghia & Shin 1982")
    left.set(xlabel="u / U on x = 1/2", ylabel="y / L")
    right.set(xlabel="x / L", ylabel="v / U on y = 1/2")
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend()
    figure.suptitle(title)
    figure.savefig(path, dpi=150)
