"""Two bodies of different materials collide and fall (thesis §4.3, §4.8.2, Fig. 4.2).

Pairs by id % 6: 0 liquid-snow, 1 rope-snow, 2 rope-liquid, 3 snow-snow, 4 rope-jelly
ball, 5 liquid-liquid. The bodies start apart; an attractor has acted before the first
frame (§4.3.2): each moves towards one common point high in the box, at a rate drawn for
the scenario, so that they meet in flight and from the side. Expected behaviour: liquid
splashes and settles, snow breaks and stays, rope bends, jelly rebounds. Two snow bodies
rest after about 100 frames.

The subset ``shift`` lies outside train on purpose: three bodies, see :data:`TRIPLES`.

What is said here holds for :mod:`.multimaterial_3d` too, whose shapes fill a cube.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import WorkFailedError

from .constants import (
    constants,
    draw_between,
    free_surface_walls,
    shift_number,
)
from .draws import (
    RandomSource,
    add_in_order,
    choice,
    draw_direction,
    quantise,
)
from .shapes import Body, Disc, Rectangle, Shape, place, sample_points
from .split import FreeSurfaceParameters, InitialState, Material

if TYPE_CHECKING:
    from lagbench.data.registry import Size

Array = NDArray[np.float64]

PAIRS = (
    (Material.LIQUID, Material.SNOW),
    (Material.ROPE, Material.SNOW),
    (Material.ROPE, Material.LIQUID),
    (Material.SNOW, Material.SNOW),
    (Material.ROPE, Material.JELLY),
    (Material.LIQUID, Material.LIQUID),
)
"""Materials of the two bodies, by id % 6."""

TRIPLES = (
    (Material.LIQUID, Material.SNOW, Material.JELLY),
    (Material.ROPE, Material.LIQUID, Material.JELLY),
    (Material.ROPE, Material.SNOW, Material.LIQUID),
    (Material.ROPE, Material.JELLY, Material.SNOW),
)
"""Materials of the three bodies of shift, by place in the subset modulo 4."""

ShapeDraw: TypeAlias = "Callable[[RandomSource, Size, float], Shape]"
"""Draws a shape of a length, area or volume."""


@dataclass(frozen=True, kw_only=True)
class BodyShapes:
    """The shapes that bodies have in the plane, or in space."""

    measure: str  # parameter for the area or volume of a ball or block
    rope: ShapeDraw  # of a length
    ball: Callable[[float], Shape]  # of an area or volume
    block: ShapeDraw  # of an area or volume


_NAMES = ("first", "second", "third")

# when to give up; no scenario of datasets.yaml comes near it
_ATTEMPTS = 1000


def solver_parameters(size: Size) -> FreeSurfaceParameters:
    """Return the solver's constants at this size."""
    return constants(FreeSurfaceParameters, size)


def _draw_rectangle(rng: RandomSource, size: Size, area: float) -> Shape:
    aspect = draw_between(rng, size, "aspect")
    return Rectangle.of_area(area, aspect)


def _draw_rope(rng: RandomSource, size: Size, length: float) -> Shape:
    width = size.value("rope_width")
    axis = draw_direction(rng, 2)
    return Rectangle(length, width, axis)


PLANE_SHAPES = BodyShapes(
    measure="area", rope=_draw_rope, ball=Disc.of_area, block=_draw_rectangle
)
"""Shapes of the bodies in the plane: a rope and a block are rectangles."""


def _draw_shape(
    rng: RandomSource,
    material: Material,
    size: Size,
    kinds: BodyShapes,
) -> Shape:
    """Draw a rope, a ball of jelly, or a block or ball of anything else."""
    if material is Material.ROPE:
        length = draw_between(rng, size, "rope_length")
        return kinds.rope(rng, size, length)
    measure = draw_between(rng, size, kinds.measure)
    if material is Material.JELLY:
        return kinds.ball(measure)
    is_ball = choice(rng, 2) == 1
    if is_ball:
        return kinds.ball(measure)
    return kinds.block(rng, size, measure)


def _probe_nodes(shape: Shape, cell_count: int) -> Array:
    """Return nodes of a grid over a bounding box about the origin [length], shape
    [node, axis].
    """
    numbers = np.arange(cell_count + 1)
    from_middle = 2.0 * numbers - cell_count  # [half a cell]
    unit_axis = from_middle / cell_count  # from -1 to 1
    axes = [unit_axis * reach for reach in shape.reach]
    coordinates = np.meshgrid(*axes)
    columns = []
    for along in coordinates:
        column = along.ravel()
        columns.append(column)
    return np.stack(columns, axis=-1)


def _keeps_gap(
    first: Body,
    second: Body,
    offsets: Array,
    gap: float,
) -> bool:
    """Tell whether the second body keeps a gap [length] from the first.

    It is probed at those offsets from its centre that lie inside it.
    """
    nodes = second.centre + offsets
    is_inside = second.distance(nodes) <= 0.0
    inner_nodes = nodes[is_inside]
    distance = first.distance(inner_nodes)
    return float(distance.min()) >= gap


def _are_apart(bodies: Sequence[Body], offsets: Sequence[Array], gap: float) -> bool:
    """Tell whether all bodies keep a gap [length] from one another."""
    numbers = range(len(bodies))
    for i, j in combinations(numbers, 2):
        first = bodies[i]
        second = bodies[j]
        second_offsets = offsets[j]
        if not _keeps_gap(first, second, second_offsets, gap):
            return False
    return True


