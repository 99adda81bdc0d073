"""Lid-driven cavity: a full box, one wall or two opposite ones slide (thesis §5.8).

Every moving wall, except those of a belt (see below), follows a program of its own
(:func:`.draw_program`): knots with speeds drawn from [-U, U], of the other sign at each
knot. Without the change of sign half of the walls would slide as before when it
matters, and the frozen flow would do for an answer. One scenario in eight is the
classic: lid at rest, then a constant speed.

Expected behaviour: vortices grow from the moving walls, are cut off where a wall turns
and merge; the flow never settles. The id decides which walls move, so that every subset
holds all six choices alike. Two walls that meet in a corner never move both, because
their corner blows up. The Reynolds number is (U/2) L / nu: U/2 is the mean absolute
speed of a wall at the knots of its program (over time it is about 0.35 U), L the box's
width.

The subset ``shift`` lies outside train on purpose. Its scenarios alternate: a Reynolds
number beyond train's range, then two walls that meet in a corner. These slide as one
belt around the corner, one towards it while the other moves away, so that what the one
brings the other takes along.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lagbench.data import WALLS

from .constants import constants, interval, shift_number, start_frame
from .draws import (
    RandomSource,
    choice,
    draw_integer,
    draw_program,
    fill,
    log_uniform,
    uniform,
)
from .full_box_parameters import FullBoxParameters
from .split import InitialState, liquid

if TYPE_CHECKING:
    from lagbench.data.registry import Size

DRIVEN = (
    ("top",),
    ("bottom",),
    ("left",),
    ("right",),
    ("left", "right"),
    ("bottom", "top"),
)
"""The sets of walls that move, by id % 6: six consecutive scenarios hold each once."""

BELTS = (
    ("left", "bottom"),
    ("bottom", "right"),
    ("right", "top"),
    ("top", "left"),
)
"""The pairs of walls that meet in a corner, in the order of a turn anticlockwise."""

_TURN = {"left": -1.0, "bottom": 1.0, "right": 1.0, "top": -1.0}
"""Sign of a wall's velocity where it slides anticlockwise around the box."""

_TANGENT = {"left": 1, "right": 1, "bottom": 0, "top": 0}


def solver_parameters(size: Size) -> FullBoxParameters:
    """Return the constants of thesis Table 5.2 at this size; walls hold the fluid."""
    return constants(FullBoxParameters, size, box=size.box, no_slip=True)


def is_classic(scenario: int) -> bool:
    """Tell whether the lid starts once and keeps its speed, unless it is a belt.

    One id in eight. All ids with the remainder 7 of 8 are odd and would meet only half
    of :data:`DRIVEN`, so the remainder that is asked for falls by one every 24 ids.
    """
    return (scenario + scenario // 24) % 8 == 7


def _draw_motion(
    rng: RandomSource, size: Size, scenario: int, start: int
) -> NDArray[np.float64]:
    """Draw the velocity of each wall towards each frame [length/s].

    The shape is [frame, wall, 2]; the ``start`` frames before frame 0 are included.
    """
    frame_count = start + size.frame_count(scenario)
    speed_max = size.value("speed_max")
    knot_gap = interval(size, "knot_gap")
    velocity = np.zeros((frame_count, len(WALLS), 2))

    first_moving_frame = 0
    if is_classic(scenario):
        # It moves in the last given frame at the latest, so no predicted frame is at
        # rest. A belt does not use the draw, but without it all later draws would
        # change.
        earliest = start - size.value("lid_lead")
        latest = start + size.task.input_frames - 1
        first_moving_frame = draw_integer(rng, earliest, latest)

    belt = _belt(size, scenario)
    if belt is not None:
        speed = draw_program(rng, frame_count, amplitude=speed_max, knot_gap=knot_gap)
        for wall in belt:
            number = WALLS.index(wall)
            tangent = _TANGENT[wall]
            velocity[:, number, tangent] = _TURN[wall] * speed
        return velocity

    for wall in DRIVEN[scenario % len(DRIVEN)]:
        if is_classic(scenario):
            sign = 2 * choice(rng, 2) - 1
            constant_speed = sign * uniform(rng, 0.5 * speed_max, speed_max)
            is_moving = np.arange(frame_count) >= first_moving_frame
            speed = np.where(is_moving, constant_speed, 0.0)
        else:
            speed = draw_program(
                rng,
                frame_count,
                amplitude=speed_max,
                knot_gap=knot_gap,
            )
        number = WALLS.index(wall)
        tangent = _TANGENT[wall]
        velocity[:, number, tangent] = speed
    return velocity


def _belt(size: Size, scenario: int) -> tuple[str, str] | None:
    """Return the two walls that slide as a belt: every second scenario of shift."""
    number = shift_number(size, scenario)
    if number is None or number % 2 == 0:
        return None
    return BELTS[number // 2 % len(BELTS)]


def _driven_walls(size: Size, scenario: int) -> tuple[str, ...]:
    """Return the walls that move."""
    return _belt(size, scenario) or DRIVEN[scenario % len(DRIVEN)]


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw a fluid at rest and the wall motion that drives it through all frames."""
    low, high = size.bounds[0]
    start = start_frame(size, scenario, rng)
    motion = _draw_motion(rng, size, scenario, start)
    belt = _belt(size, scenario)
    reynolds_range = "reynolds"
    if belt is None and shift_number(size, scenario) is not None:
        reynolds_range = "reynolds_shift"
    reynolds = log_uniform(rng, *interval(size, reynolds_range))
    viscosity = 0.5 * size.value("speed_max") * (high - low) / reynolds
    position = fill(
        rng,
        size.particles,
        low=low,
        high=high,
        jitter=size.value("jitter"),
        subdivision=size.subdivision,
    )
    if belt is not None:
        motion_kind = "belt"
    elif is_classic(scenario):
        motion_kind = "constant"
    else:
        motion_kind = "varying"
    return InitialState(
        position=position,
        velocity=np.zeros((size.particles, 2)),
        affine=np.zeros((size.particles, 2, 2)),
        material=liquid(size.particles),
        area=(high - low) * (high - low),
        viscosity=viscosity,
        wall_velocity=motion,
        start_frame=start,
        parameters={
            "wall": "+".join(_driven_walls(size, scenario)),
            "motion": motion_kind,
            "reynolds": reynolds,
            "viscosity": viscosity,
            "dynamic_viscosity": size.value("density") * viscosity,
        },
    )
