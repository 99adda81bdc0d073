"""Centre-line velocities of the lid-driven cavity after Ghia, Ghia & Shin.

U. Ghia, K. N. Ghia, C. T. Shin, J. Comput. Phys. 48 (1982) 387-411, Tables I and II: u/U on
x = 1/2 and v/U on y = 1/2 of the unit cavity, the lid at y = 1 moving to +x with speed U.
The values at the walls (0, and 1 on the lid) are left out: they are boundary conditions.

Misprints of the paper, NaN here: at Re 400, v(0.9063) = -0.23827 does not lie on a smooth
curve through its neighbours (about -0.38 does); at Re 3200, u(0.4531) = -0.86636 has its
decimal point one place too far right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["REYNOLDS", "X", "Y", "CentreLines", "Deviation", "centre_lines", "deviation"]


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

REYNOLDS = tuple(_U)
"""Reynolds numbers U L / nu that are tabulated here."""


@dataclass(frozen=True)
class CentreLines:
    """Velocities on the two centre lines."""

    u: NDArray[np.float64]  # u/U at (1/2, Y) [1], shape [15]; NaN where there is no value
    v: NDArray[np.float64]  # v/U at (X, 1/2) [1], shape [15]; NaN where there is no value


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


def deviation(measured: NDArray[np.float64], reference: NDArray[np.float64]) -> Deviation:
    """Compare two profiles at the points where the reference has a value."""
    known = ~np.isnan(reference)
    difference = measured[known] - reference[known]
    return Deviation(rmse=float(np.sqrt(np.mean(difference**2))), maximum=float(np.max(np.abs(difference))))
