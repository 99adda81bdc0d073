"""Decaying curl noise in a periodic cube, and vortex rings among the scenarios.

The initial velocity is the curl of a vector potential A. In three scenarios of four
each component of A is gradient noise on a lattice of F^3 cells that is wrapped around
the cube (:mod:`.periodic_noise`; Bridson 2007). In the fourth A is a sum of rings: for
a ring of centre c, axis n and radius R, with r the way from c to a point,

    A = s (1 - q)^4 (n x r),   q = |r|^2 / R^2,   0 where q > 1.

Its vorticity is a torus around the axis, which travels along n. The flow is scaled to a
drawn root mean square speed U; the viscosity is U L / Re, with L = 1 the side of the
cube.

Expected behaviour: vortices stretch and tilt, energy moves to smaller scales and decays
faster than in two dimensions; rings meet, and break where they do.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .constants import constants, draw_between, interval
from .decaying_vortices import kinetic_energy, particles_per_side
from .draws import RandomSource, draw_direction, log_uniform
from .full_box_parameters import FullBoxParameters
from .periodic_noise import (
    Flow,
    Smooth,
    coordinate,
    curl,
    draw_lattice,
    fill_box,
    noise,
    scaled_to,
    wrapped_offset,
    zero,
)
from .split import InitialState, liquid

if TYPE_CHECKING:
    from lagbench.data.registry import Size

__all__ = [
    "draw_noise",
    "draw_rings",
    "has_rings",
    "initial_state",
    "ring_potential",
    "solver_parameters",
]

Array = NDArray[np.float64]


def solver_parameters(size: Size) -> FullBoxParameters:
    """Return the solver's constants at this size; no axis has walls."""
    return constants(FullBoxParameters, size, box=size.box, no_slip=False)


def has_rings(scenario: int) -> bool:
    """Tell whether a scenario begins with vortex rings: one in four does."""
    return scenario % 4 == 3


def ring_potential(
    position: Array, *, centre: Array, normal: Sequence[float], radius: float
) -> tuple[Smooth, Smooth, Smooth]:
    """Return the vector potential of a ring, with s = 1.

    Args:
        position: points in the unit cube [length], shape [point, 3].
        centre: centre of the ring [length], shape [3].
        normal: unit vector along the axis, shape [3].
        radius: R, at most half of the cube's side [length].
    """
    offset = wrapped_offset(position, centre)
    x = coordinate(offset[:, 0], 0, 3)
    y = coordinate(offset[:, 1], 1, 3)
    z = coordinate(offset[:, 2], 2, 3)
    square = x * x + y * y + z * z
    one_minus_q = square.scale(-1.0 / (radius * radius)).shift(1.0)
    inside = one_minus_q.only_where(one_minus_q.value > 0.0)
    square_inside = inside * inside
    strength = square_inside * square_inside
    # the cross product of the normal and the way from the centre
    n_x, n_y, n_z = normal
    return (
        strength * (z.scale(n_y) + y.scale(-n_z)),
        strength * (x.scale(n_z) + z.scale(-n_x)),
        strength * (y.scale(n_x) + x.scale(-n_y)),
    )


def draw_rings(size: Size, rng: RandomSource, position: Array) -> Flow:
    """Draw the rings of a scenario."""
    potential = [zero(len(position), 3) for _ in range(3)]
    for _ in range(size.value("ring_count")):
        centre = rng.random((3,))
        normal = draw_direction(rng, 3)
        radius = draw_between(rng, size, "ring_radius")
        ring = ring_potential(position, centre=centre, normal=normal, radius=radius)
        for axis in range(3):
            potential[axis] = potential[axis] + ring[axis]
    return curl(potential)


def draw_noise(rng: RandomSource, position: Array, frequency: int) -> Flow:
    """Draw the vector potential of curl noise."""
    lattices = [draw_lattice(rng, frequency, 3) for _ in range(3)]
    return curl([noise(position, lattice) for lattice in lattices])


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw a lattice of particles and the vector potential that sets them moving."""
    side = particles_per_side(size)
    box = size.box
    position = fill_box(
        rng,
        (side, side, side),
        low=box.low,
        high=box.high,
        jitter=size.value("jitter"),
        subdivision=size.subdivision,
    )
    if has_rings(scenario):
        kind = "rings"
        frequency = 0
        flow = draw_rings(size, rng, position)
        speed = draw_between(rng, size, "ring_speed")
    else:
        kind = "noise"
        count = size.value("frequency_count")
        frequency = size.value("frequency_min") + scenario % count
        flow = draw_noise(rng, position, frequency)
        speed = draw_between(rng, size, "speed")
    flow = scaled_to(flow, speed)
    reynolds = log_uniform(rng, *interval(size, "reynolds"))
    viscosity = speed / reynolds
    return InitialState(
        position=position,
        velocity=flow.velocity,
        affine=flow.affine,
        material=liquid(size.particles),
        area=box.volume,
        viscosity=viscosity,
        wall_velocity=np.zeros((6, 3)),
        parameters={
            "kind": kind,
            "frequency": frequency,
            "speed_rms": speed,
            "reynolds": reynolds,
            "viscosity": viscosity,
            "initial_kinetic_energy": kinetic_energy(flow),
        },
    )
