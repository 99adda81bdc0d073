"""Lid-driven cavity: a full box, one wall or two opposite ones slide (thesis §5.8).

Every moving wall follows a program of its own: knots with speeds drawn from [-U, U], to
the other side at each (else half of the walls would slide as before when it matters,
and the frozen flow would do for an answer), and between two of them, at frames t0 and
t1 with speeds a and b,

    u(t) = a + (b - a) s^2 (3 - 2 s),    s = (t - t0) / (t1 - t0).

One scenario in eight is the classic: lid at rest, then a constant speed. Expected
behaviour: vortices grow from the moving walls, are cut off where a wall turns and
merge; the flow never settles. Which walls move goes by id, so that every subset holds
all six choices alike; two that meet in a corner never move both, because their corner
blows up. The Reynolds number is (U/2) L / nu: U/2 is the mean absolute speed of a wall,
L the box's width.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lagbench.data import WALLS

from .constants import closed_box_walls, constants, interval
from .draws import RandomSource, choice, fill, log_uniform, quantise, uniform
from .split import ClosedBoxParameters, InitialState, Material

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

_TANGENT = {"left": 1, "right": 1, "bottom": 0, "top": 0}


def solver_parameters(size: Size) -> ClosedBoxParameters:
    """Return the constants of Table 5.2 and design 4.3 at this size; walls hold the
    fluid.
    """
    return constants(ClosedBoxParameters, size, no_slip=True)


def is_classic(scenario: int) -> bool:
    """Tell whether the lid starts once and keeps its speed: once in eight ids.

    The remainder moves on by one every 24 ids, else these ids would always be odd, and
    only half of :data:`DRIVEN` would occur among them.
    """
    return (scenario + scenario // 24) % 8 == 7


def _whole(rng: RandomSource, low: float, high: float) -> int:
    """Draw an integer, end points included."""
    return int(low) + choice(rng, int(high) - int(low) + 1)


def _program(rng: RandomSource, size: Size, frames: int) -> NDArray[np.float64]:
    """Draw the speed of a wall towards each frame [length/s], shape [frame]."""
    fastest = size.value("speed_max")
    gap = interval(size, "knot_gap")
    speed = np.empty(frames)
    start = 0
    before = uniform(rng, -fastest, fastest)
    while start < frames:
        end = start + _whole(rng, *gap)
        after = uniform(rng, 0.0, fastest)
        after = -after if before > 0.0 else after
        s = np.arange(min(end, frames) - start) / (end - start)
        speed[start:end] = before + (after - before) * (s * s * (3.0 - 2.0 * s))
        start = end
        before = after
    return quantise(speed)


def _motion(
    rng: RandomSource, size: Size, scenario: int, start: int
) -> NDArray[np.float64]:
    """Draw the velocity of each wall towards each frame, ``start`` frames before frame
    0 included.
    """
    frames = start + size.frame_count(scenario)
    fastest = size.value("speed_max")
    first = 0
    velocity = np.zeros((frames, len(WALLS), 2))
    if is_classic(scenario):
        # In the last given frame at the latest: what is to be predicted is never at
        # rest.
        first = _whole(
            rng, start - size.value("lid_lead"), start + size.task.input_frames - 1
        )
    for wall in DRIVEN[scenario % len(DRIVEN)]:
        if is_classic(scenario):
            sign = 2 * choice(rng, 2) - 1
            speed = np.where(
                np.arange(frames) >= first,
                sign * uniform(rng, 0.5 * fastest, fastest),
                0.0,
            )
        else:
            speed = _program(rng, size, frames)
        velocity[:, WALLS.index(wall), _TANGENT[wall]] = speed
    return velocity


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw a fluid at rest and the wall motion that drives it through all frames."""
    low, high = closed_box_walls(size)
    start = _whole(rng, *interval(size, "start_frame"))
    motion = _motion(rng, size, scenario, start)
    reynolds = log_uniform(rng, *interval(size, "reynolds"))
    viscosity = 0.5 * size.value("speed_max") * (high - low) / reynolds
    return InitialState(
        position=fill(
            rng, size.particles, low=low, high=high, jitter=size.value("jitter")
        ),
        velocity=np.zeros((size.particles, 2)),
        affine=np.zeros((size.particles, 2, 2)),
        material=np.full(size.particles, Material.LIQUID, dtype=np.int8),
        area=(high - low) * (high - low),
        viscosity=viscosity,
        wall_velocity=motion,
        start_frame=start,
        parameters={
            "wall": "+".join(DRIVEN[scenario % len(DRIVEN)]),
            "motion": "constant" if is_classic(scenario) else "varying",
            "reynolds": reynolds,
            "viscosity": viscosity,
            "dynamic_viscosity": size.value("density") * viscosity,
        },
    )
