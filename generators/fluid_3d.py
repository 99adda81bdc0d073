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
from .shapes import Body, check_room, sample_points
from .solids import Ball, Block, Solid
from .split import (
    FreeSurface3DParameters,
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

    solid: Solid
    centre: Point  # [length]
    velocity: Point  # [length/s]


def solver_parameters(size: Size) -> FreeSurfaceParameters:
    """Return the solver's constants at this size."""
    return constants(FreeSurface3DParameters, size)


def _draw_vector(rng: RandomSource, size: Size, name: str) -> Point:
    """Draw a vector from the intervals ``<name>_x``, ``<name>_y`` and ``<name>_z``."""
    x = draw_between(rng, size, f"{name}_x")
    y = draw_between(rng, size, f"{name}_y")
    z = draw_between(rng, size, f"{name}_z")
    return x, y, z


def _draw_place(rng: RandomSource, size: Size, solid: Solid, lowest: float) -> Point:
    """Draw where a solid hangs: within the walls' margin, its centre above a height.

    Raises:
        WorkFailedError: there is no room for it.
    """
    low, high = free_surface_walls(size)
    margin = size.value("margin")
    least = low + margin
    most = high - margin
    reach_x, reach_y, reach_z = solid.reach
    lowest = max(lowest, least + reach_y)
    across = (least, most)
    upright = (lowest - reach_y, most)
    check_room(solid, [across, upright, across])
    x = uniform(rng, least + reach_x, most - reach_x)
    y = uniform(rng, lowest, most - reach_y)
    z = uniform(rng, least + reach_z, most - reach_z)
    return x, y, z


def _falling_ball(rng: RandomSource, size: Size) -> InitialState:
    radius = draw_between(rng, size, "ball_radius")
    ball = Ball(radius)
    lowest = size.value("fall_height")
    centre = _draw_place(rng, size, ball, lowest)
    velocity = _draw_vector(rng, size, "fall_velocity")
    body = _LiquidBody(ball, centre, velocity)
    return _state(rng, size, "falling-ball", [body])


def _draw_sign(rng: RandomSource) -> float:
    """Draw 1 or -1, each equally likely."""
    if choice(rng, 2) == 1:
        return -1.0
    return 1.0


def _thrown_block(rng: RandomSource, size: Size) -> InitialState:
    width = draw_between(rng, size, "block_side")
    height = draw_between(rng, size, "block_side")
    depth = draw_between(rng, size, "block_side")
    block = Block((width, height, depth))
    centre = _draw_place(rng, size, block, 0.0)
    u, v, w = _draw_vector(rng, size, "throw_velocity")
    # towards either end of both horizontal axes
    velocity_x = _draw_sign(rng) * u
    velocity_z = _draw_sign(rng) * w
    velocity = (velocity_x, v, velocity_z)
    body = _LiquidBody(block, centre, velocity)
    return _state(rng, size, "thrown-block", [body])


def _dam_break(rng: RandomSource, size: Size, number: int) -> InitialState:
    low, high = free_surface_walls(size)
    width = draw_between(rng, size, "column_width")
    height = draw_between(rng, size, "column_height")
    half_width = 0.5 * width
    start = low + half_width
    if choice(rng, 2) == 1:
        start = high - half_width
    y = low + 0.5 * height
    middle = 0.5 * (low + high)
    side = high - low
    if number % 2 == 0:
        column = Block((width, height, side))
        centre = (start, y, middle)
    else:
        column = Block((side, height, width))
        centre = (middle, y, start)
    check_room(column, [(low, high)] * 3)
    body = _LiquidBody(column, centre, AT_REST)
    return _state(rng, size, "dam-break", [body])


def _splash(rng: RandomSource, size: Size) -> InitialState:
    low, high = free_surface_walls(size)
    depth = draw_between(rng, size, "pool_depth")
    side = high - low
    pool = Block((side, depth, side))
    check_room(pool, [(low, high)] * 3)
    middle = 0.5 * (low + high)
    pool_y = low + 0.5 * depth
    pool_centre = (middle, pool_y, middle)
    radius = draw_between(rng, size, "drop_radius")
    ball = Ball(radius)
    surface = low + depth
    lowest = surface + size.value("margin") + radius
    ball_centre = _draw_place(rng, size, ball, lowest)
    velocity = _draw_vector(rng, size, "drop_velocity")
    pool_body = _LiquidBody(pool, pool_centre, AT_REST)
    ball_body = _LiquidBody(ball, ball_centre, velocity)
    return _state(rng, size, "splash", [pool_body, ball_body])


def _state(
    rng: RandomSource,
    size: Size,
    family: str,
    bodies: list[_LiquidBody],
) -> InitialState:
    """Return the initial state of bodies of liquid.

    Particles are shared out by volume; the last body has what rounding leaves.
    """
    volumes = [body.solid.measure for body in bodies]
    total_volume = add_in_order(volumes)
    positions = []
    velocities = []
    left_count = size.particles
    for index, body in enumerate(bodies):
        count = left_count
        if index < len(bodies) - 1:
            volume_share = volumes[index] / total_volume
            count = int(size.particles * volume_share)
        left_count -= count
        centre = np.array(body.centre)
        place = Body(body.solid, centre)
        position = sample_points(rng, place, count)
        velocity = np.full(position.shape, body.velocity)
        positions.append(position)
        velocities.append(velocity)

    low, high = free_surface_walls(size)
    all_positions = np.concatenate(positions)
    all_velocities = np.concatenate(velocities)
    last_body = bodies[-1]
    parameters: dict[str, int | float | str] = {
        "family": family,
        "volume": total_volume,
    }
    last_centre = quantise(last_body.centre)
    for axis, name in enumerate("xyz"):
        parameters[f"centre_{name}"] = float(last_centre[axis])
        parameters[f"velocity_{name}"] = float(last_body.velocity[axis])
    return InitialState(
        position=np.clip(all_positions, low, high),
        velocity=quantise(all_velocities),
        affine=np.zeros((size.particles, 3, 3)),
        material=liquid(size.particles),
        area=total_volume,
        wall_velocity=np.zeros((6, 3)),
        parameters=parameters,
    )


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw one or two bodies of liquid, their places and velocities."""
    family = FAMILIES[scenario % len(FAMILIES)]
    if family == "falling-ball":
        return _falling_ball(rng, size)
    if family == "thrown-block":
        return _thrown_block(rng, size)
    if family == "dam-break":
        return _dam_break(rng, size, scenario // len(FAMILIES))
    return _splash(rng, size)
