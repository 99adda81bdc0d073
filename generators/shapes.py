"""Shapes of bodies, where they may lie, and evenly spread particles inside them.

A shape stands about the origin. Its distance function is negative inside, so that one
definition says what the shape contains and how far it keeps from another.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import WorkFailedError

from .draws import RandomSource, quantise, uniform

__all__ = [
    "Blobs",
    "Body",
    "Disc",
    "Rectangle",
    "Region",
    "Shape",
    "body_at",
    "place",
    "seeds",
]

Array = NDArray[np.float64]
Region = tuple[tuple[float, float], tuple[float, float]]
"""Where a bounding box may lie: (left, right), (bottom, top) [length]."""

# Roberts' R2 sequence: 1/g and 1/g^2 for the real root g of g^3 = g + 1.
_R2 = np.array([0.7548776662466927, 0.5698402909980532])


class Shape(Protocol):
    """A body's outline about the origin."""

    @property
    def area(self) -> float:
        """Area [length^2]."""

    @property
    def reach(self) -> tuple[float, float]:
        """Half the width and half the height of the bounding box [length]."""

    def distance(self, position: Array) -> Array:
        """Return the signed distance, negative inside [length], shape [point]."""


@dataclass(frozen=True)
class Rectangle:
    """A rectangle whose length lies along a unit vector."""

    length: float  # extent along 'axis' [length]
    width: float  # extent across it [length]
    axis: tuple[float, float] = (1.0, 0.0)  # unit vector

    @classmethod
    def of_area(cls, area: float, aspect: float) -> Rectangle:
        """Return the level rectangle of this area [length^2] and length over width
        [1].
        """
        length = math.sqrt(area * aspect)
        return cls(length, area / length)

    @property
    def area(self) -> float:
        """Length times width."""
        return self.length * self.width

    @property
    def reach(self) -> tuple[float, float]:
        """Half the bounding box of the turned rectangle."""
        c = abs(self.axis[0])
        s = abs(self.axis[1])
        return 0.5 * (c * self.length + s * self.width), 0.5 * (
            s * self.length + c * self.width
        )

    def distance(self, position: Array) -> Array:
        """Return the exact signed distance."""
        (c, s), (x, y) = self.axis, position.T
        along = np.abs(c * x + s * y) - 0.5 * self.length
        across = np.abs(c * y - s * x) - 0.5 * self.width
        inside = np.minimum(np.maximum(along, across), 0.0)
        along = np.maximum(along, 0.0)
        across = np.maximum(across, 0.0)
        return np.asarray(np.sqrt(along * along + across * across) + inside)


@dataclass(frozen=True)
class Disc:
    """A disc of a given radius [length]."""

    radius: float

    @classmethod
    def of_area(cls, area: float) -> Disc:
        """Return the disc that covers this area [length^2]."""
        return cls(math.sqrt(area / math.pi))

    @property
    def area(self) -> float:
        """Pi times the radius squared."""
        return math.pi * self.radius * self.radius

    @property
    def reach(self) -> tuple[float, float]:
        """The radius, twice."""
        return self.radius, self.radius

    def distance(self, position: Array) -> Array:
        """Return the exact signed distance."""
        x, y = position.T
        return np.asarray(np.sqrt(x * x + y * y) - self.radius)


@dataclass(frozen=True)
class Blobs:
    """The union of discs of one radius; their bounding box is centred on the origin."""

    centres: tuple[tuple[float, float], ...]  # centres of the discs [length]
    radius: float  # their radius [length]
    area: float  # area of the union [length^2]

    @classmethod
    def of_area(cls, area: float, offsets: Array, *, cells: int) -> Blobs:
        """Scale an arrangement of unit discs, centres in radii [disc, 2], until their
        union covers an area.

        The union of unit discs is measured once, by counting cells of a grid, so many
        across the bounding box; at 512 the error is about 1e-3. Any other area follows
        by its scale.
        """
        low = offsets.min(axis=0) - 1.0
        high = offsets.max(axis=0) + 1.0
        centres = offsets - 0.5 * (low + high)
        extent = high - low
        middle = (np.arange(cells) + 0.5) / cells - 0.5
        x, y = (
            side.ravel() for side in np.meshgrid(middle * extent[0], middle * extent[1])
        )
        covered = np.zeros(cells * cells, dtype=np.bool_)
        for centre in centres:
            dx = x - centre[0]
            dy = y - centre[1]
            covered |= dx * dx + dy * dy <= 1.0
        counted = float(np.count_nonzero(covered) * (extent[0] * extent[1])) / (
            cells * cells
        )
        scale = math.sqrt(area / counted)
        placed = tuple((float(x) * scale, float(y) * scale) for x, y in centres)
        return cls(placed, scale, area)

    @property
    def reach(self) -> tuple[float, float]:
        """Half the bounding box of all discs."""
        x, y = (max(axis) + self.radius for axis in zip(*self.centres, strict=True))
        return x, y

    def distance(self, position: Array) -> Array:
        """Return the signed distance, exact outside and on the outline."""
        discs = [
            Disc(self.radius).distance(position - np.array(c)) for c in self.centres
        ]
        return np.asarray(np.minimum.reduce(discs))


@dataclass(frozen=True)
class Body:
    """A shape put somewhere."""

    shape: Shape  # outline about the origin
    centre: Array  # where the origin lies [length], shape [2]

    def distance(self, position: Array) -> Array:
        """Return the signed distance from the outline, negative inside [length]."""
        return self.shape.distance(position - self.centre)


def body_at(shape: Shape, x: float, y: float) -> Body:
    """Put a shape at a point, rounded to multiples of 2^-20."""
    return Body(shape, quantise([x, y]))


def place(rng: RandomSource, shape: Shape, region: Region) -> Body:
    """Put a shape uniformly at random where its bounding box lies within a region."""
    centre = []
    for reach, (low, high) in zip(shape.reach, region, strict=True):
        if high - low < 2.0 * reach:
            raise WorkFailedError(
                "a body does not fit between the walls",
                expected=f"extent up to {high - low:.4f}",
                got=f"{2.0 * reach:.4f}",
                fix="lower the areas or lengths of this split in datasets.yaml",
            )
        centre.append(uniform(rng, low + reach, high - reach))
    return body_at(shape, *centre)


def seeds(rng: RandomSource, body: Body, count: int) -> Array:
    """Spread particles evenly inside a body: multiples of 2^-20 [length], shape [count,
    2].

    The first ``count`` points inside it of Roberts' R2 low-discrepancy sequence, laid
    by a random shift over the smallest square about the bounding box, so that spacings
    are alike in both directions however slender the body is.
    """
    shift = rng.random((2,))
    side = 2.0 * max(body.shape.reach)
    # at once: a million particles take no memory beside their own
    block = min(4 * count, 1 << 16)
    found = [np.empty((0, 2))]
    missing = count
    start = 1
    while missing > 0:
        index = np.arange(start, start + block, dtype=np.float64)[:, None]
        turns = shift + index * _R2
        local = (turns - np.floor(turns) - 0.5) * side
        inside = local[body.shape.distance(local) <= 0.0][:missing]
        found.append(inside)
        missing -= len(inside)
        start += block
    return quantise(body.centre + np.concatenate(found))
