"""Particle-grid transfer: quadratic B-splines and exact fixed-point sums.

Shared by both formulations. A particle at x touches the 3 x 3 nodes base + (i, j) with the
weight w_i w_j, where f = x/dx - base lies in [1/2, 3/2) and per axis

    w_0 = (3/2 - f)^2 / 2,    w_1 = 3/4 - (f - 1)^2,    w_2 = (f - 1/2)^2 / 2.

Nodes sum 64-bit integers, q = round(scale x value): integer addition commutes, so neither the
order of particles nor threads nor devices can change a bit of the sum.
"""

from __future__ import annotations

import taichi as ti

__all__ = [
    "accumulate",
    "bounded",
    "fixed_point_scale",
    "from_fixed",
    "stencil",
    "to_fixed",
]

_ROUNDING_SHIFT = 6755399441055744.0
"""1.5 x 2^52: added to a float64 below 2^51, it leaves the rounded integer in the low bits."""


def fixed_point_scale(particles: int, bound: float) -> float:
    """Return the largest power of two for which no nodal sum of contributions can overflow.

    A contribution of at most ``bound`` scales to at most 2^50 (:func:`to_fixed` is exact below
    2^51), and ``particles`` of them sum to less than 2^62.

    >>> fixed_point_scale(8192, 8.0) == 2.0**46
    True
    """
    bits = min(50, 62 - (particles - 1).bit_length())
    return 2.0**bits / power_of_two_above(bound)


def power_of_two_above(value: float) -> float:
    """Return the smallest power of two that is not below a positive value.

    >>> power_of_two_above(12.5)
    16.0
    """
    power = 1.0
    while power < value:
        power *= 2.0
    while power / 2.0 >= value:
        power /= 2.0
    return power


@ti.func
def stencil(position, inv_dx):
    """Return the base node, the offset f from it in cells, and the weights [node, axis]."""
    scaled = position * inv_dx
    base = ti.cast(scaled - 0.5, ti.i32)
    f = scaled - ti.cast(base, ti.f32)
    to_low, to_mid, to_high = 1.5 - f, f - 1.0, f - 0.5
    weight = ti.Matrix.rows([0.5 * (to_low * to_low), 0.75 - to_mid * to_mid, 0.5 * (to_high * to_high)])
    return base, f, weight


@ti.func
def to_fixed(scaled):
    """Round a float32 below 2^51 to the nearest 64-bit integer, ties to even.

    NaN and larger values give some integer, never a trap: the float's bits are only read.
    """
    shift = ti.cast(_ROUNDING_SHIFT, ti.f64)
    return ti.bit_cast(ti.cast(scaled, ti.f64) + shift, ti.i64) - ti.bit_cast(shift, ti.i64)


@ti.func
def from_fixed(total, inverse_scale):
    """Return a sum of :func:`to_fixed` as float32, rounded once."""
    return ti.cast(total, ti.f32) * inverse_scale


@ti.func
def accumulate(sums: ti.template(), index, scaled, atomic: ti.template()):
    """Add a vector of scaled contributions to one node's fixed-point sums.

    Args:
        sums: vector field of int64.
        index: [scenario, node_x, node_y].
        scaled: contributions, already times their scales.
        atomic: whether other threads may add to the same node.
    """
    for c in ti.static(range(sums.n)):
        # Even in serial code `+=` is an atomic, which costs five times as much.
        if ti.static(atomic):
            ti.atomic_add(sums[index][c], to_fixed(scaled[c]))
        else:
            sums[index][c] = sums[index][c] + to_fixed(scaled[c])


@ti.func
def bounded(value, low, high):
    """Return the value kept in [low, high]; NaN becomes low."""
    raised = ti.select(value > low, value, low)
    return ti.select(raised < high, raised, high)
