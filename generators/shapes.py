"""Shapes of bodies, where they may lie, and evenly spread particles inside them.

A shape stands about the origin, in the plane or in space. Its distance function is
negative inside, so that one definition says what the shape contains and how far it
keeps from another.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import WorkFailedError

from .draws import RandomSource, quantise, uniform

__all__ = [
    "Ball",
    "Blobs",
    "Block",
    "Body",
    "Disc",
    "Rectangle",
    "Region",
    "Rod",
    "Shape",
    "body_at",
    "check_room",
    "cube_root",
    "place",
    "sample_points",
]

Array = NDArray[np.float64]
Region = Sequence[tuple[float, float]]
"""Where a bounding box may lie: lowest and highest coordinate along each axis [length].
"""

# Roberts' low-discrepancy sequences by number of axes: 1/g, 1/g^2, ... for the real
# root g of g^3 = g + 1 in the plane and of g^4 = g + 1 in space.
_ROBERTS = {
    2: np.array([0.7548776662466927, 0.5698402909980532]),
    3: np.array([0.8191725133961645, 0.6710436067037893, 0.5497004779019703]),
}


LEAST_SHARE = 1e-6
"""Share of the square or cube around a body that the body fills, at least."""


class Shape(Protocol):
    """A body's outline about the origin."""

    @property
    def measure(self) -> float:
        """Area [length^2], in space volume [length^3]."""

    @property
    def reach(self) -> tuple[float, ...]:
        """Half the sides of the bounding box [length]."""

    def distance(self, position: Array) -> Array:
        """Return the signed distance, negative inside [length], shape [point]."""


def _length(components: Iterable[Array]) -> Array:
    """Return the lengths of vectors, whose squares are added in this order."""
    square = np.zeros(())
    for component in components:
        square = square + component * component
    return np.sqrt(square)


def _distance_from_faces(*beyond: Array) -> Array:
    """Return the signed distance from a convex shape with right angles.

    Args:
        beyond: distances beyond its pairs of faces, negative between them [length].
    """
    inside = np.minimum(np.maximum.reduce(beyond), 0.0)
    outside = _length([np.maximum(distance, 0.0) for distance in beyond])
    return np.asarray(outside + inside)


@dataclass(frozen=True)
class Rectangle:
    """A rectangle whose length lies along a unit vector."""

    length: float  # extent along 'axis' [length]
    width: float  # extent across it [length]
    axis: tuple[float, ...] = (1.0, 0.0)  # unit vector

    @classmethod
    def of_area(cls, area: float, aspect: float) -> Rectangle:
        """Return the level rectangle of an area [length^2] and an aspect ratio [1]."""
        length = math.sqrt(area * aspect)
        return cls(length, area / length)

    @property
    def measure(self) -> float:
        """Length times width."""
        return self.length * self.width

    @property
    def reach(self) -> tuple[float, ...]:
        """Half the bounding box of the turned rectangle."""
        x, y = self.axis
        width = abs(x) * self.length + abs(y) * self.width
        height = abs(y) * self.length + abs(x) * self.width
        return 0.5 * width, 0.5 * height

    def distance(self, position: Array) -> Array:
        """Return the exact signed distance."""
        c, s = self.axis
        x, y = position.T
        along = np.abs(c * x + s * y) - 0.5 * self.length
        across = np.abs(c * y - s * x) - 0.5 * self.width
        return _distance_from_faces(along, across)


@dataclass(frozen=True)
class Disc:
    """A disc of a given radius [length]."""

    dimension: ClassVar[int] = 2
    radius: float

    @classmethod
    def of_area(cls, area: float) -> Disc:
        """Return the disc that covers this area [length^2]."""
        return cls(math.sqrt(area / math.pi))

    @property
    def measure(self) -> float:
        """Pi times the radius squared."""
        return math.pi * self.radius * self.radius

    @property
    def reach(self) -> tuple[float, ...]:
        """The radius along each axis."""
        return (self.radius,) * self.dimension

    def distance(self, position: Array) -> Array:
        """Return the exact signed distance."""
        return np.asarray(_length(position.T) - self.radius)


class Ball(Disc):
    """A ball of a given radius [length]."""

    dimension = 3

    @classmethod
    def of_volume(cls, volume: float) -> Ball:
        """Return the ball that fills this volume [length^3]."""
        return cls(cube_root(volume / (4.0 / 3.0 * math.pi)))

    @property
    def measure(self) -> float:
        """Four thirds of pi times the radius cubed."""
        r = self.radius
        return 4.0 / 3.0 * math.pi * r * r * r


