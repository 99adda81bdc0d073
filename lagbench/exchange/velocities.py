"""Velocities of a user's trajectory beside the motion of its particles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import DataError

SLOWEST = 0.25
FASTEST = 4.0
"""Least and greatest speed over that of the motion, as root mean squares.

Between two frames a particle may turn, so that it is faster than its displacement.
"""

LEAST_COSINE = 0.25
"""Least cosine of the angle between velocities and motion, over all particles."""

AT_REST = 1e-7
"""Root mean square step under which particles rest, as float32 rounds [length]."""


@dataclass
class MotionCheck:
    """Sums of velocities v and motion ``d = (x(f) - x(f-1)) / dt`` of a trajectory."""

    rate: float  # frames per second [1/s]
    count: int = 0  # components that were added
    product: float = 0.0  # sum of v d [length^2/s^2]
    velocity_square: float = 0.0  # sum of v^2 [length^2/s^2]
    motion_square: float = 0.0  # sum of d^2 [length^2/s^2]

    def add(self, velocity: NDArray[np.float32], step: NDArray[np.float64]) -> None:
        """Add a frame.

        Args:
            velocity: v(f) [length/s], shape [particle, axis].
            step: x(f) - x(f-1) [length], shape [particle, axis].
        """
        motion = step * self.rate
        self.count += motion.size
        self.product += float(np.sum(velocity * motion))
        self.velocity_square += float(np.sum(velocity.astype(np.float64) ** 2))
        self.motion_square += float(np.sum(motion**2))

    def finish(self, *, where: str) -> None:
        """Refuse velocities that contradict the motion.

        Raises:
            DataError: they are of another size or direction.
        """
        if not self.count:
            return
        speed = math.sqrt(self.velocity_square / self.count)
        motion = math.sqrt(self.motion_square / self.count)
        at_rest = AT_REST * self.rate
        if speed <= at_rest and motion <= at_rest:
            return
        ratio = math.inf
        cosine = 0.0
        if motion > at_rest:
            ratio = speed / motion
        if speed > 0.0 and motion > 0.0:
            cosine = self.product / self.count / (speed * motion)
        if SLOWEST <= ratio <= FASTEST and cosine >= LEAST_COSINE:
            return
        raise DataError(
            "velocities contradict the motion of the particles",
            where=where,
            expected=f"velocities [length/s] like (x(f) - x(f-1)) / frame interval: "
            f"{SLOWEST:g} to {FASTEST:g} times as fast, cosine >= {LEAST_COSINE:g}",
            got=f"{ratio:.3g} times as fast, cosine {cosine:.3g}",
            fix="give them per second, in the length of the positions, or mend "
            "--frame-interval; or leave them out: they are then those differences",
        )
