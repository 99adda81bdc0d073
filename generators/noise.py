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

# coefficients of 1, t, t^2 and so on
_FADE = (0.0, 0.0, 0.0, 10.0, -15.0, 6.0)
_RAMP = (0.0, 1.875, 0.0, -1.25, 0.0, 0.375)


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
        opposite = other.scale(-1.0)
        return self + opposite

    def __mul__(self, other: Jet) -> Jet:
        """Multiply by the product rule."""
        f = self.value
        g = other.value
        f_x = self.x
        f_y = self.y
        g_x = other.x
        g_y = other.y
        f_xx = self.xx
        f_xy = self.xy
        f_yy = self.yy
        g_xx = other.xx
        g_xy = other.xy
        g_yy = other.yy

        value = f * g
        x = f_x * g + f * g_x
        y = f_y * g + f * g_y
        xx = f_xx * g + 2.0 * (f_x * g_x) + f * g_xx
        xy = f_xy * g + f_x * g_y + f_y * g_x + f * g_xy
        yy = f_yy * g + 2.0 * (f_y * g_y) + f * g_yy
        return Jet(value, x, y, xx, xy, yy)

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
    x, y = position.T
    point_count = len(position)
    zero = np.zeros(point_count)
    one = np.ones(point_count)
    x_jet = Jet(x, one, zero, zero, zero, zero)
    y_jet = Jet(y, zero, one, zero, zero, zero)
    return x_jet, y_jet


def gradients(rng: RandomSource, frequency: int) -> Array:
    """Draw the unit gradients of a lattice, shape [frequency + 1, frequency + 1, 2]."""
    side = frequency + 1
    node_count = side * side
    vectors = []
    for _ in range(node_count):
        vector = direction(rng)
        vectors.append(vector)
    lattice = np.array(vectors)
    shape = (side, side, 2)
    return lattice.reshape(shape)


def fade(t: Jet) -> Jet:
    """Return Perlin's 6 t^5 - 15 t^4 + 10 t^3; slope and curvature vanish at 0 and
    1.
    """
    return t.polynomial(*_FADE)


def noise(x: Jet, y: Jet, lattice: Array) -> Jet:
    """Return gradient noise of a lattice at points in units of its cells.

    Eqs. 5.40 and 5.41 of the thesis. It is 0 at every node and its slope there is the
    node's gradient. The lattice has the shape [node, node, 2].
    """
    last = len(lattice) - 2
    place_x = x.value
    place_y = y.value
    column = np.floor(place_x).astype(np.int64)
    row = np.floor(place_y).astype(np.int64)
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
        node_i = i + k
        node_j = j + m
        gradient = lattice[node_i, node_j]
        slope_x, slope_y = gradient.T
        corner_p = float(k)
        corner_q = float(m)
        from_corner_x = p.shift(-corner_p)
        from_corner_y = q.shift(-corner_q)
        ramp_x = from_corner_x.scale(slope_x)
        ramp_y = from_corner_y.scale(slope_y)
        return ramp_x + ramp_y

    u = fade(p)
    w = fade(q)
    low_left = corner(0, 0)
    low_right = corner(1, 0)
    high_left = corner(0, 1)
    high_right = corner(1, 1)
    low = low_left + u * (low_right - low_left)
    return low + w * (high_left + u * (high_right - high_left) - low)


def ramp(t: Jet) -> Jet:
    """Return Bridson's ramp: (15 t - 10 t^3 + 3 t^5) / 8 up to t = 1, with two
    derivatives, then 1.
    """
    rising = t.polynomial(*_RAMP)
    is_rising = t.value < 1.0
    value = np.where(is_rising, rising.value, 1.0)

    def kept(derivative: Array) -> Array:
        """Return a derivative where the ramp rises, and 0 beyond."""
        return np.where(is_rising, derivative, 0.0)

    return Jet(
        value=value,
        x=kept(rising.x),
        y=kept(rising.y),
        xx=kept(rising.xx),
        xy=kept(rising.xy),
        yy=kept(rising.yy),
    )
