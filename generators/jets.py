"""Functions of the plane carried together with their first and second derivatives.

A :class:`Jet` obeys the product rule to second order, so a field written once in + - * has
exact derivatives (to rounding) and no step width to choose:

    (f g)_x = f_x g + f g_x,    (f g)_xy = f_xy g + f_x g_y + f_y g_x + f g_xy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Jet", "coordinates"]

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
        return Jet(*(a + b for a, b in zip(self._terms(), other._terms(), strict=True)))

    def __sub__(self, other: Jet) -> Jet:
        """Subtract term by term."""
        return self + other.scale(-1.0)

    def __mul__(self, other: Jet) -> Jet:
        """Multiply by the product rule."""
        f, g = self, other
        return Jet(
            f.value * g.value,
            f.x * g.value + f.value * g.x,
            f.y * g.value + f.value * g.y,
            f.xx * g.value + 2.0 * (f.x * g.x) + f.value * g.xx,
            f.xy * g.value + f.x * g.y + f.y * g.x + f.value * g.xy,
            f.yy * g.value + 2.0 * (f.y * g.y) + f.value * g.yy,
        )

    def scale(self, factor: Array | float) -> Jet:
        """Multiply by numbers that do not depend on the point's coordinates."""
        return Jet(*(factor * term for term in self._terms()))

    def shift(self, amount: Array | float) -> Jet:
        """Add numbers that do not depend on the point's coordinates."""
        return Jet(self.value + amount, self.x, self.y, self.xx, self.xy, self.yy)

    def polynomial(self, *coefficients: float) -> Jet:
        """Return c0 + c1 f + c2 f^2 + ... by Horner's rule."""
        result = self.scale(0.0)
        for coefficient in reversed(coefficients):
            result = (result * self).shift(coefficient)
        return result

    def where(self, condition: NDArray[np.bool_], otherwise: float) -> Jet:
        """Keep the function where the condition holds; a constant takes its place elsewhere."""
        value, *derivatives = self._terms()
        kept = (np.where(condition, term, 0.0) for term in derivatives)
        return Jet(np.where(condition, value, otherwise), *kept)

    def _terms(self) -> tuple[Array, Array, Array, Array, Array, Array]:
        return self.value, self.x, self.y, self.xx, self.xy, self.yy


def coordinates(position: Array) -> tuple[Jet, Jet]:
    """Return x and y as jets at the given points, shape [point, 2]."""
    zero = np.zeros(len(position))
    one = np.ones(len(position))
    x = Jet(position[:, 0], one, zero, zero, zero, zero)
    y = Jet(position[:, 1], zero, one, zero, zero, zero)
    return x, y
