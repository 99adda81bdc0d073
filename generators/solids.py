"""Bodies in three dimensions and evenly spread particles inside them.

A solid stands about the origin. Its distance function is negative inside.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .draws import RandomSource, quantise

__all__ = ["Ball", "Block", "Solid", "sample_solid"]

Array = NDArray[np.float64]

# Roberts' R3 sequence: 1/g, 1/g^2 and 1/g^3 for the real root g of g^4 = g + 1.
_R3 = np.array([0.8191725133961645, 0.6710436067037893, 0.5497004779019703])


class Solid(Protocol):
    """A body's surface about the origin."""

    @property
    def volume(self) -> float:
        """Volume [length^3]."""

    @property
    def reach(self) -> tuple[float, float, float]:
        """Half the sides of the bounding box [length]."""

    def distance(self, position: Array) -> Array:
        """Return the signed distance, negative inside [length], shape [point]."""


@dataclass(frozen=True)
class Ball:
    """A ball of a given radius [length]."""

    radius: float

    @property
    def volume(self) -> float:
        """Four thirds of pi times the radius cubed."""
        return 4.0 / 3.0 * math.pi * self.radius * self.radius * self.radius

    @property
    def reach(self) -> tuple[float, float, float]:
        """The radius, three times."""
        return self.radius, self.radius, self.radius

    def distance(self, position: Array) -> Array:
        """Return the exact signed distance."""
        x, y, z = position.T
        return np.asarray(np.sqrt(x * x + y * y + z * z) - self.radius)


@dataclass(frozen=True)
class Block:
    """A block whose edges lie along the axes."""

    sides: tuple[float, float, float]  # extents along x, y and z [length]

    @property
    def volume(self) -> float:
        """Product of the sides."""
        return self.sides[0] * self.sides[1] * self.sides[2]

    @property
    def reach(self) -> tuple[float, float, float]:
        """Half the sides."""
        return 0.5 * self.sides[0], 0.5 * self.sides[1], 0.5 * self.sides[2]

    def distance(self, position: Array) -> Array:
        """Return the exact signed distance."""
        beyond = np.abs(position) - np.array(self.reach)
        inside = np.minimum(beyond.max(axis=1), 0.0)
        x, y, z = np.maximum(beyond, 0.0).T
        outside = np.sqrt(x * x + y * y + z * z)
        return np.asarray(outside + inside)


def sample_solid(
    rng: RandomSource, solid: Solid, centre: tuple[float, float, float], count: int
) -> Array:
    """Spread particles evenly inside a solid.

    These are the first ``count`` points inside it of Roberts' R3 low-discrepancy
    sequence. The sequence is laid by a random shift over the smallest cube about the
    bounding box, so that spacings are alike in all directions however slender the
    solid is.

    Args:
        rng: source of the shift.
        solid: the solid about the origin.
        centre: where its origin lies [length].
        count: how many particles.

    Returns:
        Positions [length], multiples of 2^-20, shape [count, 3].
    """
    shift = rng.random((3,))
    side = 2.0 * max(solid.reach)
    # in blocks: a million particles take no memory beside their own
    block_size = min(4 * count, 1 << 16)
    blocks = [np.empty((0, 3))]
    missing_count = count
    start = 1
    while missing_count > 0:
        index = np.arange(start, start + block_size, dtype=np.float64)[:, None]
        turns = shift + index * _R3
        local = (turns - np.floor(turns) - 0.5) * side
        is_inside = solid.distance(local) <= 0.0
        points = local[is_inside][:missing_count]
        blocks.append(points)
        missing_count -= len(points)
        start += block_size
    return quantise(np.array(centre) + np.concatenate(blocks))
