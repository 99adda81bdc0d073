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

from .draws import RandomSource, draw_offsets, quantise

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
        f_column = self.gradient[:, :, None]
        g_row = other.gradient[:, None, :]
        crossed = f_column * g_row
        transposed = crossed.transpose(0, 2, 1)
        both_crossed = crossed + transposed
        f_factor = f[..., None]
        g_factor = g[..., None]
        hessian = g_factor * self.hessian + f_factor * other.hessian + both_crossed
        return Smooth(value, gradient, hessian)

    def scale(self, factor: Array | float) -> Smooth:
        """Multiply by numbers that do not depend on the point's coordinates."""
        shape = self.value.shape
        factors = np.broadcast_to(np.asarray(factor, np.float64), shape)
        of_gradient = factors[:, None]
        of_hessian = factors[:, None, None]
        value = factors * self.value
        gradient = of_gradient * self.gradient
        hessian = of_hessian * self.hessian
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
        square_sum = _square_sum(self.velocity)
        return math.sqrt(square_sum / len(self.velocity))


def _square_sum(values: Array) -> float:
    """Return the sum of the squares of all numbers, rounded once."""
    numbers = values.ravel()
    squares = []
    for number in numbers.tolist():
        square = number * number
        squares.append(square)
    return math.fsum(squares)


def coordinate(values: Array, axis: int, dimension: int) -> Smooth:
    """Return a coordinate, or it less a constant, as a function of the position."""
    point_count = len(values)
    gradient_shape = (point_count, dimension)
    hessian_shape = (point_count, dimension, dimension)
    gradient = np.zeros(gradient_shape)
    gradient[:, axis] = 1.0
    hessian = np.zeros(hessian_shape)
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
    shape = (dimension,)
    # until a point of the cube lies in the unit ball, and not at its very centre
    while True:
        unit = rng.random(shape)
        vector = 2.0 * unit - 1.0
        square = _square_sum(vector)
        if 2.0**-20 <= square <= 1.0:
            return np.asarray(vector / math.sqrt(square))


def draw_lattice(rng: RandomSource, frequency: int, dimension: int) -> Array:
    """Draw the unit gradients of a wrapped lattice.

    The shape is [frequency, ..., axis]: as many nodes as cells along each axis.
    """
    count = frequency**dimension
    vectors = []
    for _ in range(count):
        direction = draw_direction(rng, dimension)
        vectors.append(direction)
    gradients = np.array(vectors)
    nodes = [frequency] * dimension
    shape = (*nodes, dimension)
    return gradients.reshape(shape)


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
    per_length = float(frequency)
    point_count, dimension = position.shape
    scaled = position * per_length
    cell = np.floor(scaled).astype(np.int64)
    cell = np.minimum(cell, frequency - 1)
    # distances from the low corner of the cell, and the weights of the two corners
    along = []
    weights = []
    for axis in range(dimension):
        axis_cell = cell[:, axis]
        low = axis_cell.astype(np.float64)
        distance = scaled[:, axis] - low
        t = coordinate(distance, axis, dimension)
        along.append(t)
        rising = _fade(t)
        minus_rising = rising.scale(-1.0)
        falling = minus_rising.shift(1.0)
        sides = (falling, rising)
        weights.append(sides)

    total = constant(0.0, point_count, dimension)
    for corner in itertools.product((0, 1), repeat=dimension):
        unwrapped_node = cell + np.array(corner)
        node = unwrapped_node % frequency  # shape [point, axis]
        node_of_axis = tuple(node.T)
        gradient = lattice[node_of_axis]
        term = constant(0.0, point_count, dimension)
        for axis, side in enumerate(corner):
            slope = gradient[:, axis]
            from_low = along[axis]
            minus_side = -float(side)
            from_corner = from_low.shift(minus_side)
            rise = from_corner.scale(slope)
            term = term + rise
        for axis, side in enumerate(corner):
            weight = weights[axis][side]
            term = term * weight
        total = total + term

    # from derivatives per cell of the lattice to derivatives per length
    gradient = total.gradient * per_length
    hessian = total.hessian * (per_length * per_length)
    return Smooth(total.value, gradient, hessian)


def wrapped_offset(position: Array, centre: Array) -> Array:
    """Return the way from a centre to points of the unit box, shape [point, axis].

    Each component lies in [-1/2, 1/2]: the nearest image of the centre counts.
    """
    way = position - centre
    return np.asarray(way - np.rint(way))


def rotated_gradient(psi: Smooth) -> Flow:
    """Return the flow u = dpsi/dy, v = -dpsi/dx."""
    slope = psi.gradient
    u = slope[:, 1]
    v = -slope[:, 0]
    components = [u, v]
    curvature = psi.hessian
    u_gradient = curvature[:, 1]
    v_gradient = -curvature[:, 0]
    gradients = [u_gradient, v_gradient]
    velocity = np.stack(components, axis=1)
    affine = np.stack(gradients, axis=1)
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
        component = b_slope - a_slope
        components.append(component)
        b_curvature = b.hessian[:, first]
        a_curvature = a.hessian[:, second]
        gradient = b_curvature - a_curvature
        gradients.append(gradient)
    velocity = np.stack(components, axis=1)
    affine = np.stack(gradients, axis=1)
    return Flow(velocity, affine)


def scaled_to(flow: Flow, speed_rms: float) -> Flow:
    """Return a flow of another root mean square speed, as multiples of 2^-20."""
    factor = speed_rms / flow.speed_rms
    exact_velocity = factor * flow.velocity
    exact_affine = factor * flow.affine
    velocity = quantise(exact_velocity)
    affine = quantise(exact_affine)
    return Flow(velocity, affine)


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
    dimension = len(counts)
    indices = np.indices(tuple(counts))
    cell = indices.reshape(dimension, -1).T
    centred = draw_offsets(rng, cell.shape, subdivision=subdivision)
    displacement = centred * jitter
    middle = cell + 0.5
    place = middle + displacement  # [cells]
    spacings = np.asarray(counts)
    share = place / spacings  # of the extent
    start = np.asarray(low, np.float64)
    position = start + (np.asarray(high, np.float64) - start) * share
    return quantise(position)
