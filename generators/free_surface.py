"""Liquid, jelly, snow and rope with a free surface, in the plane or in a cube.

The equations stand in :mod:`.particle_stress`, the stresses in :mod:`.constitutive` and
:mod:`.constitutive_3d`. The walls lie on node ``wall`` and its mirror image along each
axis; the fluid slides along them or is braked by friction. Gravity acts along the
second axis.

The solver is valid while no particle crosses more than a cell per substep, max abs(v)
dt <= dx (checked), and while sound does not either: keep every value of :func:`courant`
below 0.8. It explodes beyond. Settings that work over thousands of frames are those of
the splits.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import UsageError

from .driver import Driver, Field, stack
from .free_surface_kernels import FreeSurfaceKernels
from .particle_stress import ParticleStress
from .particle_stress_3d import ParticleStress3D
from .solver import Health, Singles
from .soundness import sound_speeds
from .split import FreeSurfaceParameters, InitialState, Material

Array = NDArray[np.float64]

_LARGEST = 1e30  # extremes beyond this stand for what is not a number


def _exact(values: Singles) -> Array:
    return values.astype(np.float64)


def courant(parameters: FreeSurfaceParameters) -> dict[Material, float]:
    """Return the acoustic Courant number c dt / dx of each material at rest [1].

    c^2 is K/rho in liquid and (lambda + 2 mu)/rho in solids, for snow at its hardest.
    """
    p = parameters
    numbers = {}
    for material, sound_speed in sound_speeds(p).items():
        numbers[material] = sound_speed * p.dt * p.grid
    numbers[Material.SNOW] *= math.sqrt(p.snow_hardening_max)
    return numbers


@dataclass(frozen=True, kw_only=True)
class Energy:
    """Energy of each scenario [mass length^2/s^2], arrays of shape [scenario]."""

    # sum m (abs(v)^2 + dx^2/4 abs(C)^2) / 2; the second part is what APIC carries
    kinetic: Array
    gravitational: Array  # sum m g (y - y_floor)
    # sum V psi: K (J - 1 - ln J) in liquid, mu abs(F - R)^2 + lambda/2 (J - 1)^2 in
    # solids, times the hardening in snow
    elastic: Array

    @property
    def total(self) -> Array:
        """Sum of the three."""
        return self.kinetic + self.gravitational + self.elastic


class FreeSurface(Driver[FreeSurfaceParameters]):
    """Solver of a free surface in the plane or in a cube.

    Its methods are those of :class:`.Solver`.
    """

    _kernels: FreeSurfaceKernels

    @property
    def dimension(self) -> int:
        """Number of axes: 2 or 3."""
        return self.parameters.dimension

    def _compile(self, atomic: bool, threads: int) -> FreeSurfaceKernels:
        kernels = ParticleStress if self.dimension == 2 else ParticleStress3D
        return kernels(
            self.parameters, scenarios=self.scenarios, atomic=atomic, threads=threads
        )

    def deformation(self) -> Singles:
        """Deformation gradients F, elastic in snow, I in liquid [1], shape [scenario,
        particle, axis, axis].
        """
        return self._matrices(self._kernels.deformation_columns)

    def affine(self) -> Singles:
        """APIC matrices C = grad v [1/s], shape [scenario, particle, axis, axis]."""
        return self._matrices(self._kernels.slopes)

    def _matrices(self, fields: Sequence[Field]) -> Singles:
        """Return matrices from the fields of their columns."""
        columns = [field.to_numpy()[..., : self.dimension] for field in fields]
        return np.stack(columns, axis=-1)

    def _check_state(self, index: int, state: InitialState) -> None:
        super()._check_state(index, state)
        has_walls = np.any(state.wall_velocity)
        has_others = (state.body_force, state.obstacle, state.stream) != (None,) * 3
        if state.viscosity != 0.0 or has_walls or has_others:
            raise UsageError(
                "a free surface knows no viscosity of a scenario, no moving wall, "
                "body force, obstacle or stream; leave them out of the initial state",
                where=self.names[index],
            )

    def _start(self, states: Sequence[InitialState]) -> None:
        kernels = self._kernels
        # Material of each particle, shape [scenario, particle]
        self._material = stack(states, "material").astype(np.int32)
        kernels.sort_by_material(self._material)

        shape = (self.scenarios, self.parameters.particles, 4)
        matter = np.ones(shape, np.float32)
        matter[..., 0] = self._material
        kernels.matter.from_numpy(matter)
        # F is the identity
        for axis, field in enumerate(kernels.deformation_columns):
            column = np.zeros(shape, np.float32)
            column[..., axis] = 1.0
            field.from_numpy(column)
        friction = np.array([state.friction for state in states], np.float32)
        kernels.friction.from_numpy(friction)

    def health(self) -> list[Health]:
        """Return what each scenario went through during the last advance.

        Before the first one these are the extremes of the loaded state.
        """
        extremes = self._read(self._kernels.extremes)
        # largest abs(v) + abs(A o) of each scenario
        self._reach = extremes[..., 3].max(axis=1)
        # The kernels keep a huge number where they saw something that is none.
        extremes = np.where(np.abs(extremes) < _LARGEST, extremes, np.nan)
        healths = []
        for extreme in extremes:
            speed, jacobian_min, jacobian_max, _ = extreme.T
            health = Health(
                finite=bool(np.isfinite(extreme).all()),
                max_speed=float(speed.max()),
                jacobian_min=float(jacobian_min.min()),
                jacobian_max=float(jacobian_max.max()),
            )
            healths.append(health)
        return healths

    def _broken_bounds(self, index: int, health: Health) -> dict[str, str]:
        reach = self._reach[index]
        bound = self._kernels.reach_bound
        quantity = "abs(v) + abs(A o)"
        if bound < reach < _LARGEST:
            name = f"fixed-point sums: {quantity} <= {bound:.6g}"
            return {name: f"{quantity} = {reach:.6g}"}
        return {}

    def volume_ratio(self) -> Singles:
        """J of liquid, plastic Jp of snow, 1 in other solids [1], shape [scenario,
        particle].
        """
        return self._read(self._kernels.matter)[..., 1]

    def volume_ratio_extremes(self) -> tuple[Singles, Singles]:
        """Smallest and largest :meth:`volume_ratio` of each particle at any substep
        since the start [1], each of shape [scenario, particle].
        """
        matter = self._read(self._kernels.matter)
        return matter[..., 2], matter[..., 3]

    def jacobian(self) -> Singles:
        """J of liquid, det F of solids (elastic in snow) [1], shape [scenario,
        particle].
        """
        determinant = np.linalg.det(self.deformation())
        ratio = self.volume_ratio()
        return np.where(self._material == Material.LIQUID, ratio, determinant)

    def energy(self) -> Energy:
        """Return the energy of each scenario, in float64 from the particles."""
        p = self.parameters
        mass = p.density * self._volume  # of a particle, shape [scenario]
        weight = p.gravity * mass
        position = _exact(self.position())
        velocity = _exact(self.velocity())
        affine = _exact(self.affine())

        # abs(v)^2 + dx^2/4 abs(C)^2 of each particle, shape [scenario, particle]
        velocity_square = np.square(velocity).sum(axis=-1)
        affine_square = np.square(affine).sum(axis=(-2, -1))
        motion = velocity_square + affine_square / (4.0 * p.grid**2)
        kinetic = 0.5 * mass * motion.sum(axis=-1)

        height = position[..., 1] - self._kernels.position_min
        gravitational = weight * height.sum(axis=-1)
        elastic = self._volume * self._elastic_density().sum(axis=-1)
        return Energy(
            kinetic=kinetic,
            gravitational=gravitational,
            elastic=elastic,
        )

    def _elastic_density(self) -> Array:
        """Return psi of each particle [mass/s^2], shape [scenario, particle]."""
        p = self.parameters
        kernels = self._kernels
        f = _exact(self.deformation())
        ratio = _exact(self.volume_ratio())
        # abs(F - R)^2 is the sum of (stretch - 1)^2; where F inverts, the least stretch
        # is negative.
        stretches = np.linalg.svd(f, compute_uv=False)
        jacobian = np.linalg.det(f)
        stretches[..., -1] *= np.sign(jacobian)
        shear = np.square(stretches - 1.0).sum(axis=-1)
        bulk = 0.5 * (jacobian - 1.0) ** 2

        hardening = np.clip(
            np.exp(p.snow_hardening * (1.0 - ratio)),
            p.snow_hardening_min,
            p.snow_hardening_max,
        )

        density = p.liquid_modulus * (ratio - 1.0 - np.log(ratio))
        moduli = {
            Material.JELLY: kernels.jelly,
            Material.ROPE: kernels.rope,
            Material.SNOW: kernels.snow,
        }
        for material, (mu, la) in moduli.items():
            psi = mu * shear + la * bulk
            if material is Material.SNOW:
                psi = psi * hardening
            density = np.where(self._material == material, psi, density)
        return np.asarray(density)
