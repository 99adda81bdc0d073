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

from .draws import RandomSource, quantise

__all__ = [
    "Flow",
    "Smooth",
    "constant",
    "coordinate",
    "curl",
    "draw_direction",
    "draw_lattice",
    "fill_box",
    "noise",
    "rotated_gradient",
    "scaled_to",
    "wrapped_offset",
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
        value = self.value + other.value
        gradient = self.gradient + other.gradient
        hessian = self.hessian + other.hessian
        return Smooth(value, gradient, hessian)

    def __mul__(self, other: Smooth) -> Smooth:
        """Multiply by the product rule."""
        f = self.value[:, None]
        g = other.value[:, None]
        value = self.value * other.value
        gradient = g * self.gradient + f * other.gradient
        # f'_i g'_j and its transpose, shape [point, axis, axis]
        f_slope = self.gradient[:, :, None]
        g_slope = other.gradient[:, None, :]
        crossed = f_slope * g_slope
        transposed = crossed.transpose(0, 2, 1)
        both_crossed = crossed + transposed
        f_curved = g[..., None] * self.hessian
        g_curved = f[..., None] * other.hessian
        hessian = f_curved + g_curved + both_crossed
        return Smooth(value, gradient, hessian)

    def scale(self, factor: Array | float) -> Smooth:
        """Multiply by numbers that do not depend on the point's coordinates."""
        exact = np.asarray(factor, np.float64)
        factors = np.broadcast_to(exact, self.value.shape)
        value = factors * self.value
        gradient = factors[:, None] * self.gradient
        hessian = factors[:, None, None] * self.hessian
        return Smooth(value, gradient, hessian)

    def shift(self, amount: Array | float) -> Smooth:
        """Add numbers that do not depend on the point's coordinates."""
        value = self.value + amount
        return Smooth(value, self.gradient, self.hessian)

    def polynomial(self, *coefficients: float) -> Smooth:
        """Return c0 + c1 f + c2 f^2 + ... by Horner's rule."""
        result = self.scale(0.0)
        for coefficient in reversed(coefficients):
            product = result * self
            result = product.shift(coefficient)
        return result

    def only_where(self, chosen: NDArray[np.bool_]) -> Smooth:
        """Return the function at some points, and zero at the others."""
        of_gradient = chosen[:, None]
        of_hessian = chosen[:, None, None]
        value = np.where(chosen, self.value, 0.0)
        gradient = np.where(of_gradient, self.gradient, 0.0)
        hessian = np.where(of_hessian, self.hessian, 0.0)
        return Smooth(value, gradient, hessian)


@dataclass(frozen=True)
class Flow:
    """A velocity field at many points."""

    velocity: Array  # [length/s], shape [point, axis]
    affine: Array  # its gradient, component by axis [1/s], shape [point, axis, axis]

    @property
    def speed_rms(self) -> float:
        """Root mean square of the speed over the points [length/s]."""
        components = self.velocity.ravel().tolist()
        square_sum = math.fsum(component * component for component in components)
        return math.sqrt(square_sum / len(self.velocity))


def coordinate(values: Array, axis: int, dimension: int) -> Smooth:
    """Return a coordinate, or it less a constant, as a function of the position."""
    point_count = len(values)
    gradient = np.zeros((point_count, dimension))
    gradient[:, axis] = 1.0
    hessian = np.zeros((point_count, dimension, dimension))
    return Smooth(values, gradient, hessian)


def constant(value: float, point_count: int, dimension: int) -> Smooth:
    """Return a constant function."""
    gradient_shape = (point_count, dimension)
    hessian_shape = (point_count, dimension, dimension)
    values = np.full(point_count, value)
    gradient = np.zeros(gradient_shape)
    hessian = np.zeros(hessian_shape)
    return Smooth(values, gradient, hessian)


def draw_direction(rng: RandomSource, dimension: int) -> Array:
    """Draw a unit vector, uniform over the circle or sphere, without sine or cosine."""
    # until a point of the cube lies in the unit ball, and not at its very centre
    while True:
        unit = rng.random((dimension,))
        vector = 2.0 * unit - 1.0
        components = vector.tolist()
        square = math.fsum(component * component for component in components)
        if 2.0**-20 <= square <= 1.0:
            length = math.sqrt(square)
            return np.asarray(vector / length)


def draw_lattice(rng: RandomSource, frequency: int, dimension: int) -> Array:
    """Draw the unit gradients of a wrapped lattice.

    The shape is [frequency, ..., axis]: as many nodes as cells along each axis.
    """
    count = frequency**dimension
    vectors = [draw_direction(rng, dimension) for _ in range(count)]
    nodes = [frequency] * dimension
    return np.array(vectors).reshape(*nodes, dimension)


def _fade(t: Smooth) -> Smooth:
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
    point_count, dimension = position.shape
    scaled = position * float(frequency)
    cell = np.floor(scaled).astype(np.int64)
    cell = np.minimum(cell, frequency - 1)
    # distances from the low corner of the cell, and the weights of the two corners
    along = []
    weights = []
    for axis in range(dimension):
        low_corner = cell[:, axis].astype(np.float64)
        distance = scaled[:, axis] - low_corner
        t = coordinate(distance, axis, dimension)
        along.append(t)
        rising = _fade(t)
        minus_rising = rising.scale(-1.0)
        falling = minus_rising.shift(1.0)
        weights.append((falling, rising))

    total = constant(0.0, point_count, dimension)
    for corner in itertools.product((0, 1), repeat=dimension):
        node = (cell + np.array(corner)) % frequency  # shape [point, axis]
        gradient = lattice[tuple(node.T)]
        term = constant(0.0, point_count, dimension)
        for axis, side in enumerate(corner):
            slope = gradient[:, axis]
            from_corner = along[axis].shift(-float(side))
            term = term + from_corner.scale(slope)
        for axis, side in enumerate(corner):
            weight = weights[axis][side]
            term = term * weight
        total = total + term
    # from derivatives per cell of the lattice to derivatives per length
    per_length = float(frequency)
    per_square = per_length * per_length
    gradient = total.gradient * per_length
    hessian = total.hessian * per_square
    return Smooth(total.value, gradient, hessian)


def wrapped_offset(position: Array, centre: Array) -> Array:
    """Return the way from a centre to points of the unit box, shape [point, axis].

    Each component lies in [-1/2, 1/2]: the nearest image of the centre counts.
    """
    way = position - centre
    return np.asarray(way - np.rint(way))


def rotated_gradient(psi: Smooth) -> Flow:
    """Return the flow u = dpsi/dy, v = -dpsi/dx."""
    slope_x = psi.gradient[:, 0]
    slope_y = psi.gradient[:, 1]
    velocity = np.stack([slope_y, -slope_x], axis=1)
    gradient_of_slope_x = psi.hessian[:, 0]
    gradient_of_slope_y = psi.hessian[:, 1]
    affine = np.stack([gradient_of_slope_y, -gradient_of_slope_x], axis=1)
    return Flow(velocity, affine)


def curl(potential: Sequence[Smooth]) -> Flow:
    """Return the flow that is the curl of a vector potential."""
    components = []
    gradients = []
    for axis in range(3):
        first = (axis + 1) % 3
        second = (axis + 2) % 3
        a = potential[first]
        b = potential[second]
        b_slope = b.gradient[:, first]
        a_slope = a.gradient[:, second]
        b_curvature = b.hessian[:, first]
        a_curvature = a.hessian[:, second]
        components.append(b_slope - a_slope)
        gradients.append(b_curvature - a_curvature)
    velocity = np.stack(components, axis=1)
    affine = np.stack(gradients, axis=1)
    return Flow(velocity, affine)


def scaled_to(flow: Flow, speed_rms: float) -> Flow:
    """Return a flow of another root mean square speed, as multiples of 2^-20."""
    factor = speed_rms / flow.speed_rms
    velocity = quantise(factor * flow.velocity)
    affine = quantise(factor * flow.affine)
    return Flow(velocity, affine)


def fill_box(
    rng: RandomSource,
    counts: Sequence[int],
    *,
    low: Sequence[float],
    high: Sequence[float],
    jitter: float,
) -> Array:
    """Fill a box with a lattice of particles, each a little off its place.

    Args:
        rng: source of the jitter.
        counts: particles along each axis.
        low: lower end of the box along each axis [length].
        high: upper end of the box along each axis [length].
        jitter: width of the uniform displacement, in spacings [1].

    Returns:
        Positions [length], multiples of 2^-20, shape [particle, axis].
    """
    dimension = len(counts)
    indices = np.indices(tuple(counts))
    cell = indices.reshape(dimension, -1).T
    unit = rng.random(cell.shape)
    displacement = (unit - 0.5) * jitter
    place = cell + 0.5 + displacement  # [cells]
    share = place / np.asarray(counts)  # of the extent
    start = np.asarray(low, np.float64)
    end = np.asarray(high, np.float64)
    extent = end - start
    return quantise(start + extent * share)
