"""Liquid, jelly, snow and rope with a free surface: fluid and multimaterial (design
4.4).

The equations stand in :mod:`.particle_stress`, the stresses in :mod:`.constitutive`.
The walls lie on node ``wall`` and its mirror image; the fluid slides along them or is
braked by friction.

Valid while no particle crosses more than a cell per substep, max abs(v) dt <= dx
(checked), and while sound does not either: keep every value of :func:`courant` below
0.8. Explodes beyond. Settings that work over thousands of frames are those of the
splits.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import constitutive
from .driver import Driver, stack
from .particle_stress import ParticleStress
from .solver import Health
from .split import FreeSurfaceParameters, InitialState, Material

Array = NDArray[np.float64]

_LARGEST = 1e30  # extremes beyond this stand for what is not a number


def courant(parameters: FreeSurfaceParameters) -> dict[Material, float]:
    """Return the acoustic Courant number c dt / dx of each material at rest [1].

    c^2 is K/rho in liquid and (lambda + 2 mu)/rho in solids, for snow at its hardest.
    """
    p = parameters
    solids = {
        Material.JELLY: (constitutive.lame(p.jelly_modulus, p.jelly_poisson), 1.0),
        Material.SNOW: (
            constitutive.lame(p.snow_modulus, p.snow_poisson),
            p.snow_hardening_max,
        ),
        Material.ROPE: (constitutive.lame(p.rope_modulus, p.rope_poisson), 1.0),
    }
    moduli = {
        material: factor * (la + 2.0 * mu)
        for material, ((mu, la), factor) in solids.items()
    }
    moduli[Material.LIQUID] = p.liquid_modulus
    return {
        material: float(np.sqrt(modulus / p.density)) * p.dt * p.grid
        for material, modulus in moduli.items()
    }


@dataclass(frozen=True, kw_only=True)
class Energy:
    """Energy of each scenario [mass length^2/s^2], arrays of shape [scenario]."""

    # sum m (abs(v)^2 + dx^2/4 abs(C)^2) / 2; the second part is what APIC carries
    kinetic: Array
    gravitational: Array  # sum m g (y - y_floor)
    # sum V psi: K (J - 1 - ln J) in liquid, mu abs(F - R)^2 + lambda/2 (J - 1)^2, times
    # the hardening, in solids
    elastic: Array

    @property
    def total(self) -> Array:
        """Sum of the three."""
        return self.kinetic + self.gravitational + self.elastic


class FreeSurface(Driver[FreeSurfaceParameters]):
    """Solver for scenarios that share :class:`FreeSurfaceParameters`; see
    :class:`.Solver`.
    """

    _kernels: ParticleStress

    def _compile(self, atomic: bool, threads: int) -> ParticleStress:
        return ParticleStress(
            self.parameters, scenarios=self.scenarios, atomic=atomic, threads=threads
        )

    def _start(self, states: Sequence[InitialState]) -> None:
        p = self.parameters
        k = self._kernels
        self._material = stack(states, "material").astype(np.int32)
        k.solid = bool((self._material != Material.LIQUID).any())
        matter = np.zeros((self.scenarios, p.particles, 4), np.float32)
        matter[:, :, 0] = self._material
        matter[:, :, 1] = 1.0
        k.matter.from_numpy(matter)
        shape = (self.scenarios, p.particles, 2, 2)
        k.f.from_numpy(np.broadcast_to(np.eye(2, dtype=np.float32), shape).copy())
        k.friction.from_numpy(
            np.array([state.friction for state in states], np.float32)
        )

    def affine(self) -> NDArray[np.float32]:
        """APIC matrices C = grad v [1/s], shape [scenario, particle, 2, 2]."""
        slopes = [
            field.to_numpy()[..., :2]
            for field in (self._kernels.slope_x, self._kernels.slope_y)
        ]
        return np.stack(slopes, axis=-1)

    def deformation(self) -> NDArray[np.float32]:
        """Deformation gradients F, elastic in snow, I in liquid [1], shape [scenario,
        particle, 2, 2].
        """
        return np.asarray(self._kernels.f.to_numpy())

    def volume_ratio(self) -> NDArray[np.float32]:
        """J of liquid, plastic Jp of snow, 1 in other solids [1], shape [scenario,
        particle].
        """
        return np.asarray(self._kernels.matter.to_numpy()[..., 1])

    def jacobian(self) -> NDArray[np.float32]:
        """J of liquid, det F of solids (elastic in snow) [1], shape [scenario,
        particle].
        """
        f = self.deformation()
        determinant = f[..., 0, 0] * f[..., 1, 1] - f[..., 0, 1] * f[..., 1, 0]
        return np.where(
            self._material == Material.LIQUID, self.volume_ratio(), determinant
        )

    def energy(self) -> Energy:
        """Return the energy of each scenario, in float64 from the particles."""
        p = self.parameters
        k = self._kernels
        # psi [mass/s^2], shape [scenario, particle]
        f = self.deformation().astype(np.float64)
        ratio = self.volume_ratio().astype(np.float64)
        a = f[..., 0, 0]
        b = f[..., 0, 1]
        c = f[..., 1, 0]
        d = f[..., 1, 1]
        # abs(F - R)^2 = abs(F)^2 - 2 tr(R^T F) + 2, and tr(R^T F) is twice the mean
        # stretch.
        shear = a * a + b * b + c * c + d * d - 2.0 * np.hypot(a + d, c - b) + 2.0
        bulk = 0.5 * (a * d - b * c - 1.0) ** 2
        factor = np.clip(
            np.exp(p.snow_hardening * (1.0 - ratio)),
            p.snow_hardening_min,
            p.snow_hardening_max,
        )
        density = p.liquid_modulus * (ratio - 1.0 - np.log(ratio))
        moduli = {Material.JELLY: k.jelly, Material.ROPE: k.rope, Material.SNOW: k.snow}
        for material, (mu, la) in moduli.items():
            psi = (mu * shear + la * bulk) * (
                factor if material is Material.SNOW else 1.0
            )
            density = np.where(self._material == material, psi, density)
        height = self.position()[..., 1].astype(np.float64) - k.least
        square = (self.velocity().astype(np.float64) ** 2).sum(axis=-1)
        spin = (self.affine().astype(np.float64) ** 2).sum(axis=(-2, -1)) / (
            4.0 * p.grid**2
        )
        mass = p.density * self._volume
        return Energy(
            kinetic=0.5 * mass * (square + spin).sum(axis=-1),
            gravitational=p.gravity * mass * height.sum(axis=-1),
            elastic=self._volume * density.sum(axis=-1),
        )

    def health(self) -> list[Health]:
        """Return what each scenario went through during the last advance."""
        extremes = self._read(self._kernels.extremes)
        self._reach = extremes[:, :, 3].max(axis=1)
        # The kernels keep a huge number where they saw something that is none.
        extremes = np.where(np.abs(extremes) < _LARGEST, extremes, np.nan)
        return [
            Health(
                finite=bool(np.isfinite(seen).all()),
                max_speed=float(seen[:, 0].max()),
                jacobian_min=float(seen[:, 1].min()),
                jacobian_max=float(seen[:, 2].max()),
            )
            for seen in extremes
        ]

    def _broken(self, index: int, health: Health) -> dict[str, str]:
        reach = self._reach[index]
        bound = self._kernels.reach_bound
        what = "abs(v) + abs(A o)"
        left = bound < reach < _LARGEST
        return (
            {}
            if not left
            else {f"fixed-point sums: {what} <= {bound:.6g}": f"{what} = {reach:.6g}"}
        )
