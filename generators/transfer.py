"""Particle-grid transfer: quadratic B-splines and exact fixed-point sums.

All kernels use it. In two dimensions a particle at x touches the 3 x 3 nodes
base + (i, j) with the weight w_i w_j, where f = x/dx - base lies in [1/2, 3/2) and per
axis

    w_0 = (3/2 - f)^2 / 2,    w_1 = 3/4 - (f - 1)^2,    w_2 = (f - 1/2)^2 / 2.

Nodes sum 64-bit integers, q = round(scale x value): integer addition commutes, so
neither the order of particles nor threads nor devices can change a bit of the sum.

A particle is stored as vectors of four, each in an array of its own. Loops that only
look at one particle (stencil, stress, motion) then have one stride, and LLVM takes
eight particles at a time; P2G and G2P, whose nodes lie anywhere, take several numbers
of a node at a time.

In the signatures of Taichi functions ``Template`` is a field or a compile-time constant
and ``Value`` a scalar or vector of any type, for which Taichi wants no annotation; nor
does it for a kernel that returns ``Nothing``.
"""

import inspect
import math
from typing import TYPE_CHECKING, Any, TypeAlias

from .language import f32, f64, i32, i64, ti, vec2, vec3, vec4

if TYPE_CHECKING:
    Template: TypeAlias = Any
    Value: TypeAlias = Any
    Nothing: TypeAlias = None
else:
    Template = ti.template()
    Value = inspect.Parameter.empty
    Nothing = tuple[()]

# 1.5 x 2^52: added to a float64 below 2^51, it leaves the rounded integer in the low
# bits.
_ROUNDING_SHIFT = 6755399441055744.0
_SHIFT_BITS = 0x4338000000000000  # of that float64


def fixed_point_scale(particles: int, bound: float) -> float:
    """Return the largest power of two for which no nodal sum can overflow.

    A contribution of at most ``bound`` scales to at most 2^50 (:func:`to_fixed` is
    exact below 2^51), and ``particles`` of them sum to less than 2^62.

    >>> fixed_point_scale(8192, 8.0) == 2.0**46
    True
    """
    last_particle = particles - 1
    count_bits = last_particle.bit_length()
    room = 62 - count_bits  # for one contribution [bits]
    bits = min(50, room)
    mantissa, exponent = math.frexp(bound)
    is_power_of_two = mantissa == 0.5
    if is_power_of_two:
        exponent -= 1
    return math.ldexp(1.0, bits - exponent)


@ti.func
def spline_weights(f: Value) -> Value:
    """Return the weights w_0, w_1 and w_2 of the three nodes along an axis.

    f = x/dx - base is a number, or a vector over axes.
    """
    to_low = 1.5 - f
    to_mid = f - 1.0
    to_high = f - 0.5
    low = 0.5 * (to_low * to_low)
    mid = 0.75 - to_mid * to_mid
    high = 0.5 * (to_high * to_high)
    return low, mid, high


@ti.func
def stencil(x: vec4, inv_dx: f32, width: i32) -> Value:
    """Return three rows of weights w_i w_j, each with a fourth number.

    The fourth numbers are what else a transfer needs: the bits of the base node's index
    i width + j, and the offset f - 1 along x and along y.
    """
    position = x.xy
    scaled = position * inv_dx
    base = ti.cast(scaled - 0.5, i32)
    base_place = ti.cast(base, f32)  # [cells]
    f = scaled - base_place
    offset = f - 1.0
    node_bits = ti.bit_cast(base.x * width + base.y, f32)

    low, mid, high = spline_weights(f)
    low_y = low.y
    mid_y = mid.y
    high_y = high.y
    along_y = vec3(low_y, mid_y, high_y)
    low_weights = low.x * along_y
    mid_weights = mid.x * along_y
    high_weights = high.x * along_y

    first_row = vec4(low_weights, node_bits)
    second_row = vec4(mid_weights, offset.x)
    third_row = vec4(high_weights, offset.y)
    return first_row, second_row, third_row


@ti.func
def base_node(rows: Template, s: i32, p: i32) -> Value:
    """Return a particle's base node and its offset from the middle node [cells].

    Both stand in its stencil, see :func:`stencil`.
    """
    # Only these numbers: whole rows would be kept in registers that P2G needs.
    node_bits = rows[0][s, p][3]
    offset_x = rows[1][s, p][3]
    offset_y = rows[2][s, p][3]
    base = ti.bit_cast(node_bits, i32)
    offset = vec2(offset_x, offset_y)
    return base, offset


