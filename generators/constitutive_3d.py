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

from .constitutive import STRETCH_MIN, larger
from .transfer import Value, bounded

# Newton steps: relative error of V within 2e-6 for stretches from 0.3 to 2.5
_NEWTON_STEPS = 6
# sweeps of Jacobi's method over the three pairs of axes
_SWEEPS = 4
# least derivative of the quartic, and least (s1 + s2) (s2 + s3) (s3 + s1)
_EPSILON = 1e-6


@ti.func
def principal_minors(b: ti.math.mat3) -> ti.f32:
    """Return the sum of the three principal minors of a symmetric matrix."""
    minor_z = b[0, 0] * b[1, 1] - b[0, 1] * b[0, 1]
    minor_x = b[1, 1] * b[2, 2] - b[1, 2] * b[1, 2]
    minor_y = b[0, 0] * b[2, 2] - b[0, 2] * b[0, 2]
    return (minor_z + minor_x) + minor_y


@ti.func
def determinant(f: ti.math.mat3) -> ti.f32:
    """Return det F, expanded along the first row."""
    first = f[0, 0] * (f[1, 1] * f[2, 2] - f[1, 2] * f[2, 1])
    second = f[0, 1] * (f[1, 0] * f[2, 2] - f[1, 2] * f[2, 0])
    third = f[0, 2] * (f[1, 0] * f[2, 1] - f[1, 1] * f[2, 0])
    return (first - second) + third


@ti.func
def left_stretch(b: ti.math.mat3, jacobian: ti.f32) -> ti.math.mat3:
    """Return V of the polar decomposition F = V R, from B = F F^T and J = det F.

    It vanishes where the rotation is ambiguous: where two stretches are opposite.
    """
    square = (b[0, 0] + b[1, 1]) + b[2, 2]
    minors = principal_minors(b)
    total = ti.sqrt(3.0 * square)
    for _ in ti.static(range(_NEWTON_STEPS)):
        gap = total * total - square
        value = (gap * gap - 8.0 * jacobian * total) - 4.0 * minors
        slope = 4.0 * total * gap - 8.0 * jacobian
        total = total - value / larger(slope, _EPSILON)
    pairs = 0.5 * (total * total - square)
    inverse = 1.0 / larger(pairs * total - jacobian, _EPSILON)
    linear = pairs + square
    constant = total * jacobian
    v = linear * b - b @ b
    for axis in ti.static(range(3)):
        v[axis, axis] = v[axis, axis] + constant
    return inverse * v


@ti.func
def corotated_stress(f: ti.math.mat3, mu: ti.f32, la: ti.f32) -> ti.math.mat3:
    """Return the fixed corotated stress 2 mu (F - R) F^T + lambda (J - 1) J I.

    Lame's constants mu and lambda are in [mass/(length s^2)].
    """
    b = f @ f.transpose()
    jacobian = determinant(f)
    volumetric = la * (jacobian - 1.0) * jacobian
    tau = (2.0 * mu) * (b - left_stretch(b, jacobian))
    for axis in ti.static(range(3)):
        tau[axis, axis] = tau[axis, axis] + volumetric
    return tau


@ti.func
def principal_axes(b: ti.math.mat3) -> Value:
    """Return the eigenvalues of a symmetric matrix, and its eigenvectors as columns.

    Jacobi's method, four sweeps: each turns a pair of axes so that the entry between
    them vanishes, by the angle with the tangent 2 b_pq / (d +- sqrt(d^2 + 4 b_pq^2)),
    d = b_qq - b_pp, with the sign of d.
    """
    a = b
    axes = ti.Matrix([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    for _ in ti.static(range(_SWEEPS)):
        for p, q in ti.static(((0, 1), (0, 2), (1, 2))):
            double = 2.0 * a[p, q]
            difference = a[q, q] - a[p, p]
            root = ti.sqrt(difference * difference + double * double)
            divisor = difference + ti.select(difference < 0.0, -root, root)
            is_diagonal = divisor == 0.0
            tangent = ti.select(
                is_diagonal, 0.0, double / ti.select(is_diagonal, 1.0, divisor)
            )
            cosine = 1.0 / ti.sqrt(tangent * tangent + 1.0)
            sine = tangent * cosine
            r = ti.static(3 - p - q)
            shift = tangent * a[p, q]
            a[p, p] = a[p, p] - shift
            a[q, q] = a[q, q] + shift
            a[p, q] = 0.0
            a[q, p] = 0.0
            of_p = cosine * a[r, p] - sine * a[r, q]
            of_q = sine * a[r, p] + cosine * a[r, q]
            a[r, p] = of_p
            a[p, r] = of_p
            a[r, q] = of_q
            a[q, r] = of_q
            for row in ti.static(range(3)):
                along_p = cosine * axes[row, p] - sine * axes[row, q]
                along_q = sine * axes[row, p] + cosine * axes[row, q]
                axes[row, p] = along_p
                axes[row, q] = along_q
    return ti.Vector([a[0, 0], a[1, 1], a[2, 2]]), axes


@ti.func
def plastic_return(f: ti.math.mat3, low: ti.f32, high: ti.f32) -> Value:
    """Clamp the principal stretches of the trial gradient F to [low, high].

    With the principal axes Q of B = F F^T, the elastic gradient is Q diag(new / old)
    Q^T F. The limits are 1 - theta_c and 1 + theta_s. Stretches below
    :data:`.constitutive.STRETCH_MIN` count as that; a gradient that inverts is no trial
    gradient of snow, whose stretches lie near 1.

    Returns:
        The elastic F, and the factor on Jp: trial stretches over clamped ones.
    """
    squares, axes = principal_axes(f @ f.transpose())
    scaled = axes
    growth = 1.0
    for k in ti.static(range(3)):
        trial = larger(ti.sqrt(larger(squares[k], 0.0)), STRETCH_MIN)
        clamped = bounded(trial, low, high)
        growth = growth * (trial / clamped)
        ratio = clamped / trial
        for row in ti.static(range(3)):
            scaled[row, k] = ratio * axes[row, k]
    return (scaled @ axes.transpose()) @ f, growth
