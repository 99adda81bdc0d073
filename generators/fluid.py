"""A body of liquid that falls, is thrown or splashes (thesis §4.3, Fig. 4.3).

Families by id % 4: 0 falling rectangle, 1 body thrown at the right wall, 2 falling
circle, 3 splash (four overlapping discs with velocities of their own, which tear the
body apart before it falls). Expected behaviour: a jet along the walls after the impact,
sloshing, rest.

The subset ``shift`` lies outside train on purpose. Its scenarios alternate: one of the
families with twice the liquid (and as many particles, so that each stands for twice the
area), then a column that stands on the floor beside a wall and breaks (a dam break).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .constants import (
    constants,
    draw_between,
    free_surface_walls,
    interval,
    ranges,
    shift_number,
)
from .draws import RandomSource, choice, draw_direction, normal, quantise, uniform
from .shapes import (
    Blobs,
    Body,
    Disc,
    Rectangle,
    Region,
    Shape,
    body_at,
    check_room,
    place,
    sample_points,
)
from .split import FreeSurfaceParameters, InitialState, liquid

if TYPE_CHECKING:
    from lagbench.data.registry import Size

Array = NDArray[np.float64]

FAMILIES = ("falling-rectangle", "thrown", "falling-circle", "splash")
"""Family of a scenario, by id % 4."""

COLUMN = "column"
"""Family of the columns that break, which only shift has."""

# Families whose bodies start in one region with one range of velocities share its
# parameters.
_START = {
    "falling-rectangle": "falling",
    "thrown": "thrown",
    "falling-circle": "falling",
    "splash": "splash",
}


def solver_parameters(size: Size) -> FreeSurfaceParameters:
    """Return the solver's constants at this size."""
    return constants(FreeSurfaceParameters, size)


def _draw_shape(rng: RandomSource, family: str, area: float, size: Size) -> Shape:
    if family == "splash":
        return _draw_blobs(rng, area, size)
    if family == "falling-circle":
        return Disc.of_area(area)
    if family == "thrown" and choice(rng, 2) == 1:
        return Disc.of_area(area)
    aspect = draw_between(rng, size, "aspect")
    return Rectangle.of_area(area, aspect)


def _draw_blobs(rng: RandomSource, area: float, size: Size) -> Blobs:
    """Draw discs that all reach a common point, so that the body is one piece."""
    least_distance, greatest_distance = interval(size, "blob_offset")
    centres = []
    for _ in range(size.value("blob_count")):
        distance = uniform(rng, least_distance, greatest_distance)
        x, y = draw_direction(rng, 2)
        centres.append((distance * x, distance * y))
    return Blobs.of_area(area, np.array(centres), cells=size.value("blob_cells"))


def _draw_splash(rng: RandomSource, body: Body, position: Array, size: Size) -> Array:
    """Return velocities of the blobs, blended by inverse squared distance, plus noise.

    v(x) = sum_k v_k / d_k^2 / sum_k 1 / d_k^2, with d_k the distance from the centre of
    disc k (softened): noise of single particles alone is averaged away by the grid. A
    body that is no union of blobs has no such velocities.
    """
    if not isinstance(body.shape, Blobs):
        return np.zeros_like(position)

    blob_count = size.value("blob_count")
    blob_velocities = normal(rng, size.value("blob_speed"), (blob_count, 2))
    softening = size.value("blob_softening")
    from_body_centre = position - body.centre
    total = np.zeros_like(position)
    weights = np.zeros((len(position), 1))
    for centre, velocity in zip(body.shape.centres, blob_velocities, strict=True):
        x, y = (from_body_centre - np.array(centre)).T
        weight = (1.0 / (x * x + y * y + softening * softening))[:, None]
        total = total + weight * velocity
        weights = weights + weight
    noise = normal(rng, size.value("particle_speed"), position.shape)
    return total / weights + noise


def _start_region(size: Size, start: str) -> Region:
    """Return where a body may lie: its family's region, within the walls' margin."""
    (left, right), (bottom, top) = ranges(size, start)
    low, high = free_surface_walls(size)
    margin = size.value("margin")
    least = low + margin
    most = high - margin
    return (max(left, least), min(right, most)), (max(bottom, least), min(top, most))


def _draw_column(rng: RandomSource, size: Size, number: int) -> InitialState:
    """Draw a column at rest on the floor, at the left wall or at the right one."""
    area = draw_between(rng, size, "area")
    aspect = draw_between(rng, size, "column_aspect")
    shape = Rectangle.of_area(area, 1.0 / aspect)
    low, high = free_surface_walls(size)
    check_room(shape, [(low, high), (low, high)])
    half_width, half_height = shape.reach
    x = low + half_width
    if number // 2 % 2 == 1:
        x = high - half_width
    body = body_at(shape, x, low + half_height)
    position = np.clip(sample_points(rng, body, size.particles), low, high)
    return _liquid_at(
        size,
        body,
        family=COLUMN,
        area=area,
        position=position,
        velocity=np.zeros((size.particles, 2)),
        mean_velocity=(0.0, 0.0),
    )


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw a body of liquid, its place and its velocity."""
    number = shift_number(size, scenario)
    if number is not None and number % 2 == 1:
        return _draw_column(rng, size, number)

    family = FAMILIES[scenario % len(FAMILIES)]
    area_range = "area"
    if number is not None:
        family = FAMILIES[number // 2 % len(FAMILIES)]
        area_range = "area_shift"
    start = _START[family]
    area = draw_between(rng, size, area_range)
    shape = _draw_shape(rng, family, area, size)
    body = place(rng, shape, _start_region(size, start))

    horizontal_speeds, vertical_speeds = ranges(size, f"{start}_velocity")
    velocity_x = uniform(rng, *horizontal_speeds)
    velocity_y = uniform(rng, *vertical_speeds)
    position = sample_points(rng, body, size.particles)
    splash = _draw_splash(rng, body, position, size)
    velocity = quantise(np.array([velocity_x, velocity_y]) + splash)
    return _liquid_at(
        size,
        body,
        family=family,
        area=area,
        position=position,
        velocity=velocity,
        mean_velocity=(velocity_x, velocity_y),
    )


def _liquid_at(
    size: Size,
    body: Body,
    *,
    family: str,
    area: float,
    position: Array,
    velocity: Array,
    mean_velocity: tuple[float, float],
) -> InitialState:
    """Return the initial state of one body of liquid, with the parameters that its file
    states.
    """
    return InitialState(
        position=position,
        velocity=velocity,
        affine=np.zeros((size.particles, 2, 2)),
        material=liquid(size.particles),
        area=area,
        parameters={
            "family": family,
            "area": area,
            "centre_x": float(body.centre[0]),
            "centre_y": float(body.centre[1]),
            "velocity_x": mean_velocity[0],
            "velocity_y": mean_velocity[1],
        },
    )
