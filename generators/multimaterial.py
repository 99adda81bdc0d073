"""Two bodies of different materials collide and fall (thesis §4.3, §4.8.2, Fig. 4.2).

Pairs by id % 6: 0 liquid-snow, 1 rope-snow, 2 rope-liquid, 3 snow-snow, 4 rope-jelly ball,
5 liquid-liquid. The bodies start apart; an attractor has acted before the first frame
(§4.3.2): each moves towards one common point high in the box, at a rate drawn for the scenario, so
that they meet in flight and from the side. Expected behaviour: liquid splashes and settles, snow
breaks and stays, rope bends, jelly rebounds. Two snow bodies rest after about 100 frames.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import WorkFailedError

from .constants import constants, free_surface_walls, interval, ranges
from .draws import RandomSource, choice, direction, quantise, uniform
from .shapes import Body, Disc, Rectangle, Shape, place, seeds
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

# Says when to give up; no scenario of datasets.yaml comes near it.
_ATTEMPTS = 1000


def solver_parameters(size: Size) -> FreeSurfaceParameters:
    """Return the constants of design 4.4 at this size."""
    return constants(FreeSurfaceParameters, size)


def _rope(rng: RandomSource, size: Size) -> Rectangle:
    length = uniform(rng, *interval(size, "rope_length"))
    return Rectangle(length, size.value("rope_width"), direction(rng))


def _shape(rng: RandomSource, material: Material, size: Size) -> Shape:
    """Draw a rope, a ball of jelly, or a rectangle or disc of anything else."""
    if material is Material.ROPE:
        return _rope(rng, size)
    area = uniform(rng, *interval(size, "area"))
    if material is Material.JELLY or choice(rng, 2) == 1:
        return Disc.of_area(area)
    width = math.sqrt(area * uniform(rng, *interval(size, "aspect")))
    return Rectangle(width, area / width)


def _shares(count: int, first: Shape, second: Shape) -> tuple[int, int]:
    """Divide the particles by area, to the nearest particle."""
    own = math.floor(count * first.area / (first.area + second.area) + 0.5)
    return own, count - own


def _apart(rng: RandomSource, size: Size, shapes: tuple[Shape, Shape]) -> tuple[Body, Body]:
    """Place two shapes between the walls until they keep their gap.

    The second's outline is probed where it matters: at evenly spread points inside it.
    """
    low, high = free_surface_walls(size)
    inner = (low + size.value("margin"), high - size.value("margin"))
    gap, cells = float(size.value("gap")), int(size.value("gap_cells"))
    for _ in range(_ATTEMPTS):
        first, second = (place(rng, shape, (inner, inner)) for shape in shapes)
        if float(np.min(first.distance(_probe(second, cells)))) >= gap:
            return first, second
    raise WorkFailedError(
        "two bodies found no room side by side",
        expected=f"a gap of {gap} within {_ATTEMPTS} attempts",
        fix="lower the areas or lengths of this split in datasets.yaml",
    )


def _probe(body: Body, cells: int) -> Array:
    """Return nodes of a grid over a body that lie inside it [length], shape [point, 2].

    The grid has ``cells`` cells across the bounding box, each way.
    """
    side = (2.0 * np.arange(cells + 1) - cells) / cells
    x, y = np.meshgrid(side * body.shape.reach[0], side * body.shape.reach[1])
    grid = body.centre + np.stack([x.ravel(), y.ravel()], axis=-1)
    return np.asarray(grid[body.distance(grid) <= 0.0])


def _pull(rng: RandomSource, bodies: tuple[Body, Body], size: Size) -> tuple[Array, Array, float]:
    """Draw the attractor: velocity of each body = rate (point - centre) [length/s]."""
    point = np.array([uniform(rng, *component) for component in ranges(size, "attractor")])
    rate = uniform(rng, *interval(size, "attraction"))
    first, second = (quantise(rate * (point - body.centre)) for body in bodies)
    return first, second, rate


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw two bodies, their places and their velocities."""
    materials = PAIRS[scenario % len(PAIRS)]
    first, second = (_shape(rng, material, size) for material in materials)
    bodies = _apart(rng, size, (first, second))
    counts = _shares(size.particles, first, second)
    *velocities, rate = _pull(rng, bodies, size)
    friction = 0.0 if Material.LIQUID in materials else float(size.value("friction"))
    drawn: dict[str, int | float | str] = {
        "pair": "-".join(material.name.lower() for material in materials),
        "attraction": rate,
        "friction": friction,
    }
    for name, body, velocity in zip(("first", "second"), bodies, velocities, strict=True):
        drawn |= _describe(name, body, velocity)
    return InitialState(
        position=np.concatenate([seeds(rng, b, n) for b, n in zip(bodies, counts, strict=True)]),
        velocity=np.repeat(np.stack(velocities), counts, axis=0),
        affine=np.zeros((size.particles, 2, 2)),
        material=np.repeat(np.array(materials, dtype=np.int8), counts),
        area=first.area + second.area,
        friction=friction,
        parameters=drawn,
    )


def _describe(name: str, body: Body, velocity: Array) -> dict[str, int | float | str]:
    """Return what the file says about a body."""
    return {
        f"{name}_shape": type(body.shape).__name__.lower(),
        f"{name}_area": body.shape.area,
        f"{name}_centre_x": float(body.centre[0]),
        f"{name}_centre_y": float(body.centre[1]),
        f"{name}_velocity_x": float(velocity[0]),
        f"{name}_velocity_y": float(velocity[1]),
    }
