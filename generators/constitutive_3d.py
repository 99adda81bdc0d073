"""Stress and plastic flow of jelly, rope and snow in three dimensions.

The equations are those of :mod:`.constitutive`, with the same signs and units per
length^3. Only ``+ - * /``, ``sqrt`` and comparisons are used, each a fixed number of
times, so that every processor returns the same bits.

A matrix is written as its three rows, a symmetric one as its entries in Voigt's order:
xx, yy, zz, yz, xz and xy. An entry is a number, or a vector that holds the numbers of
several particles: vector instructions then treat these particles at once, and the bits
stay the same.

A deformation gradient F has the polar decomposition F = V R with the symmetric left
stretch V; V^2 = B = F F^T. With the signed principal stretches s1, s2, s3 (one is
negative where F inverts) the invariants of V are

    total = s1 + s2 + s3,    pairs = s1 s2 + s2 s3 + s3 s1,    J = s1 s2 s3 = det F.

The total is the largest root of the quartic

    (total^2 - tr B)^2 - 8 J total - 4 minors(B) = 0,

where ``minors`` is the sum of the principal minors; Newton's method falls towards it
from sqrt(3 tr B). V then follows from the theorem of Cayley and Hamilton:

    V = ((pairs + tr B) B + total J I - B^2) / (pairs total - J).

The stress needs V and B only: (F - R) F^T = B - V.

Sources: Markley 1993 (the quartic), Hoger and Carlson 1984 (the square root), Golub and
Van Loan (Jacobi's method), Stomakhin et al. 2012, 2013.
"""

import taichi as ti
from taichi import f32
from taichi.math import mat3

from .constitutive import STRETCH_MIN, larger
from .transfer import Template, Value, bounded

# Newton steps: relative error of V within 2e-6 for stretches from 0.3 to 2.5
_NEWTON_STEPS = 6
# pairs of axes that a sweep turns
_AXIS_PAIRS = ((0, 1), (0, 2), (1, 2))
# sweeps of Jacobi's method over the three pairs of axes
_SWEEPS = 4
# least derivative of the quartic, and least (s1 + s2) (s2 + s3) (s3 + s1)
_EPSILON = 1e-6


@ti.func
def rows_of(f: mat3) -> Value:
    """Return the rows of the matrix of one particle."""
    return [
        [f[0, 0], f[0, 1], f[0, 2]],
        [f[1, 0], f[1, 1], f[1, 2]],
        [f[2, 0], f[2, 1], f[2, 2]],
    ]


@ti.func
def dot(a: Template, b: Template) -> Value:
    """Return the sum of the products of three pairs of entries."""
    return (a[0] * b[0] + a[1] * b[1]) + a[2] * b[2]


@ti.func
def times_transposed(rows: Template) -> Value:
    """Return M M^T, a symmetric matrix."""
    x = rows[0]
    y = rows[1]
    z = rows[2]
    return [dot(x, x), dot(y, y), dot(z, z), dot(y, z), dot(x, z), dot(x, y)]


@ti.func
def principal_minors(b: Template) -> Value:
    """Return the sum of the three principal minors of a symmetric matrix."""
    xx, yy, zz, yz, xz, xy = b
    minor_z = xx * yy - xy * xy
    minor_x = yy * zz - yz * yz
    minor_y = xx * zz - xz * xz
    return (minor_z + minor_x) + minor_y


@ti.func
def determinant(rows: Template) -> Value:
    """Return det F, expanded along the first row."""
    xx, xy, xz = rows[0]
    yx, yy, yz = rows[1]
    zx, zy, zz = rows[2]
    minor_x = yy * zz - yz * zy
    minor_y = yx * zz - yz * zx
    minor_z = yx * zy - yy * zx
    return (xx * minor_x - xy * minor_y) + xz * minor_z


@ti.func
def trace(b: Template) -> Value:
    """Return the sum of the diagonal of a symmetric matrix."""
    return (b[0] + b[1]) + b[2]


