"""Liquid with a free surface in a cube: falls, throws, dam breaks and splashes.

Scenario ids walk through four families:

    0  falling-ball   a ball falls
    1  thrown-block   a block is thrown along the floor and up
    2  dam-break      a column at rest beside a wall breaks
    3  splash         a ball falls into a pool at rest

Each scenario draws sizes, places and velocities. All particles of a scenario stand for
the same volume. The walls are free-slip. Expected behaviour: a sheet along the floor or
a crown around the impact, jets up the walls, sloshing.

The column that breaks fills the cube along one horizontal axis, which the id decides.
It is the dam break of Martin and Moyce (1952) between two glass walls.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .constants import constants, draw_between, free_surface_walls
from .draws import RandomSource, add_in_order, choice, quantise, uniform
from .shapes import Ball, Block, Body, Shape, check_room, sample_points
from .split import (
    FreeSurfaceParameters,
    InitialState,
    liquid,
)

if TYPE_CHECKING:
    from lagbench.data.registry import Size

Array = NDArray[np.float64]
Point: TypeAlias = tuple[float, float, float]

FAMILIES = ("falling-ball", "thrown-block", "dam-break", "splash")
"""Family of a scenario, by id % 4."""

AT_REST: Point = (0.0, 0.0, 0.0)


class _LiquidBody(NamedTuple):
    """A body of liquid at the start."""

    solid: Shape
    centre: Point  # [length]
    velocity: Point  # [length/s]


def solver_parameters(size: Size) -> FreeSurfaceParameters:
    """Return the solver's constants at this size."""
    return constants(FreeSurfaceParameters, size, dimension=3)


def _draw_vector(rng: RandomSource, size: Size, name: str) -> Point:
    """Draw a vector from the intervals ``<name>_x``, ``<name>_y`` and ``<name>_z``."""
    x = draw_between(rng, size, f"{name}_x")
    y = draw_between(rng, size, f"{name}_y")
    z = draw_between(rng, size, f"{name}_z")
    return x, y, z


def _draw_place(rng: RandomSource, size: Size, solid: Shape, lowest: float) -> Point:
    """Draw where a solid hangs: within the walls' margin, its centre above a height.

    Raises:
        WorkFailedError: there is no room for it.
    """
    low, high = free_surface_walls(size)
    margin = size.value("margin")
    least = low + margin
    most = high - margin
    reach_x, reach_y, reach_z = solid.reach
    least_y = max(lowest, least + reach_y)  # of its centre
    check_room(solid, [(least, most), (least_y - reach_y, most), (least, most)])
    x = uniform(rng, least + reach_x, most - reach_x)
    y = uniform(rng, least_y, most - reach_y)
    z = uniform(rng, least + reach_z, most - reach_z)
    return x, y, z


def _falling_ball(rng: RandomSource, size: Size) -> list[_LiquidBody]:
    ball = Ball(draw_between(rng, size, "ball_radius"))
    centre = _draw_place(rng, size, ball, size.value("fall_height"))
    return [_LiquidBody(ball, centre, _draw_vector(rng, size, "fall_velocity"))]


def _draw_sign(rng: RandomSource) -> float:
    """Draw 1 or -1, each equally likely."""
    if choice(rng, 2) == 1:
        return -1.0
    return 1.0


def _thrown_block(rng: RandomSource, size: Size) -> list[_LiquidBody]:
    width = draw_between(rng, size, "block_side")
    height = draw_between(rng, size, "block_side")
    depth = draw_between(rng, size, "block_side")
    block = Block((width, height, depth))
    centre = _draw_place(rng, size, block, 0.0)
    u, v, w = _draw_vector(rng, size, "throw_velocity")
    # towards either end of both horizontal axes
    sign_x = _draw_sign(rng)
    sign_z = _draw_sign(rng)
    return [_LiquidBody(block, centre, (sign_x * u, v, sign_z * w))]


def _dam_break(rng: RandomSource, size: Size, number: int) -> list[_LiquidBody]:
    low, high = free_surface_walls(size)
    side = high - low
    middle = 0.5 * (low + high)
    width = draw_between(rng, size, "column_width")
    height = draw_between(rng, size, "column_height")
    start = low + 0.5 * width
    if choice(rng, 2) == 1:
        start = high - 0.5 * width
    y = low + 0.5 * height
    column = Block((width, height, side))
    centre = (start, y, middle)
    if number % 2 == 1:  # turned
        column = Block((side, height, width))
        centre = (middle, y, start)
    check_room(column, [(low, high)] * 3)
    return [_LiquidBody(column, centre, AT_REST)]


def _splash(rng: RandomSource, size: Size) -> list[_LiquidBody]:
    low, high = free_surface_walls(size)
    side = high - low
    middle = 0.5 * (low + high)
    depth = draw_between(rng, size, "pool_depth")
    pool = Block((side, depth, side))
    check_room(pool, [(low, high)] * 3)
    radius = draw_between(rng, size, "drop_radius")
    ball = Ball(radius)
    lowest = low + depth + size.value("margin") + radius
    ball_centre = _draw_place(rng, size, ball, lowest)
    velocity = _draw_vector(rng, size, "drop_velocity")
    return [
        _LiquidBody(pool, (middle, low + 0.5 * depth, middle), AT_REST),
        _LiquidBody(ball, ball_centre, velocity),
    ]


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw one or two bodies of liquid, their places and velocities.

    Particles are shared out by volume; the last body has what rounding leaves.
    """
    family = FAMILIES[scenario % len(FAMILIES)]
    if family == "falling-ball":
        bodies = _falling_ball(rng, size)
    elif family == "thrown-block":
        bodies = _thrown_block(rng, size)
    elif family == "dam-break":
        bodies = _dam_break(rng, size, scenario // len(FAMILIES))
    else:
        bodies = _splash(rng, size)

    particles = size.particles
    volumes = [body.solid.measure for body in bodies]
    total_volume = add_in_order(volumes)
    counts = [int(particles * (volume / total_volume)) for volume in volumes[:-1]]
    counts.append(particles - sum(counts))
    positions = []
    velocities = []
    for body, count in zip(bodies, counts, strict=True):
        place = Body(body.solid, np.array(body.centre))
        positions.append(sample_points(rng, place, count))
        velocities.append(np.full((count, 3), body.velocity))

    last_body = bodies[-1]
    last_centre = quantise(last_body.centre)
    parameters: dict[str, int | float | str] = {
        "family": family,
        "volume": total_volume,
    }
    for axis, name in enumerate("xyz"):
        parameters[f"centre_{name}"] = float(last_centre[axis])
        parameters[f"velocity_{name}"] = float(last_body.velocity[axis])
    return InitialState(
        position=np.clip(np.concatenate(positions), *free_surface_walls(size)),
        velocity=quantise(np.concatenate(velocities)),
        affine=np.zeros((particles, 3, 3)),
        material=liquid(particles),
        area=total_volume,
        wall_velocity=np.zeros((6, 3)),
        parameters=parameters,
    )
