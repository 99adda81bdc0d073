"""Boxes of three dimensions in a picture: where a point stands, how deep it lies.

The view is orthographic, from the front, to the right and from above. The second axis
points up, the third one away from the viewer. Farther particles are painted first and
are paler.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import Box

Floats = NDArray[np.float64]

AZIMUTH = math.radians(28.0)  # of the viewer, from the front to the right
ELEVATION = math.radians(20.0)  # of the viewer, upwards

RIM = 0.03  # of the picture around the box, as a share of its side
PALEST = 0.4  # share of its own colour that the farthest particle keeps; paper the rest

SLICE = "across z, in the middle"
"""What a slice is, for titles and captions."""


@functools.cache
def _axes_of_view() -> Floats:
    """Return the unit vectors to the right, up and away, shape [3, axis]."""
    sine = math.sin(AZIMUTH)
    cosine = math.cos(AZIMUTH)
    tilt = math.sin(ELEVATION)
    level = math.cos(ELEVATION)
    right = (cosine, 0.0, sine)
    up = (-sine * tilt, level, cosine * tilt)
    away = (-sine * level, -tilt, cosine * level)
    return np.array([right, up, away])


class View:
    """How a box of three dimensions fills the unit square of a picture."""

    def __init__(self, box: Box) -> None:
        self._centre = box.centre
        corners = itertools.product(*box.bounds)
        self._corners = np.array(list(corners))
        from_centre = self._corners - self._centre
        seen = from_centre @ _axes_of_view().T
        reach = np.abs(seen).max(axis=0)  # right, up, away [length]
        self.scale = (0.5 - RIM) / float(reach[:2].max())
        """Side lengths of the picture per length of the box."""
        self._reach = float(reach[2])

    def place(self, position: NDArray[np.floating]) -> Floats:
        """Return where points stand in the picture, from (0, 0) at the lower left.

        Args:
            position: points [length], shape [..., axis].

        Returns:
            Shape [..., 2], in sides of the picture.
        """
        from_centre = np.asarray(position, np.float64) - self._centre
        seen = from_centre @ _axes_of_view()[:2].T
        return np.asarray(0.5 + self.scale * seen)

    def depth(self, position: NDArray[np.floating]) -> Floats:
        """Return how far away points lie, 0 at the nearest corner, 1 at the farthest.

        The points [length] have the shape [..., axis].
        """
        from_centre = np.asarray(position, np.float64) - self._centre
        away = from_centre @ _axes_of_view()[2]
        return np.asarray(np.clip(0.5 + 0.5 * away / self._reach, 0.0, 1.0))

    def edges(self) -> Iterator[tuple[Floats, bool]]:
        """Yield the edges of the box, shape [end, 2], and whether each lies in front.

        Edges at the nearest corner are in front of all particles.
        """
        corners = self._corners
        depths = self.depth(corners)
        nearest = int(np.argmin(depths))
        for pair in itertools.combinations(range(len(corners)), 2):
            ends = corners[list(pair)]
            is_different = ends[0] != ends[1]
            if np.count_nonzero(is_different) == 1:
                is_in_front = nearest in pair
                yield self.place(ends), is_in_front

    def wall(self, number: int) -> Floats:
        """Return the corners of a wall in the picture, around it, shape [4, 2].

        Walls are numbered left, right, bottom, top, front, back.
        """
        axis, side = divmod(number, 2)
        coordinate = self._corners[:, axis]
        ends = np.unique(coordinate)  # ascending
        corners = self._corners[coordinate == ends[side]]
        around = [0, 1, 3, 2]
        return self.place(corners[around])


def shade(colours: NDArray[np.floating], depth: Floats, paper: Floats) -> Floats:
    """Return colours that fade into paper with depth, shape [particle, channel].

    Args:
        colours: colour of each particle, shape [particle, channel].
        depth: how far away each lies, from 0 to 1, shape [particle].
        paper: colour of the background, shape [channel].
    """
    share = 1.0 - (1.0 - PALEST) * depth[:, None]
    return np.asarray(share * colours + (1.0 - share) * paper)
