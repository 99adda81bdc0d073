"""Gradient noise that repeats itself, and flows made of it, in two or three dimensions.

Perlin's noise on a lattice that is wrapped around the unit box: a polynomial within
each cell of the lattice, with continuous second derivatives. Every operation is + - *
/, sqrt or rounding to a whole number, so that bits are the same on every x86-64 Linux
CPU.

A :class:`Smooth` carries a function with its gradient and Hessian by the product rule,

    grad(f g) = g grad f + f grad g,
    H(f g) = g H f + f H g + grad f grad g^T + grad g grad f^T.

A flow without divergence is the rotated gradient of a stream function in two
dimensions, u = dpsi/dy, v = -dpsi/dx, and the curl of a vector potential in three.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .draws import RandomSource, draw_direction, draw_offsets, quantise, square_sum

__all__ = [
    "Flow",
    "Smooth",
    "coordinate",
    "curl",
    "draw_lattice",
    "fade",
    "fill_box",
    "noise",
    "rotated_gradient",
    "scaled_to",
    "wrapped_offset",
    "zero",
]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Smooth:
    """A function at many points, with its first and second derivatives."""

    value: Array  # shape [point]
    gradient: Array  # shape [point, axis]
    hessian: Array  # shape [point, axis, axis]

    def __add__(self, other: Smooth) -> Smooth:
        """Add term by term."""
        return Smooth(
            self.value + other.value,
            self.gradient + other.gradient,
            self.hessian + other.hessian,
        )

    def __sub__(self, other: Smooth) -> Smooth:
        """Subtract term by term."""
        return self + other.scale(-1.0)

    def __mul__(self, other: Smooth) -> Smooth:
        """Multiply by the product rule."""
        f = self.value[:, None]
        g = other.value[:, None]
        # f'_i g'_j, shape [point, axis, axis]
        crossed = self.gradient[:, :, None] * other.gradient[:, None, :]
        return Smooth(
            self.value * other.value,
            g * self.gradient + f * other.gradient,
            g[..., None] * self.hessian
            + f[..., None] * other.hessian
            + (crossed + crossed.transpose(0, 2, 1)),
        )

    def scale(self, factor: Array | float) -> Smooth:
        """Multiply by numbers that do not depend on the point's coordinates."""
        factors = np.broadcast_to(np.asarray(factor, np.float64), self.value.shape)
        return Smooth(
            factors * self.value,
            factors[:, None] * self.gradient,
            factors[:, None, None] * self.hessian,
        )

    def shift(self, amount: Array | NDArray[np.int64] | float) -> Smooth:
        """Add numbers that do not depend on the point's coordinates."""
        return Smooth(self.value + amount, self.gradient, self.hessian)

    def polynomial(self, *coefficients: float) -> Smooth:
        """Return c0 + c1 f + c2 f^2 + ... by Horner's rule."""
        result = self.scale(0.0)
        for coefficient in reversed(coefficients):
            result = (result * self).shift(coefficient)
        return result

    def only_where(self, chosen: NDArray[np.bool_]) -> Smooth:
        """Return the function at some points, and zero at the others."""
        return Smooth(
            np.where(chosen, self.value, 0.0),
            np.where(chosen[:, None], self.gradient, 0.0),
            np.where(chosen[:, None, None], self.hessian, 0.0),
        )


@dataclass(frozen=True)
class Flow:
    """A velocity field at many points."""

    velocity: Array  # [length/s], shape [point, axis]
    affine: Array  # its gradient, component by axis [1/s], shape [point, axis, axis]

    @property
    def speed_rms(self) -> float:
        """Root mean square of the speed over the points [length/s]."""
        return math.sqrt(square_sum(self.velocity) / len(self.velocity))


def coordinate(values: Array, axis: int, dimension: int) -> Smooth:
    """Return a coordinate, or it less a constant, as a function of the position."""
    gradient = np.zeros((len(values), dimension))
    gradient[:, axis] = 1.0
    return Smooth(values, gradient, np.zeros((len(values), dimension, dimension)))


def zero(point_count: int, dimension: int) -> Smooth:
    """Return the function that is 0."""
    nowhere = coordinate(np.zeros(point_count), 0, dimension)
    return nowhere.scale(0.0)


def draw_lattice(rng: RandomSource, frequency: int, dimension: int) -> Array:
    """Draw the unit gradients of a wrapped lattice.

    The shape is [frequency, ..., axis]: as many nodes as cells along each axis.
    """
    vectors = [draw_direction(rng, dimension) for _ in range(frequency**dimension)]
    return np.array(vectors).reshape(*[frequency] * dimension, dimension)


