"""Particle clouds projected on fixed directions and sorted, for sliced distances."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["DIRECTIONS", "sorted_projections"]

DIRECTIONS = 64
"""Directions on which clouds are projected, at equal angles over a half turn."""


def sorted_projections(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the coordinates along each direction in ascending order [length].

    Args:
        points: positions [length], shape [particle, 2].

    Returns:
        Shape [direction, particle].
    """
    projected = np.empty((DIRECTIONS, len(points)))
    for row, angle in zip(projected, np.arange(DIRECTIONS) * (math.pi / DIRECTIONS), strict=True):
        row[:] = points[:, 0] * math.cos(angle) + points[:, 1] * math.sin(angle)
        row.sort()
    return projected