@dataclass(frozen=True)
class Block:
    """A block whose edges lie along the axes."""

    sides: tuple[float, float, float]  # extents along x, y and z [length]

    @classmethod
    def of_volume(cls, volume: float, aspects: tuple[float, float]) -> Block:
        """Return the block of a volume [length^3] whose x and z are these multiples of
        its height [1].
        """
        along_x, along_z = aspects
        height = cube_root(volume / (along_x * along_z))
        return cls((along_x * height, height, along_z * height))

    @property
    def measure(self) -> float:
        """Product of the sides."""
        width, height, depth = self.sides
        return width * height * depth

    @property
    def reach(self) -> tuple[float, ...]:
        """Half the sides."""
        return tuple(0.5 * side for side in self.sides)

    def distance(self, position: Array) -> Array:
        """Return the exact signed distance."""
        return _distance_from_faces(*(np.abs(position) - np.array(self.reach)).T)


@dataclass(frozen=True)
class Rod:
    """A round rod, that is a cylinder, whose length lies along a unit vector."""

    length: float  # extent along 'axis' [length]
    radius: float  # of its cross-section [length]
    axis: tuple[float, ...] = (1.0, 0.0, 0.0)  # unit vector

    @property
    def measure(self) -> float:
        """Pi times the radius squared times the length."""
        return math.pi * self.radius * self.radius * self.length

    @property
    def reach(self) -> tuple[float, ...]:
        """Half the bounding box of the turned rod."""
        reaches = []
        for component in self.axis:
            sine = math.sqrt(max(0.0, 1.0 - component * component))
            reaches.append(0.5 * self.length * abs(component) + self.radius * sine)
        return tuple(reaches)

    def distance(self, position: Array) -> Array:
        """Return the exact signed distance."""
        x, y, z = position.T
        a, b, c = self.axis
        height = a * x + b * y + c * z
        square = x * x + y * y + z * z - height * height
        along = np.abs(height) - 0.5 * self.length
        across = np.sqrt(np.maximum(square, 0.0)) - self.radius
        return _distance_from_faces(along, across)


def cube_root(value: float) -> float:
    """Return the cube root of a positive number by Newton's method.

    Only + - * / are used, so that the result has the same bits on every x86-64 Linux
    CPU.

    >>> cube_root(27.0)
    3.0
    """
    root = max(1.0, value)
    while True:
        smaller = root - (root * root * root - value) / (3.0 * root * root)
        if not smaller < root:
            return root
        root = smaller


@dataclass(frozen=True)
class Blobs:
    """The union of discs of one radius; their bounding box is centred on the origin."""

    centres: tuple[tuple[float, float], ...]  # centres of the discs [length]
    radius: float  # their radius [length]
    measure: float  # area of the union [length^2]

    @classmethod
    def of_area(cls, area: float, offsets: Array, *, cells: int) -> Blobs:
        """Scale an arrangement of unit discs until their union covers an area.

        The union of unit discs is measured by counting cells of a grid; at 512 cells
        the error is about 1e-3. Any other area follows by its scale.

        Args:
            area: area of the scaled union [length^2].
            offsets: centres of the unit discs [radius], shape [disc, 2].
            cells: cells of the grid across the bounding box.
        """
        low = offsets.min(axis=0) - 1.0
        high = offsets.max(axis=0) + 1.0
        centres = offsets - 0.5 * (low + high)
        width, height = high - low
        # middles of the cells from the centre, as shares of the box
        middle = (np.arange(cells) + 0.5) / cells - 0.5
        x, y = np.meshgrid(middle * width, middle * height)
        cell_count = cells * cells
        is_covered = np.zeros((cells, cells), dtype=np.bool_)
        for centre_x, centre_y in centres:
            dx = x - centre_x
            dy = y - centre_y
            is_covered |= dx * dx + dy * dy <= 1.0
        box_area = width * height
        unit_area = float(np.count_nonzero(is_covered) * box_area) / cell_count
        scale = math.sqrt(area / unit_area)
        scaled = []
        for centre_x, centre_y in centres.tolist():
            scaled_x = centre_x * scale
            scaled_y = centre_y * scale
            scaled.append((scaled_x, scaled_y))
        return cls(tuple(scaled), scale, area)

    @property
    def reach(self) -> tuple[float, float]:
        """Half the bounding box of all discs."""
        x, y = zip(*self.centres, strict=True)
        reach_x = max(x) + self.radius
        reach_y = max(y) + self.radius
        return reach_x, reach_y

    def distance(self, position: Array) -> Array:
        """Return the signed distance, exact outside and on the outline."""
        disc = Disc(self.radius)
        distances = []
        for centre in self.centres:
            from_centre = position - np.array(centre)
            distances.append(disc.distance(from_centre))
        return np.asarray(np.minimum.reduce(distances))


