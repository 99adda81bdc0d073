"""Perlin noise and the window that ends it at walls (thesis §5.9; Bridson 2007).

Both are polynomials within a lattice cell, so that a stream function made of them has
continuous second derivatives, and every operation is + - * or floor. A :class:`.Smooth`
carries a function with its first and second derivatives.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .draws import RandomSource, draw_direction
from .periodic_noise import Smooth, fade

__all__ = ["gradients", "noise", "ramp"]

Array = NDArray[np.float64]


def gradients(rng: RandomSource, frequency: int) -> Array:
    """Draw the unit gradients of a lattice, shape [frequency + 1, frequency + 1, 2]."""
    side = frequency + 1
    vectors = [draw_direction(rng, 2) for _ in range(side * side)]
    return np.array(vectors).reshape(side, side, 2)


def noise(x: Smooth, y: Smooth, lattice: Array) -> Smooth:
    """Return gradient noise of a lattice at points in units of its cells.

    Eqs. 5.40 and 5.41 of the thesis. It is 0 at every node and its slope there is the
    node's gradient. The lattice has the shape [node, node, 2].
    """
    last = len(lattice) - 2
    # A point on the far wall belongs to the last cell, not to one beyond the lattice.
    i = np.minimum(np.floor(x.value).astype(np.int64), last)
    j = np.minimum(np.floor(y.value).astype(np.int64), last)
    # distances from the low corner of the cell
    p = x.shift(-i)
    q = y.shift(-j)

    def corner(k: int, m: int) -> Smooth:
        """Return the ramp along the gradient of one corner of the cell."""
        slope_x, slope_y = lattice[i + k, j + m].T
        return p.shift(-k).scale(slope_x) + q.shift(-m).scale(slope_y)

    u = fade(p)
    w = fade(q)
    low_left = corner(0, 0)
    high_left = corner(0, 1)
    low = low_left + u * (corner(1, 0) - low_left)
    return low + w * (high_left + u * (corner(1, 1) - high_left) - low)


def ramp(t: Smooth) -> Smooth:
    """Return Bridson's ramp: (15 t - 10 t^3 + 3 t^5) / 8 up to t = 1, with two
    derivatives, then 1.
    """
    is_rising = t.value < 1.0
    rising = t.polynomial(0.0, 1.875, 0.0, -1.25, 0.0, 0.375)
    return rising.only_where(is_rising).shift(np.where(is_rising, 0.0, 1.0))