@ti.func
def node_number(bits: f32, node_count: Template) -> Value:
    """Return the number of a node from a float with the bits of that number.

    The number must be below ``node_count``. The mask does not check this, see
    :func:`masked`.
    """
    number = ti.bit_cast(bits, i32)
    return masked(number, node_count)


@ti.func
def masked(number: i32, node_count: Template) -> Value:
    """Return the number of a node with a mask on its bits.

    The mask changes no number below ``node_count``. It tells LLVM that the numbers of
    the neighbours do not overflow either: their addresses are then one address plus
    constants. Without it each address is computed anew. P2G of closed boxes and free
    surfaces in two dimensions has no mask: on processors without AVX it is slower with
    one.
    """
    bit_count = ti.static(node_count.bit_length())
    return number & ti.static(ti.static(1 << bit_count) - 1)


@ti.func
def to_fixed(scaled: Value) -> Value:
    """Round a float32 below 2^51 to the nearest 64-bit integer, ties to even.

    NaN and larger values give some integer, never a trap: the float's bits are only
    read.
    """
    with_shift = shifted(scaled)
    shift = i64(_SHIFT_BITS)
    return with_shift - shift


@ti.func
def shifted(scaled: Value) -> Value:
    """Return :func:`to_fixed` plus the bits of the shift."""
    return ti.bit_cast(ti.cast(scaled, f64) + ti.cast(_ROUNDING_SHIFT, f64), i64)


@ti.func
def from_fixed(total: Value, inverse_scale: f32) -> Value:
    """Return a sum of :func:`to_fixed` as float32, rounded once."""
    return ti.cast(total, f32) * inverse_scale


@ti.func
def accumulate(
    sums: Template, s: i32, node: i32, scaled: vec4, atomic: Template
) -> None:
    """Add contributions, times their scales, to the sums of one node.

    ``atomic``: whether other threads may add to it at the same time.
    """
    # Even in serial code `+=` is an atomic, which costs five times as much.
    if ti.static(atomic):
        contribution = to_fixed(scaled)
        ti.atomic_add(sums[s, node], contribution)
    else:
        # The shift comes off the sum: off the contribution, LLVM finds vectors for two
        # lanes only.
        total = sums[s, node]
        shift = i64(_SHIFT_BITS)
        reduced = total - shift
        contribution = shifted(scaled)
        sums[s, node] = reduced + contribution


@ti.func
def add_shifted(
    sums: Template, s: i32, node: i32, scaled: vec4, atomic: Template
) -> None:
    """Add contributions, times their scales, and the bits of the shift.

    The reader of the sums subtracts the shifts. This saves a subtraction at each node
    of each particle.
    """
    contribution = shifted(scaled)
    if ti.static(atomic):
        ti.atomic_add(sums[s, node], contribution)
    else:
        # Even in serial code `+=` is an atomic.
        total = sums[s, node]
        sums[s, node] = total + contribution


@ti.func
def row_count(rows: Template, s: i32, n: i32) -> Value:
    """Return the fixed-point sum of the weights of node n, and the bits of its shifts.

    A row is three nodes along the last axis, and has the number of its last node. So
    the rows n, n + 1 and n + 2 contain node n. A particle adds to a row the weights of
    its three nodes, and a zero. Each added number brings the bits of one shift, so the
    fourth sum of a row has only shifts. The other sums of node n have the same shifts.
    Their reader subtracts them.
    """
    first = rows[s, n + 2]
    second = rows[s, n + 1]
    third = rows[s, n]
    first_shift = first[3]
    second_shift = second[3]
    third_shift = third[3]
    shifts = first_shift + second_shift + third_shift

    first_weights = first[0]
    second_weights = second[1]
    third_weights = third[2]
    count = first_weights + second_weights + third_weights - shifts
    return count, shifts


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
def bounded(value: Value, low: f32, high: f32) -> Value:
    """Return the value kept in [low, high]; NaN becomes low."""
    raised = ti.select(value > low, value, low)
    return ti.select(raised < high, raised, high)


@ti.func
def largest(value: Value, so_far: Value) -> Value:
    """Return the larger one; a value that is NaN wins, so that it is seen."""
    return ti.select(value <= so_far, so_far, value)
