"""A fixed round obstacle in a full box: a disc in the plane, a ball in space.

NumPy only: a split can be drawn, inspected and tested without Taichi.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Obstacle", "is_inside"]

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Obstacle:
    """A disc or ball that never moves, and the particles that it is made of.

    Its particles have the mass of a fluid particle and no velocity. They fill the
    nodes inside, so that the fluid beside the obstacle feels neither a hole in the
    density nor one in the pressure.
    """

    centre: tuple[float, ...]  # [length], shape [axis]
    radius: float  # [length]
    position: Array  # of its particles [length], shape [particle, axis]


def is_inside(
    points: Array, centre: Sequence[float] | Array, radius: float
) -> NDArray[np.bool_]:
    """Tell which points lie less than a radius away from a centre.

    Args:
        points: points [length], shape [..., axis].
        centre: [length], shape [axis].
        radius: [length].
    """
    square = np.zeros(points.shape[:-1])
    for axis, middle in enumerate(centre):
        way = points[..., axis] - middle
        square += way * way
    return np.asarray(square < radius * radius)
