"""Lid-driven cavity in three dimensions: a cube of which one wall or two slide.

Every moving wall follows a smooth random program of its own (:mod:`.programs`), of the
other sign at each knot. Which walls move, and along which axis, goes by id, so that
every subset holds all six choices alike; of two walls that move, each slides along an
axis of its own and they lie opposite, because two that meet at an edge would tear the
fluid there. The Reynolds number is (U/2) L / nu: U/2 is the mean absolute speed of a
wall, L = 1 the side of the cube.

Expected behaviour: vortices grow from the moving walls, end at the walls beside them,
where the fluid turns back, and are cut off where a wall turns; the flow never settles.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import AXES, WALL_NAMES

from .constants import constants, interval
from .decaying_vortices import particles_per_side
from .draws import RandomSource, log_uniform
from .full_box_parameters import FullBoxParameters
from .periodic_noise import fill_box
from .programs import draw_integer, draw_program
from .split import InitialState, Material

if TYPE_CHECKING:
    from lagbench.data.registry import Size

__all__ = ["DRIVEN", "initial_state", "solver_parameters", "start_frame"]

DRIVEN = (
    (("top", "x"),),
    (("left", "z"),),
    (("back", "y"),),
    (("bottom", "x"), ("top", "z")),
    (("left", "y"), ("right", "z")),
    (("front", "x"), ("back", "y")),
)
"""The walls that move and the axes along which they slide, by id % 6."""


def solver_parameters(size: Size) -> FullBoxParameters:
    """Return the solver's constants at this size; walls hold the fluid."""
    return constants(FullBoxParameters, size, box=size.box, no_slip=True)


def start_frame(size: Size, scenario: int, rng: RandomSource) -> int:
    """Draw how many frames a scenario is simulated before frame 0; the first draw."""
    del scenario  # the same range for all
    return draw_integer(rng, *interval(size, "start_frame"))


def _draw_motion(
    rng: RandomSource, size: Size, scenario: int, frame_count: int
) -> NDArray[np.float64]:
    """Draw the velocity of each wall towards each frame [length/s].

    The shape is [frame, wall, axis].
    """
    velocity = np.zeros((frame_count, 6, 3))
    for wall, axis in DRIVEN[scenario % len(DRIVEN)]:
        velocity[:, WALL_NAMES.index(wall), AXES.index(axis)] = draw_program(
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
        rng, (side,) * 3, low=box.low, high=box.high, jitter=size.value("jitter")
    )
    walls = [f"{wall} along {axis}" for wall, axis in DRIVEN[scenario % len(DRIVEN)]]
    return InitialState(
        position=position,
        velocity=np.zeros((size.particles, 3)),
        affine=np.zeros((size.particles, 3, 3)),
        material=np.full(size.particles, Material.LIQUID, dtype=np.int8),
        area=box.volume,
        viscosity=viscosity,
        wall_velocity=motion,
        start_frame=start,
        parameters={
            "wall": " + ".join(walls),
            "reynolds": reynolds,
            "viscosity": viscosity,
            "dynamic_viscosity": size.value("density") * viscosity,
        },
    )
