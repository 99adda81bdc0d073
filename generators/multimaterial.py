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

from lagbench.errors import WorkFailedError

from .constants import constants, free_surface_walls, interval, ranges
from .draws import RandomSource, choice, direction, quantise, uniform
from .shapes import Body, Disc, Rectangle, Shape, place, seeds
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

# Says when to give up; no scenario of datasets.yaml comes near it.
_ATTEMPTS = 1000


def solver_parameters(size: Size) -> FreeSurfaceParameters:
    """Return the constants of design 4.4 at this size."""
    return constants(FreeSurfaceParameters, size)


def _shape(rng: RandomSource, material: Material, size: Size) -> Shape:
    """Draw a rope, a ball of jelly, or a rectangle or disc of anything else."""
    if material is Material.ROPE:
        length = uniform(rng, *interval(size, "rope_length"))
        return Rectangle(length, size.value("rope_width"), direction(rng))
    area = uniform(rng, *interval(size, "area"))
    if material is Material.JELLY or choice(rng, 2) == 1:
        return Disc.of_area(area)
    return Rectangle.of_area(area, uniform(rng, *interval(size, "aspect")))


def _apart(
    rng: RandomSource, size: Size, shapes: tuple[Shape, Shape]
) -> tuple[Body, Body]:
    """Place two shapes between the walls until they keep their gap.

    The second is probed at those nodes of a grid of ``gap_cells`` cells over its
    bounding box, each way, that lie inside it.
    """
    low, high = free_surface_walls(size)
    inner = (low + size.value("margin"), high - size.value("margin"))
    gap = float(size.value("gap"))
    cells = int(size.value("gap_cells"))
    side = (2.0 * np.arange(cells + 1) - cells) / cells
    x, y = np.meshgrid(side * shapes[1].reach[0], side * shapes[1].reach[1])
    offsets = np.stack([x.ravel(), y.ravel()], axis=-1)
    for _ in range(_ATTEMPTS):
        first, second = (place(rng, shape, (inner, inner)) for shape in shapes)
        grid = second.centre + offsets
        if float(np.min(first.distance(grid[second.distance(grid) <= 0.0]))) >= gap:
            return first, second
    raise WorkFailedError(
        "two bodies found no room side by side",
        expected=f"a gap of {gap} within {_ATTEMPTS} attempts",
        fix="lower the areas or lengths of this split in datasets.yaml",
    )


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw two bodies, their places and their velocities."""
    materials = PAIRS[scenario % len(PAIRS)]
    first, second = (_shape(rng, material, size) for material in materials)
    bodies = _apart(rng, size, (first, second))
    own = math.floor(size.particles * first.area / (first.area + second.area) + 0.5)
    counts = own, size.particles - own
    # the attractor: velocity of each body = rate (point - centre) [length/s]
    point = np.array(
        [uniform(rng, *component) for component in ranges(size, "attractor")]
    )
    rate = uniform(rng, *interval(size, "attraction"))
    velocities = [quantise(rate * (point - body.centre)) for body in bodies]
    friction = 0.0 if Material.LIQUID in materials else float(size.value("friction"))
    drawn: dict[str, int | float | str] = {
        "pair": "-".join(material.name.lower() for material in materials),
        "attraction": rate,
        "friction": friction,
    }
    for name, body, velocity in zip(
        ("first", "second"), bodies, velocities, strict=True
    ):
        drawn |= {
            f"{name}_shape": type(body.shape).__name__.lower(),
            f"{name}_area": body.shape.area,
        }
        for what, (x, y) in (
            ("centre", body.centre.tolist()),
            ("velocity", velocity.tolist()),
        ):
            drawn |= {f"{name}_{what}_x": x, f"{name}_{what}_y": y}
    return InitialState(
        position=np.concatenate(
            [seeds(rng, b, n) for b, n in zip(bodies, counts, strict=True)]
        ),
        velocity=np.repeat(np.stack(velocities), counts, axis=0),
        affine=np.zeros((size.particles, 2, 2)),
        material=np.repeat(np.array(materials, dtype=np.int8), counts),
        area=first.area + second.area,
        friction=friction,
        parameters=drawn,
    )
