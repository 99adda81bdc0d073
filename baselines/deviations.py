"""Standard deviations by which models divide.

The deviation of a component that never varies is exactly 0. Another number has to stand
in its place.
"""

from __future__ import annotations

import math
from collections.abc import Sequence


def root_mean_square(deviations: Sequence[float]) -> float:
    """Return the deviation of one component, from those along each axis.

    It is 1 where nothing varies.
    """
    mean_square = math.fsum(std * std for std in deviations) / len(deviations)
    return math.sqrt(mean_square) or 1.0


def replace_zeros(deviations: Sequence[float]) -> tuple[float, ...]:
    """Return deviations by which numbers can be divided.

    The root mean square of all stands in place of a 0, and 1 where nothing varies.
    """
    if all(deviation != 0.0 for deviation in deviations):
        return tuple(deviations)
    typical = root_mean_square(deviations)
    return tuple(std or typical for std in deviations)