def fade(t: Smooth) -> Smooth:
    """Return Perlin's 6 t^5 - 15 t^4 + 10 t^3."""
    return t.polynomial(0.0, 0.0, 0.0, 10.0, -15.0, 6.0)


def noise(position: Array, lattice: Array) -> Smooth:
    """Return the gradient noise of a wrapped lattice in the unit box.

    It is 0 at every node of the lattice and its slope there is the node's gradient, in
    units of the lattice's cells; derivatives are with respect to the position [length].

    Args:
        position: points in [0, 1) [length], shape [point, axis].
        lattice: gradients, shape [node, ..., axis].
    """
    frequency = len(lattice)
    per_length = float(frequency)
    point_count, dimension = position.shape
    scaled = position * per_length
    cell = np.floor(scaled).astype(np.int64)
    cell = np.minimum(cell, frequency - 1)
    # distances from the low corner of the cell, and the weights of the two corners
    along = []
    weights = []
    for axis in range(dimension):
        t = coordinate(scaled[:, axis] - cell[:, axis], axis, dimension)
        along.append(t)
        rising = fade(t)
        weights.append((rising.scale(-1.0).shift(1.0), rising))

    total = zero(point_count, dimension)
    for corner in itertools.product((0, 1), repeat=dimension):
        node = (cell + np.array(corner)) % frequency  # shape [point, axis]
        gradient = lattice[tuple(node.T)]
        term = zero(point_count, dimension)
        for axis, side in enumerate(corner):
            term = term + along[axis].shift(-side).scale(gradient[:, axis])
        for axis, side in enumerate(corner):
            term = term * weights[axis][side]
        total = total + term

    # from derivatives per cell of the lattice to derivatives per length
    return Smooth(
        total.value,
        total.gradient * per_length,
        total.hessian * (per_length * per_length),
    )


def wrapped_offset(position: Array, centre: Array) -> Array:
    """Return the way from a centre to points of the unit box, shape [point, axis].

    Each component lies in [-1/2, 1/2]: the nearest image of the centre counts.
    """
    way = position - centre
    return np.asarray(way - np.rint(way))


def rotated_gradient(psi: Smooth) -> Flow:
    """Return the flow u = dpsi/dy, v = -dpsi/dx."""
    slope = psi.gradient
    curvature = psi.hessian
    return Flow(
        np.stack([slope[:, 1], -slope[:, 0]], axis=1),
        np.stack([curvature[:, 1], -curvature[:, 0]], axis=1),
    )


def curl(potential: Sequence[Smooth]) -> Flow:
    """Return the flow that is the curl of a vector potential."""
    velocity = []
    affine = []
    for axis in range(3):
        first = (axis + 1) % 3
        second = (axis + 2) % 3
        a = potential[first]
        b = potential[second]
        velocity.append(b.gradient[:, first] - a.gradient[:, second])
        affine.append(b.hessian[:, first] - a.hessian[:, second])
    return Flow(np.stack(velocity, axis=1), np.stack(affine, axis=1))


def scaled_to(flow: Flow, speed_rms: float) -> Flow:
    """Return a flow of another root mean square speed, as multiples of 2^-20."""
    factor = speed_rms / flow.speed_rms
    return Flow(quantise(factor * flow.velocity), quantise(factor * flow.affine))


def fill_box(
    rng: RandomSource,
    counts: Sequence[int],
    *,
    low: Sequence[float],
    high: Sequence[float],
    jitter: float,
    subdivision: int = 1,
) -> Array:
    """Fill a box with a lattice of particles, each a little off its place.

    Args:
        rng: source of the jitter.
        counts: particles along each axis.
        low: lower end of the box along each axis [length].
        high: upper end of the box along each axis [length].
        jitter: width of the uniform displacement, in spacings [1].
        subdivision: as in :func:`.draw_offsets`.

    Returns:
        Positions [length], multiples of 2^-20, shape [particle, axis].
    """
    cell = np.indices(tuple(counts)).reshape(len(counts), -1).T
    centred = draw_offsets(rng, cell.shape, subdivision=subdivision)
    place = cell + 0.5 + centred * jitter  # [cells]
    share = place / np.asarray(counts)  # of the extent
    start = np.asarray(low, np.float64)
    return quantise(start + (np.asarray(high, np.float64) - start) * share)
