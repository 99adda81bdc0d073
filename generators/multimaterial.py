"""Two bodies of different materials collide and fall (thesis §4.3, §4.8.2, Fig. 4.2).

Pairs by id % 6: 0 liquid-snow, 1 rope-snow, 2 rope-liquid, 3 snow-snow, 4 rope-jelly
ball, 5 liquid-liquid. The bodies start apart; an attractor has acted before the first
frame (§4.3.2): each moves towards one common point high in the box, at a rate drawn for
the scenario, so that they meet in flight and from the side. Expected behaviour: liquid
splashes and settles, snow breaks and stays, rope bends, jelly rebounds. Two snow bodies
rest after about 100 frames.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import WorkFailedError

from .constants import constants, free_surface_walls, interval, ranges
from .draws import RandomSource, choice, direction, quantise, uniform
from .shapes import Body, Disc, Rectangle, Shape, place, sample_points
from .split import FreeSurfaceParameters, InitialState, Material

if TYPE_CHECKING:
    from lagbench.data.registry import Size

PAIRS = (
    (Material.LIQUID, Material.SNOW),
    (Material.ROPE, Material.SNOW),
    (Material.ROPE, Material.LIQUID),
    (Material.SNOW, Material.SNOW),
    (Material.ROPE, Material.JELLY),
    (Material.LIQUID, Material.LIQUID),
)
"""Materials of the two bodies, by id % 6."""

# when to give up; no scenario of datasets.yaml comes near it
_ATTEMPTS = 1000


def solver_parameters(size: Size) -> FreeSurfaceParameters:
    """Return the solver's constants at this size."""
    return constants(FreeSurfaceParameters, size)


def _draw_shape(rng: RandomSource, material: Material, size: Size) -> Shape:
    """Draw a rope, a ball of jelly, or a rectangle or disc of anything else."""
    if material is Material.ROPE:
        length = uniform(rng, *interval(size, "rope_length"))
        return Rectangle(length, size.value("rope_width"), direction(rng))
    area = uniform(rng, *interval(size, "area"))
    if material is Material.JELLY or choice(rng, 2) == 1:
        return Disc.of_area(area)
    return Rectangle.of_area(area, uniform(rng, *interval(size, "aspect")))


def _place_apart(
    rng: RandomSource, size: Size, first_shape: Shape, second_shape: Shape
) -> tuple[Body, Body]:
    """Place two shapes between the walls until they keep their gap.

    The second is probed at those nodes of a grid of ``gap_cells`` cells over its
    bounding box, each way, that lie inside it.
    """
    low, high = free_surface_walls(size)
    inner = (low + size.value("margin"), high - size.value("margin"))
    gap = float(size.value("gap"))
    cell_count = int(size.value("gap_cells"))

    # grid nodes about the origin [length], shape [node, 2]
    side = (2.0 * np.arange(cell_count + 1) - cell_count) / cell_count
    reach_x, reach_y = second_shape.reach
    x, y = np.meshgrid(side * reach_x, side * reach_y)
    offsets = np.stack([x.ravel(), y.ravel()], axis=-1)

    for _ in range(_ATTEMPTS):
        first = place(rng, first_shape, (inner, inner))
        second = place(rng, second_shape, (inner, inner))
        nodes = second.centre + offsets
        inside = nodes[second.distance(nodes) <= 0.0]
        if float(np.min(first.distance(inside))) >= gap:
            return first, second
    raise WorkFailedError(
        "two bodies have no room side by side",
        expected=f"a gap of {gap} within {_ATTEMPTS} attempts",
        fix="lower the areas or lengths of this split in datasets.yaml",
    )


def _body_parameters(
    name: str, body: Body, velocity: NDArray[np.float64]
) -> dict[str, int | float | str]:
    """Return what a file states of one body: shape, area, centre and velocity."""
    centre_x, centre_y = body.centre.tolist()
    velocity_x, velocity_y = velocity.tolist()
    return {
        f"{name}_shape": type(body.shape).__name__.lower(),
        f"{name}_area": body.shape.area,
        f"{name}_centre_x": centre_x,
        f"{name}_centre_y": centre_y,
        f"{name}_velocity_x": velocity_x,
        f"{name}_velocity_y": velocity_y,
    }


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw two bodies, their places and their velocities."""
    materials = PAIRS[scenario % len(PAIRS)]
    first_shape = _draw_shape(rng, materials[0], size)
    second_shape = _draw_shape(rng, materials[1], size)
    first, second = _place_apart(rng, size, first_shape, second_shape)

    # particles in proportion to the areas
    area = first_shape.area + second_shape.area
    first_count = math.floor(size.particles * first_shape.area / area + 0.5)
    second_count = size.particles - first_count

    # the attractor: velocity of each body = rate (point - centre) [length/s]
    x_range, y_range = ranges(size, "attractor")
    point_x = uniform(rng, *x_range)
    point_y = uniform(rng, *y_range)
    point = np.array([point_x, point_y])
    rate = uniform(rng, *interval(size, "attraction"))
    first_velocity = quantise(rate * (point - first.centre))
    second_velocity = quantise(rate * (point - second.centre))

    friction = 0.0
    if Material.LIQUID not in materials:
        friction = float(size.value("friction"))

    first_points = sample_points(rng, first, first_count)
    second_points = sample_points(rng, second, second_count)
    counts = (first_count, second_count)
    velocities = np.stack([first_velocity, second_velocity])
    return InitialState(
        position=np.concatenate([first_points, second_points]),
        velocity=np.repeat(velocities, counts, axis=0),
        affine=np.zeros((size.particles, 2, 2)),
        material=np.repeat(np.array(materials, dtype=np.int8), counts),
        area=area,
        friction=friction,
        parameters={
            "pair": "-".join(material.name.lower() for material in materials),
            "attraction": rate,
            "friction": friction,
            **_body_parameters("first", first, first_velocity),
            **_body_parameters("second", second, second_velocity),
        },
    )
