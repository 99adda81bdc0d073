"""What a split hands to the solver: parameters, initial state, wall motion.

NumPy only: a split can be drawn, inspected and tested without Taichi.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from lagbench.data.registry import Size

__all__ = [
    "WALLS",
    "ClosedBoxParameters",
    "FreeSurfaceParameters",
    "InitialState",
    "Material",
    "Split",
]


WALLS = ("left", "right", "bottom", "top")
"""Order of the walls wherever an array has a wall axis."""


class Material(enum.IntEnum):
    """Constitutive model of a particle; the values are the CF ``flag_values`` of the files."""

    LIQUID = 0
    JELLY = 1
    SNOW = 2
    ROPE = 3


@dataclass(frozen=True, kw_only=True)
class ClosedBoxParameters:
    """Constants of the weakly compressible, nodal-stress solver (design 4.3).

    The walls lie half-way between nodes, at ``(wall + 1/2) / grid`` and its mirror image.

    Attributes:
        particles: particles in one scenario.
        grid: cells across the unit box; the grid has ``grid + 1`` nodes a side.
        dt: substep [s].
        wall: index of the ghost node layer outside the low walls.
        no_slip: whether the walls hold the fluid (cavity) or let it slide (curl noise).
        density: rest density rho [mass/length^2].
        modulus: bulk modulus E [mass/s^2]; the speed of sound is sqrt(E/rho).
        velocity_relaxation: lambda, share of the grid velocity mixed into v_p per substep [1].
        jacobian_relaxation: kappa, share of the nodal J mixed into J_p per substep [1].
        density_coupling: theta, pull of J_p towards the grid density per substep [1].
        shift: beta, strength of the particle shift [1].
    """

    particles: int
    grid: int
    dt: float
    wall: int
    no_slip: bool
    density: float
    modulus: float
    velocity_relaxation: float
    jacobian_relaxation: float
    density_coupling: float
    shift: float


@dataclass(frozen=True, kw_only=True)
class FreeSurfaceParameters:
    """Constants of the MLS-MPM solver for liquid, jelly, snow and rope (design 4.4).

    The walls are free-slip and lie on node ``wall`` and its mirror image.

    Attributes:
        particles: particles in one scenario.
        grid: cells across the unit box; the grid has ``grid + 1`` nodes a side.
        dt: substep [s].
        wall: index of the wall node at the low sides.
        gravity: downward acceleration g [length/s^2].
        density: rest density rho of every material [mass/length^2].
        liquid_modulus: bulk modulus K of the liquid [mass/s^2].
        liquid_viscosity: kinematic viscosity nu of the liquid [length^2/s].
        jacobian_relaxation: kappa, share of the nodal J mixed into J_p per substep [1].
        density_coupling: theta, pull of J_p towards the grid density per substep [1].
        jacobian_min: lower bound of the liquid's J [1].
        jacobian_max: upper bound of the liquid's J [1].
        jelly_modulus: Young's modulus of jelly [mass/s^2].
        jelly_poisson: Poisson's ratio of jelly [1].
        rope_modulus: Young's modulus of rope [mass/s^2].
        rope_poisson: Poisson's ratio of rope [1].
        elastic_damping: kinematic damping eta of jelly and rope [length^2/s].
        snow_modulus: Young's modulus of snow [mass/s^2].
        snow_poisson: Poisson's ratio of snow [1].
        snow_compression: critical compression theta_c (Stomakhin 2013) [1].
        snow_stretch: critical stretch theta_s (Stomakhin 2013) [1].
        snow_hardening: hardening exponent xi in exp(xi (1 - Jp)) [1].
        snow_hardening_min: lower cap of the hardening factor [1].
        snow_hardening_max: upper cap of the hardening factor [1].
        snow_jp_min: lower bound of the plastic Jacobian Jp [1].
        snow_jp_max: upper bound of the plastic Jacobian Jp [1].
    """

    particles: int
    grid: int
    dt: float
    wall: int
    gravity: float
    density: float
    liquid_modulus: float
    liquid_viscosity: float
    jacobian_relaxation: float
    density_coupling: float
    jacobian_min: float
    jacobian_max: float
    jelly_modulus: float = 30.0
    jelly_poisson: float = 0.3
    rope_modulus: float = 100.0
    rope_poisson: float = 0.3
    elastic_damping: float = 0.002
    snow_modulus: float = 40.0
    snow_poisson: float = 0.2
    snow_compression: float = 2.5e-2
    snow_stretch: float = 4.5e-3
    snow_hardening: float = 10.0
    snow_hardening_min: float = 0.05
    snow_hardening_max: float = 5.0
    snow_jp_min: float = 0.3
    snow_jp_max: float = 4.0


@dataclass(frozen=True, kw_only=True)
class InitialState:
    """One scenario before its first substep.

    Arrays are float64 multiples of 2^-20 (exact in float32), see ``draws.quantise``.

    Attributes:
        position: particle positions [length], shape [particle, 2].
        velocity: particle velocities [length/s], shape [particle, 2].
        affine: APIC matrix C = grad v [1/s], shape [particle, 2, 2].
        material: :class:`Material` of each particle, shape [particle], int8.
        area: area that the material covers [length^2]; particle volume is area / particles.
        viscosity: kinematic viscosity nu of a closed box [length^2/s]; free surfaces ignore it.
        wall_velocity: velocity of each wall in the order of :data:`WALLS` [length/s], shape [4, 2].
        friction: Coulomb friction of the walls (free surface only) [1].
        start_substep: substeps simulated before frame 0 is recorded.
        parameters: what was drawn for this scenario; stored as attributes and hashed.
    """

    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    affine: NDArray[np.float64]
    material: NDArray[np.int8]
    area: float
    viscosity: float = 0.0
    wall_velocity: NDArray[np.float64] = field(default_factory=lambda: np.zeros((4, 2)))
    friction: float = 0.0
    start_substep: int = 0
    parameters: Mapping[str, int | float | str] = field(default_factory=dict)


class Split(Protocol):
    """What an entry point of the group ``lagbench.generators`` must name: a split.

    A module with these two functions is one.
    """

    def solver_parameters(self, size: Size) -> ClosedBoxParameters | FreeSurfaceParameters:
        """Return the constants of the solver at this size."""

    def initial_state(self, size: Size, scenario: int, rng: np.random.Generator) -> InitialState:
        """Draw one scenario; only ``rng.random`` may be used."""
