"""Stress and plastic flow of liquid, jelly, rope and snow, as Taichi functions.

Every stress is a Kirchhoff stress tau [mass/s^2], symmetric, shape [2, 2]. Only ``+ - * /``,
``sqrt`` and comparisons are used, so that every processor returns the same bits.

Sources: Hu et al. 2018 (MLS-MPM), Stomakhin et al. 2012 (fixed corotated), 2013 (snow).
"""

import taichi as ti

__all__ = [
    "EXPONENT_MAX",
    "STRETCH_MIN",
    "corotated_stress",
    "exponential",
    "hardening",
    "lame",
    "liquid_stress",
    "plastic_return",
    "rotation",
    "viscous_stress",
]

EXPONENT_MAX = 4.0
"""Largest magnitude of the argument for which the error bound of :func:`exponential` holds."""

STRETCH_MIN = 0.1
"""Smallest trial stretch that enters the plastic volume; an inverted particle counts as this."""

_SPIN_MIN = 1e-6
_SHEAR_MIN = 1e-12
_INVERSE_FACTORIALS = (1.0, 1.0, 1 / 2, 1 / 6, 1 / 24, 1 / 120, 1 / 720)


def lame(young: float, poisson: float) -> tuple[float, float]:
    """Return Lame's constants (mu, lambda) of plane strain.

    mu = E / (2 (1 + nu)), lambda = E nu / ((1 + nu) (1 - 2 nu)).

    Args:
        young: Young's modulus E [mass/s^2].
        poisson: Poisson's ratio nu < 1/2 [1].

    >>> lame(40.0, 0.25)
    (16.0, 16.0)
    """
    return young / (2.0 * (1.0 + poisson)), young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))


@ti.func
def exponential(z: ti.f32) -> ti.f32:
    """Return exp(z): the Taylor polynomial of degree 6 in z/16, squared four times.

    Relative error <= 3e-6 for abs(z) <= :data:`EXPONENT_MAX` in float32.
    """
    t = z * 0.0625
    e = _INVERSE_FACTORIALS[6]
    for degree in ti.static(range(5, -1, -1)):
        e = _INVERSE_FACTORIALS[degree] + t * e
    for _ in ti.static(range(4)):
        e = e * e
    return e


@ti.func
def rotation(f: ti.math.mat2) -> ti.math.vec2:
    """Return (cos, sin) of the rotation R nearest to F, the polar factor of F = R S.

    In 2D, R is the direction of (F00 + F11, F10 - F01); a vanishing vector gives R = I.
    """
    x = f[0, 0] + f[1, 1]
    y = f[1, 0] - f[0, 1]
    length = ti.sqrt(x * x + y * y)
    direction = ti.Vector([1.0, 0.0])
    if length > _SPIN_MIN:
        direction = ti.Vector([x / length, y / length])
    return direction


@ti.func
def viscous_stress(c: ti.math.mat2, viscosity: ti.f32) -> ti.math.mat2:
    """Return mu (C + C^T).

    Args:
        c: velocity gradient [1/s].
        viscosity: dynamic viscosity mu, density times kinematic viscosity [mass/s].
    """
    shear = viscosity * (c[0, 1] + c[1, 0])
    return ti.Matrix([[2.0 * viscosity * c[0, 0], shear], [shear, 2.0 * viscosity * c[1, 1]]])


@ti.func
def liquid_stress(jacobian: ti.f32, modulus: ti.f32) -> ti.f32:
    """Return K (J - 1), the isotropic stress of a liquid; negative is pressure."""
    return modulus * (jacobian - 1.0)


@ti.func
def corotated_stress(f: ti.math.mat2, mu: ti.f32, la: ti.f32) -> ti.math.mat2:
    """Return the fixed corotated stress 2 mu (F - R) F^T + lambda (J - 1) J I.

    (F - R) F^T = R (S - I) S R^T is symmetric, so three entries are computed.

    Args:
        f: deformation gradient [1].
        mu: shear modulus [mass/s^2].
        la: Lame's first constant [mass/s^2].
    """
    r = rotation(f)
    a = f[0, 0] - r[0]
    b = f[0, 1] + r[1]
    c = f[1, 0] - r[1]
    d = f[1, 1] - r[0]
    jacobian = f[0, 0] * f[1, 1] - f[0, 1] * f[1, 0]
    volumetric = la * (jacobian - 1.0) * jacobian
    shear = 2.0 * mu * (a * f[1, 0] + b * f[1, 1])
    return ti.Matrix(
        [
            [2.0 * mu * (a * f[0, 0] + b * f[0, 1]) + volumetric, shear],
            [shear, 2.0 * mu * (c * f[1, 0] + d * f[1, 1]) + volumetric],
        ]
    )


@ti.func
def hardening(plastic: ti.f32, exponent: ti.f32, low: ti.f32, high: ti.f32) -> ti.f32:
    """Return exp(xi (1 - Jp)) within [low, high], the factor on the moduli of snow.

    Args:
        plastic: plastic volume ratio Jp [1]; below 1 the snow is compacted and stiffer.
        exponent: xi [1].
        low: lower cap, at least exp(-EXPONENT_MAX) [1].
        high: upper cap, at most exp(EXPONENT_MAX) [1].
    """
    z = ti.min(ti.max(exponent * (1.0 - plastic), -EXPONENT_MAX), EXPONENT_MAX)
    return ti.min(ti.max(exponential(z), low), high)


@ti.func
def plastic_return(f: ti.math.mat2, low: ti.f32, high: ti.f32) -> tuple[ti.math.mat2, ti.f32]:
    """Clamp the principal stretches of F to [low, high]; return (elastic F, volume ratio).

    F = R S with S = [[p, q], [q, s]]; the stretches are m +- r with m = (p + s) / 2 and
    r = sqrt(((p - s) / 2)^2 + q^2). Clamping changes m and r only, so no eigenvector is needed.
    The second value is the factor on Jp: trial stretches (at least :data:`STRETCH_MIN`) over
    clamped ones.

    Args:
        f: trial deformation gradient [1].
        low: smallest elastic stretch, 1 - theta_c [1].
        high: largest elastic stretch, 1 + theta_s [1].
    """
    t = rotation(f)
    p = t[0] * f[0, 0] + t[1] * f[1, 0]
    s = t[0] * f[1, 1] - t[1] * f[0, 1]
    q = 0.5 * ((t[0] * f[0, 1] + t[1] * f[1, 1]) + (t[0] * f[1, 0] - t[1] * f[0, 0]))
    mean = 0.5 * (p + s)
    half = 0.5 * (p - s)
    radius = ti.sqrt(half * half + q * q)
    first = ti.min(ti.max(mean + radius, low), high)
    second = ti.min(ti.max(mean - radius, low), high)
    ratio = 0.0
    if radius > _SHEAR_MIN:
        ratio = 0.5 * (first - second) / radius
    mean_kept = 0.5 * (first + second)
    p_kept = mean_kept + ratio * half
    s_kept = mean_kept - ratio * half
    q_kept = ratio * q
    trial = ti.max(mean + radius, STRETCH_MIN) * ti.max(mean - radius, STRETCH_MIN)
    elastic = ti.Matrix(
        [
            [t[0] * p_kept - t[1] * q_kept, t[0] * q_kept - t[1] * s_kept],
            [t[1] * p_kept + t[0] * q_kept, t[1] * q_kept + t[0] * s_kept],
        ]
    )
    return elastic, trial / (first * second)
