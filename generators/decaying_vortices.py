"""Decaying vortices: two-dimensional flow in a periodic square, stirred once.

The initial velocity is the rotated gradient of one stream function, u = dpsi/dy, v =
-dpsi/dx, where psi is gradient noise on a lattice of F x F cells that is wrapped around
the square (:mod:`.periodic_noise`). F goes by id. The flow is scaled to a drawn root
mean square speed U; the viscosity is U L / Re, with L = 1 the side of the square.

Expected behaviour: vortices of one sign merge, energy moves to larger scales and decays
as exp(-2 nu k^2 t) of the scale that is left. The total momentum stays zero.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lagbench.errors import UsageError

from .constants import constants, draw_between, interval
from .draws import RandomSource, log_uniform
from .full_box_parameters import FullBoxParameters
from .periodic_noise import (
    Flow,
    draw_lattice,
    fill_box,
    noise,
    rotated_gradient,
    scaled_to,
)
from .split import InitialState, liquid

if TYPE_CHECKING:
    from lagbench.data.registry import Size

__all__ = ["initial_state", "particles_per_side", "solver_parameters"]


def solver_parameters(size: Size) -> FullBoxParameters:
    """Return the solver's constants at this size; no axis has walls."""
    return constants(FullBoxParameters, size, box=size.box, no_slip=False)


def particles_per_side(size: Size) -> int:
    """Return the particles along each axis of the initial lattice.

    Raises:
        UsageError: the particles fill no square, or cube, lattice.
    """
    dimension = size.box.dimension
    side = int(size.value("lattice"))
    if side**dimension != size.particles:
        raise UsageError(
            f"the lattice does not hold the particles: got {side**dimension}, "
            f"expected lattice to the power {dimension} = particles = "
            f"{size.particles}; correct the number of particles in the file of the "
            "split",
            where=f"datasets.yaml, {size.split} {size.name}",
        )
    return side


def kinetic_energy(flow: Flow) -> float:
    """Return half of the mean square speed [length^2/s^2]."""
    return 0.5 * flow.speed_rms * flow.speed_rms


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw a lattice of particles and the stream function that sets them moving."""
    side = particles_per_side(size)
    box = size.box
    position = fill_box(
        rng,
        (side, side),
        low=box.low,
        high=box.high,
        jitter=size.value("jitter"),
        subdivision=size.subdivision,
    )
    count = size.value("frequency_count")
    frequency = size.value("frequency_min") + scenario % count
    psi = noise(position, draw_lattice(rng, frequency, 2))
    speed = draw_between(rng, size, "speed")
    flow = scaled_to(rotated_gradient(psi), speed)
    reynolds = log_uniform(rng, *interval(size, "reynolds"))
    viscosity = speed / reynolds
    return InitialState(
        position=position,
        velocity=flow.velocity,
        affine=flow.affine,
        material=liquid(size.particles),
        area=box.volume,
        viscosity=viscosity,
        parameters={
            "frequency": frequency,
            "speed_rms": speed,
            "reynolds": reynolds,
            "viscosity": viscosity,
            "initial_kinetic_energy": kinetic_energy(flow),
        },
    )
