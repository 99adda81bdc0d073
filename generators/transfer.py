"""Particle-grid transfer: quadratic B-splines and exact fixed-point sums.

Shared by both formulations. A particle at x touches the 3 x 3 nodes base + (i, j) with the
weight w_i w_j, where f = x/dx - base lies in [1/2, 3/2) and per axis

    w_0 = (3/2 - f)^2 / 2,    w_1 = 3/4 - (f - 1)^2,    w_2 = (f - 1/2)^2 / 2.

Nodes sum 64-bit integers, q = round(scale x value): integer addition commutes, so neither the
order of particles nor threads nor devices can change a bit of the sum.

In the signatures of Taichi functions ``Template`` is a field or a compile-time constant and
``Value`` a scalar or vector of any type, for which Taichi wants no annotation; nor does it for a
kernel that returns ``Nothing``.
"""

import inspect
from typing import TYPE_CHECKING, Any, TypeAlias

import taichi as ti

if TYPE_CHECKING:
    Template: TypeAlias = Any
    Value: TypeAlias = Any
    Nothing: TypeAlias = None
else:
    Template = ti.template()
    Value = inspect.Parameter.empty
    Nothing = tuple[()]

__all__ = [
    "Nothing",
    "Template",
    "Value",
    "accumulate",
    "bounded",
    "fixed_point_scale",
    "from_fixed",
    "largest",
    "stencil",
    "stepped",
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
def stencil(position: ti.math.vec2, inv_dx: ti.f32) -> Value:
    """Return the base node, the offset f from it in cells, and the weights [node, axis]."""
    scaled = position * inv_dx
    base = ti.cast(scaled - 0.5, ti.i32)
    f = scaled - ti.cast(base, ti.f32)
    to_low, to_mid, to_high = 1.5 - f, f - 1.0, f - 0.5
    weight = ti.Matrix.rows([0.5 * (to_low * to_low), 0.75 - to_mid * to_mid, 0.5 * (to_high * to_high)])
    return base, f, weight


@ti.func
def to_fixed(scaled: Value) -> Value:
    """Round a float32 below 2^51 to the nearest 64-bit integer, ties to even.

    NaN and larger values give some integer, never a trap: the float's bits are only read.
    """
    shift = ti.cast(_ROUNDING_SHIFT, ti.f64)
    return ti.bit_cast(ti.cast(scaled, ti.f64) + shift, ti.i64) - ti.bit_cast(shift, ti.i64)


@ti.func
def from_fixed(total: Value, inverse_scale: ti.f32) -> Value:
    """Return a sum of :func:`to_fixed` as float32, rounded once."""
    return ti.cast(total, ti.f32) * inverse_scale


@ti.func
def accumulate(sums: Template, node: ti.math.ivec3, scaled: ti.math.vec4, atomic: Template) -> None:
    """Add scaled contributions to one node's fixed-point sums.

    Args:
        sums: vector field of int64, shape [scenario, node_x, node_y].
        node: its index.
        scaled: contributions, already times their scales.
        atomic: whether other threads may add to the same node.
    """
    # Even in serial code `+=` is an atomic, which costs five times as much.
    if ti.static(atomic):
        ti.atomic_add(sums[node], to_fixed(scaled))
    else:
        sums[node] = sums[node] + to_fixed(scaled)


@ti.func
def stepped(value: Value, step: Value, count: Template) -> Value:
    """Return value + count step, for a count of -1, 0 or 1."""
    result = value
    if ti.static(count > 0):
        result = value + step
    if ti.static(count < 0):
        result = value - step
    return result


@ti.func
def bounded(value: Value, low: ti.f32, high: ti.f32) -> Value:
    """Return the value kept in [low, high]; NaN becomes low."""
    raised = ti.select(value > low, value, low)
    return ti.select(raised < high, raised, high)


@ti.func
def largest(value: Value, so_far: Value) -> Value:
    """Return the larger one; a value that is NaN wins, so that it is seen."""
    return ti.select(value <= so_far, so_far, value)
