"""Perlin noise and the window that ends it at walls (thesis §5.9; Bridson 2007).

Both are polynomials within a lattice cell, so that a stream function made of them has
continuous second derivatives, and every operation is + - * or floor.

A :class:`Jet` carries a function with its first and second derivatives by the product
rule, so a field written once in + - * has exact derivatives (to rounding) and no step
width to choose:

    (f g)_x = f_x g + f g_x,    (f g)_xy = f_xy g + f_x g_y + f_y g_x + f g_xy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .draws import RandomSource, direction

__all__ = ["Jet", "coordinates", "gradients", "noise", "ramp"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Jet:
    """A function at many points: value, gradient and Hessian, each of shape [point]."""

    value: Array
    x: Array
    y: Array
    xx: Array
    xy: Array
    yy: Array

    def __add__(self, other: Jet) -> Jet:
        """Add term by term."""
        return Jet(
            self.value + other.value,
            self.x + other.x,
            self.y + other.y,
            self.xx + other.xx,
            self.xy + other.xy,
            self.yy + other.yy,
        )

    def __sub__(self, other: Jet) -> Jet:
        """Subtract term by term."""
        return self + other.scale(-1.0)

    def __mul__(self, other: Jet) -> Jet:
        """Multiply by the product rule."""
        f = self
        g = other
        x = f.x * g.value + f.value * g.x
        y = f.y * g.value + f.value * g.y
        xx = f.xx * g.value + 2.0 * (f.x * g.x) + f.value * g.xx
        xy = f.xy * g.value + f.x * g.y + f.y * g.x + f.value * g.xy
        yy = f.yy * g.value + 2.0 * (f.y * g.y) + f.value * g.yy
        return Jet(f.value * g.value, x, y, xx, xy, yy)

    def scale(self, factor: Array | float) -> Jet:
        """Multiply by numbers that do not depend on the point's coordinates."""
        return Jet(
            factor * self.value,
            factor * self.x,
            factor * self.y,
            factor * self.xx,
            factor * self.xy,
            factor * self.yy,
        )

    def shift(self, amount: Array | float) -> Jet:
        """Add numbers that do not depend on the point's coordinates."""
        return Jet(self.value + amount, self.x, self.y, self.xx, self.xy, self.yy)

    def polynomial(self, *coefficients: float) -> Jet:
        """Return c0 + c1 f + c2 f^2 + ... by Horner's rule."""
        result = self.scale(0.0)
        for coefficient in reversed(coefficients):
            result = (result * self).shift(coefficient)
        return result


def coordinates(position: Array) -> tuple[Jet, Jet]:
    """Return x and y as jets at the given points, shape [point, 2]."""
    zero = np.zeros(len(position))
    one = np.ones(len(position))
    x, y = position.T
    x_jet = Jet(x, one, zero, zero, zero, zero)
    y_jet = Jet(y, zero, one, zero, zero, zero)
    return x_jet, y_jet


def gradients(rng: RandomSource, frequency: int) -> NDArray[np.float64]:
    """Draw the unit gradients of a lattice, shape [frequency + 1, frequency + 1, 2]."""
    node_count = frequency + 1
    vectors = [direction(rng) for _ in range(node_count * node_count)]
    return np.array(vectors).reshape(node_count, node_count, 2)


def fade(t: Jet) -> Jet:
    """Return Perlin's 6 t^5 - 15 t^4 + 10 t^3; slope and curvature vanish at 0 and
    1.
    """
    return t.polynomial(0.0, 0.0, 0.0, 10.0, -15.0, 6.0)


def noise(x: Jet, y: Jet, lattice: NDArray[np.float64]) -> Jet:
    """Return gradient noise of a lattice at points in units of its cells.

    Eqs. 5.40 and 5.41 of the thesis. It is 0 at every node and its slope there is the
    node's gradient. The lattice has the shape [node, node, 2].
    """
    last = len(lattice) - 2
    # A point on the far wall belongs to the last cell, not to one beyond the lattice.
    i = np.minimum(np.floor(x.value).astype(np.int64), last)
    j = np.minimum(np.floor(y.value).astype(np.int64), last)
    # distances from the low corner of the cell
    p = x.shift(-i.astype(np.float64))
    q = y.shift(-j.astype(np.float64))

    def corner(k: int, m: int) -> Jet:
        """Return the ramp along the gradient of one corner of the cell."""
        slope = lattice[i + k, j + m]
        along_x = p.shift(-float(k)).scale(slope[:, 0])
        along_y = q.shift(-float(m)).scale(slope[:, 1])
        return along_x + along_y

    u = fade(p)
    w = fade(q)
    low = corner(0, 0) + u * (corner(1, 0) - corner(0, 0))
    high = corner(0, 1) + u * (corner(1, 1) - corner(0, 1))
    return low + w * (high - low)


def ramp(t: Jet) -> Jet:
    """Return Bridson's ramp: (15 t - 10 t^3 + 3 t^5) / 8 up to t = 1, with two
    derivatives, then 1.
    """
    rising = t.polynomial(0.0, 1.875, 0.0, -1.25, 0.0, 0.375)
    below = t.value < 1.0
    return Jet(
        np.where(below, rising.value, 1.0),
        np.where(below, rising.x, 0.0),
        np.where(below, rising.y, 0.0),
        np.where(below, rising.xx, 0.0),
        np.where(below, rising.xy, 0.0),
        np.where(below, rising.yy, 0.0),
    )
