"""Liquid, jelly, snow and rope with a free surface: fluid and multimaterial.

The equations stand in :mod:`.particle_stress`, the stresses in :mod:`.constitutive`.
The walls lie on node ``wall`` and its mirror image; the fluid slides along them or is
braked by friction.

The solver is valid while no particle crosses more than a cell per substep, max abs(v)
dt <= dx (checked), and while sound does not either: keep every value of :func:`courant`
below 0.8. It explodes beyond. Settings that work over thousands of frames are those of
the splits.
"""

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import UsageError

from .driver import Driver, stack
from .free_surface_kernels import FreeSurfaceKernels
from .particle_stress import ParticleStress
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
        fastest = sound_speed
        if material is Material.SNOW:
            fastest = sound_speed * math.sqrt(p.snow_hardening_max)
        numbers[material] = fastest * p.dt * p.grid
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


class FreeSurfaceDriver(Driver[FreeSurfaceParameters]):
    """What solvers of free surfaces share in the plane and in space."""

    _kernels: FreeSurfaceKernels

    @abstractmethod
    def deformation(self) -> Singles:
        """Deformation gradients F, elastic in snow, I in liquid [1], shape [scenario,
        particle, axis, axis].
        """

    @abstractmethod
    def _set_deformation(self, gradients: Singles) -> None:
        """Fill the field of F, shape [scenario, particle, axis, axis]."""

    def _check_state(self, index: int, state: InitialState) -> None:
        super()._check_state(index, state)
        has_walls = np.any(state.wall_velocity)
        has_others = (state.body_force, state.obstacle, state.stream) != (None,) * 3
        if state.viscosity != 0.0 or has_walls or has_others:
            raise UsageError(
                "a free surface knows no viscosity of a scenario, no moving wall, "
                "body force, obstacle or stream; leave them out of the initial state",
                where=f"scenario {index}",
            )

    def _start(self, states: Sequence[InitialState]) -> None:
        kernels = self._kernels
        scenarios = self.scenarios
        particles = self.parameters.particles
        # Material of each particle, shape [scenario, particle]
        material = stack(states, "material")
        self._material = material.astype(np.int32)
        kernels.sort_by_material(self._material)

        matter_shape = (scenarios, particles, 4)
        matter = np.ones(matter_shape, np.float32)
        matter[..., 0] = self._material
        kernels.matter.from_numpy(matter)

        dimension = self.dimension
        identity = np.eye(dimension, dtype=np.float32)
        gradient_shape = (scenarios, particles, dimension, dimension)
        gradients = np.empty(gradient_shape, np.float32)
        gradients[...] = identity
        self._set_deformation(gradients)

        frictions = [state.friction for state in states]
        friction = np.array(frictions, np.float32)
        kernels.friction.from_numpy(friction)

    def health(self) -> list[Health]:
        """Return what each scenario went through during the last advance.

        Before the first one these are the extremes of the loaded state.
        """
        extremes = self._read(self._kernels.extremes)
        # largest abs(v) + abs(A o) of each scenario
        reach = extremes[..., 3]
        self._reach = reach.max(axis=1)
        # The kernels keep a huge number where they saw something that is none.
        extremes = np.where(np.abs(extremes) < _LARGEST, extremes, np.nan)
        healths = []
        for extreme in extremes:
            speed, jacobian_min, jacobian_max, _ = extreme.T
            all_finite = np.isfinite(extreme).all()
            fastest = speed.max()
            least_jacobian = jacobian_min.min()
            greatest_jacobian = jacobian_max.max()
            health = Health(
                finite=bool(all_finite),
                max_speed=float(fastest),
                jacobian_min=float(least_jacobian),
                jacobian_max=float(greatest_jacobian),
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

    def affine(self) -> Singles:
        """APIC matrices C = grad v [1/s], shape [scenario, particle, axis, axis]."""
        columns = []
        for field in self._kernels.slopes:
            slope = field.to_numpy()
            column = slope[..., : self.dimension]
            columns.append(column)
        return np.stack(columns, axis=-1)

    def volume_ratio(self) -> Singles:
        """J of liquid, plastic Jp of snow, 1 in other solids [1], shape [scenario,
        particle].
        """
        matter = self._read(self._kernels.matter)
        return matter[..., 1]

    def volume_ratio_extremes(
        self,
    ) -> tuple[Singles, Singles]:
        """Smallest and largest :meth:`volume_ratio` of each particle at any substep
        since the start [1], each of shape [scenario, particle].
        """
        matter = self._read(self._kernels.matter)
        least = matter[..., 2]
        greatest = matter[..., 3]
        return least, greatest

    def jacobian(self) -> Singles:
        """J of liquid, det F of solids (elastic in snow) [1], shape [scenario,
        particle].
        """
        deformation = self.deformation()
        determinant = np.linalg.det(deformation)
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
        affine_squares = np.square(affine)
        velocity_square = np.square(velocity).sum(axis=-1)
        affine_square = affine_squares.sum(axis=(-2, -1))
        motion = velocity_square + affine_square / (4.0 * p.grid**2)
        kinetic = 0.5 * mass * motion.sum(axis=-1)

        y = position[..., 1]
        floor = self._kernels.position_min
        gravitational = weight * (y - floor).sum(axis=-1)

        elastic_density = self._elastic_density()
        elastic = self._volume * elastic_density.sum(axis=-1)
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

        hardening = np.exp(p.snow_hardening * (1.0 - ratio))
        least_hardening = p.snow_hardening_min
        greatest_hardening = p.snow_hardening_max
        hardening = np.clip(hardening, least_hardening, greatest_hardening)

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


class FreeSurface(FreeSurfaceDriver):
    """Solver of a free surface; its methods are those of :class:`.Solver`."""

    _kernels: ParticleStress

    def _compile(self, atomic: bool, threads: int) -> ParticleStress:
        return ParticleStress(
            self.parameters, scenarios=self.scenarios, atomic=atomic, threads=threads
        )

    def deformation(self) -> Singles:
        """Deformation gradients F, elastic in snow, I in liquid [1], shape [scenario,
        particle, 2, 2].
        """
        return np.asarray(self._kernels.deformation.to_numpy())

    def _set_deformation(self, gradients: Singles) -> None:
        self._kernels.deformation.from_numpy(gradients)
