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
    return constants(FreeSurfaceParameters, size, dimension=size.dimension)


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
    # from -1 to 1
    unit_axis = (2.0 * np.arange(cell_count + 1) - cell_count) / cell_count
    axes = [unit_axis * reach for reach in shape.reach]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, len(axes))


def _are_apart(bodies: Sequence[Body], offsets: Sequence[Array], gap: float) -> bool:
    """Tell whether all bodies keep a gap [length] from one another.

    The later one of two is probed at those offsets from its centre that lie inside it.
    """
    for i, j in combinations(range(len(bodies)), 2):
        nodes = bodies[j].centre + offsets[j]
        is_inside = bodies[j].distance(nodes) <= 0.0
        if float(bodies[i].distance(nodes[is_inside]).min()) < gap:
            return False
    return True


def _place_apart(rng: RandomSource, size: Size, shapes: Sequence[Shape]) -> list[Body]:
    """Place shapes between the walls until all keep their gap from one another.

    A body is probed at the nodes of a grid of ``gap_cells`` cells over its bounding
    box, each way.
    """
    low, high = free_surface_walls(size)
    margin = size.value("margin")
    region = size.dimension * [(low + margin, high - margin)]
    gap = float(size.value("gap"))
    cell_count = int(size.value("gap_cells"))
    offsets = [_probe_nodes(shape, cell_count) for shape in shapes]

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
    parameters: dict[str, int | float | str] = {
        f"{name}_shape": type(body.shape).__name__.lower(),
        f"{name}_{measure_name}": measure,
    }
    for quantity, vector in (("centre", body.centre), ("velocity", velocity)):
        for axis, component in zip("xyz", vector.tolist(), strict=False):
            parameters[f"{name}_{quantity}_{axis}"] = component
    return parameters


def _share_particles(particle_count: int, measures: Sequence[float]) -> list[int]:
    """Return the particles of each body, in proportion to areas or volumes."""
    area = add_in_order(measures)
    counts = []
    for body_area in measures[:-1]:
        counts.append(math.floor(particle_count * body_area / area + 0.5))
    return [*counts, particle_count - sum(counts)]


def _materials(size: Size, scenario: int) -> tuple[Material, ...]:
    """Return the materials of the bodies of a scenario."""
    number = shift_number(size, scenario)
    if number is None:
        return PAIRS[scenario % len(PAIRS)]
    return TRIPLES[number % len(TRIPLES)]


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
    shapes = [_draw_shape(rng, material, size, kinds) for material in materials]
    bodies = _place_apart(rng, size, shapes)
    measures = [shape.measure for shape in shapes]
    counts = _share_particles(size.particles, measures)

    # the attractor: velocity of each body = rate (point - centre) [length/s]
    dimension = size.dimension
    axes = "xyz"[:dimension]
    point = np.array([draw_between(rng, size, f"attractor_{axis}") for axis in axes])
    rate = draw_between(rng, size, "attraction")
    velocities = [quantise(rate * (point - body.centre)) for body in bodies]

    friction = 0.0
    if Material.LIQUID not in materials:
        friction = float(size.value("friction"))

    positions = []
    for body, count in zip(bodies, counts, strict=True):
        positions.append(sample_points(rng, body, count))
    names = [material.name.lower() for material in materials]
    parameters: dict[str, int | float | str] = {
        "pair": "-".join(names),
        "attraction": rate,
        "friction": friction,
    }
    for body_values in zip(_NAMES, bodies, measures, velocities, strict=False):
        parameters |= _body_parameters(*body_values)
    return InitialState(
        position=np.concatenate(positions),
        velocity=np.repeat(np.stack(velocities), counts, axis=0),
        affine=np.zeros((size.particles, dimension, dimension)),
        material=np.repeat(np.array(materials, dtype=np.int8), counts),
        area=add_in_order(measures),
        wall_velocity=np.zeros((2 * dimension, dimension)),
        friction=friction,
        parameters=parameters,
    )
