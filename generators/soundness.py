"""Is a free surface nearly incompressible, and does no numerical bound act?

The Mach number of a particle is its speed over the speed of sound in its material at
rest. A weakly compressible liquid needs about 0.3 at most: its density then varies by
less than a tenth, and what moves is governed by its mass and not by its stiffness.

Two bounds of the model are physics and are no clamps: a liquid bears no tension, so its
J stays at 1 where it separates; and snow that flies apart keeps the room of loose snow,
``snow_jp_max``. All other bounds are numerical. :class:`SoundnessRecorder` counts the
particles that reached one of these at any substep:

- J of a liquid at ``jacobian_min``;
- Jp of snow at ``snow_jp_min``;
- a hardening factor exp(xi (1 - Jp)) at ``snow_hardening_min`` or at
  ``snow_hardening_max``.

No hash covers these numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .solver import Singles
from .split import FreeSurfaceParameters, Material

BIN = 1e-3
"""Width of the bins by which quantiles of Mach numbers and of J are counted [1]."""

_BIN_COUNT = 4096


@dataclass(frozen=True, kw_only=True)
class FreeSurfaceSoundness:
    """How compressible a scenario was, and which bounds it reached."""

    mach_999: float  # Mach number that 99.9 % of particles and frames stay below [1]
    mach_max: float  # largest Mach number of any particle at any recorded frame [1]
    # J that 99.9 % of liquid particles and frames stay above, 1 without liquid [1]
    liquid_jacobian_999: float
    liquid_jacobian_min: float  # smallest J of a liquid at any substep [1]
    liquid_jacobian_max: float  # largest J of a liquid at any substep [1]
    snow_jp_min: float  # smallest Jp of snow at any substep, 1 without snow [1]
    snow_jp_max: float  # largest Jp of snow at any substep, 1 without snow [1]
    # particles that reached a numerical bound at any substep [1]
    clamped_particles: int


def sound_speeds(parameters: FreeSurfaceParameters) -> dict[Material, float]:
    """Return the speed of sound c of each material at rest [length/s].

    c^2 is K/rho in liquid and (lambda + 2 mu)/rho in solids.
    """
    p = parameters
    moduli = {
        Material.LIQUID: p.liquid_modulus,
        Material.JELLY: wave_modulus(p.jelly_modulus, p.jelly_poisson),
        Material.SNOW: wave_modulus(p.snow_modulus, p.snow_poisson),
        Material.ROPE: wave_modulus(p.rope_modulus, p.rope_poisson),
    }
    return {kind: math.sqrt(value / p.density) for kind, value in moduli.items()}


def wave_modulus(young: float, poisson: float) -> float:
    """Return lambda + 2 mu = E (1 - nu) / ((1 + nu) (1 - 2 nu)), in the unit of E."""
    return young * (1.0 - poisson) / ((1.0 + poisson) * (1.0 - 2.0 * poisson))


class SoundnessRecorder:
    """Collects the Mach numbers and J of one scenario, frame by frame.

    Its memory does not grow with the frames: values are counted in bins of
    :data:`BIN`, and a quantile is the end of a bin.
    """

    def __init__(
        self, parameters: FreeSurfaceParameters, material: NDArray[np.integer]
    ) -> None:
        self._parameters = parameters
        self._is_liquid = material == Material.LIQUID
        self._is_snow = material == Material.SNOW
        speeds = sound_speeds(parameters)
        # of each particle [length/s], shape [particle]
        self._sound_speed = np.array([speeds[Material(kind)] for kind in material])
        self._mach_counts = np.zeros(_BIN_COUNT, np.int64)
        self._mach_max = 0.0
        self._jacobian_counts = np.zeros(_BIN_COUNT, np.int64)

    def add(self, velocity: Singles, ratio: Singles) -> None:
        """Add a recorded frame.

        Args:
            velocity: particle velocities [length/s], shape [particle, axis].
            ratio: J of liquid [1], shape [particle]; of others it is not read.
        """
        speed = np.sqrt(np.square(velocity, dtype=np.float64).sum(axis=-1))
        mach = speed / self._sound_speed
        self._mach_max = max(self._mach_max, float(mach.max()))
        self._mach_counts += _count_bins(mach)
        liquid_jacobian = ratio[self._is_liquid].astype(np.float64)
        self._jacobian_counts += _count_bins(liquid_jacobian)

    def summary(self, least: Singles, greatest: Singles) -> FreeSurfaceSoundness:
        """Return what the frames and substeps so far have shown.

        Args:
            least: smallest J of liquid or Jp of snow at any substep [1], shape
                [particle].
            greatest: the largest, shape [particle].
        """
        liquid_jacobian_999 = 1.0
        if self._is_liquid.any():
            # the other tail: the start of the bin that holds it
            liquid_jacobian_999 = _quantile(self._jacobian_counts, 0.001) - BIN
        # without such particles the extremes are 1
        liquid_least = least[self._is_liquid]
        liquid_greatest = greatest[self._is_liquid]
        snow_least = least[self._is_snow]
        snow_greatest = greatest[self._is_snow]
        return FreeSurfaceSoundness(
            mach_999=round(_quantile(self._mach_counts, 0.999), 3),
            mach_max=self._mach_max,
            liquid_jacobian_999=round(liquid_jacobian_999, 3),
            liquid_jacobian_min=float(min(liquid_least, default=1.0)),
            liquid_jacobian_max=float(max(liquid_greatest, default=1.0)),
            snow_jp_min=float(min(snow_least, default=1.0)),
            snow_jp_max=float(max(snow_greatest, default=1.0)),
            clamped_particles=self._count_clamped(least, greatest),
        )

    def _count_clamped(self, least: Singles, greatest: Singles) -> int:
        """Return how many particles reached a numerical bound at any substep."""
        p = self._parameters
        # Exponents xi (1 - Jp) are compared, because exp may overflow.
        largest_exponent = p.snow_hardening * (1.0 - least.astype(np.float64))
        smallest_exponent = p.snow_hardening * (1.0 - greatest.astype(np.float64))
        is_hard = largest_exponent >= math.log(p.snow_hardening_max)
        is_soft = smallest_exponent <= math.log(p.snow_hardening_min)
        is_at_snow_bound = (least <= np.float32(p.snow_jp_min)) | is_hard | is_soft
        is_clamped_snow = self._is_snow & is_at_snow_bound

        is_clamped_liquid = self._is_liquid & (least <= np.float32(p.jacobian_min))
        return int(np.count_nonzero(is_clamped_liquid | is_clamped_snow))


def _count_bins(values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return how many values lie in each bin; the last one holds all that is beyond."""
    place = np.minimum(values / BIN, _BIN_COUNT - 1)
    return np.bincount(place.astype(np.int64), minlength=_BIN_COUNT)


def _quantile(counts: NDArray[np.int64], share: float) -> float:
    """Return the end of the first bin up to which a share of the values lies."""
    cumulative = np.cumsum(counts)
    end = int(np.searchsorted(cumulative, share * cumulative[-1])) + 1  # [bins]
    return end * BIN
