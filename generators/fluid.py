"""A body of liquid that falls, is thrown or splashes (thesis §4.3, Fig. 4.3).

Families by id % 4: 0 falling rectangle, 1 body thrown at the right wall, 2 falling circle,
3 splash (four overlapping discs with velocities of their own, which tear the body apart
before it falls). Expected behaviour: a jet along the walls after the impact, sloshing, rest.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .base import FreeSurfaceParameters, InitialState, Material
from .draws import RandomSource, choice, direction, normal, quantise, uniform
from .parameters import constants, free_surface_walls
from .shapes import Blobs, Body, Disc, Rectangle, Region, Shape, place, seeds

if TYPE_CHECKING:
    from lagbench.registry import Size

__all__ = ["FAMILIES", "initial_state", "solver_parameters"]

Array = NDArray[np.float64]

FAMILIES = ("falling-rectangle", "thrown", "falling-circle", "splash")
"""Family of a scenario, by id % 4."""

MARGIN = 0.02
"""Least distance between a body and a wall at the start [length]."""

ASPECT = (0.6, 1.7)
"""Width over height of a rectangle, least and greatest."""

_REGION: dict[str, Region] = {
    "falling-rectangle": ((0.0, 1.0), (0.35, 1.0)),
    "falling-circle": ((0.0, 1.0), (0.35, 1.0)),
    "thrown": ((0.0, 0.7), (0.1, 0.85)),
    "splash": ((0.12, 0.88), (0.2, 0.8)),
}
# Least and greatest velocity of the whole body, per component [length/s].
_VELOCITY: dict[str, Region] = {
    "falling-rectangle": ((-0.3, 0.3), (-0.3, 0.0)),
    "falling-circle": ((-0.3, 0.3), (-0.3, 0.0)),
    "thrown": ((1.0, 2.0), (0.0, 1.0)),
    "splash": ((0.0, 0.0), (0.5, 0.5)),
}
_BLOBS = 4
_BLOB_SPEED = 0.7
_PARTICLE_SPEED = 0.5


def solver_parameters(size: Size) -> FreeSurfaceParameters:
    """Return the constants of design 4.4 at this size."""
    return constants(FreeSurfaceParameters, size)


def _rectangle(rng: RandomSource, area: float) -> Rectangle:
    width = math.sqrt(area * uniform(rng, *ASPECT))
    return Rectangle(width, area / width)


def _blobs(rng: RandomSource, area: float) -> Blobs:
    """Draw discs that all reach a common point, so that the body is one piece."""
    offsets = [(uniform(rng, 0.5, 0.95), direction(rng)) for _ in range(_BLOBS)]
    return Blobs.of_area(area, np.array([(r * x, r * y) for r, (x, y) in offsets]))


def _shape(rng: RandomSource, family: str, area: float) -> Shape:
    if family == "splash":
        return _blobs(rng, area)
    if family == "falling-circle" or (family == "thrown" and choice(rng, 2) == 1):
        return Disc.of_area(area)
    return _rectangle(rng, area)


def _within_walls(region: Region, size: Size) -> Region:
    """Return the part of a region that keeps its margin from the walls."""
    low, high = free_surface_walls(size)
    (left, right), (bottom, top) = region
    least, most = low + MARGIN, high - MARGIN
    return (max(left, least), min(right, most)), (max(bottom, least), min(top, most))


def _splash(rng: RandomSource, body: Body, position: Array) -> Array:
    """Return velocities of the blobs, blended by inverse squared distance, plus noise.

    v(x) = sum_k v_k / d_k^2 / sum_k 1 / d_k^2, with d_k the distance from the centre of
    disc k (softened by 0.01): noise of single particles alone is averaged away by the grid.
    """
    if not isinstance(body.shape, Blobs):
        return np.zeros_like(position)
    own = normal(rng, _BLOB_SPEED, (_BLOBS, 2))
    total, weights = np.zeros_like(position), np.zeros((len(position), 1))
    for centre, velocity in zip(body.shape.centres, own, strict=True):
        x, y = (position - body.centre - np.array(centre)).T
        weight = (1.0 / (x * x + y * y + 1e-4))[:, None]
        total, weights = total + weight * velocity, weights + weight
    return total / weights + normal(rng, _PARTICLE_SPEED, position.shape)


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw a body of liquid, its place and its velocity."""
    family = FAMILIES[scenario % len(FAMILIES)]
    area = uniform(rng, size.value("area_min"), size.value("area_max"))
    body = place(rng, _shape(rng, family, area), _within_walls(_REGION[family], size))
    drift = [uniform(rng, *interval) for interval in _VELOCITY[family]]
    position = seeds(rng, body, size.particles)
    return InitialState(
        position=position,
        velocity=quantise(np.array(drift) + _splash(rng, body, position)),
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
