"""Arithmetic that the solvers in plain NumPy float32 share.

Independent of Taichi and of ``generators/``. Every operation rounds to float32 in the
order in which the equation is written; sums over particles are 64-bit integers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.generators.split import FreeSurfaceParameters, Material

Float = np.float32
Floats = NDArray[np.float32]
Sums = NDArray[np.int64]
Mask = NDArray[np.bool_]

ZERO = Float(0.0)
ONE = Float(1.0)
TWO = Float(2.0)
HALF = Float(0.5)
WEIGHT_SCALE = 2.0**50


def lame(young: float, poisson: float) -> tuple[float, float]:
    """Lame's constants in float64."""
    lateral = 1 + poisson
    compression = 1 - 2 * poisson
    mu = young / (2 * lateral)
    la = young * poisson / (lateral * compression)
    return mu, la


def fixed(value: Floats, scale: float) -> Sums:
    """Round to the nearest multiple of 1/scale, ties to even, as an integer."""
    exact = value.astype(np.float64) * scale
    return np.rint(exact).astype(np.int64)


def exp(z: Floats) -> Floats:
    """Degree-6 Taylor polynomial of z/16, squared four times."""
    t = z * Float(1 / 16)
    tt = t * t
    fourth = Float(1 / 24) + t * Float(1 / 120)
    high = fourth + tt * Float(1 / 720)
    second = HALF + t * Float(1 / 6)
    e = (ONE + t) + tt * (second + tt * high)
    for _ in range(4):
        e = e * e
    return e.astype(Float)


@dataclass
class Materials:
    """What the particles are made of: their moduli and viscosity, shape [particle]."""

    liquid: Mask
    snow: Mask
    mu: Floats
    la: Floats
    viscosity: Floats

    @classmethod
    def of(cls, p: FreeSurfaceParameters, material: NDArray[np.int8]) -> Materials:
        """Look the constants up in float64, then round them once."""
        moduli = {
            Material.LIQUID: (0.0, 0.0),
            Material.JELLY: lame(p.jelly_modulus, p.jelly_poisson),
            Material.SNOW: lame(p.snow_modulus, p.snow_poisson),
            Material.ROPE: lame(p.rope_modulus, p.rope_poisson),
        }
        constants = [moduli[Material(m)] for m in material]
        mu, la = np.array(constants, Float).T
        liquid = material == Material.LIQUID
        snow = material == Material.SNOW
        damping = np.where(snow, 0.0, p.elastic_damping)
        kinematic = np.where(liquid, p.liquid_viscosity, damping)
        viscosity = p.density * kinematic
        return cls(liquid, snow, mu, la, viscosity.astype(Float))


def velocity_scale(p: FreeSurfaceParameters, count: int, most_cells: int) -> float:
    """Return the fixed-point scale of velocities up to some cells per substep.

    Their sums have 62 bits less those of the particle count.
    """
    count_bits = (count - 1).bit_length()
    bits = min(50, 62 - count_bits)
    greatest_speed = most_cells / (p.grid * p.dt)
    speed_bits = int(np.ceil(np.log2(greatest_speed)))
    return 2.0 ** (bits - speed_bits)


def hardening(p: FreeSurfaceParameters, ratio: Floats) -> Floats:
    """Return the factor of the moduli of snow."""
    exponent = Float(p.snow_hardening) * (ONE - ratio)
    exponent = np.clip(exponent, Float(-4), Float(4))
    softest = Float(p.snow_hardening_min)
    hardest = Float(p.snow_hardening_max)
    return np.clip(exp(exponent), softest, hardest)


def mirror_counts(count: Sums, low: int, high: int) -> None:
    """Add what lies behind both walls to what lies before them, and mirror that."""
    for wall, inwards in ((low, 1), (high, -1)):
        inside = wall + inwards
        outside = wall - inwards
        count[wall] *= 2
        count[inside] += count[outside]
        count[outside] = count[inside]


def stay_inside(p: FreeSurfaceParameters, position: Floats) -> Floats:
    """Clamp positions just inside the walls."""
    dx = 1 / p.grid
    last_cell = p.grid - p.wall
    low = Float((p.wall + 1e-3) * dx)
    high = Float((last_cell - 1e-3) * dx)
    return np.clip(position, low, high)


def volume_ratio(
    p: FreeSurfaceParameters,
    old: Floats,
    *,
    divergence: Floats,
    smooth: Floats,
    density: Floats,
) -> Floats:
    """Return the J of liquid after a substep.

    J <- J (1 + dt tr C) + kappa (Jbar - J); J <- J + theta (1 / max(r, 1) - J); limits.
    """
    j = old + Float(p.dt) * divergence * old
    j = j + Float(p.jacobian_relaxation) * (smooth - old)
    volume = ONE / np.maximum(density, ONE)
    j = j + Float(p.density_coupling) * (volume - j)
    least = Float(p.jacobian_min)
    most = Float(p.jacobian_max)
    return np.clip(j, least, most)
