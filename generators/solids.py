"""Shapes of bodies in three dimensions; those of the plane stand in :mod:`.shapes`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["Ball", "Block", "Rod", "Solid"]

Array = NDArray[np.float64]


class Solid(Protocol):
    """A :class:`.Shape` in three dimensions."""

    @property
    def measure(self) -> float:
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

    @classmethod
    def of_volume(cls, volume: float) -> Ball:
        """Return the ball that fills this volume [length^3]."""
        unit_volume = 4.0 / 3.0 * math.pi
        radius_cubed = volume / unit_volume
        radius = cube_root(radius_cubed)
        return cls(radius)

    @property
    def measure(self) -> float:
        """Four thirds of pi times the radius cubed."""
        r = self.radius
        unit_volume = 4.0 / 3.0 * math.pi
        return unit_volume * r * r * r

    @property
    def reach(self) -> tuple[float, float, float]:
        """The radius, three times."""
        return (self.radius, self.radius, self.radius)

    def distance(self, position: Array) -> Array:
        """Return the exact signed distance."""
        x, y, z = position.T
        square = x * x + y * y + z * z
        from_centre = np.sqrt(square)
        distance = from_centre - self.radius
        return np.asarray(distance)


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
        relative_area = along_x * along_z
        height_cubed = volume / relative_area
        height = cube_root(height_cubed)
        width = along_x * height
        depth = along_z * height
        return cls((width, height, depth))

    @property
    def measure(self) -> float:
        """Product of the sides."""
        width, height, depth = self.sides
        return width * height * depth

    @property
    def reach(self) -> tuple[float, float, float]:
        """Half the sides."""
        width, height, depth = self.sides
        reach_x = 0.5 * width
        reach_y = 0.5 * height
        reach_z = 0.5 * depth
        return reach_x, reach_y, reach_z

    def distance(self, position: Array) -> Array:
        """Return the exact signed distance."""
        reach = np.array(self.reach)
        from_middle = np.abs(position)
        beyond = from_middle - reach
        nearest_face = beyond.max(axis=1)
        inside = np.minimum(nearest_face, 0.0)
        way_outside = np.maximum(beyond, 0.0)
        x, y, z = way_outside.T
        square = x * x + y * y + z * z
        outside = np.sqrt(square)
        distance = outside + inside
        return np.asarray(distance)


@dataclass(frozen=True)
class Rod:
    """A round rod, that is a cylinder, whose length lies along a unit vector."""

    length: float  # extent along 'axis' [length]
    radius: float  # of its cross-section [length]
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0)  # unit vector

    @property
    def measure(self) -> float:
        """Pi times the radius squared times the length."""
        r = self.radius
        cross_section = math.pi * r * r
        return cross_section * self.length

    @property
    def reach(self) -> tuple[float, float, float]:
        """Half the bounding box of the turned rod."""
        x, y, z = self.axis
        reach_x = self._reach_along(x)
        reach_y = self._reach_along(y)
        reach_z = self._reach_along(z)
        return reach_x, reach_y, reach_z

    def _reach_along(self, component: float) -> float:
        square_cosine = component * component
        square_sine = 1.0 - square_cosine
        square_sine = max(0.0, square_sine)
        sine = math.sqrt(square_sine)
        half_length = 0.5 * self.length
        reach_of_axis = half_length * abs(component)
        reach_of_disc = self.radius * sine
        return reach_of_axis + reach_of_disc

    def distance(self, position: Array) -> Array:
        """Return the exact signed distance."""
        x, y, z = position.T
        a, b, c = self.axis
        height = a * x + b * y + c * z
        square_from_centre = x * x + y * y + z * z
        square_height = height * height
        square = square_from_centre - square_height
        square = np.maximum(square, 0.0)
        # distances beyond the ends and beyond the side, negative between them
        half_length = 0.5 * self.length
        from_middle = np.abs(height)
        along = from_middle - half_length
        from_axis = np.sqrt(square)
        across = from_axis - self.radius
        farther = np.maximum(along, across)
        inside = np.minimum(farther, 0.0)
        along = np.maximum(along, 0.0)
        across = np.maximum(across, 0.0)
        square_outside = along * along + across * across
        outside = np.sqrt(square_outside)
        distance = outside + inside
        return np.asarray(distance)


def cube_root(value: float) -> float:
    """Return the cube root of a positive number by Newton's method.

    Only + - * / are used, so that the result has the same bits on every x86-64 Linux
    CPU.

    >>> cube_root(27.0)
    3.0
    """
    root = max(1.0, value)
    while True:
        cube = root * root * root
        excess = cube - value
        slope = 3.0 * root * root
        smaller = root - excess / slope
        if not smaller < root:
            return root
        root = smaller
