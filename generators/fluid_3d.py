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
    # where its centre may lie
    least_x = least + reach_x
    least_y = least + reach_y
    least_z = least + reach_z
    most_x = most - reach_x
    most_y = most - reach_y
    most_z = most - reach_z
    least_y = max(lowest, least_y)

    bottom = least_y - reach_y
    across = (least, most)
    upright = (bottom, most)
    room = [across, upright, across]
    check_room(solid, room)
    x = uniform(rng, least_x, most_x)
    y = uniform(rng, least_y, most_y)
    z = uniform(rng, least_z, most_z)
    return x, y, z


def _falling_ball(rng: RandomSource, size: Size) -> InitialState:
    radius = draw_between(rng, size, "ball_radius")
    ball = Ball(radius)
    lowest = size.value("fall_height")
    centre = _draw_place(rng, size, ball, lowest)
    velocity = _draw_vector(rng, size, "fall_velocity")
    body = _LiquidBody(ball, centre, velocity)
    bodies = [body]
    return _state(rng, size, "falling-ball", bodies)


def _draw_sign(rng: RandomSource) -> float:
    """Draw 1 or -1, each equally likely."""
    if choice(rng, 2) == 1:
        return -1.0
    return 1.0


def _thrown_block(rng: RandomSource, size: Size) -> InitialState:
    width = draw_between(rng, size, "block_side")
    height = draw_between(rng, size, "block_side")
    depth = draw_between(rng, size, "block_side")
    sides = (width, height, depth)
    block = Block(sides)
    centre = _draw_place(rng, size, block, 0.0)
    u, v, w = _draw_vector(rng, size, "throw_velocity")
    # towards either end of both horizontal axes
    sign_x = _draw_sign(rng)
    sign_z = _draw_sign(rng)
    velocity_x = sign_x * u
    velocity_z = sign_z * w
    velocity = (velocity_x, v, velocity_z)
    body = _LiquidBody(block, centre, velocity)
    bodies = [body]
    return _state(rng, size, "thrown-block", bodies)


def _dam_break(rng: RandomSource, size: Size, number: int) -> InitialState:
    low, high = free_surface_walls(size)
    walls = (low, high)
    side = high - low
    middle = 0.5 * (low + high)
    width = draw_between(rng, size, "column_width")
    height = draw_between(rng, size, "column_height")
    half_width = 0.5 * width
    half_height = 0.5 * height
    start = low + half_width
    if choice(rng, 2) == 1:
        start = high - half_width
    y = low + half_height
    sides = (width, height, side)
    centre = (start, y, middle)
    is_turned = number % 2 == 1
    if is_turned:
        sides = (side, height, width)
        centre = (middle, y, start)
    column = Block(sides)
    room = [walls, walls, walls]
    check_room(column, room)
    body = _LiquidBody(column, centre, AT_REST)
    bodies = [body]
    return _state(rng, size, "dam-break", bodies)


def _splash(rng: RandomSource, size: Size) -> InitialState:
    low, high = free_surface_walls(size)
    walls = (low, high)
    side = high - low
    middle = 0.5 * (low + high)
    depth = draw_between(rng, size, "pool_depth")
    half_depth = 0.5 * depth
    sides = (side, depth, side)
    pool = Block(sides)
    room = [walls, walls, walls]
    check_room(pool, room)
    pool_y = low + half_depth
    pool_centre = (middle, pool_y, middle)
    radius = draw_between(rng, size, "drop_radius")
    ball = Ball(radius)
    margin = size.value("margin")
    lowest = low + depth + margin + radius
    ball_centre = _draw_place(rng, size, ball, lowest)
    velocity = _draw_vector(rng, size, "drop_velocity")
    pool_body = _LiquidBody(pool, pool_centre, AT_REST)
    ball_body = _LiquidBody(ball, ball_centre, velocity)
    bodies = [pool_body, ball_body]
    return _state(rng, size, "splash", bodies)


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
    particles = size.particles
    positions = []
    velocities = []
    left_count = particles
    last_index = len(bodies) - 1
    for index, body in enumerate(bodies):
        count = left_count
        if index < last_index:
            volume = volumes[index]
            count = int(particles * (volume / total_volume))
        left_count -= count
        centre = np.array(body.centre)
        place = Body(body.solid, centre)
        body_position = sample_points(rng, place, count)
        body_shape = body_position.shape
        body_velocity = np.full(body_shape, body.velocity)
        positions.append(body_position)
        velocities.append(body_velocity)

    low, high = free_surface_walls(size)
    all_velocities = np.concatenate(velocities)
    position = np.clip(np.concatenate(positions), low, high)
    velocity = quantise(all_velocities)
    affine_shape = (particles, 3, 3)
    affine = np.zeros(affine_shape)
    last_body = bodies[-1]
    last_centre = quantise(last_body.centre)
    last_velocity = last_body.velocity
    parameters: dict[str, int | float | str] = {
        "family": family,
        "volume": total_volume,
    }
    for axis, name in enumerate("xyz"):
        coordinate = last_centre[axis]
        component = last_velocity[axis]
        parameters[f"centre_{name}"] = float(coordinate)
        parameters[f"velocity_{name}"] = float(component)
    return InitialState(
        position=position,
        velocity=velocity,
        affine=affine,
        material=liquid(particles),
        area=total_volume,
        wall_velocity=np.zeros((6, 3)),
        parameters=parameters,
    )


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw one or two bodies of liquid, their places and velocities."""
    family_count = len(FAMILIES)
    family = FAMILIES[scenario % family_count]
    if family == "falling-ball":
        return _falling_ball(rng, size)
    if family == "thrown-block":
        return _thrown_block(rng, size)
    if family == "dam-break":
        number = scenario // family_count
        return _dam_break(rng, size, number)
    return _splash(rng, size)
