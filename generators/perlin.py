"""Perlin noise and the window that ends it at walls (thesis §5.9; Bridson 2007).

Both are polynomials within a lattice cell, so that a stream function made of them has
continuous second derivatives, and every operation is + - * or floor.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .draws import RandomSource, direction
from .jets import Jet

__all__ = ["gradients", "noise", "ramp"]


def gradients(rng: RandomSource, frequency: int) -> NDArray[np.float64]:
    """Draw the unit gradients of a lattice, shape [frequency + 1, frequency + 1, 2]."""
    nodes = frequency + 1
    drawn = [direction(rng) for _ in range(nodes * nodes)]
    return np.array(drawn, dtype=np.float64).reshape(nodes, nodes, 2)


def fade(t: Jet) -> Jet:
    """Return Perlin's 6 t^5 - 15 t^4 + 10 t^3; slope and curvature vanish at 0 and 1."""
    return t.polynomial(0.0, 0.0, 0.0, 10.0, -15.0, 6.0)


def _lerp(share: Jet, start: Jet, end: Jet) -> Jet:
    return start + share * (end - start)


def noise(x: Jet, y: Jet, lattice: NDArray[np.float64]) -> Jet:
    """Return gradient noise with lattice nodes at whole numbers (Eqs. 5.40, 5.41).

    It is 0 at every node and its slope there is the node's gradient.

    Args:
        x: first coordinate in lattice cells, between 0 and the lattice's cells.
        y: second coordinate, alike.
        lattice: gradients, shape [node, node, 2].
    """
    last = len(lattice) - 2
    # A point on the far wall belongs to the last cell, not to one beyond the lattice.
    i = np.minimum(np.floor(x.value).astype(np.int64), last)
    j = np.minimum(np.floor(y.value).astype(np.int64), last)
    p, q = x.shift(-i.astype(np.float64)), y.shift(-j.astype(np.float64))

    def corner(k: int, m: int) -> Jet:
        slope = lattice[i + k, j + m]
        return p.shift(-float(k)).scale(slope[:, 0]) + q.shift(-float(m)).scale(slope[:, 1])

    u, w = fade(p), fade(q)
    return _lerp(w, _lerp(u, corner(0, 0), corner(1, 0)), _lerp(u, corner(0, 1), corner(1, 1)))


def ramp(t: Jet) -> Jet:
    """Return Bridson's ramp: (15 t - 10 t^3 + 3 t^5) / 8 up to t = 1, then 1.

    It starts from 0 with a slope of 15/8 and arrives with slope and curvature 0.
    """
    rising = t.polynomial(0.0, 1.875, 0.0, -1.25, 0.0, 0.375)
    return rising.where(t.value < 1.0, 1.0)