def _place_apart(rng: RandomSource, size: Size, shapes: Sequence[Shape]) -> list[Body]:
    """Place shapes between the walls until all keep their gap from one another.

    A body is probed at the nodes of a grid of ``gap_cells`` cells over its bounding
    box, each way.
    """
    low, high = free_surface_walls(size)
    margin = size.value("margin")
    inner_low = low + margin
    inner_high = high - margin
    inner = (inner_low, inner_high)
    region = size.dimension * [inner]
    gap = float(size.value("gap"))
    cell_count = int(size.value("gap_cells"))
    offsets = []
    for shape in shapes:
        shape_offsets = _probe_nodes(shape, cell_count)
        offsets.append(shape_offsets)

    for _ in range(_ATTEMPTS):
        bodies = [place(rng, shape, region) for shape in shapes]
        if _are_apart(bodies, offsets, gap):
            return bodies
    raise WorkFailedError(
        f"{len(shapes)} bodies have no room side by side: got bodies that touch or "
        f"overlap, in every attempt, expected a gap of {gap} within {_ATTEMPTS} "
        "attempts; lower the areas or lengths in the file of the split",
        where=f"{size.split} {size.name}",
    )


def _body_parameters(
    name: str,
    body: Body,
    measure: float,
    velocity: Array,
) -> dict[str, int | float | str]:
    """Return what a file states of one body: shape, area or volume, centre and
    velocity.
    """
    measure_name = "volume"
    if len(velocity) == 2:
        measure_name = "area"
    shape_class = type(body.shape)
    shape_name = shape_class.__name__.lower()
    parameters: dict[str, int | float | str] = {
        f"{name}_shape": shape_name,
        f"{name}_{measure_name}": measure,
    }
    vectors = {"centre": body.centre, "velocity": velocity}
    for quantity, vector in vectors.items():
        components = vector.tolist()
        for axis, component in zip("xyz", components, strict=False):
            parameters[f"{name}_{quantity}_{axis}"] = component
    return parameters


def _share_particles(particle_count: int, measures: Sequence[float]) -> list[int]:
    """Return the particles of each body, in proportion to areas or volumes."""
    area = add_in_order(measures)
    counts = []
    for body_area in measures[:-1]:
        count = math.floor(particle_count * body_area / area + 0.5)
        counts.append(count)
    last_count = particle_count - sum(counts)
    counts.append(last_count)
    return counts


def _materials(size: Size, scenario: int) -> tuple[Material, ...]:
    """Return the materials of the bodies of a scenario."""
    number = shift_number(size, scenario)
    if number is None:
        return PAIRS[scenario % len(PAIRS)]
    return TRIPLES[number % len(TRIPLES)]


def _draw_attractor(rng: RandomSource, size: Size) -> Array:
    """Draw the point that attracts all bodies [length], shape [axis]."""
    point = []
    for axis in "xyz"[: size.dimension]:
        coordinate = draw_between(rng, size, f"attractor_{axis}")
        point.append(coordinate)
    return np.array(point)


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw the bodies, their places and their velocities."""
    return draw_bodies(size, scenario, rng, PLANE_SHAPES)


def draw_bodies(
    size: Size, scenario: int, rng: RandomSource, kinds: BodyShapes
) -> InitialState:
    """Draw the bodies of a scenario in the plane or in space, by their shapes.

    Args:
        size: the split and size.
        scenario: number of the scenario; it chooses the materials.
        rng: source of the draws.
        kinds: shapes of the bodies, in the plane or in space.

    Raises:
        WorkFailedError: the bodies find no places apart from one another.
    """
    materials = _materials(size, scenario)
    shapes = []
    for material in materials:
        shape = _draw_shape(rng, material, size, kinds)
        shapes.append(shape)
    bodies = _place_apart(rng, size, shapes)
    measures = [shape.measure for shape in shapes]
    counts = _share_particles(size.particles, measures)

    # the attractor: velocity of each body = rate (point - centre) [length/s]
    point = _draw_attractor(rng, size)
    rate = draw_between(rng, size, "attraction")
    velocities = []
    for body in bodies:
        exact_velocity = rate * (point - body.centre)
        velocity = quantise(exact_velocity)
        velocities.append(velocity)

    friction = 0.0
    if Material.LIQUID not in materials:
        friction = float(size.value("friction"))

    positions = []
    for body, count in zip(bodies, counts, strict=True):
        position = sample_points(rng, body, count)
        positions.append(position)
    names = [material.name.lower() for material in materials]
    parameters: dict[str, int | float | str] = {
        "pair": "-".join(names),
        "attraction": rate,
        "friction": friction,
    }
    for body_values in zip(_NAMES, bodies, measures, velocities, strict=False):
        parameters |= _body_parameters(*body_values)
    dimension = size.dimension
    affine_shape = (size.particles, dimension, dimension)
    wall_shape = (2 * dimension, dimension)
    body_velocity = np.stack(velocities)
    body_material = np.array(materials, dtype=np.int8)
    return InitialState(
        position=np.concatenate(positions),
        velocity=np.repeat(body_velocity, counts, axis=0),
        affine=np.zeros(affine_shape),
        material=np.repeat(body_material, counts),
        area=add_in_order(measures),
        wall_velocity=np.zeros(wall_shape),
        friction=friction,
        parameters=parameters,
    )
