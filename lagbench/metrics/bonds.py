"""Which particles of a body are neighbours at first, and which still are."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["STRETCH", "Bonds"]

Floats = NDArray[np.float64]

STRETCH = 2.0
"""A bond holds while its length is within this multiple of the first one."""


@dataclass(frozen=True)
class Bonds:
    """Pairs of neighbouring particles of a body."""

    pairs: NDArray[np.intp]  # numbers of the particles within the body, shape [pair, 2]
    reach: Floats  # greatest length at which each bond holds [length], shape [pair]

    @classmethod
    def within(cls, radius: float, position: Floats) -> Bonds:
        """Return the bonds of particles closer than a radius.

        Args:
            radius: greatest distance of neighbours [length].
            position: first positions of the body [length], shape [particle, 2].
        """
        from scipy.spatial import cKDTree  # a fifth of a second that splits without bodies save

        found = cKDTree(position).query_pairs(radius, output_type="ndarray")
        pairs = np.asarray(found, np.intp).reshape(-1, 2)
        return cls(pairs, STRETCH * np.sqrt(_squared_lengths(position, pairs)))

    def share_held(self, position: Floats) -> float:
        """Return the share of bonds that hold at these positions [1]; NaN if there are none."""
        if not len(self.pairs):
            return math.nan
        return float(np.mean(_squared_lengths(position, self.pairs) <= self.reach**2))


def _squared_lengths(position: Floats, pairs: NDArray[np.intp]) -> Floats:
    gap = position[pairs[:, 0]] - position[pairs[:, 1]]
    return np.asarray(gap[:, 0] ** 2 + gap[:, 1] ** 2, np.float64)