@dataclass(frozen=True)
class Body:
    """A shape put somewhere."""

    shape: Shape  # outline about the origin
    centre: Array  # where the origin lies [length], shape [axis]

    def distance(self, position: Array) -> Array:
        """Return the signed distance from the outline, negative inside [length]."""
        return self.shape.distance(position - self.centre)


def body_at(shape: Shape, *centre: float) -> Body:
    """Put a shape at a point, rounded to multiples of 2^-20."""
    return Body(shape, quantise(centre))


def check_room(shape: Shape, region: Region) -> None:
    """Refuse a region that is too small for the bounding box of a shape.

    Raises:
        WorkFailedError: it is, along some axis.
    """
    for reach, (low, high) in zip(shape.reach, region, strict=True):
        room = high - low
        extent = 2.0 * reach
        if room < extent:
            raise WorkFailedError(
                f"a body does not fit between the walls: got {extent:.4f}, expected "
                f"extent up to {room:.4f}; lower the areas or lengths in the file of "
                "the split",
                where=f"{type(shape).__name__} between {low:.4f} and {high:.4f}",
            )


def place(rng: RandomSource, shape: Shape, region: Region) -> Body:
    """Put a shape uniformly at random where its bounding box lies within a region.

    Raises:
        WorkFailedError: the region is too small for it.
    """
    check_room(shape, region)
    centre = []
    for reach, (low, high) in zip(shape.reach, region, strict=True):
        coordinate = uniform(rng, low + reach, high - reach)
        centre.append(coordinate)
    return body_at(shape, *centre)


def _check_share(shape: Shape, volume: float) -> None:
    """Refuse a shape that fills next to nothing of the square or cube around it.

    The search for points inside it would not end.
    """
    least = LEAST_SHARE * volume
    is_thick_enough = min(shape.reach) > 0.0 and shape.measure > least > 0.0
    if not is_thick_enough:
        raise WorkFailedError(
            f"a body is too thin to hold particles: got {shape.measure:g} of "
            f"{volume:g}, expected an area or volume above {LEAST_SHARE:g} of the "
            "square or cube around the body; correct the lengths of the shape",
            where=type(shape).__name__,
        )


def sample_points(rng: RandomSource, body: Body, count: int) -> Array:
    """Spread particles evenly inside a body.

    These are the first ``count`` points inside it of Roberts' low-discrepancy sequence.
    The sequence is laid by a random shift over the smallest square, or cube, about the
    bounding box, so that spacings are alike in all directions however slender the body
    is.

    Returns:
        Positions [length], multiples of 2^-20, shape [count, axis].

    Raises:
        WorkFailedError: the body is so thin that next to no point lies inside it, or
            its sides are no positive numbers.
    """
    reach = body.shape.reach
    dimension = len(reach)
    steps = _ROBERTS[dimension]
    shift = rng.random(steps.shape)
    side = 2.0 * max(reach)
    volume = 1.0  # of the square or cube
    for _ in range(dimension):
        volume *= side
    _check_share(body.shape, volume)
    # in blocks: a million particles take no memory beside their own
    block_size = min(4 * count, 1 << 16)
    blocks = [np.empty((0, dimension))]
    missing_count = count
    start = 1
    while missing_count > 0:
        index = np.arange(start, start + block_size, dtype=np.float64)
        turns = shift + index[:, None] * steps
        place = turns - np.floor(turns)  # in the unit square or cube
        local = (place - 0.5) * side
        is_inside = body.shape.distance(local) <= 0.0
        inside = local[is_inside]
        points = inside[:missing_count]
        blocks.append(points)
        missing_count -= len(points)
        start += block_size
    from_centre = np.concatenate(blocks)
    return quantise(body.centre + from_centre)
