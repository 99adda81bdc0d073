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
        radius_cubed = volume / (4.0 / 3.0 * math.pi)
        radius = cube_root(radius_cubed)
        return cls(radius)

    @property
    def measure(self) -> float:
        """Four thirds of pi times the radius cubed."""
        r = self.radius
        return 4.0 / 3.0 * math.pi * r * r * r

    @property
    def reach(self) -> tuple[float, float, float]:
        """The radius, three times."""
        return (self.radius, self.radius, self.radius)

    def distance(self, position: Array) -> Array:
        """Return the exact signed distance."""
        x, y, z = position.T
        from_centre = np.sqrt(x * x + y * y + z * z)
        return np.asarray(from_centre - self.radius)


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
        height_cubed = volume / (along_x * along_z)
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
        beyond = np.abs(position) - np.array(self.reach)
        inside = np.minimum(beyond.max(axis=1), 0.0)
        x, y, z = np.maximum(beyond, 0.0).T
        outside = np.sqrt(x * x + y * y + z * z)
        return np.asarray(outside + inside)


@dataclass(frozen=True)
class Rod:
    """A round rod, that is a cylinder, whose length lies along a unit vector."""

    length: float  # extent along 'axis' [length]
    radius: float  # of its cross-section [length]
    axis: tuple[float, ...] = (1.0, 0.0, 0.0)  # unit vector

    @property
    def measure(self) -> float:
        """Pi times the radius squared times the length."""
        r = self.radius
        return math.pi * r * r * self.length

    @property
    def reach(self) -> tuple[float, float, float]:
        """Half the bounding box of the turned rod."""
        x, y, z = self.axis
        reach_x = self._reach_along(x)
        reach_y = self._reach_along(y)
        reach_z = self._reach_along(z)
        return reach_x, reach_y, reach_z

    def _reach_along(self, component: float) -> float:
        square_sine = 1.0 - component * component
        square_sine = max(0.0, square_sine)
        sine = math.sqrt(square_sine)
        return 0.5 * self.length * abs(component) + self.radius * sine

    def distance(self, position: Array) -> Array:
        """Return the exact signed distance."""
        x, y, z = position.T
        a, b, c = self.axis
        height = a * x + b * y + c * z
        square = x * x + y * y + z * z - height * height
        square = np.maximum(square, 0.0)
        # distances beyond the ends and beyond the side, negative between them
        along = np.abs(height) - 0.5 * self.length
        across = np.sqrt(square) - self.radius
        inside = np.minimum(np.maximum(along, across), 0.0)
        along = np.maximum(along, 0.0)
        across = np.maximum(across, 0.0)
        return np.asarray(np.sqrt(along * along + across * across) + inside)


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
