"""Lengths of data from elsewhere: how they fit the unit box, and how far particles are apart."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import UsageError

__all__ = ["Box", "Measure", "estimate_spacing"]

Box = tuple[tuple[float, float], tuple[float, float]]

WIDE = 3.0
"""Radii within which neighbours are counted to estimate the spacing."""


@dataclass(frozen=True, kw_only=True)
class Measure:
    """How lengths of the source become lengths of the unit box: ``(x - corner) / scale``.

    A scale that is a power of two, with the corner 0, loses no bit.
    """

    scale: float = 1.0
    corner: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def fitting(cls, bounds: Box) -> Measure:
        """Return the measure by which a box fits into the unit box.

        The scale is the least power of two that holds it; the corner stays 0 where that is enough.
        """
        low, high = np.array(bounds, dtype=np.float64).T
        corner = np.where((low >= 0.0) & (high <= _power(float(high.max()))), 0.0, low)
        corner = corner if not corner.any() else low
        scale = _power(float((high - corner).max()))
        return cls(scale=scale, corner=(float(corner[0]), float(corner[1])))

    @property
    def is_plain(self) -> bool:
        """Whether nothing changes."""
        return self.scale == 1.0 and not any(self.corner)

    def place(self, position: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return positions in the unit box, float32."""
        moved = position
        if not self.is_plain:
            moved = (position.astype(np.float64) - self.corner) / self.scale
        with np.errstate(over="ignore"):  # what is beyond float32 becomes infinite
            return moved.astype(np.float32, copy=False)

    def box(self, bounds: Box) -> Box:
        """Return a box of the source in the unit box."""
        (left, right), (bottom, top) = (
            tuple((value - corner) / self.scale for value in pair)
            for pair, corner in zip(bounds, self.corner, strict=True)
        )
        return (left, right), (bottom, top)


def _power(length: float) -> float:
    """Return the least power of two that is not below a length, at least 1."""
    return 2.0 ** max(0, math.ceil(math.log2(length))) if length > 1.0 else 1.0


def estimate_spacing(position: NDArray[np.floating], radius: float) -> float:
    """Return the distance of neighbouring particles ``sqrt(area / particles)``.

    The density deep inside the material is that within three radii of a particle, where the
    upper quartile over particles leaves surfaces out.

    Args:
        position: one frame, shape [particle, 2].
        radius: connectivity radius, same unit.

    Raises:
        UsageError: most particles have no neighbour there.
    """
    from scipy.spatial import cKDTree

    points = position.astype(np.float64)
    reach = WIDE * radius
    counts = cKDTree(points).query_ball_point(points, reach, return_length=True)
    inside = float(np.quantile(counts, 0.75))
    if inside < 2.0 and len(points) > 1:  # a particle counts itself
        raise UsageError(
            "particles have no neighbours: their spacing cannot be estimated",
            where="--radius",
            expected=f"neighbours within {WIDE:g} radii",
            got=radius,
            fix="a larger --radius, or say how far particles are apart: --spacing",
        )
    return math.sqrt(math.pi * reach**2 / inside)
