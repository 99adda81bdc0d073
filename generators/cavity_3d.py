"""Lid-driven cavity in three dimensions: a cube of which one wall or two slide.

Every moving wall follows smooth random programs (:func:`.draw_program`), one along each
of its two axes, of the other sign at each knot. So the direction turns, and a predictor
that keeps the flow frozen fails. The id decides which walls move: every subset of mini
holds all six choices alike. Two walls that move lie opposite, because two that meet at
an edge would tear the fluid there. The Reynolds number is (U/2) L / nu: U/2 is the mean
absolute speed along an axis at the knots of a program (over time it is about 0.35 U).
L = 1 is the side of the cube.

Where a sliding wall meets the wall beside it the velocity jumps and the pressure of an
incompressible fluid has no bound. There J departs from 1 by an amount that goes with
the square of the Mach number and, at small Reynolds numbers, with nu U / (dx c^2). The
speed of sound is therefore about twice that of the other full boxes.

Expected behaviour: vortices grow from the moving walls, end at the walls beside them,
where the fluid turns back, and turn with the walls; the flow never settles.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import WALL_NAMES

from .constants import constants, interval, start_frame
from .decaying_vortices import particles_per_side
from .draws import RandomSource, draw_program, log_uniform
from .full_box_parameters import FullBoxParameters
from .periodic_noise import fill_box
from .split import InitialState, liquid

if TYPE_CHECKING:
    from lagbench.data.registry import Size

__all__ = ["DRIVEN", "initial_state", "solver_parameters", "start_frame"]

DRIVEN = (
    ("top",),
    ("left",),
    ("back",),
    ("bottom", "top"),
    ("left", "right"),
    ("front", "back"),
)
"""The walls that move, by id % 6: six consecutive scenarios hold each choice once."""


def solver_parameters(size: Size) -> FullBoxParameters:
    """Return the solver's constants at this size; walls hold the fluid."""
    return constants(FullBoxParameters, size, box=size.box, no_slip=True)


def _draw_motion(
    rng: RandomSource, size: Size, scenario: int, frame_count: int
) -> NDArray[np.float64]:
    """Draw the velocity of each wall towards each frame [length/s].

    The shape is [frame, wall, axis].
    """
    velocity = np.zeros((frame_count, len(WALL_NAMES), 3))
    for name in DRIVEN[scenario % len(DRIVEN)]:
        wall = WALL_NAMES.index(name)
        for axis in range(3):
            if axis == wall // 2:
                continue  # a wall slides along itself
            velocity[:, wall, axis] = draw_program(
                rng,
                frame_count,
                amplitude=size.value("speed_max"),
                knot_gap=interval(size, "knot_gap"),
            )
    return velocity


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw a fluid at rest and the wall motion that drives it through all frames."""
    start = start_frame(size, scenario, rng)
    motion = _draw_motion(rng, size, scenario, start + size.frame_count(scenario))
    reynolds = log_uniform(rng, *interval(size, "reynolds"))
    viscosity = 0.5 * size.value("speed_max") / reynolds
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
    return InitialState(
        position=position,
        velocity=np.zeros((size.particles, 3)),
        affine=np.zeros((size.particles, 3, 3)),
        material=liquid(size.particles),
        area=box.volume,
        viscosity=viscosity,
        wall_velocity=motion,
        start_frame=start,
        parameters={
            "wall": "+".join(DRIVEN[scenario % len(DRIVEN)]),
            "reynolds": reynolds,
            "viscosity": viscosity,
        },
    )
