"""What a split hands to the solver: parameters, initial state, wall motion.

NumPy only: a split can be drawn, inspected and tested without Taichi.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .full_box_parameters import FullBoxParameters
from .obstacle import Obstacle

if TYPE_CHECKING:
    from lagbench.data.registry import Size

__all__ = [
    "Device",
    "FreeSurfaceParameters",
    "InitialState",
    "Material",
    "SolverParameters",
    "SplitGenerator",
    "liquid",
]


class Device(enum.StrEnum):
    """Where and how the substeps run. CUDA gives other bits than the other two."""

    # one scenario, a whole frame of substeps in one serial kernel without atomics
    CPU = "cpu"
    # the GPU's kernels (scenarios x particles, atomics) on Taichi's CPU threads
    PARALLEL = "parallel"
    CUDA = "cuda"  # the same kernels on an NVIDIA GPU


class Material(enum.IntEnum):
    """Constitutive model of a particle.

    The values are the CF ``flag_values`` of the files.
    """

    LIQUID = 0
    JELLY = 1
    SNOW = 2
    ROPE = 3


@dataclass(frozen=True, kw_only=True)
class FreeSurfaceParameters:
    """Constants of the MLS-MPM solver for liquid, jelly, snow and rope.

    The equations stand in :mod:`.particle_stress`. The walls are free-slip and lie on
    node ``wall`` and its mirror image. In a cube, densities are per length^3 and moduli
    in mass/(length s^2).
    """

    particles: int  # particles in one scenario
    dimension: int = 2  # number of axes: 2 or 3
    grid: int  # cells across the unit box; the grid has grid + 1 nodes a side
    dt: float  # substep [s]
    wall: int  # index of the wall node at the low sides
    gravity: float  # downward acceleration g [length/s^2]
    density: float  # rest density rho of every material [mass/length^2]
    liquid_modulus: float  # bulk modulus K of the liquid [mass/s^2]
    liquid_viscosity: float  # kinematic viscosity nu of the liquid [length^2/s]
    # kappa, share of the nodal J mixed into J_p per substep [1]
    jacobian_relaxation: float
    # theta, pull of J_p towards the grid density per substep [1]
    density_coupling: float
    jacobian_min: float  # lower bound of the liquid's J [1]
    jacobian_max: float  # upper bound of the liquid's J [1]
    jelly_modulus: float = 30.0  # Young's modulus of jelly [mass/s^2]
    jelly_poisson: float = 0.3  # Poisson's ratio of jelly [1]
    rope_modulus: float = 100.0  # Young's modulus of rope [mass/s^2]
    rope_poisson: float = 0.3  # Poisson's ratio of rope [1]
    # kinematic damping eta of jelly and rope [length^2/s]
    elastic_damping: float = 0.002
    snow_modulus: float = 40.0  # Young's modulus of snow [mass/s^2]
    snow_poisson: float = 0.2  # Poisson's ratio of snow [1]
    # critical compression theta_c (Stomakhin 2013) [1]
    snow_compression: float = 2.5e-2
    snow_stretch: float = 4.5e-3  # critical stretch theta_s (Stomakhin 2013) [1]
    snow_hardening: float = 10.0  # hardening exponent xi in exp(xi (1 - Jp)) [1]
    snow_hardening_min: float = 0.05  # lower cap of the hardening factor [1]
    snow_hardening_max: float = 5.0  # upper cap of the hardening factor [1]
    snow_jp_min: float = 0.3  # lower bound of the plastic Jacobian Jp [1]
    snow_jp_max: float = 4.0  # upper bound of the plastic Jacobian Jp [1]


SolverParameters: TypeAlias = FreeSurfaceParameters | FullBoxParameters
"""Constants of a solver; their type chooses the formulation."""


@dataclass(frozen=True, kw_only=True)
class InitialState:
    """One scenario before its first substep.

    Arrays are float64 multiples of 2^-20 (exact in float32), see ``draws.quantise``.
    """

    # particle positions [length], shape [particle, axis]
    position: NDArray[np.float64]
    # particle velocities [length/s], shape [particle, axis]
    velocity: NDArray[np.float64]
    # APIC matrix C = grad v [1/s], shape [particle, axis, axis]
    affine: NDArray[np.float64]
    material: NDArray[np.int8]  # Material of each particle, shape [particle], int8
    # area that the material covers [length^2], or its volume in a solid box
    # [length^3]; particle volume is area / particles
    area: float
    # kinematic viscosity nu of a full box [length^2/s]; 0 on a free surface, whose
    # constants state that of its liquid
    viscosity: float = 0.0
    # velocity of each wall in the order of WALLS [length/s], shape [4, 2], or a program
    # of shape [frame, 4, 2]: row f acts from frame f-1 to f, counted from the first
    # substep; row 0 never acts, the last row acts from its frame on. In a solid box
    # there are six walls and three axes. Zeros on a free surface.
    wall_velocity: NDArray[np.float64] = field(default_factory=lambda: np.zeros((4, 2)))
    # acceleration of layers of equal height along y [length/s^2], lowest first, a
    # program of shape [frame, layer, axis] whose rows act as those of the walls; in a
    # full box whose parameters count its layers
    body_force: NDArray[np.float64] | None = None
    # a disc or ball that never moves, in a full box whose parameters count its
    # particles
    obstacle: Obstacle | None = None
    # velocity to which the fringe of a full box draws the fluid [length/s], shape
    # [axis]
    stream: NDArray[np.float64] | None = None
    friction: float = 0.0  # Coulomb friction of the walls (free surface only) [1]
    start_frame: int = 0  # frames simulated before frame 0 is recorded
    # what was drawn for this scenario; stored as attributes and hashed
    parameters: Mapping[str, int | float | str] = field(default_factory=dict)

    def force_towards(self, frame: int) -> NDArray[np.float64]:
        """Return the acceleration that acts on the way to a frame [length/s^2].

        The shape is [layer, axis]; without a force there are no layers. After the end
        of the program its last row acts.
        """
        program = self.body_force
        if program is None:
            return np.zeros((0, self.position.shape[1]))
        row: NDArray[np.float64] = program[min(frame, len(program) - 1)]
        return row

    def walls_towards(self, frame: int) -> NDArray[np.float64]:
        """Return the velocity of each wall from the frame before up to this one
        [length/s], shape [4, 2], or [6, 3] in a solid box.
        """
        program = self.wall_velocity
        if program.ndim == 2:
            return program
        row: NDArray[np.float64] = program[min(frame, len(program) - 1)]
        return row


def liquid(particle_count: int) -> NDArray[np.int8]:
    """Return the material of particles that are all liquid, shape [particle]."""
    return np.full(particle_count, Material.LIQUID, dtype=np.int8)


class SplitGenerator(Protocol):
    """What an entry point of the group ``lagbench.generators`` must name: a split.

    A module with these two functions is one. A split whose scenarios are simulated for
    a while before frame 0 is recorded also has a third,
    ``start_frame(size, scenario, rng) -> int``. It returns the ``start_frame`` of the
    initial state from the same random stream, so that work is planned without a draw.
    """

    def solver_parameters(self, size: Size) -> SolverParameters:
        """Return the constants of the solver at this size."""

    def initial_state(
        self, size: Size, scenario: int, rng: np.random.Generator
    ) -> InitialState:
        """Draw one scenario; only ``rng.random`` may be used."""
