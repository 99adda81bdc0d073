"""A body of liquid that falls, is thrown or splashes (thesis §4.3, Fig. 4.3).

Families by id % 4: 0 falling rectangle, 1 body thrown at the right wall, 2 falling
circle, 3 splash (four overlapping discs with velocities of their own, which tear the
body apart before it falls). Expected behaviour: a jet along the walls after the impact,
sloshing, rest.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .constants import constants, free_surface_walls, interval, ranges
from .draws import RandomSource, choice, direction, normal, quantise, uniform
from .shapes import Blobs, Body, Disc, Rectangle, Shape, place, seeds
from .split import FreeSurfaceParameters, InitialState, Material

if TYPE_CHECKING:
    from lagbench.data.registry import Size

Array = NDArray[np.float64]

FAMILIES = ("falling-rectangle", "thrown", "falling-circle", "splash")
"""Family of a scenario, by id % 4."""

# Families whose bodies start in one region with one range of velocities share its
# parameters.
_START = dict(zip(FAMILIES, ("falling", "thrown", "falling", "splash"), strict=True))


def solver_parameters(size: Size) -> FreeSurfaceParameters:
    """Return the constants of design 4.4 at this size."""
    return constants(FreeSurfaceParameters, size)


def _shape(rng: RandomSource, family: str, area: float, size: Size) -> Shape:
    if family == "splash":
        # All discs reach a common point, so that the body is one piece.
        reach = interval(size, "blob_offset")
        offsets = [
            (uniform(rng, *reach), direction(rng))
            for _ in range(size.value("blob_count"))
        ]
        arrangement = np.array([(r * x, r * y) for r, (x, y) in offsets])
        return Blobs.of_area(area, arrangement, cells=size.value("blob_cells"))
    if family == "falling-circle" or (family == "thrown" and choice(rng, 2) == 1):
        return Disc.of_area(area)
    return Rectangle.of_area(area, uniform(rng, *interval(size, "aspect")))


def _splash(rng: RandomSource, body: Body, position: Array, size: Size) -> Array:
    """Return velocities of the blobs, blended by inverse squared distance, plus noise.

    v(x) = sum_k v_k / d_k^2 / sum_k 1 / d_k^2, with d_k the distance from the centre of
    disc k (softened): noise of single particles alone is averaged away by the grid.
    """
    if not isinstance(body.shape, Blobs):
        return np.zeros_like(position)
    own = normal(rng, size.value("blob_speed"), (size.value("blob_count"), 2))
    softening = size.value("blob_softening")
    total = np.zeros_like(position)
    weights = np.zeros((len(position), 1))
    for centre, velocity in zip(body.shape.centres, own, strict=True):
        x, y = (position - body.centre - np.array(centre)).T
        weight = (1.0 / (x * x + y * y + softening * softening))[:, None]
        total = total + weight * velocity
        weights = weights + weight
    return total / weights + normal(rng, size.value("particle_speed"), position.shape)


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw a body of liquid, its place and its velocity."""
    family = FAMILIES[scenario % len(FAMILIES)]
    start = _START[family]
    area = uniform(rng, *interval(size, "area"))
    shape = _shape(rng, family, area, size)
    (left, right), (bottom, top) = ranges(size, start)
    low, high = free_surface_walls(size)
    least = low + size.value("margin")
    most = high - size.value("margin")
    region = (max(left, least), min(right, most)), (max(bottom, least), min(top, most))
    body = place(rng, shape, region)
    drift = [
        uniform(rng, *component) for component in ranges(size, f"{start}_velocity")
    ]
    position = seeds(rng, body, size.particles)
    return InitialState(
        position=position,
        velocity=quantise(np.array(drift) + _splash(rng, body, position, size)),
        affine=np.zeros((size.particles, 2, 2)),
        material=np.full(size.particles, Material.LIQUID, dtype=np.int8),
        area=area,
        parameters={
            "family": family,
            "area": area,
            "centre_x": float(body.centre[0]),
            "centre_y": float(body.centre[1]),
            "velocity_x": drift[0],
            "velocity_y": drift[1],
        },
    )
