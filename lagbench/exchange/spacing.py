"""The distance of neighbouring particles, measured in one frame."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import Box
from lagbench.errors import DataError

Array = NDArray[np.floating]

REACHES_ACROSS = 4.0
"""Radii of the kernel that measures the density, across a square or cube of all
particles, between the limits.
"""

LEAST_REACH = 3.0
MOST_REACH = 6.0
"""Limits of the radius of the kernel [spacing]; a large one averages over random
positions.
"""

REACH_IN_LATTICE = 1.8
"""Radius of the kernel where particles stand on a lattice: it fits into thin bodies
[spacing].
"""

LATTICE_SPREAD = 0.1
"""Spread of the distances to the nearest neighbour up to which particles are taken for
a lattice: quartile range over median [1].
"""

ROUNDS = 10
"""Rounds in which spacing and reach of the kernel come to agree."""

MOST_SAMPLES = 2_000
"""Particles around which the density is measured, at most."""

INTERIOR_QUANTILE = 0.75
"""Quantile of densities that stands for the inside of the material."""


def estimate_spacing(position: Array, box: Box, *, where: str) -> float | None:
    """Return the distance of neighbouring particles in one frame [length].

    It is ``(volume / particles)^(1/d)`` inside the material, by the density that a
    cubic spline kernel measures (Monaghan 1992, Annu. Rev. Astron. Astrophys. 30) with
    a reach of 3 to 6 spacings, in lattices of 1.8 spacings. None for one particle.

    Args:
        position: particles [length], shape [particle, axis].
        box: the box of the particles.
        where: trajectory and frame.

    Raises:
        DataError: a quarter of the particles lie on another one.
    """
    count, dimension = position.shape
    if count == 1:
        return None
    exact = position.astype(np.float64)
    points = box.tree_points(exact)
    samples = points
    if count > MOST_SAMPLES:
        samples = points[np.linspace(0, count - 1, MOST_SAMPLES).astype(int)]
    relative_reach = float(
        np.clip(count ** (1.0 / dimension) / REACHES_ACROSS, LEAST_REACH, MOST_REACH)
    )
    # twice the neighbours within the reach, so that the reach may grow
    neighbours = math.ceil(2.0 * ball_volume(relative_reach, dimension))
    query = box.tree(exact).query(samples, k=min(count, neighbours))
    distances = np.asarray(query[0])  # [sample, neighbour]; the first one is itself
    lower, median, upper = np.quantile(distances[:, 1], (0.25, 0.5, 0.75))
    if lower == 0.0:
        raise DataError(
            f"{where}: a quarter of the particles lie at the place of another one; "
            "leave out copies"
        )

    if upper - lower <= LATTICE_SPREAD * median:
        relative_reach = REACH_IN_LATTICE
    spacing = float(median)
    for _ in range(ROUNDS):
        reach = relative_reach * spacing
        weights = _cubic_spline(distances / reach, dimension) / reach**dimension
        # this quantile leaves surfaces out
        density = float(np.quantile(weights.sum(axis=1), INTERIOR_QUANTILE))
        spacing = density ** (-1.0 / dimension)
    return spacing


def ball_volume(radius: float, dimension: int) -> float:
    """Return the volume of a ball, or the area of a disc."""
    factor = math.pi if dimension == 2 else 4.0 / 3.0 * math.pi
    return factor * radius**dimension


def _cubic_spline(distance: Array, dimension: int) -> Array:
    """Return the cubic spline kernel of reach 1, whose integral is 1.

    Args:
        distance: distances over the reach [1].
        dimension: 2 or 3.
    """
    q = 2.0 * distance
    inner = 1.0 - 1.5 * q**2 + 0.75 * q**3
    outer = 0.25 * np.maximum(2.0 - q, 0.0) ** 3
    shape = np.where(q < 1.0, inner, outer)
    norm = 40.0 / (7.0 * math.pi) if dimension == 2 else 8.0 / math.pi
    return np.asarray(norm * shape)
