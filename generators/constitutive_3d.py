"""Stress and plastic flow of jelly, rope and snow in three dimensions.

The equations are those of :mod:`.constitutive`, with the same signs and units per
length^3. Only ``+ - * /``, ``sqrt`` and comparisons are used, each a fixed number of
times, so that every processor returns the same bits.

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
from taichi.math import mat3, vec3

from .constitutive import STRETCH_MIN, larger
from .transfer import Value, bounded

# Newton steps: relative error of V within 2e-6 for stretches from 0.3 to 2.5
_NEWTON_STEPS = 6
# pairs of axes that a sweep turns
_AXIS_PAIRS = ((0, 1), (0, 2), (1, 2))
# sweeps of Jacobi's method over the three pairs of axes
_SWEEPS = 4
# least derivative of the quartic, and least (s1 + s2) (s2 + s3) (s3 + s1)
_EPSILON = 1e-6


@ti.func
def principal_minors(b: mat3) -> f32:
    """Return the sum of the three principal minors of a symmetric matrix."""
    xx = b[0, 0]
    yy = b[1, 1]
    zz = b[2, 2]
    xy = b[0, 1]
    yz = b[1, 2]
    xz = b[0, 2]
    minor_z = xx * yy - xy * xy
    minor_x = yy * zz - yz * yz
    minor_y = xx * zz - xz * xz
    return (minor_z + minor_x) + minor_y


@ti.func
def determinant(f: mat3) -> f32:
    """Return det F, expanded along the first row."""
    xx = f[0, 0]
    xy = f[0, 1]
    xz = f[0, 2]
    yx = f[1, 0]
    yy = f[1, 1]
    yz = f[1, 2]
    zx = f[2, 0]
    zy = f[2, 1]
    zz = f[2, 2]
    minor_x = yy * zz - yz * zy
    minor_y = yx * zz - yz * zx
    minor_z = yx * zy - yy * zx
    return (xx * minor_x - xy * minor_y) + xz * minor_z


@ti.func
def trace(b: mat3) -> f32:
    """Return the sum of the diagonal."""
    return (b[0, 0] + b[1, 1]) + b[2, 2]


@ti.func
def add_to_diagonal(b: mat3, value: f32) -> mat3:
    """Return b + value I."""
    result = b
    for axis in ti.static(range(3)):
        result[axis, axis] = b[axis, axis] + value
    return result


@ti.func
def left_stretch(b: mat3, jacobian: f32) -> mat3:
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
    numerator = (pairs + b_trace) * b - b @ b
    numerator = add_to_diagonal(numerator, total * jacobian)
    return inverse * numerator


@ti.func
def corotated_stress(f: mat3, mu: f32, la: f32) -> mat3:
    """Return the fixed corotated stress 2 mu (F - R) F^T + lambda (J - 1) J I.

    Lame's constants mu and lambda are in [mass/(length s^2)].
    """
    b = f @ f.transpose()
    jacobian = determinant(f)
    volumetric = la * (jacobian - 1.0) * jacobian
    excess = b - left_stretch(b, jacobian)  # (F - R) F^T
    stretch_stress = (2.0 * mu) * excess
    return add_to_diagonal(stretch_stress, volumetric)


@ti.func
def tangent_of_turn(difference: f32, double: f32) -> f32:
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
def turned(along_p: f32, along_q: f32, cosine: f32, sine: f32) -> Value:
    """Return the components along two axes after these have turned."""
    new_p = cosine * along_p - sine * along_q
    new_q = sine * along_p + cosine * along_q
    return new_p, new_q


@ti.func
def principal_axes(b: mat3) -> Value:
    """Return the eigenvalues of a symmetric matrix, and its eigenvectors as columns.

    Jacobi's method, four sweeps: each turns a pair of axes so that the entry between
    them vanishes.
    """
    a = b
    axes = mat3([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    for _ in ti.static(range(_SWEEPS)):
        for p, q in ti.static(_AXIS_PAIRS):
            between = a[p, q]
            difference = a[q, q] - a[p, p]
            tangent = tangent_of_turn(difference, 2.0 * between)
            cosine = 1.0 / ti.sqrt(tangent * tangent + 1.0)
            sine = tangent * cosine

            shift = tangent * between
            a[p, p] = a[p, p] - shift
            a[q, q] = a[q, q] + shift
            a[p, q] = 0.0
            a[q, p] = 0.0
            # r is the third axis.
            r = ti.static(3 - p - q)
            entry_p, entry_q = turned(a[r, p], a[r, q], cosine, sine)
            a[r, p] = entry_p
            a[p, r] = entry_p
            a[r, q] = entry_q
            a[q, r] = entry_q
            for row in ti.static(range(3)):
                along_p, along_q = turned(axes[row, p], axes[row, q], cosine, sine)
                axes[row, p] = along_p
                axes[row, q] = along_q
    eigenvalues = vec3(a[0, 0], a[1, 1], a[2, 2])
    return eigenvalues, axes


@ti.func
def plastic_return(f: mat3, low: f32, high: f32) -> Value:
    """Clamp the principal stretches of the trial gradient F to [low, high].

    With the principal axes Q of B = F F^T, the elastic gradient is Q diag(new / old)
    Q^T F. The limits are 1 - theta_c and 1 + theta_s. Stretches below
    :data:`.constitutive.STRETCH_MIN` count as that; a gradient that inverts is no trial
    gradient of snow, whose stretches lie near 1.

    Returns:
        The elastic F, and the factor on Jp: trial stretches over clamped ones.
    """
    squares, axes = principal_axes(f @ f.transpose())
    scaled_axes = axes
    growth = 1.0
    for k in ti.static(range(3)):
        square = larger(squares[k], 0.0)
        trial = larger(ti.sqrt(square), STRETCH_MIN)
        clamped = bounded(trial, low, high)
        growth = growth * (trial / clamped)
        ratio = clamped / trial
        for row in ti.static(range(3)):
            scaled_axes[row, k] = ratio * axes[row, k]
    stretch = scaled_axes @ axes.transpose()
    return stretch @ f, growth
