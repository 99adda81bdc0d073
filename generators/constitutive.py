"""Stress and plastic flow of liquid, jelly, rope and snow, as Taichi functions.

Every stress is a Kirchhoff stress tau [mass/s^2], symmetric, shape [2, 2]. Only
``+ - * /``, ``sqrt`` and comparisons are used, so that every processor returns the same
bits.

A 2 x 2 deformation gradient is a scaled rotation plus a scaled reflection,

    F = [[e, -g], [g, e]] + [[h, k], [k, -h]],
    q = sqrt(e^2 + g^2),    r = sqrt(h^2 + k^2).

The rotation R of the polar decomposition F = R S has cosine e/q and sine g/q; the
principal stretches are q + r and q - r (negative when F inverts); det F = q^2 - r^2.
This is both decompositions in closed form, with one square root each and no
eigenvector.

Sources: Hu et al. 2018 (MLS-MPM), Stomakhin et al. 2012 (fixed corotated), 2013 (snow).
"""

from .language import f32, mat2, ti, vec3
from .transfer import Value, bounded

# largest magnitude for which the error bound of :func:`exponential` holds
EXPONENT_MAX = 4.0
# smallest trial stretch that enters the plastic volume, an inverted particle's too
STRETCH_MIN = 0.1
_STRETCH_EPSILON = 1e-6
_SHEAR_EPSILON = 1e-12


def lame(young: float, poisson: float) -> tuple[float, float]:
    """Return Lame's constants mu and lambda, of plane strain and in three dimensions.

    mu = E / (2 (1 + nu)) and lambda = E nu / ((1 + nu) (1 - 2 nu)), with Young's
    modulus E and Poisson's ratio nu below 1/2. The constants have the unit of E:
    [mass/s^2] in the plane, [mass/(length s^2)] in three dimensions.

    >>> lame(40.0, 0.25)
    (16.0, 16.0)
    """
    lateral = 1.0 + poisson
    mu = young / (2.0 * lateral)
    la = young * poisson / (lateral * (1.0 - 2.0 * poisson))
    return mu, la


@ti.func
def larger(a: f32, b: f32) -> f32:
    """Return the larger of two numbers, b if a is not a number.

    This is one instruction, unlike max.
    """
    return ti.select(a > b, a, b)


@ti.func
def exponential(z: f32) -> f32:
    """Return exp(z): the Taylor polynomial of degree 6 in z/16, squared four times.

    Relative error <= 3e-6 for abs(z) <= :data:`EXPONENT_MAX` in float32.
    """
    t = z * 0.0625
    square = t * t
    # the polynomial in three groups: t^4 to t^6, t^2 and t^3, 1 and t
    high = 1.0 / 24.0 + t * (1.0 / 120.0) + square * (1.0 / 720.0)
    mid = 0.5 + t * (1.0 / 6.0)
    e = 1.0 + t + square * (mid + square * high)
    for _ in ti.static(range(4)):
        e = e * e
    return e


@ti.func
def determinant(f: mat2) -> f32:
    """Return det F."""
    return f[0, 0] * f[1, 1] - f[0, 1] * f[1, 0]


@ti.func
def rotation(f: mat2) -> vec3:
    """Return (cosine, sine, q): the polar rotation R of F and the mean stretch q.

    Where q vanishes (F a reflection, or nothing at all) R is the identity.
    """
    e = 0.5 * (f[0, 0] + f[1, 1])
    g = 0.5 * (f[1, 0] - f[0, 1])
    q = ti.sqrt(e * e + g * g)
    cosine = 1.0
    sine = 0.0
    if q > _STRETCH_EPSILON:
        inverse = 1.0 / q
        cosine = e * inverse
        sine = g * inverse
    return vec3(cosine, sine, q)


@ti.func
def shear_parts(f: mat2) -> Value:
    """Return h and k of the scaled reflection in F."""
    return 0.5 * (f[0, 0] - f[1, 1]), 0.5 * (f[1, 0] + f[0, 1])


@ti.func
def viscous_stress(c: mat2, viscosity: f32) -> mat2:
    """Return mu (C + C^T).

    C is the velocity gradient [1/s], mu the dynamic viscosity [mass/s].
    """
    double_viscosity = 2.0 * viscosity
    shear = viscosity * (c[0, 1] + c[1, 0])
    return mat2(
        [double_viscosity * c[0, 0], shear],
        [shear, double_viscosity * c[1, 1]],
    )


@ti.func
def liquid_stress(jacobian: f32, modulus: f32) -> f32:
    """Return K (J - 1), the isotropic stress of a liquid; negative is pressure."""
    return modulus * (jacobian - 1.0)


@ti.func
def corotated_stress(f: mat2, mu: f32, la: f32) -> mat2:
    """Return the fixed corotated stress 2 mu (F - R) F^T + lambda (J - 1) J I.

    With W = R [[h, k], [k, -h]], a symmetric matrix without trace,
    (F - R) F^T = (q (q - 1) + r^2) I + (2 q - 1) W. Lame's constants mu and lambda are
    in [mass/s^2].
    """
    cosine, sine, q = rotation(f)
    h, k = shear_parts(f)
    r_square = h * h + k * k
    jacobian = q * q - r_square
    volumetric = la * (jacobian - 1.0) * jacobian

    double_mu = 2.0 * mu
    mean = double_mu * (q * (q - 1.0) + r_square) + volumetric
    w_factor = double_mu * (2.0 * q - 1.0)
    normal = w_factor * (cosine * h - sine * k)
    shear = w_factor * (cosine * k + sine * h)
    return mat2([mean + normal, shear], [shear, mean - normal])


@ti.func
def hardening(plastic: f32, exponent: f32, low: f32, high: f32) -> f32:
    """Return exp(xi (1 - Jp)) within [low, high], the factor on the moduli of snow.

    Below a plastic volume ratio Jp of 1 the snow is compacted and stiffer; ``exponent``
    is xi [1]. The caps lie within exp(-+EXPONENT_MAX).
    """
    z = bounded(exponent * (1.0 - plastic), -EXPONENT_MAX, EXPONENT_MAX)
    return bounded(exponential(z), low, high)


@ti.func
def plastic_return(f: mat2, low: f32, high: f32) -> Value:
    """Clamp the principal stretches of the trial gradient F to [low, high].

    The limits are 1 - theta_c and 1 + theta_s. Clamping q + r and q - r gives new q and
    r, by which rotation and reflection are scaled.

    Returns:
        The elastic F, and the factor on Jp: trial stretches (at least
        :data:`STRETCH_MIN`) over clamped ones.
    """
    cosine, sine, q = rotation(f)
    h, k = shear_parts(f)
    r = ti.sqrt(h * h + k * k)
    trial_high = q + r
    trial_low = q - r
    new_high = bounded(trial_high, low, high)
    new_low = bounded(trial_low, low, high)
    new_q = 0.5 * (new_high + new_low)
    new_r = 0.5 * (new_high - new_low)

    r_ratio = 0.0
    if r > _SHEAR_EPSILON:
        r_ratio = new_r / r
    e = new_q * cosine
    g = new_q * sine
    h = r_ratio * h
    k = r_ratio * k
    elastic = mat2([e + h, k - g], [k + g, e - h])

    old_high = larger(trial_high, STRETCH_MIN)
    old_low = larger(trial_low, STRETCH_MIN)
    growth = old_high * old_low / (new_high * new_low)
    return elastic, growth
