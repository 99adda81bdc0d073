"""Perlin noise and the window that ends it at walls (thesis §5.9; Bridson 2007).

Both are polynomials within a lattice cell, so that a stream function made of them has
continuous second derivatives, and every operation is + - * or floor.

A :class:`Jet` carries a function with its first and second derivatives by the product
rule, so a field written once in + - * has exact derivatives (to rounding) and no step
width to choose:

    (f g)_x = f_x g + f g_x,    (f g)_xy = f_xy g + f_x g_y + f_y g_x + f g_xy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

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
        f = self.value
        g = other.value
        f_x = self.x
        f_y = self.y
        g_x = other.x
        g_y = other.y
        crossed_xx = 2.0 * (f_x * g_x)
        crossed_yy = 2.0 * (f_y * g_y)
        xx = self.xx * g + crossed_xx + f * other.xx
        xy = self.xy * g + f_x * g_y + f_y * g_x + f * other.xy
        yy = self.yy * g + crossed_yy + f * other.yy
        return Jet(
            value=f * g,
            x=f_x * g + f * g_x,
            y=f_y * g + f * g_y,
            xx=xx,
            xy=xy,
            yy=yy,
        )

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
        value = self.value + amount
        return replace(self, value=value)

    def polynomial(self, *coefficients: float) -> Jet:
        """Return c0 + c1 f + c2 f^2 + ... by Horner's rule."""
        result = self.scale(0.0)
        for coefficient in reversed(coefficients):
            product = result * self
            result = product.shift(coefficient)
        return result


def coordinates(position: Array) -> tuple[Jet, Jet]:
    """Return x and y as jets at the given points, shape [point, 2]."""
    point_count = len(position)
    zero = np.zeros(point_count)
    one = np.ones(point_count)
    x, y = position.T
    x_jet = Jet(x, one, zero, zero, zero, zero)
    y_jet = Jet(y, zero, one, zero, zero, zero)
    return x_jet, y_jet


def gradients(rng: RandomSource, frequency: int) -> Array:
    """Draw the unit gradients of a lattice, shape [frequency + 1, frequency + 1, 2]."""
    side = frequency + 1
    node_count = side * side
    vectors = [direction(rng) for _ in range(node_count)]
    return np.array(vectors).reshape(side, side, 2)


def fade(t: Jet) -> Jet:
    """Return Perlin's 6 t^5 - 15 t^4 + 10 t^3; slope and curvature vanish at 0 and
    1.
    """
    return t.polynomial(0.0, 0.0, 0.0, 10.0, -15.0, 6.0)


def noise(x: Jet, y: Jet, lattice: Array) -> Jet:
    """Return gradient noise of a lattice at points in units of its cells.

    Eqs. 5.40 and 5.41 of the thesis. It is 0 at every node and its slope there is the
    node's gradient. The lattice has the shape [node, node, 2].
    """
    last = len(lattice) - 2
    column = np.floor(x.value).astype(np.int64)
    row = np.floor(y.value).astype(np.int64)
    # A point on the far wall belongs to the last cell, not to one beyond the lattice.
    i = np.minimum(column, last)
    j = np.minimum(row, last)
    # distances from the low corner of the cell
    corner_x = i.astype(np.float64)
    corner_y = j.astype(np.float64)
    p = x.shift(-corner_x)
    q = y.shift(-corner_y)

    def corner(k: int, m: int) -> Jet:
        """Return the ramp along the gradient of one corner of the cell."""
        gradient = lattice[i + k, j + m]
        slope_x, slope_y = gradient.T
        from_corner_x = p.shift(-float(k))
        from_corner_y = q.shift(-float(m))
        ramp_x = from_corner_x.scale(slope_x)
        ramp_y = from_corner_y.scale(slope_y)
        return ramp_x + ramp_y

    u = fade(p)
    w = fade(q)
    low_left = corner(0, 0)
    low_right = corner(1, 0)
    high_left = corner(0, 1)
    high_right = corner(1, 1)
    low_rise = low_right - low_left
    high_rise = high_right - high_left
    low = low_left + u * low_rise
    high = high_left + u * high_rise
    rise = high - low
    return low + w * rise


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