@ti.func
def left_stretch(b: Template, jacobian: Value) -> Value:
    """Return V of the polar decomposition F = V R, from B = F F^T and J = det F.

    It vanishes where the rotation is ambiguous: where two stretches are opposite.
    """
    b_trace = trace(b)
    minors = principal_minors(b)
    total = ti.sqrt(3.0 * b_trace)
    for _ in ti.static(range(_NEWTON_STEPS)):
        gap = total * total - b_trace
        quartic = (gap * gap - 8.0 * jacobian * total) - 4.0 * minors
        slope = 4.0 * total * gap - 8.0 * jacobian
        step = quartic / larger(slope, _EPSILON)
        total = total - step
    pairs = 0.5 * (total * total - b_trace)
    divisor = larger(pairs * total - jacobian, _EPSILON)
    inverse = 1.0 / divisor
    factor = pairs + b_trace
    on_diagonal = total * jacobian
    xx, yy, zz, yz, xz, xy = b
    square = times_transposed([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return [
        inverse * ((factor * xx - square[0]) + on_diagonal),
        inverse * ((factor * yy - square[1]) + on_diagonal),
        inverse * ((factor * zz - square[2]) + on_diagonal),
        inverse * (factor * yz - square[3]),
        inverse * (factor * xz - square[4]),
        inverse * (factor * xy - square[5]),
    ]


@ti.func
def corotated_stress(rows: Template, mu: Value, la: Value) -> Value:
    """Return the fixed corotated stress 2 mu (F - R) F^T + lambda (J - 1) J I.

    It is symmetric. Lame's constants mu and lambda are in [mass/(length s^2)].
    """
    b = times_transposed(rows)
    jacobian = determinant(rows)
    volumetric = la * (jacobian - 1.0) * jacobian
    v = left_stretch(b, jacobian)
    double_mu = 2.0 * mu
    return [
        double_mu * (b[0] - v[0]) + volumetric,
        double_mu * (b[1] - v[1]) + volumetric,
        double_mu * (b[2] - v[2]) + volumetric,
        double_mu * (b[3] - v[3]),
        double_mu * (b[4] - v[4]),
        double_mu * (b[5] - v[5]),
    ]


@ti.func
def tangent_of_turn(difference: Value, double: Value) -> Value:
    """Return the tangent of the angle by which Jacobi's method turns a pair of axes.

    It is 2 b_pq / (d +- sqrt(d^2 + 4 b_pq^2)) with the sign of d = b_qq - b_pp: then
    the entry b_pq between the axes vanishes. ``double`` is 2 b_pq.
    """
    root = ti.sqrt(difference * difference + double * double)
    signed_root = ti.select(difference < 0.0, -root, root)
    divisor = difference + signed_root
    is_diagonal = divisor == 0.0
    safe_divisor = ti.select(is_diagonal, 1.0, divisor)
    return ti.select(is_diagonal, 0.0, double / safe_divisor)


@ti.func
def turned(along_p: Value, along_q: Value, cosine: Value, sine: Value) -> Value:
    """Return the components along two axes after these have turned."""
    new_p = cosine * along_p - sine * along_q
    new_q = sine * along_p + cosine * along_q
    return new_p, new_q


@ti.func
def principal_axes(b: Template) -> Value:
    """Return the eigenvalues of a symmetric matrix, and its eigenvectors.

    Jacobi's method, four sweeps: each turns a pair of axes so that the entry between
    them vanishes.
    """
    diagonal = [b[0], b[1], b[2]]
    # the entries beside the diagonal; that of two axes stands at the place of the third
    opposite = [b[3], b[4], b[5]]
    zero = 0.0 * b[0]
    one = zero + 1.0
    axes = [[one, zero, zero], [zero, one, zero], [zero, zero, one]]
    for _ in ti.static(range(_SWEEPS)):
        for p, q in ti.static(_AXIS_PAIRS):
            r = ti.static(3 - p - q)
            between = opposite[r]
            tangent = tangent_of_turn(diagonal[q] - diagonal[p], 2.0 * between)
            cosine = 1.0 / ti.sqrt(tangent * tangent + 1.0)
            sine = tangent * cosine
            shift = tangent * between
            diagonal[p] = diagonal[p] - shift
            diagonal[q] = diagonal[q] + shift
            opposite[r] = zero
            # the entries between p and r, and between q and r
            along_p, along_q = turned(opposite[q], opposite[p], cosine, sine)
            opposite[q] = along_p
            opposite[p] = along_q
            for row in ti.static(range(3)):
                new_p, new_q = turned(axes[p][row], axes[q][row], cosine, sine)
                axes[p][row] = new_p
                axes[q][row] = new_q
    return diagonal, axes


@ti.func
def transposed(rows: Template) -> Value:
    """Return the rows of the transposed matrix."""
    x = rows[0]
    y = rows[1]
    z = rows[2]
    return [[x[0], y[0], z[0]], [x[1], y[1], z[1]], [x[2], y[2], z[2]]]


@ti.func
def dots(row: Template, others: Template) -> Value:
    """Return the sums of the products of a row with three others."""
    return [dot(row, others[0]), dot(row, others[1]), dot(row, others[2])]


@ti.func
def clamped(square: Value, low: f32, high: f32) -> Value:
    """Return clamped over trial stretch, and its inverse, from the squared stretch."""
    positive = larger(square, 0.0)
    trial = larger(ti.sqrt(positive), STRETCH_MIN)
    stretch = bounded(trial, low, high)
    return stretch / trial, trial / stretch


@ti.func
def stretched_row(
    i: Template, ratios: Template, components: Template, columns: Template
) -> Value:
    """Return a row of Q diag(ratios) Q^T F, from the rows of Q and the columns of F."""
    row = components[i]
    scaled = [ratios[0] * row[0], ratios[1] * row[1], ratios[2] * row[2]]
    stretch = dots(scaled, components)
    return dots(stretch, columns)


@ti.func
def plastic_return(rows: Template, low: f32, high: f32) -> Value:
    """Clamp the principal stretches of the trial gradient F to [low, high].

    With the principal axes Q of B = F F^T, the elastic gradient is Q diag(new / old)
    Q^T F. The limits are 1 - theta_c and 1 + theta_s. Stretches below
    :data:`.constitutive.STRETCH_MIN` count as that; a gradient that inverts is no trial
    gradient of snow, whose stretches lie near 1.

    Returns:
        The rows of the elastic F, and the factor on Jp: trial stretches over clamped
        ones.
    """
    squares, axes = principal_axes(times_transposed(rows))
    first_ratio, first_growth = clamped(squares[0], low, high)
    second_ratio, second_growth = clamped(squares[1], low, high)
    third_ratio, third_growth = clamped(squares[2], low, high)
    growth = (first_growth * second_growth) * third_growth
    ratios = [first_ratio, second_ratio, third_ratio]
    components = transposed(axes)  # row i: the components i of the three axes
    columns = transposed(rows)
    elastic = [
        stretched_row(0, ratios, components, columns),
        stretched_row(1, ratios, components, columns),
        stretched_row(2, ratios, components, columns),
    ]
    return elastic, growth
