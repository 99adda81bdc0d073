"""Particles that jump through a periodic boundary that nobody stated."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import AXES
from lagbench.errors import DataError

from .trajectory import bounds_example

CROSSING = 0.5
"""Step beyond which a particle crossed a periodic boundary, over the box's length."""

CROSSING_MEDIAN = 0.1
"""The median step of particles that follow a flow is less, over the box's length."""

FEWEST_CROSSINGS = 3
"""Particles that must cross at once before data count as periodic."""


class CrossingCheck:
    """Finds the axes along which a few particles move more than half the box.

    Most particles hardly move there. A trajectory may cross one boundary long before
    another, so all its frames are looked at before an error names the axes.
    """

    def __init__(self, *, periodic: Sequence[str]) -> None:
        self._periodic = periodic  # names of the axes that are stated to be periodic
        # by axis: the first frame with jumps, how many particles jump, and of how many
        self._jumps: dict[str, tuple[int, int, int]] = {}
        self._dimension = 2  # components of a step

    @property
    def has_any(self) -> bool:
        """Whether particles jumped along an axis."""
        return bool(self._jumps)

    def add(
        self, step: NDArray[np.float64], lengths: NDArray[np.float64], *, frame: int
    ) -> None:
        """Look at the steps to a frame.

        Args:
            step: displacements since the frame before [length], [particle, axis].
            lengths: lengths of the box, or of the region of all positions [length],
                [axis]; an axis of length 0 has no crossings.
            frame: number of the frame.
        """
        self._dimension = step.shape[1]
        share = np.abs(step) / np.where(lengths > 0.0, lengths, np.inf)
        for axis, name in enumerate(AXES[: self._dimension]):
            crossing_count = int(np.count_nonzero(share[:, axis] > CROSSING))
            moves_little = np.median(share[:, axis]) < CROSSING_MEDIAN
            if crossing_count >= FEWEST_CROSSINGS and moves_little:
                self._jumps.setdefault(name, (frame, crossing_count, len(step)))

    def finish(self, *, where: str) -> None:
        """Refuse a trajectory with such steps.

        Raises:
            DataError: particles jump; the message names all axes.
        """
        if not self._jumps:
            return
        names = [name for name in AXES if name in {*self._jumps, *self._periodic}]
        places = []
        counts = []
        for name, (frame, crossing_count, particle_count) in self._jumps.items():
            places.append(f"frame {frame} along {name}")
            counts.append(f"{crossing_count} of {particle_count} along {name}")
        raise DataError(
            "particles jump by more than half the box",
            where=f"{where}, {' and '.join(places)}",
            expected="steps much shorter than the box, as of most particles",
            got=f"particles that jump: {', '.join(counts)}",
            fix=f"if the box is periodic: --periodic {','.join(names)} with the ends "
            f"of the box, as in {bounds_example(self._dimension)}",
        )
